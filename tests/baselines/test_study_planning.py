"""Studies: read, checked and planned, with the commands that they print and the hours that they foretell."""

import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

from baselines.common.dataset import SequenceDataset
from baselines.common.observation import observation_spec
from baselines.common.train_args import planned_steps
from baselines.registry import policy_spec, preset_cli
from baselines.studies import __main__ as study_command
from baselines.studies import cost, running
from baselines.studies.checks import require_valid_flags
from baselines.studies.command_lines import shell_command, training_args
from baselines.studies.planning import Job, jobs_of, only
from baselines.studies.study import OF_THE_STUDY, Resources, StudyError, read_study
from baselines.studies.work import AMOUNT_FLAGS
from baselines.tactile_representations.pretrain import Args as PretrainArgs
from docs import make_readme_results
from manifeel_ms3 import cli
from manifeel_ms3.analysis.condition import Condition, condition_of
from manifeel_ms3.analysis.matching import as_the_paper_says
from manifeel_ms3.analysis.paper import paper_condition, reported
from manifeel_ms3.analysis.paper_claims import comparisons
from manifeel_ms3.analysis.presets import row_in_a_study, training_settings_of
from manifeel_ms3.errors import MachineError, UnknownNameError
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.nested_settings import as_json
from manifeel_ms3.tasks.registry import task_spec, tasks_of_table
from tests.tiny_study import TINY

REPOSITORY = Path(__file__).parents[2]


