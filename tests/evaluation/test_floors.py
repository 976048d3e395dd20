"""Failure floors are read for the revision of the task alone, and refused where a file is broken."""

import json

import pytest

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation.floors import FLOORS_SCHEMA, POLICIES, floors_file, floors_of, highest_floor
from manifeel_ms3.evaluation.variant import variant_of
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from tests.tasks_and_marks import PEG

SORTING = "ManiFeel-BallSorting-v1"


def write(folder, revision=2, **floors) -> None:
    measured = {name: dict(episodes=20, rate=rate, low=rate, high=rate + 0.1) for name, rate in floors.items()}
    about = dict(schema=FLOORS_SCHEMA, env_id=PEG, revision=revision, git_commit=None, command="made up")
    floors_file(PEG, folder).write_text(json.dumps(about | dict(floors=measured)))


def test_the_highest_floor_counts(tmp_path):
    write(tmp_path, **{"random": 0.0, "mean action": 0.2, "untrained": 0.1})
    highest = highest_floor(PEG, 2, folder=tmp_path)
    assert (highest.policy, str(highest)) == ("mean action", "20% [20%, 30%]")
    assert list(floors_of(PEG, 2, folder=tmp_path)) == list(POLICIES)


def test_another_revision_or_another_task_has_no_floor(tmp_path):
    write(tmp_path, random=0.5)
    assert highest_floor(PEG, 3, folder=tmp_path) is None
    assert highest_floor(PEG, 2, '{"fit": "tight"}', tmp_path) is None
    assert floors_of("ManiFeel-Unknown-v1", 1, folder=tmp_path) == {}


@pytest.mark.parametrize(
    ("task", "given", "has_floor"),
    [
        (PEG, dict(obs_mode="rgb", cameras=["wrist"], fit="paper", lighting="normal", sim_backend="physx_cpu"), True),
        (PEG, dict(sensor="digit"), False),
        (PEG, dict(imperfections=dict(delay=2)), False),
        (SORTING, dict(goal="lift"), True),
        (SORTING, dict(goal="bowls"), False),
    ],
)
def test_a_variant_of_a_task_has_no_floor(task, given, has_floor):
    assert bool(floors_of(task, task_spec(task).revision, variant_of(task, given))) is has_floor


@pytest.mark.parametrize("content", ["{", "{}", '{"schema": "manifeel-floors-0"}'])
def test_a_broken_file_is_refused(content, tmp_path):
    floors_file(PEG, tmp_path).write_text(content)
    with pytest.raises(InvalidFileError, match=f"{PEG}.json"):
        floors_of(PEG, 2, folder=tmp_path)


def test_the_files_of_the_package_are_of_the_present_revisions_of_its_tasks():
    files = sorted((data_dir() / "floors").glob("*.json"))
    assert files
    for path in files:
        content = json.loads(path.read_text())
        assert path == floors_file(content["env_id"])
        assert content["revision"] == all_tasks()[content["env_id"]].revision
        assert floors_of(content["env_id"], content["revision"])
