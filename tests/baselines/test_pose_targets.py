"""Actions as targets of the hand's pose: the same motions, seen from the controller's own target."""

import json
import shutil
from dataclasses import replace
from itertools import pairwise

import h5py
import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from baselines.common.action_chunks import ActionChunks
from baselines.common.dataset import SequenceDataset
from baselines.common.observation import POSE, PoseForm, observation_spec, prepare
from baselines.common.pose_targets import CONTROL_MODES, POINTING_DOWN, POSITION, Command, as_targets, rotations_of
from baselines.diffusion_policy import train as diffusion
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.policy import PolicyRequest
from manifeel_ms3.tasks.registry import task_spec
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG
from tests.trust.tiny_training import tiny_args, train

TASKS = [PEG, "ManiFeel-NutBoltAssembly-v1", "ManiFeel-ObjectSearch-v1", "ManiFeel-BallSorting-v1"]
"""A task of each controller: all axes without and with a gripper, without roll and pitch, and without rotations."""

FREE = "pd_ee_delta_pose_fixed_gripper"
"""Control mode in which the hand moves along and turns about all axes."""


def demonstration(task: str, form: PoseForm) -> dict[str, np.ndarray]:
    spec = observation_spec("none", (), (), 16, pose=form)
    with h5py.File(observed_sample(task)) as file:
        episode = file["traj_0"]
        return {POSE: prepare(POSE, episode[f"obs/{POSE}"][()], spec), "actions": episode["actions"][()]}


@pytest.mark.parametrize("task", TASKS)
def test_the_command_is_the_target_of_the_controller(make_env, task):
    """Also where the peg presses on the table, where actions are too large, and where the controller ignores some of them."""
    env = make_env(task, obs_mode="state_dict", render_backend="none").unwrapped
    env.reset(seed=0)
    arm, random = env.agent.controller.controllers["arm"], np.random.default_rng(0)

    def parts(pose: Pose) -> tuple[np.ndarray, Rotation]:
        values = pose.raw_pose[0].double().numpy()
        return values[:3], Rotation.from_quat(np.roll(values[3:], -1))

    place, _ = parts(arm.ee_pose_at_base)
    command, pressed = Command(*parts(arm._target_pose), env.control_mode), 0.0
    assert parts(arm._target_pose)[0] == pytest.approx(place, abs=3e-4)  # an episode's command begins at the tool
    for step in range(60):
        action = random.uniform(-1.5, 1.5, env.action_space.shape).astype(np.float32)
        if step > 20:
            action[:3] = 0.0, 0.0, -1.0
        command.follow(*parts(arm.ee_pose_at_base))
        command.move(action)
        env.step(action)
        position, rotation = parts(arm._target_pose)
        assert command.as_target()[:3] == pytest.approx(position, abs=1e-6)
        assert (Rotation.from_rotvec(command.as_target()[3:]) * POINTING_DOWN * rotation.inv()).magnitude() < 1e-5
        pressed = max(pressed, float(env.get_info()["contact_force"]))
    assert pressed > 5.0 or task != PEG  # the grippers of the other tasks drop what they hold


@pytest.mark.parametrize("form", ["quaternion", "rotation_6d"])
@pytest.mark.parametrize("task", TASKS)
def test_targets_lead_to_the_actions_of_the_demonstration(task, form):
    episode = demonstration(task, form)
    poses, actions = episode[POSE], episode["actions"]
    targets = as_targets(poses, actions, control_mode := task_spec(task).control_mode({}))
    assert targets.shape == actions.shape
    assert np.array_equal(targets[:, 6:], actions[:, 6:])  # the gripper's
    rotations = rotations_of(poses)
    command = Command(poses[0, :3].astype(float), rotations[0], control_mode)
    for position, rotation, target, action in zip(poses[:-1, :3], rotations[:-1], targets, actions, strict=True):
        command.follow(position.astype(float), rotation)
        found = command.action_to(target.astype(float))
        assert found == pytest.approx(action, abs=2e-4)  # of a step of 10 mm, in single precision
        command.move(found)
    reached = np.linalg.norm(targets[:-1, :3] - poses[1:-1, :3], axis=1)
    assert reached.max() < 0.025  # targets lie near the tool's way