def test_every_combination_is_planned_once(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text("""
grids:
  - {tasks: [ManiFeel-PegInsertion-v1, ManiFeel-BallSorting-v1], obs_modes: [rgb, rgb+tacrgb], encoders: ["", t3],
     encoder_flags: {t3: {image-size: 224}}, seeds: [0, 1]}
  - {tasks: [ManiFeel-PegInsertion-v1], obs_modes: [rgb], seeds: [0]}
""")
    jobs = jobs_of(read_study(path))
    kinds = [job.kind for job in jobs]
    # two tasks and two seeds: rgb, and rgb+tacrgb with two encoders
    assert (kinds.count("record"), kinds.count("train"), kinds.count("evaluate")) == (2, 12, 12)
    touched = [job for job in jobs if job.settings.get("flags", {}).get("policy.encoder.tacrgb") == "t3"]
    assert len(touched) == 4
    assert all(job.settings["flags"]["image-size"] == 224 for job in touched)
    assert {job.settings["camera"] for job in jobs if job.kind == "record"} == {"wrist", "front"}
    assert len({job.key for job in jobs}) == len(jobs)


def test_five_jobs_share_a_gpu_of_which_each_takes_a_fifth(study, monkeypatch):
    monkeypatch.setattr(running.ray, "cluster_resources", lambda: dict(CPU=8.0, GPU=1.0))
    tiny = replace(read_study(study), resources=dict(record=Resources(cpus=1, gpus=0.2)))
    job = jobs_of(tiny)[0]
    assert running._next_job(tiny, set(), [job], dict.fromkeys("abcd", job)) is job
    assert running._next_job(tiny, set(), [job], dict.fromkeys("abcde", job)) is None
    assert running._next_job(tiny, {job.key}, [job], {}) is None  # another study does it


def test_other_looks_are_further_evaluations_of_the_same_policies():
    jobs = jobs_of(read_study(REPOSITORY / "configs/perturbation.yaml"))
    evaluated = {}
    for job in jobs:
        if job.kind == "evaluate":
            evaluated.setdefault(job.needs[0].key, []).append(json.loads(job.settings["env_kwargs"]))
    assert set(evaluated) == {job.key for job in jobs if job.kind == "train"}
    for arguments in evaluated.values():
        assert arguments[0] == {}
        assert [list(other) for other in arguments[1:]] == [["visual_randomization"]] * 8
    assert all(job.settings["env_kwargs"] == "{}" for job in jobs if job.kind == "record")


def test_a_job_is_named_by_all_that_it_depends_on(study):
    keys = {job.kind: job.key for job in jobs_of(read_study(study))}
    study.write_text(TINY.replace("demos: 1", "demos: 2"))
    other = {job.kind: job.key for job in jobs_of(read_study(study))}
    assert all(keys[kind] != other[kind] for kind in keys)  # other data: another policy, another result
    study.write_text(TINY.replace("episodes: 1", "episodes: 2"))
    other = {job.kind: job.key for job in jobs_of(read_study(study))}
    assert [keys[kind] == other[kind] for kind in ("record", "train", "evaluate")] == [True, True, False]


def test_a_run_is_the_same_job_however_its_flags_are_written(study):
    keys = [job.key for job in jobs_of(read_study(study))]
    for short, long in ((" {steps", " {total-iters"), ("save-every", "save_freq"), ("batch-size", "batch_size")):
        study.write_text(TINY.replace(short, long))
        assert [job.key for job in jobs_of(read_study(study))] == keys


def test_a_run_is_the_same_job_however_its_task_and_observations_are_written(study):
    content = "grids: [{tasks: [TASK], obs_modes: [MODE], seeds: [0], pretrain: {unit: OTHER}, encoders: [unit]}]"
    usual = content.replace("TASK", "ManiFeel-PegInsertion-v1").replace("MODE", "rgb+tacrgb+tacff")
    study.write_text(usual.replace("OTHER", "ManiFeel-NutBoltAssembly-v1"))
    keys = [job.key for job in jobs_of(read_study(study))]
    assert len(keys) == 5  # two recordings, a pretraining, a training and its evaluation
    for task in ("PegInsertion", "manifeel_ms3:ManiFeel-PegInsertion-v1"):
        written = content.replace("TASK", task).replace("MODE", "tacff+rgb+tacrgb")
        study.write_text(written.replace("OTHER", "NutBoltAssembly"))
        assert [job.key for job in jobs_of(read_study(study))] == keys


def test_flags_that_are_on_or_off_reach_the_training(study):
    on_and_off = "policy.encoder.freeze-tacrgb: true, policy.public-code: false, compile: true"
    study.write_text(
        f"grids: [{{tasks: [ManiFeel-PegInsertion-v1], policies: [flow_matching], train: {{{on_and_off}}}, seeds: [0]}}]"
    )
    jobs = jobs_of(read_study(study))
    require_valid_flags(jobs)
    args = next(training_args(job) for job in jobs if job.kind == "train")
    assert (args.policy.encoder.freeze_tacrgb, args.policy.public_code, args.compile) == (True, False, True)


@pytest.mark.parametrize("flags", ["no-such: 3", "batch-size: many", "policy.pred-horizon: 2"])
def test_a_flag_that_no_training_takes_is_refused_before_any_job_begins(study, flags, tmp_path, capsys):
    study.write_text(TINY.replace("batch-size: 4", flags))
    with pytest.raises(StudyError, match="does not take one of its flags"):
        study_command.main(study_command.Args(study, root=tmp_path / "root"))
    assert not list(tmp_path.glob("root/*/*"))
    assert flags.partition(":")[0].removeprefix("policy.").replace("-", "_") in capsys.readouterr().err.replace("-", "_")


def test_flags_of_evaluations_that_a_study_does_itself_are_refused_before_any_job_begins(study, tmp_path):
    study.write_text(TINY.replace("batch-size: 4", "capture-video: true"))
    with pytest.raises(StudyError, match="--capture-video without --num-eval-episodes"):
        study_command.main(study_command.Args(study, root=tmp_path / "root"))
    assert not list(tmp_path.glob("root/*/*"))


def test_numbers_that_no_training_can_meet_are_refused_before_any_job_begins(study, tmp_path):
    study.write_text(TINY.replace("batch-size: 4", "image-size: 0"))
    with pytest.raises(StudyError, match=r"seed 0: --image-size 0 must be at least 1.*correct `train` or `encoder_flags`"):
        study_command.main(study_command.Args(study, root=tmp_path / "root"))
    assert not list(tmp_path.glob("root/*/*"))


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("task_args: {randomization: {socket: 0.0}}", r"1 demonstrations: randomization\['socket'\] is unknown"),
        ("task_args: {sensor_configs: {wirst: {fov: 1.0}}}", r"sensor_configs\['wirst'\] is neither a sensor"),
        ("evaluation_args: [{}, {tactile: {units: grams}}]", "seed 0, .*: units='grams' is unknown; choose from .*newton"),
    ],
)
def test_arguments_that_a_task_does_not_take_are_refused_before_any_job_begins(study, argument, said, tmp_path):
    lines = [f"    {argument}" if "task_args" in line else line for line in TINY.splitlines()]
    study.write_text("\n".join(lines))
    with pytest.raises(StudyError, match=rf"PegInsertion, .*{said}.*; correct `task_args` or `evaluation_args`"):
        study_command.main(study_command.Args(study, root=tmp_path / "root"))
    assert not list(tmp_path.glob("root/*/*"))


