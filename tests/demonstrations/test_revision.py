"""What was recorded of an earlier revision of a task is neither trained on nor run again."""

import json
import shutil
from pathlib import Path

import pytest

from baselines.common.dataset import read_episodes
from baselines.common.observation import observation_spec
from manifeel_ms3.demonstrations import (
    DemonstrationError,
    export,
    read_demonstrations,
    read_header,
    render_observations,
    replay,
)
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.videos.__main__ import read_source
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG

HERE = task_spec(PEG).revision
REFUSED = rf"it is of revision {HERE - 1} of {PEG}, but the task has revision {HERE} here; make it again"


def copy_of(path: Path, folder: Path, revision: int | None) -> Path:
    """A copy of a file that says another revision of its task, or none."""
    copy = Path(shutil.copy(path, folder / path.name))
    header = read_header(path)
    del header["revision"]
    copy.with_suffix(".json").write_text(json.dumps(header if revision is None else header | dict(revision=revision)))
    return copy


@pytest.fixture
def earlier(tmp_path) -> Path:
    """States and actions of the earlier revision."""
    return copy_of(states_sample(PEG), tmp_path, HERE - 1)


def test_it_is_not_run_again(earlier, tmp_path):
    with pytest.raises(DemonstrationError, match=REFUSED):
        replay.replay(earlier)
    with pytest.raises(DemonstrationError, match=REFUSED):
        render_observations.main(render_observations.Args(earlier, tmp_path / "observed.h5"))
    with pytest.raises(DemonstrationError, match=REFUSED):
        read_source(earlier, 0)


@pytest.mark.parametrize("kind", [None, "lerobot", "zarr"])
def test_it_is_not_trained_on_in_any_format(tmp_path, kind):
    spec = observation_spec("rgb+tacff", ("wrist",), ("right",), 32)
    files = {}
    for name, revision in (("earlier", HERE - 1), ("not known", None)):
        (folder := tmp_path / name).mkdir()
        files[name] = copy_of(observed_sample(PEG), folder, revision)
        if kind:
            pytest.importorskip("pyarrow" if kind == "lerobot" else kind)
            files[name] = export.main(export.Args(files[name], kind, folder / kind))
    with pytest.raises(DemonstrationError, match=REFUSED):
        read_episodes([files["earlier"]], PEG, spec, 1)
    assert len(read_episodes([files["not known"]], PEG, spec, 1)) == 1


def test_it_can_still_be_read(tmp_path):
    assert read_demonstrations(copy_of(observed_sample(PEG), tmp_path, HERE - 1), ["extra/tcp_pose"])
