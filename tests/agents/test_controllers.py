"""Controllers: what an action means, in the air and in contact."""

import gymnasium as gym
import mani_skill.envs  # noqa: F401 (registers its tasks)
import numpy as np
import pytest
import torch
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.utils.geometry.rotation_conversions import quaternion_multiply
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from manifeel_ms3.agents import PandaGelSight
from manifeel_ms3.agents.controllers import solve_ik
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.errors import InvalidArgumentError

ACTION_DIMS = {
    "pd_ee_delta_pose_fixed_gripper": 6,
    "pd_ee_delta_pose": 7,
    "pd_ee_delta_pose_fixed_roll_pitch": 7,
    "pd_ee_delta_pose_fixed_rotation": 7,
    "pd_ee_delta_yaw": 5,
    "pd_ee_pose": 7,
    "pd_ee_pose_fixed_gripper": 6,
    "pd_joint_pos": 8,
    "pd_joint_pos_fixed_gripper": 7,
    "pd_joint_delta_pos": 8,
    "pd_joint_target_delta_pos": 8,
}


@pytest.fixture(scope="module")
def env(make_env):
    return make_env(obs_mode="none", render_backend="none", fit="paper")


def tool(env) -> tuple[np.ndarray, Rotation]:
    pose = env.unwrapped.agent.tcp_pose_at_base.raw_pose[0].double().numpy()
    return pose[:3], Rotation.from_quat(pose[[4, 5, 6, 3]])


def settle(env, action=None, steps=8):
    for _ in range(steps):
        env.step(np.zeros(6) if action is None else action)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_translation_action_is_ten_millimetres_along_the_base_axis(env, axis):
    env.reset(seed=0)
    before, facing = tool(env)
    for _ in range(3):
        env.step(np.eye(6)[axis])
    settle(env)
    after, turned = tool(env)
    assert after - before == pytest.approx(0.03 * np.eye(3)[axis], abs=2e-4)
    assert (turned * facing.inv()).magnitude() < 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_positive_rotation_turns_by_the_right_hand_rule(env, axis, sign):
    env.reset(seed=0)
    before, facing = tool(env)
    for _ in range(3):
        env.step(sign * np.eye(6)[3 + axis])
    settle(env)
    after, turned = tool(env)
    assert (turned * facing.inv()).as_rotvec() == pytest.approx(sign * 0.15 * np.eye(3)[axis], abs=3e-3)
    assert np.linalg.norm(after - before) < 3e-4


def test_target_is_precise_in_the_air(env):
    env.reset(seed=1)
    settle(env)
    before, _ = tool(env)
    settle(env, steps=20)
    after, _ = tool(env)
    assert np.linalg.norm(after - before) < 1e-5  # it neither sags nor creeps


def test_the_next_action_is_relative_to_a_target_that_leads_by_6_millimetres_and_0_04_radians_at_most(env):
    env.reset(seed=0)
    settle(env)
    place, facing = tool(env)
    arm = env.unwrapped.agent.controller.controllers["arm"]
    for distance, angle in ((0.1, 0.8), (0.004, 0.03)):
        target = Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]) * facing
        pose = np.r_[place + distance * np.array([0.6, 0.0, -0.8]), target.as_quat()[[3, 0, 1, 2]]]
        arm.set_state(dict(target_pose=torch.tensor(pose[None], dtype=torch.float32)))
        raw = arm.commanded_pose.raw_pose[0].double().numpy()
        lead, turn = raw[:3] - place, Rotation.from_quat(raw[[4, 5, 6, 3]]) * facing.inv()
        assert lead == pytest.approx(min(distance, 0.006) * np.array([0.6, 0.0, -0.8]), abs=1e-6)
        assert turn.as_rotvec() == pytest.approx(min(angle, 0.04) * np.array([0.0, 0.6, 0.8]), abs=1e-5)


def test_target_lead_limit_bounds_the_force_however_long_one_pushes(env):
    env.reset(seed=2)
    down = -np.eye(6)[2]
    forces = [float(env.step(0.3 * down)[-1]["contact_force"]) for _ in range(100)]
    assert max(forces) > 5.0  # the peg stands on the table until it turns in the hand; when depends on rounding
    assert max(forces) < 60.0
    assert np.ptp(forces[-20:]) < 8.0  # and the force does not wind up