@pytest.mark.parametrize("path", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_study_is_planned_and_costed(path, tmp_path):
    study = read_study(path)
    jobs = jobs_of(study)
    pretrained = {"pretrain"} if any(grid.pretrain for grid in study.grids) else set()
    assert {job.kind for job in jobs} == {"record", "train", "evaluate"} | pretrained
    needs = [study.resources[job.kind] for job in jobs]
    trials = [trial for job, own in zip(jobs, needs, strict=True) for trial in cost.trials_of(job, own.workers, own.gpus)]
    measured = {trial.key: dict(seconds=0.5) for trial in trials}  # the trials themselves: the tests below
    (tmp_path / cost.TRIALS).write_text(json.dumps(measured))
    table = study_command.plan(study, jobs, tmp_path)
    assert table.row_count == len({(job.kind, job.row) for job in jobs}) + 1
    assert list(table.columns[1].cells)[-1] == "all jobs that are left whose cost is known"
    assert float(list(table.columns[3].cells)[-1]) > 0
    on_gpus = float(list(table.columns[4].cells)[-1]) > 0
    assert ("no CUDA GPU" in str(table.caption)) == (on_gpus and not torch.cuda.is_available())
    assert {json.dumps(trial.arguments) for trial in trials if trial.measure is cost.gradient_step}
    for job in jobs:
        if job.kind == "train":
            training_args(job)  # the trainer knows the flags


def test_a_table_of_the_paper_stands_for_its_tasks(study):
    study.write_text("grids: [{tasks: table I, num_demos: [50]}]")
    (grid,) = read_study(study).grids
    assert list(grid.tasks) == tasks_of_table("I")
    trainings = [job.settings["flags"] for job in jobs_of(read_study(study)) if job.kind == "train"]
    assert len(trainings) == 9 * 3 * 3
    counts = {flags["env-id"]: flags.get("num-demos") for flags in trainings}
    assert counts["ManiFeel-GearAssembly-v1"] == 50
    assert counts["ManiFeel-BulbInstallation-v1"] is None  # the paper recorded 20: all are used


def test_the_papers_studies_answer_every_claim_and_every_cell_of_its_tables():
    """Each condition of the paper is planned with its settings, as a result of the study would be collected."""
    planned = {_condition_planned(job) for job in jobs_of(read_study(REPOSITORY / "configs/paper.yaml")) if job.kind == "train"}
    wanted = {condition for _, condition, _ in reported()}
    wanted |= {side for comparison in comparisons() for side in (comparison.first, comparison.second)}
    wanted |= {paper_condition("ObjectSearch", "rgb", camera="wrist", variant=dict(lighting="dim"))}
    missing = sorted(map(str, wanted - planned))
    assert missing == []


def test_the_small_networks_study_makes_every_published_result():
    """Each published condition and training seed is one of the study that the page of results names."""
    results = results_in(*make_readme_results.RESULTS).values()
    published = {(_without_settings(condition_of(result)), result["config"]["seed"]) for result in results}
    planned, rows = set(), set()
    for job in jobs_of(read_study(REPOSITORY / "configs/tables_cpu.yaml")):
        if job.kind == "train":
            planned.add((_without_settings(_condition_of_training(job)), training_args(job).seed))
            rows.add(job.row)
            assert row_in_a_study(_condition_of_training(job)) == job.row
    assert len(published) > 100
    assert sorted(map(str, published - planned)) == []
    assert sorted({str(row_in_a_study(condition_of(result))) for result in results} - rows) == []


def test_some_rows_of_a_study_bring_the_jobs_that_they_need(study, capsys, tmp_path):
    study.write_text("""
grids:
  - &row {tasks: [ManiFeel-PegInsertion-v1], obs_modes: [rgb, rgb+tacff], seeds: [0, 1], preset: cpu}
  - {<<: *row, preset: cpu_targets, task_args: {tactile: {units: tacsl}}}
""")
    row = 'PegInsertion, {"tactile": {"units": "tacsl"}}, diffusion_policy, cpu_targets, rgb+tacff, wrist, 50 demonstrations'
    jobs = only(jobs_of(read_study(study)), [row])
    assert [job.kind for job in jobs] == ["record", *["train", "evaluate"] * 2]
    assert {job.title for job in jobs[1:]} == {f"{row}, seed 0", f"{row}, seed 1"}
    study_command.main(study_command.Args(study, tmp_path, only=(row,), print_commands=True))
    assert len(re.findall(r"manifeel train diffusion_policy cpu_targets .*--obs-mode rgb\+tacff", capsys.readouterr().out)) == 2
    with pytest.raises(UnknownNameError, match=r"no row of the study is named 'PegInsertion, rgb'.*--dry-run lists all rows"):
        study_command.main(study_command.Args(study, tmp_path, only=("PegInsertion, rgb",)))
    with pytest.raises(UnknownNameError, match=r"did you mean 'PegInsertion, diffusion_policy, cpu, rgb, wrist, 50 demon"):
        only(jobs_of(read_study(study)), ["PegInsertion, diffusion_policy, cpu, rgb, wrist"])


def _without_settings(condition: Condition) -> tuple[Condition, str]:
    """A condition without its settings, and the preset that they come from."""
    return replace(condition, settings=()), training_settings_of(condition).preset


def _condition_planned(job: Job) -> Condition:
    condition = _condition_of_training(job)
    assert str(training_settings_of(condition)) in ("paper", "paper, precision bf16"), condition
    return as_the_paper_says(condition)


def _condition_of_training(job: Job) -> Condition:
    args, record = training_args(job), job.needs[0]
    sensing = dict(cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors))
    learning_rate = args.lr or args.public_code_lr()
    config = as_json(args) | dict(lr=learning_rate, num_demos=args.num_demos or record.settings["num"])
    kwargs = json.loads(record.settings["env_kwargs"]) | sensing
    policy, revision = job.settings["policy"], task_spec(args.env_id).revision
    result = dict(
        env_id=args.env_id, env_kwargs=kwargs, obs_mode=args.obs_mode, policy=policy, config=config, revision=revision
    )
    return condition_of(result)


