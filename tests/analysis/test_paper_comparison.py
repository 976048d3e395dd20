"""What stands beside the paper's numbers on the page of results."""

import pytest

from manifeel_ms3.analysis.paper import RUNTIME_DEMOS, TACRGB
from manifeel_ms3.analysis.paper_comparison import gpu_of_training, runtime_table
from manifeel_ms3.evaluation.result import results_in

from .made_up import TOTAL_STEPS, write_run


@pytest.mark.parametrize(("processes", "minutes", "rate"), [({}, "50.0", "8.0"), (dict(num_processes=2), "25.0", "16.0")])
def test_minutes_of_an_epoch_count_the_samples_of_all_processes(processes, minutes, rate, tmp_path):
    timed = dict(num_samples=24_000, batch_size=8, training_seconds=float(TOTAL_STEPS))
    timed |= dict(device="cuda", trained_on=dict(gpu="A30", cpu="EPYC", cores=16))
    write_run(tmp_path, TACRGB, 0.5, task="BallSorting", checkpoints=1, num_demos=RUNTIME_DEMOS, **timed, **processes)
    (row,) = (line for line in runtime_table(list(results_in(tmp_path).values())).splitlines() if "A30 |" in line)
    assert [cell.strip() for cell in row.split("|")][3:6] == [minutes, rate, "A30"]


@pytest.mark.parametrize(("device", "gpu"), [("cpu", None), ("cuda", "A30"), ("cuda:1", "A30")])
def test_a_cpu_that_trains_beside_a_gpu_is_not_taken_for_it(device, gpu):
    assert gpu_of_training(dict(device=device, trained_on=dict(gpu="A30", cpu="EPYC", cores=16))) == gpu
