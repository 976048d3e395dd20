"""The screwing tasks: near misses do not count, and what the hand feels is the torque that acts."""

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.placement import POINTING_DOWN

NUT, BULB = "ManiFeel-NutBoltAssembly-v1", "ManiFeel-BulbInstallation-v1"


def goal_with_held_at(env, height: float, offset: float = 0.0, tilt_degrees: float = 0.0, torque: float | None = None) -> bool:
    """Whether it is the goal with the held part's origin at `height` over the fixed part's underside; alike in every direction
    of the offset."""
    angles = np.linspace(0, 2 * np.pi, 4, endpoint=False)
    (goal,) = {_goal_with_held_at(env, height, offset, angle, tilt_degrees, torque) for angle in angles}
    return goal


def _goal_with_held_at(env, height: float, offset: float, angle: float, tilt_degrees: float, torque: float | None) -> bool:
    base = env.unwrapped
    fixed = base.fixed.pose.raw_pose[0, :3].double().numpy()
    quaternion = Rotation.from_euler("x", tilt_degrees, degrees=True).as_quat()[[3, 0, 1, 2]]
    place = torch.tensor((fixed + np.array([offset * np.cos(angle), offset * np.sin(angle), height]))[None]).float()
    base.held.set_pose(Pose.create_from_pq(place, torch.tensor(quaternion[None]).float()))
    measures = base.measure()
    if torque is not None:
        measures["torque"] = torch.tensor([torque])
    return bool(base.goal_reached(measures))