def test_an_encoder_is_pretrained_once_and_the_policies_start_from_it(tmp_path):
    jobs = jobs_of(read_study(REPOSITORY / "configs/representation.yaml"))
    (pretrain,) = (job for job in jobs if job.kind == "pretrain")
    (record,) = pretrain.needs
    assert record.settings["env_id"] == "ManiFeel-NutBoltAssembly-v1"
    of_table_one = {job.key for job in jobs_of(read_study(REPOSITORY / "configs/modality.yaml"))}
    assert record.key in of_table_one  # the recording that Table I needs anyway
    trained = [job for job in jobs if job.kind == "train" and job.settings["flags"]["policy.encoder.tacrgb"] == "unit"]
    assert len(trained) == 12
    for job in trained:
        assert pretrain in job.needs
        assert training_args(job, tmp_path).tacrgb_weights == tmp_path / f"pretrain/{pretrain.key}/weights.safetensors"
    words = shlex.split(shell_command(pretrain, tmp_path, Resources()))
    assert words[:4] == ["python", "-m", "baselines.tactile_representations.pretrain", "unit"]
    args = tyro.cli(PretrainArgs, args=words[3:])
    assert args.demos == (record.folder(tmp_path) / "trajectory.h5",)
    assert cost.estimate(pretrain, tmp_path, 1) is None
    assert jobs.index(record) < jobs.index(pretrain) < min(map(jobs.index, trained))


