"""PegReorientation: the peg must be turned in the hand; a hand that tilts instead does not succeed."""

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.insertion.base import GRIP_FORCE, GRIP_INDENTATION, InsertionEnv

TASK = "ManiFeel-PegReorientation-v1"


@pytest.fixture(scope="module")
def env(make_env):
    return make_env(TASK, obs_mode="none", render_backend="none")


def raw_pose(position: np.ndarray, rotation: Rotation) -> Pose:
    quaternion = torch.tensor(rotation.as_quat()[[3, 0, 1, 2]][None]).float()
    return Pose.create_from_pq(torch.tensor(position[None]).float(), quaternion)


def test_the_box_moves_with_its_rim(make_env):
    env = make_env(TASK, obs_mode="none", render_backend="none", randomization=dict(socket_xy=0.05)).unwrapped
    places = set()
    for seed in range(3):
        env.reset(seed=seed)
        places.add(tuple(env.socket.pose.p[0, :2].tolist()))
        assert torch.equal(env.box.pose.p[:, :2], env.socket.pose.p[:, :2])
        assert float(env.box.pose.p[0, 2]) == 0.0
    assert len(places) == 3


@pytest.mark.parametrize(("hand_tilt", "wins"), [(0.0, True), (4.0, False), (10.0, False), (25.0, False)])
def test_only_a_turned_peg_wins(env, hand_tilt, wins):
    """The peg stands in the rim, and the hand holds it at an angle, as after an insertion with a hand that tilts."""
    env.reset(seed=0)
    base = env.unwrapped
    down = Rotation.from_euler("x", np.pi)
    middle = base.socket.pose.p[0].double().numpy() + np.array([0.0, 0.0, base.fit.floor + base.fit.reach])
    grip = middle - np.array([0.0, 0.0, base.fit.grip])
    tool = raw_pose(grip, Rotation.from_euler("y", hand_tilt, degrees=True) * down)
    base.agent.reset_tool(tool, base.fit.grip_width / 2 - GRIP_INDENTATION, GRIP_FORCE)
    base.agent.controller.controllers["arm"].reset()  # its target is where the arm is now
    base.plug.set_pose(raw_pose(middle, down))
    successes = [bool(env.step(np.zeros(6))[-1]["success"]) for _ in range(8)]
    measures = base.measure()
    assert InsertionEnv.goal_reached(base, measures).all()  # the peg is in and upright
    assert float(measures["hand_tilt"]) == pytest.approx(np.deg2rad(hand_tilt), abs=np.deg2rad(1.0))
    assert successes == [wins and step >= 5 for step in range(1, 9)]  # after 0.5 s at the goal


def test_the_hand_must_be_upright_and_the_peg_turned_in_it(env):
    env.reset(seed=0)
    base = env.unwrapped
    at_goal = {name: torch.zeros_like(values) for name, values in base.measure().items()}
    for name, degrees in (("hand_tilt", 5.0), ("in_hand", 3.0), ("tilt", 3.0)):
        for share, reached in ((0.95, True), (1.05, False)):
            measures = at_goal | {name: torch.full_like(at_goal[name], np.deg2rad(share * degrees))}
            assert bool(base.goal_reached(measures)) is reached, name


def test_starts_are_those_of_the_public_code(env):
    ranges = env.unwrapped.Randomization()
    assert (ranges.start_xy, ranges.start_z, ranges.start_rotation, ranges.start_yaw) == (0.10, 0.05, 0.05, 0.5)
    yaws, heights = [], []
    for seed in range(8):
        env.reset(seed=seed)
        pose = env.unwrapped.agent.tcp_pose_at_base.raw_pose[0].numpy()
        tool = Rotation.from_quat(pose[[4, 5, 6, 3]])
        yaws.append(np.arctan2(*tool.apply([1.0, 0.0, 0.0])[1::-1]))
        heights.append(pose[2])
        assert float(env.unwrapped.measure()["hand_tilt"]) < 0.05 * np.sqrt(2) + 0.005
    assert 0.25 < np.abs(yaws).max() < 0.56
    assert np.abs(np.array(heights) - 0.22).max() < 0.053


def test_start_below_the_box_is_refused(make_env):
    with pytest.raises(ValueError, match="start_z"):
        make_env(TASK, obs_mode="none", render_backend="none", randomization=dict(start_z=0.09))
