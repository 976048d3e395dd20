"""The base class of every ManiFeel task: table, robot, cameras, light, touch, and the contents of an observation."""

# pyright: reportArgumentType=false
# (ManiSkill annotates camera poses as its own, and takes SAPIEN's)
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from gymnasium.envs.registration import EnvSpec
from mani_skill.utils.structs.types import GPUMemoryConfig, SceneConfig, SimConfig

from manifeel_ms3.agents import PandaGelSight
from manifeel_ms3.agents.fingers import Finger
from manifeel_ms3.arguments import by_name, checked_action, one_of, require_amount
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.rendering.backend import available_render_backend, restrict_torch_after_fork
from manifeel_ms3.rendering.presentation import drawn_sizes
from manifeel_ms3.sensors import TactileSensorConfig
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR, task_sensor

from .checks import (
    check_argument_names,
    check_base_arguments,
    check_renderer,
    checked_randomization,
    checked_reset,
    simulates_on_gpu,
    split_sensor_configs,
)
from .obs_modes import PAD, cameras_to_observe, pads_to_observe, split_obs_mode
from .registry import gym_id, instruction_of
from .scenery import SPACING, SceneryEnv
from .states import RestorableEnv, take_given_state

CONTROL_FREQ = 10
"""Control steps per second, in Hz (public code of the paper)."""
FORCE_DECIMALS = 3
"""Decimals of a contact force in json files, in N: millinewtons, far below what matters in contact."""
CAMERAS = ("front", "side", "wrist")
SIDES = ("left", "right")
HOLD_SECONDS = 0.5
"""Time for which a goal must hold until the episode is a success unless another is asked for, in s. Our choice."""
SETTLE_SECONDS = 0.2
"""Time in which the grip settles before the first observation, in s. Set once; not tuned."""
GPU_MEMORY = GPUMemoryConfig(max_rigid_contact_count=2**21, max_rigid_patch_count=2**19, collision_stack_size=2**26)
"""Numbers of contacts and contact patches, and bytes for candidates of contact, for which the engine reserves memory on a GPU:
more than ManiSkill's defaults, since many environments have threads and teeth. Not tried out; the bytes are PhysX's default."""
CONTACTS: dict[str, Any] = dict(
    enable_tgs=False,  # with TGS, friction of a compliant contact chatters and creeps (0.2 mm/s at a third of the cone)
    contact_offset=5e-4,  # m: clearances are below a millimetre
    solver_position_iterations=25,  # with the physics rate, what a held light part needs (docs/sensor.md)
    sleep_threshold=0.0,  # a sleeping body's contacts freeze
)
"""Settings of the engine's contact solver: fields of ManiSkill's `SceneConfig`."""


