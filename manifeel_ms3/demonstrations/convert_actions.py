"""Conversion of actions to another controller: an episode commands the same joint motions in another form.

At each step the recorded action is run in an environment with its own controller, and the joint targets that it commands are
expressed as an action of the other controller. With a controller that accepts any joint target, such as `pd_joint_pos`, the
robot then moves as before, except for rounding errors, which contacts can amplify to a millimetre.
"""

# pyright: reportAttributeAccessIssue=false, reportOperatorIssue=false
# (ManiSkill annotates a combined controller by its base class, and limits and joint positions as unions)
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from mani_skill.agents.controllers import PDJointPosController
from mani_skill.utils.geometry.rotation_conversions import matrix_to_euler_angles, quaternion_to_matrix
from mani_skill.utils.structs import Pose

from manifeel_ms3.agents import PandaGelSight
from manifeel_ms3.agents.controllers import LimitedLeadEEPoseController, rotation_between

ARM, GRIPPER = "arm", "gripper"
"""Names of the controllers of the robot's arm and gripper."""
LAST_STEPS = 10
"""Number of steps for which the last command is held, in case the goal is met later than in the recording; set once, not
tuned."""


def converted(actions: Iterable[np.ndarray], seed: int, source: gym.Env, target: gym.Env) -> Iterator[np.ndarray]:
    """Actions (A,) for the controller of `target`; each must be run there before the next one is requested.

    Args:
        actions: Actions for the controller of `source`.
        seed: Seed of the episode, with which `target` has been reset.
        source: Environment of the same task with the controller of the actions.
        target: Environment in which the episode runs.
    """
    source.reset(seed=seed)
    here: Any = source.unwrapped
    there: Any = target.unwrapped
    for action in actions:
        source.step(action)
        yield same_command(here.agent, there.agent)
    for _ in range(LAST_STEPS):
        yield same_command(here.agent, there.agent)


def same_command(source: PandaGelSight, target: PandaGelSight) -> np.ndarray:
    """Action (A,) with which the controller of `target` commands, as closely as it can, the last joint targets of `source`."""
    commanded = source.robot.get_drive_targets()  # (1, 9)
    parts = [_arm_action(target, commanded[:, :7])]
    if target.controller.controllers[GRIPPER].single_action_space.shape[0]:
        parts.append(_gripper_action(source, target, commanded[:, 7:8]))
    return torch.cat(parts, dim=1)[0].cpu().numpy()


def _arm_action(agent: PandaGelSight, joints: torch.Tensor) -> torch.Tensor:
    """The action (1, A) of the arm's controller for joint targets (1, 7), in rad."""
    arm = agent.controller.controllers[ARM]
    if isinstance(arm, LimitedLeadEEPoseController):
        return _pose_action(arm, agent.tool_pose_at(joints))
    assert isinstance(arm, PDJointPosController)
    if not arm.config.use_delta:
        return joints
    start = arm._target_qpos if arm.config.use_target else arm.qpos
    return ((joints - start) / arm.config.upper).clamp(-1.0, 1.0)


def _pose_action(arm: LimitedLeadEEPoseController, pose: Pose) -> torch.Tensor:
    """The action (1, A) for a pose of the tool in the base frame."""
    if not arm.config.use_delta:
        return torch.cat([pose.p, matrix_to_euler_angles(quaternion_to_matrix(pose.q), "XYZ")], dim=1)
    start, axes = arm.commanded_pose, list(arm.config.rotation_axes)
    delta = torch.cat([pose.p - start.p, rotation_between(start.q, pose.q)[:, axes]], dim=1)
    upper = [arm.config.pos_upper] * 3 + [arm.config.rot_upper] * len(axes)
    return (delta / delta.new_tensor(upper)).clamp(-1.0, 1.0)


def _gripper_action(source: PandaGelSight, target: PandaGelSight, commanded: torch.Tensor) -> torch.Tensor:
    """The action (1, 1) of a gripper that presses with the same force: stiffness times distance to the commanded position."""
    config = target.controller.controllers[GRIPPER].config
    position = source.robot.get_qpos()[:, 7:8]
    ratio = source.controller.controllers[GRIPPER].config.stiffness / config.stiffness
    finger = position + (commanded - position) * ratio
    return (2 * (finger - config.lower) / (config.upper - config.lower) - 1).clamp(-1.0, 1.0)
