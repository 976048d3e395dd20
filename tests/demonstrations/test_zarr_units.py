"""A zarr store says in which units its touch is, and touch in different units is never mixed or evaluated unawares."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from baselines.common.dataset import recorded_env_kwargs, recorded_task
from manifeel_ms3.demonstrations import DemonstrationError, export
from manifeel_ms3.demonstrations.formats.diffusion_policy_zarr import recorded_arguments
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation import evaluate
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

zarr = pytest.importorskip("zarr")
SAMPLE = observed_sample(PEG)
FIELD = "sensor_data/tactile_right/force_field"


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return export.main(export.Args(SAMPLE, "zarr", tmp_path_factory.mktemp("export") / "store"))


@pytest.fixture
def papers_store(store, tmp_path) -> Path:
    """The same arrays without their units, as in the paper's data."""
    folder = shutil.copytree(store, tmp_path / "papers")
    (folder / ".zattrs").unlink()
    return folder


def read(folder: Path, env_id: str | None = None) -> np.ndarray:
    from manifeel_ms3.demonstrations.formats import format_of

    (episode,) = format_of(folder).read(folder, [FIELD], num=1, env_id=env_id)
    return episode[FIELD]


def test_the_task_of_the_papers_own_data_must_be_named(papers_store):
    with pytest.raises(DemonstrationError, match="no file says of which task it is; give --env-id"):
        recorded_task([papers_store])


def test_the_store_names_its_task_its_arguments_and_its_units(store):
    about = json.loads((store / ".zattrs").read_text())
    assert (about["env_id"], about["force_field_units"]) == (PEG, "newton")
    assert recorded_arguments(store) == json.loads(SAMPLE.with_suffix(".json").read_text())["env_info"]["env_kwargs"]
    assert recorded_env_kwargs([store, SAMPLE]) == recorded_env_kwargs([SAMPLE])
    assert recorded_task([store]) == PEG
    assert read(store, PEG)[..., 0].max() > 0.02  # N
    with pytest.raises(DemonstrationError, match="not of ManiFeel-USBInsertion-v1"):
        read(store, "ManiFeel-USBInsertion-v1")


@pytest.mark.parametrize(
    ("given", "units"),
    [
        (dict(tactile={"units": "tacsl"}), "tacsl"),
        (dict(sensor_configs=dict(tactile_right=dict(units="tacsl"))), "tacsl"),
        (dict(tactile={"units": "tacsl"}, sensor_configs=dict(tactile_right=dict(units="newton"))), "newton"),
        (dict(tactile=None), "newton"),
    ],
)
def test_the_units_are_found_wherever_they_were_given(tmp_path, given, units):
    assert json.loads((exported_with(given, tmp_path) / ".zattrs").read_text())["force_field_units"] == units


def exported_with(env_kwargs: dict, folder: Path, kind: export.Format = "zarr") -> Path:
    """An export of the sample as if it had been recorded with these arguments."""
    recorded = Path(shutil.copy(SAMPLE, folder / "trajectory.h5"))
    header = json.loads(SAMPLE.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"] |= env_kwargs
    recorded.with_suffix(".json").write_text(json.dumps(header))
    return export.main(export.Args(recorded, kind, folder / kind))


@pytest.mark.parametrize(("given", "unit"), [({}, "in newtons"), (dict(tactile={"units": "tacsl"}), "penetration (m)")])
def test_the_card_of_a_lerobot_dataset_says_the_units(tmp_path, given, unit):
    pytest.importorskip("pyarrow")
    text = (exported_with(given, tmp_path, "lerobot") / "README.md").read_text()
    (sentence,) = [line for line in text.splitlines() if "`observation.tactile.right.force_field` holds" in line]
    assert unit in sentence
    assert ("newton" in sentence) == (not given)


def test_newtons_without_their_unit_are_not_taken_for_the_papers_penetration(papers_store):
    with pytest.raises(DemonstrationError, match="does not say in which units"):
        read(papers_store)


def test_the_papers_data_are_in_the_papers_units_and_not_mixed_with_newtons(papers_store):
    fields = zarr.open_array(str(papers_store / "data/tactile_force_field_right"), mode="r+")
    fields[:] = 1e-3 * fields[:]
    assert read(papers_store)[..., 0].max() < 0.02
    assert recorded_env_kwargs([papers_store]) == {"tactile": {"units": "tacsl"}}
    with pytest.raises(DemonstrationError, match="train on files that were recorded with the same"):
        recorded_env_kwargs([papers_store, SAMPLE])


def test_broken_attributes_are_named(store, tmp_path):
    folder = shutil.copytree(store, tmp_path / "broken")
    (folder / ".zattrs").write_text('{"env_kwargs": 3}')
    with pytest.raises(DemonstrationError, match=r"\.zattrs.*export the data set again"):
        recorded_arguments(folder)


def test_a_checkpoint_is_evaluated_with_the_sensor_and_units_of_its_demonstrations(tmp_path, caplog):
    checkpoint = save_tiny_checkpoint(tmp_path / "checkpoint")
    config = json.loads((checkpoint / "config.json").read_text())
    learnt = dict(sensor="digit", tactile={"units": "tacsl"}, lighting="dim")
    (checkpoint / "config.json").write_text(json.dumps(config | dict(env_id=PEG, env_kwargs=learnt)))

    def kwargs(**given) -> dict:
        return evaluate.evaluation_from_args(evaluate.Args(checkpoint, **given)).env_kwargs

    assert kwargs().items() >= learnt.items()
    assert kwargs(sensor="digit") == kwargs()
    with pytest.raises(InvalidArgumentError, match=r"--sensor gelsight_mini.*recorded with digit.*--env-kwargs"):
        kwargs(sensor="gelsight_mini")
    other = kwargs(env_kwargs='{"sensor": "gelsight_mini"}')
    assert (other["sensor"], other["tactile"]) == ("gelsight_mini", {"units": "tacsl"})
    assert "sensor is 'gelsight_mini' here, but 'digit'" in caplog.text