class VisuotactileEnv(RestorableEnv, SceneryEnv):
    """Base class of the ManiFeel tasks: a Panda with two tactile fingers at the origin of a table, x ahead, z up.

    The observation mode joins ManiSkill's modes with `tacrgb` and `tacff` by "+". An observation holds what the mode asks for:

    - `sensor_data[camera]`: `rgb` uint8 (N, 256, 256, 3) and ManiSkill's other textures;
    - `sensor_data["tactile_left" | "tactile_right"]`: `rgb` uint8 (N, 240, 320, 3); `force_field` float32 (N, 10, 14, 3), N per
      taxel, and `penetration` float32 (N, 10, 14), m (see `TactileSensor`); sizes of the default sensor;
    - `extra["tcp_pose"]` float32 (N, 7): m and wxyz, in the robot's base frame. Privileged state is in the state modes alone.

    `info` holds `success` (the goal has held for `hold_seconds`), `success_paper` where the goal of the paper's public code is
    known (its threshold was met at any step of the episode), `fail`, `contact_force` (N; the largest force, in any physics step
    of the last control step, of both pads together on the held object, its weight and inertia included) and the task's own
    measures. The `info` of a reset also holds `language_instruction`, the task as a sentence for each environment.

    Subclasses define `Randomization`, `_load_task`, `_initialize_task`, `measure`, `goal_reached`, `failed`, and rewards.

    Args:
        args: Positional arguments of ManiSkill's `BaseEnv`.
        obs_mode: Observation mode, such as "rgb+tacff"; "state" if not given.
        control_mode: Controller, one of the robot's; the task's own if not given.
        robot_uids: Robot; only "panda_gelsight" is supported.
        render_backend: "auto", "gpu", "cpu" or "none".
        human_render_camera_configs: Fields of the camera of `render_mode="rgb_array"` to change, such as `dict(width=512)`; its
            images have 768 x 768 pixels, and take about a second each on a CPU.
        cameras: Cameras to render, of "front", "side", "wrist" and the task's own; its policy camera if not given.
        tactile_sensors: Pads to observe, of "left", "right"; by default the right one, as in the paper.
        sensor: Sensor on both fingers: "gelsight_r15", "gelsight_mini", "digit", or one that another package registers.
        tactile: Fields of the pads' `TactileSensorConfig` to change, by dotted name: `{"units": "tacsl", "optics.noise": 2.0}`.
        sensor_configs: ManiSkill's: fields to change of one sensor, by its name, or of every camera. Pads are sensors, too:
            `dict(width=128, wrist=dict(fov=1.2), tactile_right={"optics.noise": 2.0})`.
        imperfections: Amounts of `ImperfectionConfig` by name, such as `{"hysteresis": 0.2, "delay": (0, 3)}`; the entry
            "imperfections" of `info` holds what the episode drew of them, by pad.
        lighting: "normal" or "dim" (5 %).
        quality: Quality of the cameras' images: "normal", or "fast", which leaves out the shadow.
        hold_seconds: Time for which the goal must hold until the episode is a success, in s. Demonstrations end at success, so
            that those of a larger one show how to stay at the goal.
        occlusion: Whether the task's occluder hides its interior, as it does by default where there is one.
        randomization: Fields of the task's `Randomization` to override, by name.
        visual_randomization: Fields of `VisualRandomization` to override, by name: `dict(light_level=0.3)`. Looks are drawn
            from the episode's seed, and `info["looks"]` holds them; by default they are the same in every episode.
        kwargs: Other arguments of ManiSkill's `BaseEnv`.

    Raises:
        InvalidArgumentError: An argument is unknown or has a value that is not allowed; the message lists those that are.
        MachineError: Images are asked for on a machine without a renderer, or many environments on one without a GPU.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["panda_gelsight"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    Randomization: type
    """Frozen dataclass of the half ranges of the task's random quantities."""
    policy_cameras: tuple[str, ...] = ("wrist",)
    default_control_mode = "pd_ee_delta_pose_fixed_gripper"
    has_occluder = False
    """Whether the task has a part that hides its interior from the policy's camera."""
    grips_round_parts = False
    """Whether the parts that the hand holds are round (`Finger.grips_round_parts`)."""
    physics_rate = 480
    """Physics steps per second, in Hz. At 240 the solver does not converge on a light part that is held and pushed: it turns
    in the hand like on a rubber band, and springs back."""
    contacts: dict[str, Any] = CONTACTS
    """Settings of the engine's contact solver: fields of ManiSkill's `SceneConfig`."""
    max_reward = 4.0
    """Largest value of the dense reward."""
    agent: PandaGelSight
    _spec: EnvSpec | None = None
    _episodes_of_seed: np.ndarray
    """Number of episodes (N,) that each environment has begun since a reset with a seed. ManiSkill keeps that seed in resets
    without one, so that draws from the seed alone would be the same in every episode."""

    def __init__(
        self,
        *args,
        obs_mode: str | None = None,
        control_mode: str | None = None,
        robot_uids: str = "panda_gelsight",
        render_backend: str = "auto",
        human_render_camera_configs: Mapping[str, Any] | None = None,
        cameras: Iterable[str] | None = None,
        tactile_sensors: Iterable[str] = ("right",),
        sensor: str = DEFAULT_SENSOR,
        tactile: Mapping[str, Any] | None = None,
        sensor_configs: Mapping[str, Any] | None = None,
        imperfections: Mapping[str, Any] | None = None,
        lighting: str = "normal",
        quality: str = "normal",
        hold_seconds: float = HOLD_SECONDS,
        occlusion: bool | None = None,
        randomization: dict[str, float] | None = None,
        visual_randomization: dict[str, float] | None = None,
        **kwargs,
    ):
        check_argument_names(type(self), kwargs)
        self._full_obs_mode, self.sensor = obs_mode or "state", sensor
        own_mode, self._tactile_outputs = split_obs_mode(self._full_obs_mode)
        asked = self.policy_cameras if cameras is None else cameras
        self.camera_names = cameras_to_observe(self._full_obs_mode, asked, self.known_cameras())
        self._sides = pads_to_observe(self._full_obs_mode, tactile_sensors, SIDES)
        names = {side: PAD + side for side in SIDES}
        camera_configs, own = split_sensor_configs(sensor_configs or {}, self.camera_names, [names[s] for s in self._sides])
        pad_options = by_name("tactile", tactile or {}, '{"units": "tacsl", "optics.noise": 2.0}')
        configs = {
            side: task_sensor(sensor, name, f"gel_{side}", {**pad_options, **own.get(name, {})}, imperfections)
            for side, name in names.items()
        }
        self._tactile_configs = {names[side]: configs[side] for side in self._sides}
        self._finger = self._finger_of([configs[side] for side in self._sides or SIDES])
        self._set_looks(lighting, quality, visual_randomization or {}, simulates_on_gpu(kwargs))
        require_amount("hold_seconds=", hold_seconds)
        self._hold_seconds = hold_seconds
        self.occlusion = self._checked_occlusion(occlusion)
        self.randomization = checked_randomization(
            type(self).__name__, self.Randomization, randomization or {}, self._largest_ranges()
        )
        one_of("robot_uids", robot_uids, self.SUPPORTED_ROBOTS)
        check_base_arguments(type(self), render_backend, kwargs)
        restrict_torch_after_fork()
        backend = available_render_backend(render_backend)
        check_renderer(backend, render_backend, own_mode, kwargs)
        super().__init__(
            *args,
            obs_mode=own_mode,
            control_mode=control_mode or self.default_control_mode,
            robot_uids=robot_uids,
            render_backend=backend,
            sensor_configs=camera_configs,
            human_render_camera_configs=drawn_sizes(human_render_camera_configs or {}),
            **kwargs,
        )

    @classmethod
    def known_cameras(cls) -> tuple[str, ...]:
        """Names of the cameras that the task can render."""
        return (*CAMERAS, *cls.own_cameras)

    def _checked_occlusion(self, occlusion: bool | None) -> bool:
        """Whether the task's occluder hides its interior."""
        one_of("occlusion", occlusion, (None, False, True))
        if occlusion and not self.has_occluder:
            raise InvalidArgumentError(f"occlusion=True: {type(self).__name__} has nothing that could occlude; leave it False")
        return self.has_occluder if occlusion is None else occlusion

    def _finger_of(self, pads: list[TactileSensorConfig]) -> Finger:
        """The finger that carries the pads; both fingers are alike."""
        finger, *others = (Finger.of(pad, self.grips_round_parts) for pad in pads)
        if any(other != finger for other in others):
            raise InvalidArgumentError(
                "the pads have housings or gels of different sizes, but both fingers are alike; give such fields in `tactile`, "
                "for both pads, instead of in `sensor_configs` for one"
            )
        return finger

    @property
    def obs_mode(self) -> str:
        return self._full_obs_mode

    @property
    def spec(self) -> EnvSpec | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Specification of gymnasium. Its id names the module to import, for ManiSkill's tools, which make it from a file."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = replace(spec, id=gym_id(spec.id, type(self))) if spec and ":" not in spec.id else spec

    # ---------------------------------------------------------------- for tasks to define

    def _largest_ranges(self) -> dict[str, tuple[float, str]]:
        """By the name of a field of `Randomization`: its largest playable half range, and what happens beyond it."""
        return {}

    def _load_task(self) -> None:
        """Build the task's parts."""
        raise NotImplementedError

    def _initialize_task(self, env_idx: torch.Tensor) -> None:
        """Place robot and parts at the start of an episode."""
        raise NotImplementedError

    def measure(self) -> dict[str, torch.Tensor]:
        """The task's measures, (N,) each, in SI units."""
        raise NotImplementedError

    def goal_reached(self, measures: dict[str, torch.Tensor]) -> torch.Tensor:
        """Whether the goal is met at this moment, (N,) bool."""
        raise NotImplementedError

    def paper_goal_reached(self, measures: dict[str, torch.Tensor]) -> torch.Tensor | None:
        """Whether the paper's public code would count a success at this moment, (N,) bool; None if its goal is not public."""
        return None

    def failed(self, measures: dict[str, torch.Tensor]) -> torch.Tensor:
        """Whether the episode can no longer succeed, (N,) bool."""
        raise NotImplementedError

    def shortcomings(self, measures: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Reasons, by name, why an episode has not succeeded, (N,) bool each; an evaluation counts the first that holds."""
        return {}

    def _privileged_state(self) -> dict[str, torch.Tensor]:
        """State of the task's parts that only the state modes observe."""
        raise NotImplementedError

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / self.max_reward

    # ---------------------------------------------------------------- scene

    @property
    def _default_sim_config(self):
        return SimConfig(
            spacing=SPACING,
            sim_freq=self.physics_rate,
            control_freq=CONTROL_FREQ,
            gpu_memory_config=GPU_MEMORY,
            scene_config=SceneConfig(**self.contacts),
        )

    def _load_agent(self, options: dict):
        # not from its name in `robot_uids`: ManiSkill makes robots by name without further arguments
        self.agent = PandaGelSight(
            self.scene, self._control_freq, self._control_mode, initial_pose=sapien.Pose(), finger=self._finger
        )
        self.agent.mounted_cameras = tuple(name for name in self.camera_names if name == "wrist")

    def _load_scene(self, options: dict):
        self._build_bench()
        self._load_task()

    def _after_reconfigure(self, options: dict):
        self._make_random_looks()
        self._make_tactile_sensors()
        self._measured: dict[str, torch.Tensor] | None = None
        self._steps_at_goal = torch.zeros(self.num_envs, dtype=torch.int32, device=self.device)
        self._success_paper = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._contact_force = torch.zeros(self.num_envs, device=self.device)

    # ---------------------------------------------------------------- episode

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None):
        """Reset as ManiSkill does; with a seed, a single environment also builds its scene anew.

        The engine's solver remembers earlier episodes. Only in a new scene is an episode a function of its seed alone, bit for
        bit. Where several environments share a process, ManiSkill seeds the draws of their initial states with the first
        environment's seed: they are then functions of that seed and of the number of environments.

        The option `reset_to_env_states` begins an episode in a given state. Its observation is computed, even where ManiSkill
        would take a given one.
        """
        options = dict(by_name("options", options or {}, "dict(reconfigure=True)"))
        seed, env_idx = checked_reset(seed, options.get("env_idx"), self.num_envs, self.device)
        state = take_given_state(options, self)
        if seed is not None:
            self._episodes_of_seed = np.zeros(self.num_envs, np.int64)
            if self.num_envs == 1:
                options["reconfigure"] = True
        if "env_idx" in options:
            options["env_idx"] = env_idx.sort().values  # any list is accepted; ManiSkill assigns rows in rising order
        with self._others_unchanged(env_idx):
            with self._nothing_observed():  # before the grip has settled
                _, info = super().reset(seed=seed, options=options)
            if state is None:
                self._settle()
            elif isinstance(state, Mapping):
                self.set_state_dict(state, env_idx)
            else:
                self.set_state(state, env_idx)
        self._touch_is_stale[env_idx] = True
        info = self.get_info() | dict(reconfigure=info["reconfigure"], language_instruction=self.get_language_instruction())
        self._last_obs = self.get_obs(info)
        return self._last_obs, info

    def get_language_instruction(self, **_kwargs: Any) -> list[str]:
        """The task as a sentence, one for each environment; the method's name and form are those of ManiSkill's tasks."""
        return [instruction_of(type(self))] * self.num_envs

    def _settle(self) -> None:
        """Let the grip take its load before the first observation."""
        for _ in range(round(SETTLE_SECONDS * self._sim_freq)):
            self.scene.step()
        if self.gpu_sim_enabled:
            self.scene._gpu_fetch_all()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict):
        with torch.device(self.device):
            self._initialize_task(env_idx)
        reset = env_idx.cpu().numpy()
        seeds, episodes = self._episode_seed[reset], self._episodes_of_seed[reset]
        self._episodes_of_seed[reset] += 1
        self._draw_looks(int(seeds[0]), int(episodes[0]))
        self._steps_at_goal[env_idx] = 0
        self._success_paper[env_idx] = False
        self._contact_force[env_idx] = 0.0
        self._touch_is_stale[env_idx], self._measured = True, None
        for sensor in self._tactile_sensors.values():
            sensor.reset(env_idx, seeds, episodes)

    def _step_action(self, action):
        if action is not None:
            shape: Any = self.single_action_space.shape
            batch = (self.num_envs, *shape)
            action = checked_action(action, (shape, batch) if self.num_envs == 1 else (batch,), self.device)
        self._joint_forces = []
        action = super()._step_action(action)
        self._contact_force = self.agent.held_object_force(torch.stack(self._joint_forces)).amax(dim=0)
        self._touch_is_stale[:] = True
        self._measured = self.measure()  # for the `evaluate` that follows
        reached = self.goal_reached(self._measured)
        self._steps_at_goal = torch.where(reached, self._steps_at_goal + 1, 0)
        paper_reached = self.paper_goal_reached(self._measured)
        if paper_reached is not None:
            self._success_paper |= paper_reached
        return action

    def _after_simulation_step(self):
        self._joint_forces.append(self.agent.robot.get_link_incoming_joint_forces())

    def _state_has_changed(self, changed: torch.Tensor | slice, joint_forces: torch.Tensor | None) -> None:
        """Let what is counted and measured be that of the new state; steps at the goal count on if it is at the goal, too."""
        if joint_forces is not None:
            self._contact_force = self.agent.held_object_force(joint_forces)
        self._steps_at_goal[changed] *= self.goal_reached(self.measure())[changed]
        self._touch_is_stale[changed], self._measured = True, None

    def evaluate(self) -> dict:
        measures, self._measured = self._measured or self.measure(), None
        held = self._steps_at_goal >= max(1, round(self._hold_seconds * self._control_freq))
        info = dict(success=held, fail=self.failed(measures), contact_force=self._contact_force.clone(), **measures)
        info["elapsed_steps"] = self._elapsed_steps.clone()  # instead of ManiSkill's counter itself, which counts on
        if self.paper_goal_reached(measures) is not None:
            info["success_paper"] = self._success_paper.clone()
        if self._looks:
            info["looks"] = dict(self._looks)
        return info | self._drawn_imperfections()

    # ---------------------------------------------------------------- observation

    def _get_obs_extra(self, info: dict) -> dict:
        extra = dict(tcp_pose=self.agent.tcp_pose_at_base.raw_pose)
        return extra | self._privileged_state() if self.obs_mode_struct.use_state else extra