@pytest.mark.parametrize(("mode", "dim"), ACTION_DIMS.items())
def test_action_dimensions(make_env, mode, dim):
    env = make_env(obs_mode="none", render_backend="none", control_mode=mode)
    assert env.action_space.shape == (dim,)


def test_yaw_mode_turns_about_the_vertical_alone(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_delta_yaw")
    env.reset(seed=0)
    _, facing = tool(env)
    assert ACTION_AXES["pd_ee_delta_yaw"][3:] == ("yaw", "gripper")
    for _ in range(4):
        env.step(np.array([0, 0, 0, 1.0, -1.0]))
    for _ in range(8):
        env.step(np.array([0, 0, 0, 0, -1.0]))
    _, turned = tool(env)
    assert (turned * facing.inv()).as_rotvec() == pytest.approx([0, 0, 0.2], abs=4e-3)


@pytest.mark.parametrize(("task", "axes"), [("ManiFeel-NutBoltAssembly-v1", (3, 4)), ("ManiFeel-ObjectSearch-v1", (3, 4, 5))])
def test_rotations_that_the_paper_fixes_do_nothing(make_env, task, axes):
    env = make_env(task, obs_mode="none", render_backend="none")
    assert env.action_space.shape == (7,)
    turned = {}
    for size in (0.0, 1.0):
        env.reset(seed=0)
        action = np.zeros(7)
        action[list(axes)] = size
        for _ in range(3):
            env.step(action)
        turned[size] = env.unwrapped.agent.tcp_pose_at_base.raw_pose
    assert torch.equal(turned[0.0], turned[1.0])


def test_gripper_opens_and_closes(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_delta_pose")
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.r_[np.zeros(6), 1.0])
    assert env.unwrapped.agent.robot.get_qpos()[0, 7:] == pytest.approx([0.04, 0.04], abs=1e-3)
    for _ in range(15):
        env.step(np.r_[np.zeros(6), -1.0])
    assert env.unwrapped.agent.robot.get_qpos()[0, 7:].max() < 0.005


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_refused_before_anything_moves(env, bad):
    env.reset(seed=0)
    before = env.unwrapped.get_state()
    action = np.zeros(6)
    action[3] = bad
    with pytest.raises(ValueError, match="NaN or infinity"):
        env.step(action)
    assert torch.equal(env.unwrapped.get_state(), before)


def test_the_robot_refuses_numbers_that_are_not_finite_also_in_tasks_that_do_not(env):
    env.reset(seed=0)
    for bad in (np.nan, np.inf, -np.inf):
        said = rf"^the action holds NaN or infinity: \[\[{bad}, 0.5\]\]; give finite numbers$"
        with pytest.raises(InvalidArgumentError, match=said):
            env.unwrapped.agent.set_action(torch.tensor([[bad, 0.5]]))


@pytest.mark.parametrize("task", ["PegInsertionSide-v1", "PullCubeTool-v1"])
def test_maniskills_own_tasks_can_ask_at_which_angle_the_robot_grasps(task):
    env = gym.make(task, robot_uids="panda_gelsight", obs_mode="state", reward_mode="dense", render_backend="none")
    env.reset(seed=0)
    _, reward, *_ = env.step(env.action_space.sample())
    env.close()
    assert np.isfinite(float(reward))


def test_pads_press_straight_on_a_held_peg(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    agent, plug = env.unwrapped.agent, env.unwrapped.plug
    assert agent.is_grasping(plug, max_angle=5).all()
    assert not agent.is_grasping(plug, min_force=1e3).any()


def test_maniskills_own_tasks_can_have_the_robot():
    """PickCube asks whether the robot holds the cube and whether it stands still."""
    env = gym.make("PickCube-v1", robot_uids="panda_gelsight", obs_mode="state", render_backend="none")
    agent: PandaGelSight = env.get_wrapper_attr("agent")
    env.reset(seed=0)
    still, ahead = np.zeros(7, np.float32), np.eye(7, dtype=np.float32)[0]
    found = []
    for action in (still, ahead, still):
        for _ in range(12):
            *_, info = env.step(action)
        found.append((agent.is_static().item(), info["is_robot_static"].item(), info["is_grasped"].item()))
    env.close()
    assert found == [(True, True, False), (False, False, False), (True, True, False)]


def test_wrong_shape_is_refused(env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(7,\).*takes \(6,\)"):
        env.step(np.zeros(7))


def test_out_of_range_actions_are_clipped(env):
    env.reset(seed=0)
    env.step(np.full(6, 100.0))
    clipped = env.unwrapped.get_state()
    env.reset(seed=0)
    env.step(np.ones(6))
    assert torch.equal(env.unwrapped.get_state(), clipped)


def test_an_absolute_pose_is_reached_and_never_far_ahead(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_pose_fixed_gripper")
    env.reset(seed=0)
    place, facing = tool(env)
    goal = np.r_[place + np.array([0.02, -0.01, 0.05]), facing.as_euler("XYZ")]
    for _ in range(15):
        env.step(goal)
    reached, turned = tool(env)
    assert reached == pytest.approx(goal[:3], abs=2e-4)
    assert (turned * facing.inv()).magnitude() < 2e-3
    env.step(np.r_[goal[:3] - np.array([0, 0, 1.0]), goal[3:]])
    fallen, _ = tool(env)
    assert 0.01 < reached[2] - fallen[2] < 0.024  # at most the lead that an absolute target may have


def test_lower_ends_of_the_ranges_are_those_of_the_actions(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_pose_fixed_gripper")
    config = env.unwrapped.agent.controller.controllers["arm"].config
    assert env.action_space.low == pytest.approx([config.pos_lower] * 3 + [config.rot_lower] * 3)
    assert env.action_space.high == pytest.approx([config.pos_upper] * 3 + [config.rot_upper] * 3)
    with pytest.raises(TypeError, match="pos_lower"):
        type(config)(config.joint_names, stiffness=1.0, damping=1.0, pos_lower=-0.5)


@pytest.mark.parametrize("mode", ["pd_joint_delta_pos_fixed_gripper", "pd_joint_target_delta_pos_fixed_gripper"])
def test_a_joint_delta_is_a_tenth_of_a_radian_from_the_target_or_from_where_the_joint_is(make_env, mode):
    env = make_env(obs_mode="none", render_backend="none", control_mode=mode)
    env.reset(seed=0)
    start = env.unwrapped.agent.robot.get_qpos()[0, :7].numpy().copy()
    for action in [np.eye(7)[6]] * 3 + [np.zeros(7)] * 12:
        env.step(action)
    moved = env.unwrapped.agent.robot.get_qpos()[0, :7].numpy() - start
    if "target" in mode:
        assert moved == pytest.approx(0.3 * np.eye(7)[6], abs=2e-3)
    else:  # each step, and the first one at rest, gives up what the joint lags behind
        assert 0.1 < moved[6] < 0.27


def test_joint_targets_are_reached(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_joint_pos_fixed_gripper")
    env.reset(seed=0)
    goal = env.unwrapped.agent.robot.get_qpos()[0, :7].numpy() + 0.05
    for _ in range(15):
        env.step(goal)
    assert env.unwrapped.agent.robot.get_qpos()[0, :7].numpy() == pytest.approx(goal, abs=2e-3)


def test_a_reset_of_some_environments_on_a_gpu_finds_the_joint_angles_of_these(make_env):
    """ManiSkill's solver for GPUs is plain torch, which the CPU computes here, for two of four robots."""
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    agent = env.unwrapped.agent
    kinematics = Kinematics(agent.urdf_path, agent.ee_link_name, agent.robot, agent._kinematics.active_joint_indices)
    kinematics._setup_gpu()
    agent.robot.qlimits = agent.robot.get_qlimits().repeat(4, 1, 1)
    wanted = agent.tcp_pose_at_base
    near = agent.robot.get_qpos() + torch.tensor([[0.05], [-0.05]])
    for joints in solve_ik(kinematics, Pose.create(wanted.raw_pose.repeat(2, 1)), near, iterations=10):
        reached = agent.tool_pose_at(joints[None])
        assert torch.allclose(reached.to_transformation_matrix(), wanted.to_transformation_matrix(), atol=1e-5)
    turn = torch.tensor([[np.cos(0.045), np.sin(0.045), 0.0, 0.0]], dtype=torch.float32)  # by 0.09 rad
    ahead = Pose.create_from_pq(wanted.p + torch.tensor([[0.01, 0.01, 0.008]]), quaternion_multiply(turn, wanted.q))
    reached = agent.tool_pose_at(solve_ik(kinematics, ahead, agent.robot.get_qpos()))  # an action's steps suffice
    assert torch.allclose(reached.to_transformation_matrix(), ahead.to_transformation_matrix(), atol=1e-4)
