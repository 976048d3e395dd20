"""PegInsertion: success is contact physics alone; near misses do not count."""

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry.pegs import HOLES, PEG_SIZE, SOCKET_DEPTH


@pytest.fixture(scope="module")
def env(make_env):
    return make_env(obs_mode="state_dict", render_backend="none", fit="loose", reward_mode="dense")


def measures_with_peg_at(env, offset, tilt_degrees=0.0) -> tuple[dict, bool]:
    """Measures with the peg's end at `offset` from the hole's floor, tilted about y."""
    base = env.unwrapped
    turn = Rotation.from_euler("xy", [180, tilt_degrees], degrees=True)
    socket = base.socket.pose.raw_pose[0, :3].double().numpy()
    up = Rotation.from_euler("y", tilt_degrees, degrees=True).apply([0, 0, 1])
    centre = socket + np.array(offset) + up * PEG_SIZE[2] / 2
    quaternion = turn.as_quat()[[3, 0, 1, 2]]
    base.peg.set_pose(Pose.create_from_pq(torch.tensor(centre[None]).float(), torch.tensor(quaternion[None]).float()))
    measures = base.measure()
    return measures, bool(base.goal_reached(measures))


def test_seated_peg_is_the_goal(env):
    env.reset(seed=0)
    measures, reached = measures_with_peg_at(env, (0, 0, 0.0))
    assert reached
    assert float(measures["gap"]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("miss", "offset", "tilt"),
    [
        ("on the rim", (0, 0, SOCKET_DEPTH), 0),
        ("half inserted", (0, 0, SOCKET_DEPTH / 2), 0),
        ("just short", (0, 0, 1.2e-3), 0),
        ("tilted", (0, 0, 0), 3.5),
        ("beside the socket, on the table", (0.03, 0, 0), 0),
        ("lying", (0, 0, 0), 90),
    ],
)
def test_near_misses_are_not_the_goal(env, miss, offset, tilt):
    env.reset(seed=0)
    _, reached = measures_with_peg_at(env, offset, tilt)
    assert not reached, miss


def test_goal_must_hold_half_a_second(env):
    env.reset(seed=0)
    base = env.unwrapped
    base._steps_at_goal[:] = 4
    assert not base.evaluate()["success"].any()
    base._steps_at_goal[:] = 5
    assert base.evaluate()["success"].all()
    env.step(np.zeros(6))  # the peg is in the air
    assert base._steps_at_goal.item() == 0


def test_no_success_at_reset_or_by_chance(env):
    rng = np.random.default_rng(0)
    for seed in range(40):
        _, info = env.reset(seed=seed)
        assert not info["success"].any()
        assert not info["fail"].any()
    for _ in range(60):
        *_, info = env.step(rng.uniform(-1, 1, 6))
        assert not info["success"].any()


def test_randomisation_covers_its_ranges_and_no_more(env):
    sockets, starts, pitches = [], [], []
    for seed in range(30):
        env.reset(seed=seed)
        base = env.unwrapped
        sockets.append(base.socket.pose.p[0, :2].numpy() - [0.5, 0.0])
        starts.append(base.agent.tcp_pose_at_base.p[0].numpy() - [0.5, 0.0, 0.15])
        held = (base.agent.tcp.pose.inv() * base.peg.pose).raw_pose[0].numpy()
        pitches.append(Rotation.from_quat(held[[4, 5, 6, 3]]).as_rotvec()[1])
    for values, limit in (
        (sockets, 0.05),
        (np.array(starts)[:, :2], 0.10),
        (np.array(starts)[:, 2], 0.05),
        (pitches, 0.1745),
    ):
        spread = np.abs(values)
        assert spread.max() <= limit + 2e-3
        assert spread.max() > 0.7 * limit


def test_randomization_argument_narrows(make_env):
    narrow = make_env(obs_mode="none", render_backend="none", randomization=dict(socket_xy=0.0, start_xy=0.0, start_z=0.0))
    for seed in range(3):
        narrow.reset(seed=seed)
        assert narrow.unwrapped.socket.pose.p[0].tolist() == pytest.approx([0.5, 0, 0], abs=1e-6)
        assert narrow.unwrapped.agent.tcp_pose_at_base.p[0].tolist() == pytest.approx([0.5, 0, 0.15], abs=1e-3)


@pytest.mark.parametrize("fit", HOLES)
def test_hole_is_as_large_as_it_says(make_env, fit):
    """A peg-sized probe fits; one that is wider than the hole by 0.02 mm does not."""
    env = make_env(obs_mode="none", render_backend="none", fit=fit)
    walls = env.unwrapped.socket._objs[0].components[0].collision_shapes
    inner = {axis: [] for axis in (0, 1)}
    for wall in walls:
        centre, half = wall.local_pose.p, wall.half_size
        axis = int(np.argmax(np.abs(centre[:2])))
        inner[axis].append(abs(centre[axis]) - half[axis])
    for axis in (0, 1):
        assert 2 * np.array(inner[axis]) == pytest.approx(HOLES[fit][axis], abs=1e-6)
        assert HOLES[fit][axis] > PEG_SIZE[axis]


def test_dropped_peg_fails(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_delta_pose")
    env.reset(seed=0)
    for _ in range(10):
        *_, terminated, _, info = env.step(np.r_[np.zeros(6), 1.0])
    assert info["fail"].all()
    assert terminated.all()
    assert not info["success"].any()


def test_dense_reward_rises_towards_the_goal(env):
    env.reset(seed=0)
    rewards = []
    for offset, tilt in (
        ((0.05, 0.05, 0.1), 10),
        ((0.005, 0, 0.02), 5),
        ((0, 0, SOCKET_DEPTH), 2),
        ((0, 0, 0.004), 0),
        ((0, 0, 0), 0),
    ):
        measures, _ = measures_with_peg_at(env, offset, tilt)
        info = measures | dict(success=torch.tensor([False]))
        rewards.append(float(env.unwrapped.compute_dense_reward(None, None, info)))
    assert rewards == sorted(rewards)
    assert 0 <= rewards[0] < rewards[-1] <= 3.0
