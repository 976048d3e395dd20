"""The base of every ManiFeel task: table, robot, cameras, light, touch, and what an observation holds."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import Camera, CameraConfig
from mani_skill.utils import common
from mani_skill.utils.structs.types import GPUMemoryConfig, SceneConfig, SimConfig
from mani_skill.utils.visualization.misc import tile_images

from manifeel_ms3.agents import PandaGelSight
from manifeel_ms3.arguments import by_name, is_number, one_of, several_of
from manifeel_ms3.geometry import Box, Part
from manifeel_ms3.sensors import TactileSensor, gelsight_r15, with_options

from .obs_modes import split_obs_mode
from .pictures import same_height, same_size
from .rendering import FORKED, NO_RENDERER, available_render_backend, mend_threads, renderer_lost
from .viewpoints import looking_at, looking_down

CAMERAS = ("front", "side", "wrist")
SIDES = ("left", "right")
LIGHTING = {"normal": 1.0, "dim": 0.05}  # dim: the paper's 5 % of normal
HOLD_SECONDS = 0.5  # a goal counts once it has held this long
SETTLE_SECONDS = 0.2  # the grip settles before the first observation
FIELD_OF_VIEW = np.deg2rad(75)
CONTACTS: dict[str, Any] = dict(
    enable_tgs=False,  # with TGS, friction of a compliant contact chatters and creeps (0.2 mm/s at a third of the cone)
    contact_offset=5e-4,  # m: clearances are below a millimetre
    solver_position_iterations=25,
    sleep_threshold=0.0,  # a sleeping body's contacts freeze
)
TABLE = Part("table", (Box((1.6, 1.6, 0.04), (0.4, 0.0, -0.02)),), colour=(0.55, 0.52, 0.48), friction=0.5)
FLOOR = Part("floor", (Box((8.0, 8.0, 0.02), (0.0, 0.0, -0.76)),), colour=(0.30, 0.31, 0.33))


class VisuotactileEnv(BaseEnv):
    """Base class of the ManiFeel tasks: a Panda with two GelSight fingers at the origin of a table, x ahead, z up.

    Observations (ManiSkill's modes joined by "+" with `tacrgb` and `tacff`) hold, where asked for:

    - `sensor_data[camera]`: `rgb` uint8 (N, 256, 256, 3) and ManiSkill's other textures;
    - `sensor_data["tactile_left" | "tactile_right"]`: `rgb` uint8 (N, 240, 320, 3); `force_field` float32 (N, 10, 14, 3), N per
      taxel, and `penetration` float32 (N, 10, 14), m (see `TactileSensor`);
    - `extra["tcp_pose"]` float32 (N, 7): m and wxyz, in the robot's base frame. Nothing privileged but in the state modes.

    `info` holds `success` (the goal has held for 0.5 s), `fail`, `contact_force` (N, between what the fingers hold and the
    rest of the world, the largest of any physics step of the last control step) and the task's own measures.

    Args:
        cameras: those rendered, of "front", "side", "wrist"; default: the task's policy camera.
        tactile_sensors: pads observed, of "left", "right"; default: right, as in the paper.
        tactile: fields of the pads' `TactileSensorConfig` to change, by dotted name: `{"units": "tacsl", "optics.noise": 2.0}`.
        lighting: "normal" or "dim" (5 %).
        occlusion: whether the task's occluder hides its interior, as it does by default where there is one.
        randomization: fields of the task's `Randomization` to override, by name.

    Subclasses define `Randomization`, `_load_task`, `_initialize_task`, `measure`, `goal_reached`, `failed`, and rewards.

    Raises:
        ValueError: an argument with a value that is not known; the message lists what is.
        RuntimeError: pictures are asked for on a machine without a renderer.
    """

    SUPPORTED_ROBOTS = ["panda_gelsight"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    Randomization: type
    policy_cameras: tuple[str, ...] = ("wrist",)
    default_control_mode = "pd_ee_delta_pose_fixed_gripper"
    has_occluder = False
    physics_rate = 240
    """Hz."""
    contacts = CONTACTS
    """How the engine solves contacts: fields of ManiSkill's `SceneConfig`."""
    max_reward = 4.0
    """Of the dense reward."""
    front_camera_at = (0.68, 0.0, 0.15)  # m
    agent: PandaGelSight

    def __init__(
        self,
        *args,
        obs_mode: str | None = None,
        control_mode: str | None = None,
        robot_uids: str = "panda_gelsight",
        render_backend: str = "auto",
        cameras: Iterable[str] | None = None,
        tactile_sensors: Iterable[str] = ("right",),
        tactile: Mapping[str, Any] | None = None,
        lighting: str = "normal",
        occlusion: bool | None = None,
        randomization: dict[str, float] | None = None,
        **kwargs,
    ):
        own_mode, self._tactile_outputs = split_obs_mode(obs_mode or "state")
        self._full_obs_mode = obs_mode or "state"
        self._camera_names = several_of("cameras", self.policy_cameras if cameras is None else cameras, CAMERAS)
        self._sides = several_of("tactile_sensors", tactile_sensors, SIDES)
        self._tactile_configs = {
            f"tactile_{side}": with_options(gelsight_r15(f"tactile_{side}", f"gel_{side}"), tactile or {})
            for side in self._sides
        }
        self._lighting = one_of("lighting", lighting, LIGHTING)
        one_of("occlusion", occlusion, (None, False, True))
        if occlusion and not self.has_occluder:
            raise ValueError(f"occlusion=True: {type(self).__name__} has nothing that could occlude; leave it False")
        self.occlusion = self.has_occluder if occlusion is None else occlusion
        self.randomization = self._make_randomization(randomization or {})
        one_of("robot_uids", robot_uids, self.SUPPORTED_ROBOTS)
        self._check_number(kwargs.get("num_envs", 1))
        mend_threads()
        backend = available_render_backend(render_backend)
        if backend == "none" and (wanted := self._wanted_pictures(own_mode, kwargs.get("render_mode"))):
            raise RuntimeError((FORKED if renderer_lost() else NO_RENDERER).format(wanted=wanted))
        super().__init__(
            *args,
            obs_mode=own_mode,
            control_mode=control_mode or self.default_control_mode,
            robot_uids=robot_uids,
            render_backend=backend,
            **kwargs,
        )

    def _make_randomization(self, overrides: dict[str, float]):
        known = self.Randomization.__dataclass_fields__
        for name, value in by_name("randomization", overrides, "dict(socket_xy=0.01)").items():
            if name not in known:
                raise ValueError(f"randomization[{name!r}] is unknown for {type(self).__name__}; known: {list(known)}")
            if not (is_number(value) and value >= 0):
                raise ValueError(f"randomization[{name!r}]={value!r} must be a finite number >= 0")
            limit, reason = self._largest_ranges().get(name, (np.inf, ""))
            if value > limit:
                raise ValueError(f"randomization[{name!r}]={value!r} is too large, at most {limit:.3g}: {reason}")
        return self.Randomization(**overrides)

    @staticmethod
    def _check_number(num_envs: Any) -> None:
        if type(num_envs) is not int or num_envs < 1:
            raise ValueError(f"num_envs={num_envs!r} must be a whole number of at least 1")
        if num_envs > 1 and not torch.cuda.is_available():
            raise RuntimeError(
                f"num_envs={num_envs}: many environments in one process need a CUDA GPU, and torch sees none; use several "
                "processes (gymnasium's AsyncVectorEnv, --workers of the commands)"
            )

    @staticmethod
    def _wanted_pictures(own_mode: str, render_mode: str | None) -> str:
        if own_mode not in ("none", "state", "state_dict"):
            return f"obs_mode={own_mode!r}"
        return f"render_mode={render_mode!r}" if render_mode else ""

    @property
    def obs_mode(self) -> str:
        return self._full_obs_mode

    # ---------------------------------------------------------------- for tasks to define

    def _largest_ranges(self) -> dict[str, tuple[float, str]]:
        """For fields of `Randomization`: the largest half range that can be played, and what happens beyond."""
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
        """(N,) bool: the goal is met at this moment."""
        raise NotImplementedError

    def failed(self, measures: dict[str, torch.Tensor]) -> torch.Tensor:
        """(N,) bool: the episode cannot be won any more."""
        raise NotImplementedError

    def _privileged_state(self) -> dict[str, torch.Tensor]:
        """What the state modes hold of the task's parts."""
        raise NotImplementedError

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / self.max_reward

    # ---------------------------------------------------------------- scene

    @property
    def _default_sim_config(self):
        return SimConfig(
            sim_freq=self.physics_rate,
            control_freq=10,
            gpu_memory_config=GPUMemoryConfig(max_rigid_contact_count=2**21, max_rigid_patch_count=2**19),
            scene_config=SceneConfig(**self.contacts),
        )

    @property
    def _default_sensor_configs(self):
        views = dict(front=(self.front_camera_at, (-1.0, 0.0)), side=((0.5, -0.17, 0.17), (0.0, 1.0)))
        return [
            CameraConfig(name, looking_down(*views[name]), 256, 256, FIELD_OF_VIEW, near=0.01, far=10)
            for name in self._camera_names
            if name in views
        ]

    @property
    def _default_human_render_camera_configs(self):
        pose = looking_at(np.array([0.85, -0.40, 0.32]), np.array([0.48, 0.0, 0.08]))
        return CameraConfig("render_camera", pose, 512, 512, np.deg2rad(45), near=0.01, far=10)

    def _load_agent(self, options: dict):
        super()._load_agent(options, sapien.Pose())
        self.agent.mounted_cameras = tuple(name for name in self._camera_names if name == "wrist")

    def _load_scene(self, options: dict):
        for part in (TABLE, FLOOR):
            part.build(self.scene, "static", sapien.Pose())
        self._load_task()

    def _load_lighting(self, options: dict):
        level = LIGHTING[self._lighting]
        self.scene.set_ambient_light([0.3 * level] * 3)
        self.scene.add_directional_light([0.4, 0.6, -1], [0.8 * level] * 3, shadow=self.enable_shadow, shadow_scale=1.0)
        self.scene.add_directional_light([-0.5, -0.3, -1], [0.35 * level] * 3)

    def _after_reconfigure(self, options: dict):
        # not in _setup_sensors, which runs only with a renderer: touch works without
        self._tactile_sensors = {
            uid: TactileSensor(config, self.scene, self.agent.robot, self._tactile_outputs)
            for uid, config in self._tactile_configs.items()
            if self._tactile_outputs
        }
        self._touch_is_fresh = False
        self._measured: dict[str, torch.Tensor] | None = None
        self._steps_at_goal = torch.zeros(self.num_envs, dtype=torch.int32, device=self.device)
        self._contact_force = torch.zeros(self.num_envs, device=self.device)

    # ---------------------------------------------------------------- episode

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None):
        """As ManiSkill's. With a seed, on the CPU, the scene is built anew (0.1 s): the engine's solver remembers earlier
        episodes, and only so is an episode a function of its seed alone, bit for bit."""
        options = dict(by_name("options", options or {}, "dict(reconfigure=True)"))
        self._check_seed(seed)
        if seed is not None and self.num_envs == 1:
            options["reconfigure"] = True
        obs, info = super().reset(seed=seed, options=options)
        if "reset_to_env_states" in options:
            return obs, info
        env_idx = torch.as_tensor(options.get("env_idx", torch.arange(self.num_envs)), device=self.device)
        self._settle(env_idx)
        info = self.get_info() | dict(reconfigure=info["reconfigure"])
        self._last_obs = self.get_obs(info)
        return self._last_obs, info

    def _check_seed(self, seed: Any) -> None:
        seeds = seed if isinstance(seed, list | tuple | np.ndarray) else [seed]
        if seed is not None and not all(isinstance(one, int | np.integer) and 0 <= one < 2**32 for one in seeds):
            raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1, or one for each environment")

    def _settle(self, env_idx: torch.Tensor) -> None:
        """Let the grip take its load before the first observation; environments in mid-episode are put back as they were."""
        others = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        others[env_idx] = False
        state = self.get_state_dict() if others.any() else None
        for _ in range(round(SETTLE_SECONDS * self._sim_freq)):
            self.scene.step()
        if self.gpu_sim_enabled:
            self.scene._gpu_fetch_all()
        if state is not None:
            running = others.nonzero()[:, 0]
            state.pop("controller", None)
            state = {kind: {k: v[running] for k, v in bodies.items()} for kind, bodies in state.items()}
            self.set_state_dict(state, running)
        self._touch_is_fresh = False

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict):
        with torch.device(self.device):
            self._initialize_task(env_idx)
        self._steps_at_goal[env_idx] = 0
        self._contact_force[env_idx] = 0.0
        self._touch_is_fresh, self._measured = False, None
        for sensor in self._tactile_sensors.values():
            sensor.reset(env_idx, self._episode_seed[env_idx.cpu().numpy()])

    def _step_action(self, action):
        action = self._checked(action)
        self._pad_forces = []
        action = super()._step_action(action)
        self._contact_force = self.agent.held_object_force(torch.stack(self._pad_forces)).amax(dim=0)
        self._touch_is_fresh = False
        self._measured = self.measure()  # for the `evaluate` that follows
        reached = self.goal_reached(self._measured)
        self._steps_at_goal = torch.where(reached, self._steps_at_goal + 1, 0)
        return action

    def _checked(self, action):
        """The action as a tensor; a wrong shape or a NaN is an error before anything moves."""
        if action is None:
            return None
        try:
            tensor = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        except (TypeError, RuntimeError, ValueError) as error:
            raise ValueError(f"action {action!r} is no array of numbers: {error}") from None
        shape = self.single_action_space.shape
        if tuple(tensor.shape) not in (shape, (self.num_envs, *shape)):
            raise ValueError(
                f"action has shape {tuple(tensor.shape)}; control_mode={self.agent.control_mode!r} takes {shape} "
                f"or {(self.num_envs, *shape)}"
            )
        if not torch.isfinite(tensor).all():
            raise ValueError(
                f"action {tensor.tolist()} holds NaN or infinity; give finite numbers (they are clipped to [-1, 1])"
            )
        return tensor

    def _after_simulation_step(self):
        self._pad_forces.append(self.agent.pad_joint_forces)

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None):
        super().set_state_dict(state, env_idx)
        if "controller" in state:
            self.agent.set_controller_state(state["controller"])
        self._touch_is_fresh, self._measured = False, None

    def evaluate(self) -> dict:
        measures, self._measured = self._measured or self.measure(), None
        held = self._steps_at_goal >= round(HOLD_SECONDS * self._control_freq)
        return dict(success=held, fail=self.failed(measures), contact_force=self._contact_force.clone(), **measures)

    # ---------------------------------------------------------------- observation

    def _get_obs_extra(self, info: dict) -> dict:
        extra = dict(tcp_pose=self.agent.tcp_pose_at_base.raw_pose)
        return extra | self._privileged_state() if self.obs_mode_struct.use_state else extra

    def get_obs(self, info: dict | None = None, unflattened: bool = False):
        if not self._tactile_outputs:
            return super().get_obs(info, unflattened)
        obs = self._get_obs_with_sensor_data(self.get_info() if info is None else info)
        return obs if unflattened else self._flatten_raw_obs(obs)

    def _flatten_raw_obs(self, obs: Any):
        if self._tactile_outputs and self.obs_mode_struct.state:  # plain "state" would flatten touch, too
            tree = dict(agent=obs["agent"], extra=obs["extra"])
            state = common.flatten_state_dict(tree, use_torch=True, device=self.device)
            return {name: data for name, data in obs.items() if name not in tree} | dict(state=state)
        return super()._flatten_raw_obs(obs)

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        wanted = {name: getattr(self.obs_mode_struct.visual, name) for name in self.obs_mode_struct.visual.__dict__}
        return self._sense(wanted, apply_texture_transforms)

    def _sense(self, textures: dict[str, bool], apply_texture_transforms: bool = True) -> dict:
        """What cameras (these textures) and pads see now; nothing else is rendered."""
        cameras = {name: s for name, s in self._sensors.items() if isinstance(s, Camera)} if any(textures.values()) else {}
        if cameras or any(sensor.needs_render for sensor in self._tactile_sensors.values()):
            self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        for camera in cameras.values():
            camera.capture()
        seen = {
            name: camera.get_obs(**textures, apply_texture_transforms=apply_texture_transforms)
            for name, camera in cameras.items()
        }
        if not self._touch_is_fresh:  # once per state: shear has a history
            for sensor in self._tactile_sensors.values():
                sensor.capture()
            self._touch_is_fresh = True
        return seen | {name: sensor.get_obs() for name, sensor in self._tactile_sensors.items()}

    def get_sensor_images(self) -> dict[str, dict[str, torch.Tensor]]:
        """Pictures of what every camera and pad sees now, uint8 (N, H, W, 3) each."""
        seen = self._sense(dict(rgb=True, depth=False, position=False, segmentation=False))
        sensors = self._sensors | self._tactile_sensors
        return {name: sensors[name].get_images(data) for name, data in seen.items()}

    def get_sensor_params(self) -> dict[str, dict[str, torch.Tensor]]:
        visual = any(vars(self.obs_mode_struct.visual).values())
        cameras = super().get_sensor_params() if visual else {}
        return cameras | {name: sensor.get_params() for name, sensor in self._tactile_sensors.items()}

    def render_sensors(self):
        return tile_images(self._sensor_pictures(), nrows=2)

    def render_all(self):
        sensors = self.render_sensors()
        return torch.cat(same_height([self.render_rgb_array(), sensors]), dim=2)

    def _sensor_pictures(self) -> list[torch.Tensor]:
        return same_size([image for sensor in self.get_sensor_images().values() for image in sensor.values()])
