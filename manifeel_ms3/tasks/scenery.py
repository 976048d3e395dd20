"""What the cameras of every task see: bench and light, and the cameras and random looks themselves."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (ManiSkill annotates its own poses alone, sizes as tuples, and sensors by their base class)
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from sapien.physx import PhysxMaterial

from manifeel_ms3.arguments import one_of
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.geometry import Box, Part
from manifeel_ms3.rendering.cameras import FARTHEST, FIELD_OF_VIEW, IMAGE_SIZE, NEAREST
from manifeel_ms3.rendering.lights import SHADOWS, add_lights, cast_no_shadow
from manifeel_ms3.rendering.looks import CONCRETE
from manifeel_ms3.rendering.presentation import SIZE, SIZE_OF_MANY, SUPERSAMPLING, fine_shadow, presentation_shader
from manifeel_ms3.rendering.randomization import LARGEST, RandomLooks, VisualRandomization
from manifeel_ms3.rendering.shader_pack import camera_shader, picture_formats
from manifeel_ms3.rendering.table import table_mesh, wood

from .checks import checked_randomization
from .sensing import SensingEnv
from .viewpoints import looking_at, looking_down

LIGHTING = {"normal": 1.0, "dim": 0.05}
"""Share of the normal light. The paper gives no figure for its dim light; its public code multiplies pixels by 0.5 or 0.1."""
QUALITIES = tuple(SHADOWS)
"""Qualities of the policy's images."""
VIDEO_CAMERA_AT, VIDEO_CAMERA_LOOKS_AT = (0.85, -0.40, 0.32), (0.48, 0.0, 0.08)
"""Position of the videos' camera, and the point that it looks at, base frame, in m. Chosen by eye."""
VIDEO_FIELD_OF_VIEW = np.deg2rad(45)
"""Field of view of the videos' camera, in rad. Chosen by eye."""
SPACING = 2.0
"""Distance, in m, between environments that share a process: more than a table, and no more than that. The engine computes with
single precision in the frame of all of them, in which 80 m from its origin leave no more than 8 micrometres."""
TABLE = Box((1.6, 1.6, 0.04), (0.4, 0.0, -0.02))
"""Table top, base frame, in m; its upper face is at z = 0. Chosen by eye."""
TABLE_FRICTION = 0.5
"""Coulomb's friction coefficient of the table top. Set once; not tuned."""
FLOOR = Part("floor", (Box((8.0, 8.0, 0.02), (0.0, 0.0, -0.76)),), CONCRETE)
"""Floor, base frame, in m, 0.75 m under the table's upper face. Chosen by eye."""
FAR_LINKS = ("panda_link0", "panda_link1", "panda_link2", "panda_link3")
"""Links whose shadows fall outside the area that the shadow map covers."""


