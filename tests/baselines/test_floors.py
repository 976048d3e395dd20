"""The command that measures failure floors, on the real simulator."""

import json
import shlex

import numpy as np
import pytest
import tyro

from baselines import floors
from baselines.references import RandomActions
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.floors import FLOORS_SCHEMA, POLICIES, floors_file, floors_of, highest_floor
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from tests.tasks_and_marks import PEG, needs_renderer

NUT, SEARCH = "ManiFeel-NutBoltAssembly-v1", "ManiFeel-ObjectSearch-v1"


def test_a_policy_that_is_not_known_is_named_before_anything_is_measured(tmp_path):
    with pytest.raises(InvalidArgumentError, match=r"--policies='trained' is unknown; choose from \['random', 'mean action'"):
        floors.main(floors.Args((NUT,), ("random", "trained"), out=tmp_path))
    assert not list(tmp_path.iterdir())


def test_random_actions_are_drawn_by_the_seed_of_the_episode():
    policy = RandomActions(PEG)
    policy.begin_episode(3)
    first = [policy.act({}) for _ in range(4)]
    policy.begin_episode(3)
    assert np.array_equal(first, [policy.act({}) for _ in range(4)])
    policy.begin_episode(4)
    assert not np.array_equal(first[0], policy.act({}))
    assert np.abs(first).max() <= 1
    assert len(first[0]) == 6
    assert len(RandomActions(PEG, "pd_ee_delta_yaw").act({})) == 5
    with pytest.raises(InvalidArgumentError, match=r"control_mode.*pd_joint_pos.*pd_ee_delta_pose"):
        RandomActions(PEG, "pd_joint_pos")


def test_a_floor_is_measured_and_those_of_other_policies_are_kept(tmp_path):
    """The episode is short, because random fingers let go of the nut in the first steps."""
    spec, mean = task_spec(NUT), dict(episodes=7, rate=0.5, low=0.25, high=0.75)
    about = dict(schema=FLOORS_SCHEMA, env_id=NUT, revision=spec.revision, git_commit=None, command="made up")
    floors_file(NUT, tmp_path).write_text(json.dumps(about | dict(floors={"mean action": mean})))
    (path,) = floors.main(floors.Args((NUT,), ("random",), episodes=1, out=tmp_path))
    found = floors_of(NUT, spec.revision, folder=tmp_path)
    assert {name: (one.episodes, one.rate) for name, one in found.items()} == {"random": (1, 0.0), "mean action": (7, 0.5)}
    assert highest_floor(NUT, spec.revision, folder=tmp_path).policy == "mean action"
    assert floors._earlier(path, spec.revision + 1) == ({}, [])  # floors of another revision are not kept
    before, measured = json.loads(path.read_text())["command"].split(floors.THEN)
    assert before == "made up"
    assert tyro.cli(floors.Args, args=shlex.split(measured)[3:]) == floors.Args((NUT,), ("random",), episodes=1)


def test_the_files_of_the_package_name_the_command_that_measures_their_task():
    for env_id in all_tasks():
        content = json.loads(floors_file(env_id).read_text())
        counts = {floor["episodes"] for floor in content["floors"].values()}
        assert [content["command"]] == [floors.command_of(env_id, floors.Args(episodes=count)) for count in counts]


@pytest.mark.slow
@needs_renderer
def test_all_policies_are_measured(tmp_path):
    floors.main(floors.Args((SEARCH,), episodes=2, out=tmp_path))
    found = floors_of(SEARCH, task_spec(SEARCH).revision, folder=tmp_path)
    assert list(found) == list(POLICIES)
    assert all(floor.episodes == 2 for floor in found.values())


def test_missing_demonstrations_are_named(tmp_path):
    with pytest.raises(DemonstrationError, match=r"has no trajectory file with rgb\+tacff; record one"):
        floors.main(floors.Args((NUT,), episodes=1, demos=tmp_path, out=tmp_path))
