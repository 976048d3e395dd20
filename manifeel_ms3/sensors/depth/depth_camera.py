"""Depth by rendering: an orthographic SAPIEN camera inside the pad that looks out through the gel."""

import math

import sapien
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own usage)
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render import ShaderConfig
from mani_skill.sensors.camera import Camera, CameraConfig
from mani_skill.utils.structs import Link, Pose

from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.sensors.config import TactileSensorConfig

from .raycast import REACH, Window

START = 2.5e-3  # m behind the face: inside the drawn gel (chosen), whose back would otherwise hide the object
NEAR = 1e-4  # m: near plane of the camera (chosen; less than any surface's distance)
# wxyz: the camera looks along the pad's z; down in its image is the pad's x, and right is -y
PAD_TO_CAMERA = [math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0]
FLOAT_POSITION = ShaderConfig(
    shader_pack="default",
    texture_names={"Position": ["position"]},
    texture_transforms={"Position": lambda data: {"position": data[..., :3]}},  # float32 metres; stock ones are int16 mm
)


class CameraDepth:
    """Height of everything near one pad over points of its face.

    The gel and the housing do not hide the object: their back faces are culled, and the camera sits between them.

    Args:
        sensor: Configuration of the pad.
        scene: Scene that is rendered.
        pad: Link that carries the pad.

    Raises:
        MachineError: The scene has no renderer, or is simulated on a GPU, where ManiSkill reads only its own cameras.
        InvalidArgumentError: The force field's units need velocities, which a camera does not measure.
    """

    def __init__(self, sensor: TactileSensorConfig, scene: ManiSkillScene, pad: Link):
        if sensor.units == "tacsl":
            raise InvalidArgumentError(f"tactile sensor {sensor.uid!r}: units='tacsl' needs velocities; use backend='raycast'")
        if not scene.can_render():
            raise MachineError(
                f"tactile sensor {sensor.uid!r} has backend='sapien', which needs a renderer, and this scene has none; "
                "use backend='raycast', or give gym.make a render_backend"
            )
        if scene.gpu_sim_enabled:
            raise MachineError(
                f"tactile sensor {sensor.uid!r} has backend='sapien', which does not work where a GPU simulates; use "
                "backend='raycast'"
            )
        pixel, self._start = sensor.pixel_size, START + sensor.gel.max_sag
        rows, cols = (2 * math.ceil(extent / 2 / pixel) for extent in sensor.gel.size)
        config = CameraConfig(
            f"{sensor.uid}_depth",
            pose=Pose.create(sensor.pad_pose * sapien.Pose([0, 0, -self._start], PAD_TO_CAMERA)),
            width=cols,
            height=rows,
            fov=1.0,  # has no effect on an orthographic camera
            near=NEAR,
            far=self._start + REACH,
            mount=pad,
            shader_config=FLOAT_POSITION,
        )
        self.camera = Camera(config, scene)
        self.scene = scene
        self.half_size = torch.tensor([rows, cols], device=scene.device) * pixel / 2
        right, top = cols * pixel / 2, rows * pixel / 2
        for component in self.camera.camera._render_cameras:
            component.set_orthographic_parameters(NEAR, self._start + REACH, -right, right, -top, top)

    def look(self) -> None:
        """Render depth; the scene's render state must be up to date (`scene.update_render`)."""
        self.camera.capture()
        depth = -self.camera.get_obs(rgb=False, depth=False, position=True, segmentation=False)["position"][..., 2]
        height = torch.where(depth > 0, self._start - depth, torch.full_like(depth, -REACH))
        self._height = height[:, None].to(self.scene.device)  # (N, 1, rows, cols); a GPU may render for a CPU's simulation

    def heights(self, grid: torch.Tensor, window: Window | None = None) -> torch.Tensor:
        """Height (N, C), m, of the nearest surface above (+: into) the face at points (C, 2), m; -REACH if there is none.

        Args:
            grid: Points (C, 2) of the face, m.
            window: Parts of the face that are needed; a camera sees all of it, and ignores this.
        """
        row, column = (grid / self.half_size).unbind(-1)
        where = torch.stack([-column, row], dim=-1)[None, None]  # (right, down) in [-1, 1]
        where = where.expand(len(self._height), -1, -1, -1)
        return F.grid_sample(self._height, where, padding_mode="border", align_corners=False)[:, 0, 0]