@pytest.mark.parametrize("gpus", [0, 0.5])
def test_a_job_without_a_gpu_stays_on_the_cpu_of_a_machine_with_one(gpus, tmp_path):
    """Ray hides GPUs only from jobs that ask for a share of them."""
    jobs = jobs_of(read_study(REPOSITORY / "configs/representation.yaml"))
    for job in jobs:
        words = shlex.split(shell_command(job, tmp_path, Resources(gpus=gpus)))
        told = "--device" in words
        assert told == (gpus == 0 and job.kind != "record"), words
        assert not told or words[words.index("--device") + 1] == "cpu"
        if job.kind == "train" and not gpus:
            args = training_args(job, tmp_path)
            assert (args.device, args.precision, args.compile) == ("cpu", "fp32", False)


def test_encoders_of_table_three_have_equal_demonstrations():
    jobs = jobs_of(read_study(REPOSITORY / "configs/representation.yaml"))
    trained = [job for job in jobs if job.kind == "train"]
    assert {_condition_planned(job).num_demos for job in trained} == {50}
    trained = [training_args(job) for job in trained]
    assert {(args.image_size, args.policy.encoder.image) for args in trained} == {
        (256, "resnet18")
    }  # the camera stays as it is


def test_the_printed_commands_do_the_same(study, tmp_path, capsys):
    jobs = jobs_of(read_study(study))
    study_command.main(study_command.Args(study, tmp_path, print_commands=True))
    lines = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("#")]
    assert lines == [shell_command(job, tmp_path, Resources()) for job in jobs]
    record, train = (shlex.split(line) for line in lines[:2])
    assert record[:2] == ["manifeel", "record"]
    recording = tyro.cli(cli.command_module("record").Args, args=record[2:])
    assert recording.out == jobs[0].folder(tmp_path) / "trajectory.h5"
    assert train[:3] == ["manifeel", "train", "diffusion_policy"]
    training = tyro.cli(cli.command_module("train").Args, args=train[2:])
    assert training == training_args(jobs[1], tmp_path)
    assert training.demos == (recording.out,)


@pytest.mark.parametrize("half_precision", [False, True])
def test_the_printed_evaluation_does_the_same(study, tmp_path, half_precision):
    study.write_text(TINY.replace("half_precision: true", f"half_precision: {half_precision}"))
    root = tmp_path / "root of a study"
    *_, train, evaluate = jobs_of(read_study(study))
    (root / "train" / train.key / "checkpoints/00000006").mkdir(parents=True)
    (root / "train" / train.key / "checkpoints/last").mkdir()  # not a checkpoint of its own
    printed = 'printf "%s\\n" "$#" "$@"'  # the words of each command, one a line
    shown = f"manifeel() {{ {printed}; }}; python() {{ {printed}; }}; {shell_command(evaluate, root, Resources())}"
    lines = subprocess.run(["bash", "-c", shown], capture_output=True, text=True, check=True).stdout.splitlines()
    commands = []
    while lines:
        count = int(lines[0])
        commands.append(lines[1 : 1 + count])
        lines = lines[1 + count :]
    *before, (name, *words) = commands
    assert name == "eval"
    checkpoint = trained = root / "train" / train.key / "checkpoints/00000006"
    if half_precision:
        ((*module, source, out, checkpoint),) = before
        assert (module, source, out) == (["-m", "baselines.studies.half_precision"], str(trained), "--out")
        assert Path(checkpoint) == root / "evaluate" / evaluate.key / "checkpoints/00000006"
    else:
        assert before == []
    evaluation = tyro.cli(cli.command_module("eval").Args, args=words)
    assert json.loads(evaluation.env_kwargs)["fit"] == "paper"
    assert evaluation.out == root / "evaluate" / evaluate.key / "00000006.json"
    assert evaluation.checkpoint == Path(checkpoint)