class SceneryEnv(SensingEnv):
    """An environment with the robot at a wooden table in a light room.

    Subclasses set `camera_names` and call `_set_looks` before they call the constructor.
    """

    front_camera_at = (0.68, 0.0, 0.15)
    """Position of the front camera, in m (public code of the paper)."""
    side_camera_at = (0.5, -0.17, 0.17)
    """Position of the side camera, in m (public code of the paper)."""
    own_cameras: tuple[str, ...] = ()
    """Names of the cameras that a task adds to "front", "side" and "wrist" in `_default_sensor_configs`."""
    camera_names: tuple[str, ...]
    """Names of the cameras that are rendered."""

    def _set_looks(self, lighting: str, quality: str, randomization: dict[str, float], on_gpu: bool) -> None:
        self._lighting = one_of("lighting", lighting, LIGHTING)
        self._quality = one_of("quality", quality, QUALITIES)
        self.visual_randomization = checked_randomization(
            type(self).__name__, VisualRandomization, randomization, LARGEST, "visual_randomization", "light_level"
        )
        if randomization and on_gpu:
            raise InvalidArgumentError(
                f"visual_randomization={randomization!r} needs a simulation on the CPU with num_envs=1: on a GPU, all "
                "environments of a process look alike; use several processes"
            )

    @property
    def _default_sensor_configs(self):
        views = dict(front=(self.front_camera_at, (-1.0, 0.0)), side=(self.side_camera_at, (0.0, 1.0)))
        lens: dict[str, Any] = dict(width=IMAGE_SIZE, height=IMAGE_SIZE, fov=FIELD_OF_VIEW, near=NEAREST, far=FARTHEST)
        return [
            CameraConfig(name, looking_down(*views[name]), **lens, shader_config=camera_shader())
            for name in self.camera_names
            if name in views
        ]

    @property
    def _default_human_render_camera_configs(self):
        pose = looking_at(np.array(VIDEO_CAMERA_AT), np.array(VIDEO_CAMERA_LOOKS_AT))
        drawn = (SIZE if self.num_envs == 1 else SIZE_OF_MANY) * SUPERSAMPLING
        return CameraConfig(
            "render_camera",
            pose,
            drawn,
            drawn,
            VIDEO_FIELD_OF_VIEW,
            near=NEAREST,
            far=FARTHEST,
            shader_config=presentation_shader(),
        )

    def render_rgb_array(self, camera_name: str | None = None):
        lamps = [] if self.gpu_sim_enabled else self._lamps  # a scene that a GPU simulates cannot be changed any more
        with fine_shadow(lamps, SHADOWS[self._quality]):
            image = super().render_rgb_array(camera_name)
        return None if image is None else image.to(self.device)  # a GPU may render for a simulation on the CPU

    def _build_bench(self) -> None:
        """Add table and floor to the scene."""
        builder, pose = self.scene.create_actor_builder(), sapien.Pose(TABLE.centre)
        friction = PhysxMaterial(TABLE_FRICTION, TABLE_FRICTION, 0.0)
        builder.add_box_collision(pose, np.asarray(TABLE.size) / 2, friction)
        if self.scene.can_render():
            builder.add_visual_from_file(str(table_mesh(TABLE.size)), pose, material=wood())
        builder.initial_pose = sapien.Pose()
        builder.set_physx_body_type("static")
        builder.build("table")
        FLOOR.build(self.scene, "static", sapien.Pose())

    def _load_lighting(self, options: dict):
        self._lamps = add_lights(self.scene, LIGHTING[self._lighting], SHADOWS[self._quality])
        links = self.agent.robot.links_map
        cast_no_shadow([self.scene.actors["table"], self.scene.actors["floor"], *(links[name] for name in FAR_LINKS)])

    def _setup_sensors(self, options: dict):
        with picture_formats(self.scene):
            super()._setup_sensors(options)
        self._require_textures()

    def _require_textures(self) -> None:
        """Check that the cameras' shaders draw every texture of the observation mode; ManiSkill leaves out the others.

        Raises:
            InvalidArgumentError: They do not.
        """
        wanted = {name for name, is_wanted in vars(self.obs_mode_struct.visual).items() if is_wanted}
        for name, camera in self._sensors.items():
            pictures = camera.config.shader_config.texture_names
            drawn = {texture for textures in pictures.values() for texture in textures}
            if missing := sorted(wanted - drawn):
                raise InvalidArgumentError(
                    f"obs_mode={self.obs_mode!r}: the shaders of the camera {name!r} draw no {', no '.join(missing)}, only "
                    f"{sorted(drawn)}; sensor_configs=dict(shader_pack='default') draws all textures, more slowly"
                )

    def _make_random_looks(self) -> None:
        """Remember how the scene looks: random looks are drawn around that."""
        self._random_looks, self._looks = None, dict[str, torch.Tensor]()
        if self.visual_randomization != VisualRandomization() and self.scene.can_render():
            cameras = {name: sensor.camera._render_cameras[0] for name, sensor in self._sensors.items()}
            self._random_looks = RandomLooks(self.visual_randomization, self.scene, self._lamps[0], cameras)

    def _draw_looks(self, seed: int, episode: int) -> None:
        """Draw the looks of an episode from its seed and the number of earlier episodes with it, if they are random."""
        if self._random_looks is not None:
            drawn = self._random_looks.draw(seed, episode)
            self._looks = {
                name: torch.as_tensor(value, dtype=torch.float32, device=self.device)[None] for name, value in drawn.items()
            }
