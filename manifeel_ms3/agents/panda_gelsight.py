"""The robot of every ManiFeel task: a Franka Panda with a tactile finger on each side and a wrist camera."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (ManiSkill builds controller configurations from dicts of mixed types, and annotates a combined controller by its base class)
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDJointPosController,
    PDJointPosControllerConfig,
    PDJointPosMimicControllerConfig,
    deepcopy_dict,
)
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.agents.registration import register_agent
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply
from mani_skill.utils.structs import Actor, Pose

from manifeel_ms3.arguments import one_of
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.rendering.cameras import FARTHEST, FIELD_OF_VIEW, IMAGE_SIZE
from manifeel_ms3.rendering.shader_pack import camera_shader
from manifeel_ms3.sensors.mechanics.wrench import WrenchGauge

from .controllers import HoldGripperControllerConfig, LimitedLeadEEPoseController, LimitedLeadEEPoseControllerConfig, solve_ik
from .fingers import Finger
from .panda_gelsight_urdf import panda_gelsight_urdf

GEL_STIFFNESS = 16000.0
"""Stiffness of the gel, in N/m per contact point. PhysX averages it with the other body's 0: 8 kN/m acts, which is 0.6 mm at
20 N on a face."""
GEL_FRICTION = 0.5
"""Coulomb's friction coefficient of the gel (public code of the paper); PhysX averages it with the other body's. A real
gel's is higher, but PhysX takes the friction of a face at two far corners, with twice the torque of an even pressure
(docs/sensor.md)."""
HOUSING_FRICTION = 0.3
"""Coulomb's friction coefficient of the fingers' housings: ManiSkill's default."""
ARM_STIFFNESS, ARM_DAMPING, ARM_FORCE_LIMIT = 1e3, 1e2, 100.0
"""Joint control of the arm, in N m/rad, N m s/rad and N m: those of ManiSkill's Panda."""
HOLD_STIFFNESS = 1.0e4
"""Stiffness of a finger that holds, in N/m: a push of 10 N shifts a held object by 0.5 mm between the two fingers."""
HOLD_DAMPING, HOLD_FORCE_LIMIT = 2e2, 100.0
"""Damping, in N s/m, and largest force, in N, of a finger that holds."""
GRIPPER_FORCE_LIMIT = 40.0
"""Largest force of a finger, in N, that a policy can command. Set once; not tuned."""
GRASP_FORCE, GRASP_ANGLE = 0.5, 85.0
"""Smallest force of each pad on a body, in N, and largest angle between that force and the direction into the pad, in degrees,
with which the hand grasps it (ManiSkill's Panda)."""
STILL = 0.2
"""Largest speed of a joint of an arm that is still, in rad/s (ManiSkill's Panda)."""
FINGER_RANGE = (-0.01, 0.04)
"""Range of a finger's commanded distance from the middle, in m. A command beyond the surface of a held object is a force:
1 kN/m times the distance. An object of width w is so held with 10 N + 500 N/m w at most: a peg with 14 N."""
IK_STEPS = 20
"""Number of Levenberg-Marquardt steps of the inverse kinematics at a reset on a GPU. Set once; not tuned."""
JOINT_DELTA = 0.1
"""Largest change of a joint's target in a step of the delta controllers of joints, in rad (ManiSkill's Panda)."""
ABSOLUTE_LEAD_POS, ABSOLUTE_LEAD_ROT = 0.024, 0.127
"""Largest lead of an absolute target over the tool, in m and rad: the lead limit of delta control plus its largest step along
the diagonal, so that an absolute action can do what a delta action can."""
ABSOLUTE_RANGE_POS, ABSOLUTE_RANGE_ROT = 2.0, 2 * np.pi
"""Largest coordinate, in m, and angle, in rad, of an absolute action (ManiSkill's Panda)."""
WRIST_NEAREST = 0.005
"""Smallest distance that the wrist camera draws, in m; it is small since the fingers are near. Set once; not tuned."""
FIXED_GRIPPER = "_fixed_gripper"
"""Suffix of the names of control modes without an action for the gripper, which keeps its grip."""
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
ACTION_AXES = {
    "pd_ee_delta_pose": (*_POSE, "gripper"),
    "pd_ee_delta_pose_fixed_gripper": _POSE,
    "pd_ee_delta_pose_fixed_roll_pitch": (*_POSE, "gripper"),
    "pd_ee_delta_pose_fixed_rotation": (*_POSE, "gripper"),
    "pd_ee_delta_yaw": ("x", "y", "z", "yaw", "gripper"),
}
"""Names of the components of an action, in order, by delta control mode; rotations are about the axes of the base frame."""
_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
JOINT_ACTION_AXES = {
    f"{mode}{end}": names
    for mode in ("pd_joint_pos", "pd_joint_delta_pos", "pd_joint_target_delta_pos")
    for end, names in (("", (*_JOINTS, "gripper")), (FIXED_GRIPPER, _JOINTS))
}
"""Names of the components of an action, in order, by control mode that commands joints."""
LOCKED_AXES = {"pd_ee_delta_pose_fixed_roll_pitch": (0, 1), "pd_ee_delta_pose_fixed_rotation": (0, 1, 2)}
"""Axes of the base frame about which an action does not turn the hand, although it has components for them, by control mode."""
WRIST_CAMERA_POSITION = (0.045, 0.0, 0.04)
"""Position of the wrist camera in the hand frame, in m (public code of the paper)."""
WRIST_CAMERA_FORWARD = (-0.5, 0.0, np.sqrt(3) / 2)
"""Direction of the wrist camera's view in the hand frame: along the fingers, tilted inward by 30 degrees."""