def test_flags_that_a_study_treats_apart_are_flags_of_training(capsys):
    """A flag that is renamed must be renamed in these lists, too."""
    with pytest.raises(SystemExit):
        preset_cli(policy_spec("diffusion_policy"), ["cpu", "--help"])
    known = set(re.findall(r"--[\w.-]+", capsys.readouterr().out))
    assert known >= {f"--{name}" for name in (*OF_THE_STUDY, *AMOUNT_FLAGS)}


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("grids: [", "cannot be read as a study"),
        ("[1, 2]", "is not a study"),
        ("grids: []", "has no grids"),
        (
            "grids: [{tasks: [ManiFeel-Knitting-v1]}]",
            r"'ManiFeel-Knitting-v1' is not registered; registered are \['ManiFeel-Peg",
        ),
        ("grids: [{tasks: table IX}]", r"no task is in table 'IX' of the paper; its tables are \['I', 'II', 'III'\]"),
        (
            "grids: [{tasks: table I, policies: [knitting]}]",
            r"'knitting' is not registered; registered are \['diffusion_policy', 'equivariant_diffusion_policy', 'flow_",
        ),
        (
            "grids: [{tasks: table I, preset: fast}]",
            r"tiny\.yaml: grids/0: preset of diffusion_policy='fast' is unknown; choose from \['paper', 'cpu'",
        ),
        ("grids: [{tasks: table I, seeds: [0, 1099511627776]}]", r"seed=\(0, 1099511627776\) must be a whole number from 0"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], num_demos: [900]}]", r"num_demos \[900\] are more than the 50 recorded"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], seeds: 3}]", "`seeds` has the wrong type: 3"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], demos: true}]", "`demos` has the wrong type: True"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], seeds: [false]}]", r"`seeds` has the wrong type: \[False\]"),
        ("grids: {tasks: table I}", "`grids` has the wrong type"),
        ("grids: [{tasks: table I, episodes: 0}]", "grids/0: `episodes` is 0; at least 1 is needed"),
        ("grids: [{tasks: table I, checkpoints: -2}]", "`checkpoints` is -2; at least 1 is needed"),
        ("grids: [{tasks: table I, demos: 0}]", "`demos` is 0; at least 1 is needed"),
        ("grids: [{tasks: table I, num_demos: [null, 5, 0]}]", "`num_demos` is 0; at least 1 is needed"),
        ("grids: [{tasks: table I, policies: []}]", "`policies` is empty, so that there would be no job"),
        ("grids: [{tasks: []}]", "`tasks` is empty, so that there would be no job"),
        ("grids: [{tasks: table I}]\nresources: {train: {cpus: 0}}", "resources/train: `cpus` is 0; at least 0.1 is needed"),
        (
            "grids: [{tasks: table I}]\nresources: {train: {gpus: 1.5}}",
            "`gpus` is 1.5; give a whole number, or a share of one GPU",
        ),
        (
            "grids: [{tasks: table I, encoders: [t3], encoder_flags: {T3: {image-size: 224}}}]",
            r"encoder_flags and pretrain name \['T3'\]; `encoders` are \['t3'\]",
        ),
        ("grids: [{tasks: table I}]\nresources: {train: {gpus: .nan}}", "resources/train: `gpus` is nan; at least 0 is needed"),
        (
            "grids: [{tasks: table I}]\nresources: {record: {cpus: .inf}}",
            "`cpus` is inf; at least 0.1 is needed",
        ),
        (
            "grids: [{tasks: table I, obs_modes: [rgb, rgb+tacrbg]}]",
            "grids/0: obs_mode=.*: token 'tacrbg' is unknown",
        ),
        (
            "grids: [{tasks: table I, obs_modes: [state]}]",
            "obs_modes: a part of 'state'='state' is unknown; choose",
        ),
        (
            "grids: [{tasks: table I, cameras: [policy, wirst]}]",
            r"cameras='wirst' is unknown; choose from \['policy', ",
        ),
        ("grids: [{tasks: table I, encoders: [resnet81]}]", "grids/0: encoders='resnet81' is unknown; choose from"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], seed: 1}]", "'seed'.* are not known"),
        ("grids: [{seeds: [0]}]", "tasks"),
        (
            "include: [&a0 [x], " + ", ".join(f"&a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 60)) + "]",
            "aliases and values expand to",
        ),
        ("grids: &a [*a]", "aliases and values expand to"),
        (f"grids: {'x' * 9000}", "`grids` has the wrong type: 'xxx"),
        ("grids: [{tasks: table III, pretrain: {unit: ManiFeel-Knitting-v1}}]", "'ManiFeel-Knitting-v1' is not registered"),
        (
            "grids: [{tasks: table III, pretrain: {resnet18: ManiFeel-PegInsertion-v1}}]",
            r"pretrain \['resnet18'\] cannot be pre",
        ),
        ("grids: [{tasks: table I, task_args: {fitt: paper}}]", r"grids/0: .* has no arguments \['fitt'\]; choose from"),
        ("grids: [{tasks: table I, evaluation_args: [{}, {imperfection: {delay: 2}}]}]", r"no arguments \['imperfection'\]"),
        ("grids: [{tasks: table I, evaluation_args: [{control_mode: pd_ee_pose}]}]", "has the control_mode of its dem"),
        ("grids: [{tasks: table I, evaluation_args: [{obs_mode: rgb}]}]", r"grids/0: \['obs_mode'\] of a task are set by the"),
        (
            "grids: [{tasks: table I, task_args: {sensor_configs: {width: 2026-01-02}}}]",
            "`task_args` has the wrong type: {'sensor_configs': {'width': datetime.date",
        ),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1]}]\nresources: {training: {}}", "'training'.* are not known"),
        (
            "grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {seed: 5}}]",
            "grids/0: train: 'seed' is set by the study itself; leave it out, and use `seeds`",
        ),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {num_demos: 5}}]", "'num_demos' is set by .* use `num_demos`"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {demo-path: x.h5}}]", "'demo-path' is set by .* use `demos`"),
        (
            "grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {num-eval-episodes: 9}}]",
            "'num-eval-episodes' is set by .* use `episodes`",
        ),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {overwrite: true}}]", "'overwrite' is set by .* another --root"),
        (
            "grids: [{tasks: [ManiFeel-PegInsertion-v1], encoder_flags: {t3: {obs-mode: rgb}}}]",
            "encoder_flags/t3: 'obs-mode' is set by the study itself",
        ),
        (
            "grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {act-horizon: 4, policy.action-horizon: 8}}]",
            "'policy.action-horizon' is given twice, since 'act-horizon' is the same flag",
        ),
        (
            "grids: [{tasks: [ManiFeel-PegInsertion-v1], train: {steps: 6, total-iters: 6}}]",
            "'total-iters' is given twice, since 'steps' is the same flag",
        ),
    ],
)
def test_what_is_wrong_with_a_study_is_said(study, content, word):
    study.write_text(content)
    with pytest.raises(StudyError, match=word) as error:
        read_study(study)
    if "cannot be read" not in word:  # yaml's own message has several lines
        assert len(str(error.value).splitlines()) == 1
    assert len(str(error.value)) < 1000