@pytest.mark.parametrize(
    ("turns", "offset", "tilt", "goal"),
    [
        (1.55, 0.0, 0.0, True),
        (1.45, 0.0, 0.0, False),  # not far enough
        (0.0, 0.0, 0.0, False),  # resting on the bolt
        (-0.5, 0.0, 4.0, False),  # resting on it, askew
        (1.55, 0.0, 2.5, False),  # not square
        (1.55, 0.00095, 0.0, True),
        (1.55, 0.00105, 0.0, False),  # beside the axis
        (1.55, 0.0, 1.9, True),
        (20.0, 0.1, 0.0, False),  # on the table
    ],
)
def test_nut_must_be_screwed_on_square(make_env, turns, offset, tilt, goal):
    env = make_env(NUT, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    screw = env.unwrapped.screw
    assert goal_with_held_at(env, screw.engaged - turns * screw.pitch, offset, tilt) is goal


def test_nut_dropped_on_the_bolt_does_not_reach_the_goal(make_env):
    """Let go over the bolt, and pushed on it by its weight alone, it stays above where the threads first meet."""
    env = make_env(NUT, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    for yaw in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        quaternion = torch.tensor(Rotation.from_euler("z", yaw).as_quat()[[3, 0, 1, 2]][None]).float()
        place = base.fixed.pose.p + torch.tensor([0.0, 0.0, base.screw.engaged + 0.004])
        base.held.set_pose(Pose.create_from_pq(place, quaternion))
        base.held.set_linear_velocity(torch.zeros(1, 3))
        base.held.set_angular_velocity(torch.zeros(1, 3))
        for _ in range(200):
            base.scene.step()
        measures = base.measure()
        assert not base.goal_reached(measures)
        assert measures["descent"] < 0.5 * base.screw.pitch


@pytest.mark.parametrize(
    ("gap", "torque", "offset", "goal"),
    [
        (0.0, 0.15, 0.0, True),
        (0.0, 0.05, 0.0, False),
        (0.0, 0.0, 0.0, False),
        (0.0, -0.15, 0.0, False),  # turned off
        (0.0006, 0.15, 0.0, False),
        (0.02, 0.15, 0.0, False),
        (0.00045, 0.105, 0.0019, True),
        (0.0, 0.15, 0.0021, False),
    ],
)
def test_bulb_must_be_in_and_tight(make_env, gap, torque, offset, goal):
    env = make_env(BULB, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    assert goal_with_held_at(env, env.unwrapped.screw.seated + gap, offset, torque=torque) is goal


@pytest.mark.parametrize(
    ("from_hand", "from_axis", "fails"), [(0.049, 0.03, False), (0.051, 0.03, True), (0.2, 0.0035, False), (0.2, 0.0045, True)]
)
def test_a_part_fails_when_it_is_out_of_the_hand_and_off_the_axis(make_env, from_hand, from_axis, fails):
    env = make_env(NUT, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    away = torch.tensor([[0.0, from_axis, 0.0]])
    base.held.set_pose(Pose.create_from_pq(base.fixed.pose.p + away + torch.tensor([[0.0, 0.0, 0.02]])))
    over = base.held.pose.p + torch.tensor([[0.0, 0.0, from_hand]])
    base.agent.reset_tool(Pose.create_from_pq(over, torch.tensor([POINTING_DOWN])))
    assert torch.linalg.norm(base.agent.tcp.pose.p - over) < 1e-4
    assert bool(base.failed(base.measure())) is fails


@pytest.mark.parametrize("task", [NUT, BULB])
def test_dense_reward_rises_towards_the_goal(make_env, task):
    """Depth counts on the axis alone, and no further than to the goal."""
    env = make_env(task, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    at_goal = base.screw.engaged - base.screw.seated

    def reward(descent: float, offset: float = 0.0, tilt: float = 0.0) -> float:
        measures = dict(descent=torch.tensor([descent]), offset=torch.tensor([offset]), tilt=torch.tensor([tilt]))
        return float(base.compute_dense_reward(None, None, measures | dict(success=torch.tensor([False]))))

    path = [(-0.2, 0.2, 0.0), (-0.05, 0.0, 0.2), (0.0, 0.0, 0.2), (0.0,), (at_goal / 2,), (at_goal,)]
    rewards = [reward(*place) for place in path]
    assert rewards == sorted(set(rewards))
    assert rewards[0] == pytest.approx(0.0, abs=0.01)
    assert rewards[3:] == pytest.approx([2.0, 2.5, 3.0])
    assert reward(2 * at_goal) == pytest.approx(3.0)
    assert reward(at_goal, offset=0.05) == pytest.approx(reward(0.0, offset=0.05))


@pytest.mark.parametrize("task", [NUT, BULB])
def test_hand_feels_the_torque_that_acts(make_env, task):
    """A torque on the held part, in the air, is what the pads report, about the vertical."""
    env = make_env(task, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    before = float(base.measure()["torque"])
    for _ in range(240):
        base.held._bodies[0].add_force_torque([0, 0, 0], [0, 0, 0.05])
        base.scene.step()
    assert float(base.measure()["torque"]) - before == pytest.approx(0.05, abs=3e-3)  # the hand resists, clockwise


@pytest.mark.parametrize("task", [NUT, BULB])
def test_held_part_starts_at_rest_in_the_hand(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none")
    for seed in range(3):
        _, info = env.reset(seed=seed)
        base = env.unwrapped
        assert torch.linalg.norm(base.held.pose.p - base.agent.tcp.pose.p) < 1e-3
        assert info["tilt"] < np.deg2rad(1)
        assert torch.linalg.norm(base.fixed.pose.p[0, :2] - torch.tensor([0.5, 0.0])) < 0.05 * np.sqrt(2)


def test_bulb_may_start_in_its_holder_at_a_random_depth(make_env):
    env = make_env(BULB, obs_mode="none", render_backend="none", start="holder")
    depths = []
    for seed in range(8):
        _, info = env.reset(seed=seed)
        depths.append(float(info["descent"]))
        assert info["tilt"] < np.deg2rad(4)
        assert not info["fail"].any()
    assert max(depths) - min(depths) > 1e-3
    assert 0.2e-3 < min(depths) < max(depths) < 3.3e-3  # the thread's play is half a millimetre
    with pytest.raises(ValueError, match="start='drawer'"):
        make_env(BULB, obs_mode="none", render_backend="none", start="drawer")