def test_a_hand_that_points_down_has_a_target_without_lean():
    down = np.array([[0.5, 0.0, 0.2, 0.0, 1.0, 0.0, 0.0]] * 2, np.float32)
    (target,) = as_targets(down, np.zeros((1, 6), np.float32), FREE)
    assert target == pytest.approx([0.5, 0.0, 0.2, 0.0, 0.0, -np.pi / 4], abs=1e-6)
    (leaning,) = as_targets(down, np.array([[0, 0, 0, 1.0, 0, 0]], np.float32), FREE)
    along = (Rotation.from_rotvec(leaning[3:]) * POINTING_DOWN).apply([0.0, 0.0, 1.0])
    assert along == pytest.approx([0.0, np.sin(0.05), -np.cos(0.05)], abs=1e-6)
    far = Command(np.zeros(3), POINTING_DOWN, FREE).action_to(np.array([1.0, -0.005, 0.0, 0.0, 0.0, -2.0, 0.5]))
    assert far == pytest.approx([1.0, -0.5, 0.0, 0.0, 0.0, -1.0, 0.5])  # as far as one step can


@pytest.mark.parametrize("horizons", [(1, 16, 4), (2, 16, 8)])
def test_a_policy_that_predicts_the_targets_of_a_demonstration_executes_its_actions(horizons):
    """The data set makes the targets relative to the last observation, and the episode's part makes them actions again."""
    episode, spec = demonstration(PEG, "rotation_6d"), observation_spec("none", (), (), 16, pose="rotation_6d")
    poses, actions = episode[POSE], episode["actions"].copy()
    data = SequenceDataset([episode], spec, *horizons, torch.device("cpu"), targets_of=FREE)
    assert data.actions_to_fit.shape == (len(data), 16, 6)
    observed, targets = data.sample(torch.tensor([5]))
    absolute = as_targets(poses, actions, FREE)[5 - horizons[0] + 1 :][:16]
    seen_from = observed[POSE][0, -1, POSITION].numpy()
    assert targets[0].numpy() == pytest.approx(absolute - np.r_[seen_from, np.zeros(3)], abs=1e-6)

    def ask(request: PolicyRequest) -> np.ndarray:
        step = min(request.step, len(data) - 1)
        first = horizons[0] - 1 + request.step - step
        return data.sample(torch.tensor([step]))[1][0, first : first + horizons[2]].numpy()

    with h5py.File(observed_sample(PEG)) as file:
        raw = file[f"traj_0/obs/{POSE}"][()]
    part = ActionChunks(spec, horizons[0], ask, targets_of=FREE)
    for _ in range(2):  # an episode begins without the command of the one before
        part.begin_episode(0)
        for step in range(len(data)):
            acted = part.act(dict(extra=dict(tcp_pose=torch.as_tensor(raw[step : step + 1]))))
            assert acted == pytest.approx(actions[step], abs=2e-4)


def test_ranges_of_targets_grow_with_the_step_of_the_prediction(tmp_path):
    """Each step has its own, so that the next ones, which are near, are as large for the network as those far ahead."""
    args = tiny_args(tmp_path, steps=2)
    checkpoint = train(replace(args, policy=replace(args.policy, action_form="target")))
    policy = diffusion.SPEC.load(checkpoint)
    assert policy.make_episode_part.keywords["targets_of"] == FREE
    normalizer = policy.policy.action_normalizer
    half = (normalizer.high - normalizer.low)[:, POSITION] / 2
    assert half.shape == (16, 3)
    assert all(after > before for before, after in pairwise(half.norm(dim=1)[:8].tolist()))
    config = json.loads((checkpoint / "config.json").read_text())
    config.pop("env_kwargs")
    (checkpoint / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="must say env_id and env_kwargs, and says 'ManiFeel-PegInsertion-v1' and None"):
        diffusion.SPEC.load(checkpoint)


def test_other_actions_than_motions_of_the_tool_cannot_be_targets(tmp_path):
    header = read_header(observed_sample(PEG))
    header["env_info"]["env_kwargs"]["control_mode"] = "pd_joint_pos"
    shutil.copy(observed_sample(PEG), tmp_path / "joints.h5")
    (tmp_path / "joints.json").write_text(json.dumps(header))
    args = tiny_args(tmp_path / "run", demos=(tmp_path / "joints.h5",))
    with pytest.raises(InvalidArgumentError, match="'pd_joint_pos', which a policy with the action_form 'target' cannot learn"):
        train(replace(args, policy=replace(args.policy, action_form="target")))
    assert "pd_ee_delta_pose_fixed_roll_pitch" in CONTROL_MODES
    assert not {"pd_joint_pos", "pd_ee_pose", "pd_ee_delta_yaw"} & set(CONTROL_MODES)
    with pytest.raises(InvalidArgumentError, match="does not turn with the scene"):
        EquivariantConfig(action_form="target")