def test_training_is_as_long_as_the_samples_of_its_demonstrations_make_it():
    (train, *_) = (job for job in jobs_of(read_study(REPOSITORY / "configs/modality.yaml")) if job.kind == "train")
    args, record = training_args(train), train.needs[0].settings
    steps = task_spec(record["env_id"]).demo_steps
    spec = observation_spec("rgb", (), (), 32)
    episodes = [{"actions": np.zeros((steps, 6))} | {key: np.zeros((steps + 1, 7)) for key in spec.keys}] * record["num"]
    horizons = args.policy.obs_horizon, args.policy.pred_horizon, args.policy.action_horizon
    data = SequenceDataset(episodes, spec, *horizons, torch.device("cpu"))
    assert cost._units(train) == planned_steps(args, record["num"], len(data), args.batch_size)


def test_a_plan_tells_the_hours_from_a_trial(study, tmp_path):
    jobs = jobs_of(read_study(study))
    table = study_command.plan(read_study(study), jobs, tmp_path)
    assert table.row_count == 4
    assert [cost.estimate(job, tmp_path, 1).source for job in jobs] == ["a trial"] * 3
    one, two = (cost.estimate(jobs[2], tmp_path, workers).seconds for workers in (1, 2))
    assert one == pytest.approx(2 * two)
    hours = cost.estimate(jobs[0], tmp_path, 1).seconds / 3600
    assert 1e-4 < hours < 0.1  # one demonstration
    before = (tmp_path / "trials.json").stat().st_mtime_ns
    study_command.plan(read_study(study), jobs, tmp_path)
    assert (tmp_path / "trials.json").stat().st_mtime_ns == before  # measured once