@register_agent()
class PandaGelSight(BaseAgent):
    """Panda arm, Franka hand, two fingers with gels: GelSight R1.5, or of the sizes given.

    The gel is a compliant contact: PhysX takes a negative restitution as a spring (N/m per contact point). Pads are the links
    `gel_left` and `gel_right`; the tool centre point lies between their centres, z along the fingers.

    Args:
        args: Positional arguments of ManiSkill's `BaseAgent`.
        finger: Sizes of the fingers; those of the GelSight R1.5 if not given.
        kwargs: Other arguments of ManiSkill's `BaseAgent`.
    """

    uid = "panda_gelsight"
    urdf_config: ClassVar[dict[str, Any]] = dict(
        _materials=dict(
            gel=dict(static_friction=GEL_FRICTION, dynamic_friction=GEL_FRICTION, restitution=-GEL_STIFFNESS),
            housing=dict(static_friction=HOUSING_FRICTION, dynamic_friction=HOUSING_FRICTION, restitution=0.0),
        ),
        link=dict(
            gel_left=dict(material="gel"),
            gel_right=dict(material="gel"),
            panda_leftfinger=dict(material="housing"),
            panda_rightfinger=dict(material="housing"),
        ),
    )
    arm_joint_names: ClassVar[list[str]] = list(_JOINTS)
    gripper_joint_names: ClassVar[list[str]] = ["panda_finger_joint1", "panda_finger_joint2"]
    ee_link_name = "panda_hand_tcp"
    keyframes: ClassVar[dict[str, Keyframe]] = dict(
        # fingers straight down over (0.5, 0), their tips 150 mm above the table: the paper's start
        tool_down=Keyframe(qpos=np.array([0.0, -0.2086, 0.0, -2.2905, 0.0, 2.0819, np.pi / 4, 0.04, 0.04]), pose=sapien.Pose()),
        rest=Keyframe(
            qpos=np.array([0.0, np.pi / 8, 0, -np.pi * 5 / 8, 0, np.pi * 3 / 4, np.pi / 4, 0.04, 0.04]),
            pose=sapien.Pose(),
        ),
    )

    mounted_cameras: tuple[str, ...] = ("wrist",)
    """Names of the cameras on the robot that are rendered."""

    def __init__(self, *args, finger: Finger | None = None, **kwargs):
        self.finger = finger or Finger()
        super().__init__(*args, **kwargs)

    @property
    def urdf_path(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return panda_gelsight_urdf(self.scene.can_render(), self.finger)

    def set_control_mode(self, control_mode: str | None = None) -> None:
        """Choose the controller by its name; the default one if it is not given.

        Raises:
            InvalidArgumentError: The robot has no such controller; ManiSkill's own method fails by an assertion.
        """
        wanted = self._default_control_mode if control_mode is None else control_mode
        super().set_control_mode(one_of("control_mode", wanted, self.supported_control_modes))

    def set_action(self, action: torch.Tensor) -> None:
        """Pass an action on to the controller.

        ManiSkill's own method does the same, but causes a warning of NumPy 2 when it looks for NaN in a tensor. The tasks of
        this package have checked their actions before; those of ManiSkill, which can have this robot, have not.

        Args:
            action: Actions (N, D) of the control mode.

        Raises:
            InvalidArgumentError: The action has a NaN or an infinite number, in a simulation on the CPU.
        """
        if not self.scene.gpu_sim_enabled and not torch.isfinite(given := torch.as_tensor(action)).all():
            raise InvalidArgumentError(f"the action holds NaN or infinity: {given.tolist()}; give finite numbers")
        self.controller.set_action(action)

    def get_controller_state(self) -> dict[str, dict[str, torch.Tensor]]:
        """Targets of arm and gripper, (N, ...) each; where joints are controlled, those of the drives, which exert the forces.

        ManiSkill's own controllers of joints keep no target, or, with `use_target`, set it without the drives.
        """
        drives = self.robot.get_drive_targets()
        joints = {name: dict(target_qpos=drives[:, part.active_joint_indices]) for name, part in self._joint_parts.items()}
        poses = {name: part.get_state() for name, part in self._parts.items() if name not in joints}
        return poses | joints

    def set_controller_state(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Set the targets that a state holds; it may lack some, or hold those of another control mode."""
        for name, part in self._parts.items():
            if name not in self._joint_parts:
                part.set_state(state.get(name))
            elif given := state.get(name):  # empty in files that hold no targets of these joints
                targets = common.to_tensor(given["target_qpos"], device=self.device).reshape(-1, len(part.joints))
                part._target_qpos = targets.clone()
                part.set_drive_targets(targets)

    @property
    def _parts(self) -> dict[str, Any]:
        """Controllers of arm and gripper by name."""
        return self.controller.controllers

    @property
    def _joint_parts(self) -> dict[str, PDJointPosController]:
        """Those of them that control joints, and not the pose of the tool."""
        return {name: part for name, part in self._parts.items() if not isinstance(part, LimitedLeadEEPoseController)}

    @property
    def _controller_configs(self):
        drive = dict(
            joint_names=self.arm_joint_names, stiffness=ARM_STIFFNESS, damping=ARM_DAMPING, force_limit=ARM_FORCE_LIMIT
        )
        pose = drive | dict(ee_link=self.ee_link_name, urdf_path=self.urdf_path)
        delta_pose = LimitedLeadEEPoseControllerConfig(**pose)
        absolute_pose = LimitedLeadEEPoseControllerConfig(
            **pose,
            use_delta=False,
            normalize_action=False,
            pos_upper=ABSOLUTE_RANGE_POS,
            rot_upper=ABSOLUTE_RANGE_ROT,
            target_lead_limit_pos=ABSOLUTE_LEAD_POS,
            target_lead_limit_rot=ABSOLUTE_LEAD_ROT,
        )
        locked = {mode: LimitedLeadEEPoseControllerConfig(**pose, locked_axes=axes) for mode, axes in LOCKED_AXES.items()}
        delta_yaw = LimitedLeadEEPoseControllerConfig(**pose, rotation_axes=(2,))
        joint_delta = drive | dict(lower=-JOINT_DELTA, upper=JOINT_DELTA, use_delta=True)
        arms = dict(  # each of these exists also with a gripper that keeps its grip
            pd_ee_delta_pose=delta_pose,
            pd_ee_pose=absolute_pose,
            pd_joint_pos=PDJointPosControllerConfig(**drive, lower=None, upper=None, normalize_action=False),
            pd_joint_delta_pos=PDJointPosControllerConfig(**joint_delta),
            pd_joint_target_delta_pos=PDJointPosControllerConfig(**joint_delta, use_target=True),
        )
        gripper, hold = self._gripper_configs
        return deepcopy_dict(
            {name: dict(arm=arm, gripper=gripper) for name, arm in arms.items()}
            | {name + FIXED_GRIPPER: dict(arm=arm, gripper=hold) for name, arm in arms.items()}
            | {mode: dict(arm=arm, gripper=gripper) for mode, arm in locked.items()}  # 7-D, of which two or three do nothing
            | dict(pd_ee_delta_yaw=dict(arm=delta_yaw, gripper=gripper))  # 5-D
        )

    @property
    def _gripper_configs(self):
        """The gripper that an action opens and closes, and the one that keeps its grip."""
        gripper = PDJointPosMimicControllerConfig(
            self.gripper_joint_names,
            lower=FINGER_RANGE[0],
            upper=FINGER_RANGE[1],
            stiffness=ARM_STIFFNESS,
            damping=ARM_DAMPING,
            force_limit=GRIPPER_FORCE_LIMIT,
            mimic={"panda_finger_joint2": {"joint": "panda_finger_joint1"}},
        )
        hold = HoldGripperControllerConfig(
            self.gripper_joint_names,
            None,
            None,
            stiffness=HOLD_STIFFNESS,
            damping=HOLD_DAMPING,
            force_limit=HOLD_FORCE_LIMIT,
        )
        return gripper, hold

    @property
    def _sensor_configs(self):
        if "wrist" not in self.mounted_cameras:
            return []
        forward = np.array(WRIST_CAMERA_FORWARD)
        left = np.array([0.0, 1.0, 0.0])
        rotation = np.stack([forward, left, np.cross(forward, left)], axis=1)  # SAPIEN cameras: x ahead, y left, z up
        pose = sapien.Pose(np.block([[rotation, np.c_[list(WRIST_CAMERA_POSITION)]], [np.zeros(3), 1.0]]))
        return [
            CameraConfig(
                "wrist",
                pose=pose,
                width=IMAGE_SIZE,
                height=IMAGE_SIZE,
                fov=FIELD_OF_VIEW,
                near=WRIST_NEAREST,
                far=FARTHEST,
                mount=self.robot.links_map["panda_hand"],
                shader_config=camera_shader(),
            )
        ]

    def _after_init(self):
        self.tcp = self.robot.links_map[self.ee_link_name]
        self.gels = {side: self.robot.links_map[f"gel_{side}"] for side in ("left", "right")}
        self._gel_indices = [int(gel.index[0]) for gel in self.gels.values()]
        self._gauges = {side: WrenchGauge(self.robot, gel) for side, gel in self.gels.items()}
        # joint frame -> pad frame -> right pad's frame; pad frames share y and point against each other in x and z
        to_pad = [gel.joint._objs[0].pose_in_child.to_transformation_matrix()[:3, :3] for gel in self.gels.values()]
        rotations = np.stack([np.diag([-1.0, 1.0, -1.0]) @ to_pad[0], to_pad[1]])
        self._joint_to_hand = torch.as_tensor(rotations, dtype=torch.float32, device=self.device)

    def reset(self, init_qpos: torch.Tensor | None = None, grip_force: float = 0.0):
        """Put the joints of the n environments that are being reset in place, and make them stay there.

        Args:
            init_qpos: Joint positions (n, 9), in rad and m; the present ones if not given.
            grip_force: Force, in N, of each finger on the object that it holds at these joint positions.
        """
        super().reset(init_qpos)
        if init_qpos is not None:
            targets = init_qpos.clone()
            targets[:, 7:] -= grip_force / self.controller.controllers["gripper"].config.stiffness
            self.robot.set_joint_drive_targets(targets, self.robot.active_joints, torch.arange(9, device=self.device))

    def reset_tool(self, pose: Pose, opening: float = FINGER_RANGE[1], grip_force: float = 0.0, wrist_turn: float = 0.0):
        """Reset the robot with the tool at given poses.

        Args:
            pose: Poses (n,) of the tool in the base frame.
            opening: Distance of each finger from the middle, in m.
            grip_force: Force, in N, of each finger on the object that it holds there.
            wrist_turn: Angle, in rad, by which the last joint is turned in the first guess of the inverse kinematics; it
                selects one of the solutions that differ by a whole turn.
        """
        qpos = torch.tensor(self.keyframes["tool_down"].qpos, dtype=torch.float32, device=self.device).repeat(len(pose), 1)
        qpos[:, 6] += wrist_turn
        qpos[:, :7] = self.solve_ik(pose, qpos)
        qpos[:, 7:] = opening
        self.reset(qpos, grip_force)

    def get_proprioception(self):
        return dict(qpos=self.robot.get_qpos(), qvel=self.robot.get_qvel())  # no controller internals

    @property
    def tcp_pose(self) -> Pose:
        """Pose of the tool centre point in the world, for ManiSkill's tasks."""
        return self.tcp.pose

    @property
    def tcp_pose_at_base(self) -> Pose:
        """Pose of the tool centre point in the robot's base frame."""
        return self.robot.pose.inv() * self.tcp.pose

    def solve_ik(self, pose: Pose, q0: torch.Tensor) -> torch.Tensor:
        """Arm joint angles (N, 7), in rad, that put the tool at poses (N,) in the base frame; see `controllers.solve_ik`."""
        return solve_ik(self._kinematics, pose, q0, iterations=IK_STEPS)

    def tool_pose_at(self, joints: torch.Tensor) -> Pose:
        """Pose of the tool in the base frame at arm joint angles (1, 7), in rad; only for one environment on the CPU."""
        model = self._kinematics.pmodel
        model.compute_forward_kinematics(torch.cat([joints[0], self.robot.get_qpos()[0, 7:]]).double().cpu().numpy())
        return Pose.create(model.get_link_pose(self._kinematics.end_link_idx), device=self.device)

    @cached_property
    def _kinematics(self) -> Kinematics:
        """Kinematics of the arm: the controller's own, or one for a controller of joints, which has none."""
        arm = self.controller.controllers["arm"]
        if isinstance(arm, LimitedLeadEEPoseController):
            return arm.kinematics
        return Kinematics(self.urdf_path, self.ee_link_name, self.robot, arm.active_joint_indices)

    def pad_wrench(self, side: str) -> torch.Tensor:
        """Force and moment (N, 6), N and N m, of the world on the "left" or "right" pad, pad frame; what TacFF adds up to.

        Raises:
            InvalidArgumentError: There is no such pad.
        """
        return self._gauges[one_of("side", side, self._gauges)].read()

    def held_object_force(self, joint_forces: torch.Tensor) -> torch.Tensor:
        """Norm (...), in N, of the force of both pads together on the held object, which equals that of the world on it.

        Args:
            joint_forces: Forces and moments (..., L, 6) of the joints of all L links, N and N m, in the joints' frames, as
                `robot.get_link_incoming_joint_forces` returns them.
        """
        forces = joint_forces[..., self._gel_indices, :3]
        return torch.linalg.norm(torch.einsum("...kj,kij->...i", forces, self._joint_to_hand), dim=-1)

    def is_grasping(self, body: Actor, min_force: float = GRASP_FORCE, max_angle: float = GRASP_ANGLE) -> torch.Tensor:
        """Whether both pads press on a body, as ManiSkill's tasks ask; (N,) bool.

        Args:
            body: The body.
            min_force: Least force on each pad, in N.
            max_angle: Largest angle, in degrees, between the force on a pad and the direction into the pad.
        """
        held = []
        for gel in self.gels.values():
            force = self.scene.get_pairwise_contact_forces(gel, body)
            size, inward = torch.linalg.norm(force, dim=1), -quaternion_apply(gel.pose.q, force.new_tensor([[0.0, 0.0, 1.0]]))
            held.append((size >= min_force) & ((force * inward).sum(1) >= np.cos(np.deg2rad(max_angle)) * size))
        return torch.stack(held).all(dim=0)

    def is_static(self, threshold: float = STILL) -> torch.Tensor:
        """Whether no joint of the arm is faster than `threshold`, in rad/s, for ManiSkill's tasks; (N,) bool."""
        return self.robot.get_qvel()[:, : len(self.arm_joint_names)].abs().amax(dim=1) <= threshold

    def torque_on_held(self, point: torch.Tensor) -> torch.Tensor:
        """Torque (N,), in N m, of both pads on the held object about the vertical through `point` (N, 3).

        It is positive counter-clockwise, seen from above.
        """
        total = torch.zeros(len(point), device=point.device)
        for side, gel in self.gels.items():
            wrench = self.pad_wrench(side).to(point.dtype)
            force, moment = quaternion_apply(gel.pose.q, wrench[:, :3]), quaternion_apply(gel.pose.q, wrench[:, 3:])
            total -= (moment + torch.linalg.cross(gel.pose.p - point, force))[:, 2]
        return total