def test_what_a_machine_does_not_have_is_said(study, tmp_path):
    study.write_text(TINY.replace("train: {cpus: 1}", "train: {cpus: 1, gpus: 99}"))
    with pytest.raises(MachineError, match="train needs 99 GPUs"):
        study_command.main(study_command.Args(study, tmp_path))
    ended = subprocess.run([sys.executable, "-c", "raise SystemExit(3)"], check=False)
    assert ended.returncode == 3  # Ray does not hide exit codes


@pytest.mark.parametrize(
    ("device", "error", "said"),
    [("cuda:99", MachineError, "--device cuda:99 is not there"), ("gpu", StudyError, "--device 'gpu' is no device of torch")],
)
def test_a_device_that_is_not_there_is_said_before_the_first_job_begins(study, device, error, said, tmp_path):
    study.write_text(TINY.replace("batch-size: 4", f"device: {device}"))
    with pytest.raises(error, match=said):
        study_command.main(study_command.Args(study, root=tmp_path / "root"))
    assert not list(tmp_path.glob("root/*/*"))


@pytest.mark.parametrize(
    ("address", "said"),
    [
        (None, "Ray, which runs the jobs, does not start (timed out during startup); give the same command again when"),
        ("10.1.2.3:6379", "the Ray cluster 10.1.2.3:6379 cannot be reached (timed out during startup); start it, or correct"),
    ],
)
def test_a_ray_that_does_not_start_is_one_line(study, tmp_path, monkeypatch, address, said):
    def init(*_, **__):
        raise Exception("timed out\nduring startup")  # a bare one, as of Ray

    monkeypatch.setattr(running.ray, "init", init)
    with pytest.raises(MachineError, match=re.escape(said)):
        study_command.main(study_command.Args(study, tmp_path / "root", address=address))
    assert not (tmp_path / "root/record").exists()


def test_a_policy_is_trained_once_and_evaluated_with_each_set_of_arguments():
    jobs = jobs_of(read_study(REPOSITORY / "configs/robustness.yaml"))
    counts = {kind: [job.kind for job in jobs].count(kind) for kind in ("record", "train", "evaluate")}
    assert counts == dict(record=2, train=12, evaluate=108)  # 2 tasks, 2 observation modes, 3 seeds, 9 sensors
    given = {job.settings["env_kwargs"] for job in jobs if job.kind == "evaluate"}
    assert {"{}", '{"imperfections": {"delay": 2}}'} < given
    assert all(job.settings["env_kwargs"] == "{}" for job in jobs if job.kind == "record")
