"""The package's own shaders, which SAPIEN compiles when the first camera is made, and the configuration of cameras for them.

They are written for any Vulkan driver, and tested with Mesa's lavapipe, on the CPU. Where a driver does not compile them,
`gym.make(..., sensor_configs=dict(shader_pack="minimal"))` renders with ManiSkill's own.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render import PREBUILT_SHADER_CONFIGS, ShaderConfig

SHADER_PACK = str(Path(__file__).parent / "shaders")
"""Path of the folder with the shaders."""
_PICTURE_FORMATS = {
    "Color": "r8g8b8a8unorm",
    "ColorRaw": "r8g8b8a8unorm",
    "PositionSegmentation": "r16g16b16a16sint",  # mm, and the id
}


def camera_shader() -> ShaderConfig:
    """Shaders of a camera whose outputs have the names, types and units of ManiSkill's "minimal" pack."""
    minimal = PREBUILT_SHADER_CONFIGS["minimal"]
    return ShaderConfig(SHADER_PACK, minimal.texture_names, {}, minimal.texture_transforms)


@contextmanager
def picture_formats(scene: ManiSkillScene) -> Iterator[None]:
    """Give each camera that is made in this context, and has the package's shaders, the formats that these write.

    SAPIEN's formats are those of the process when a camera is made, and ManiSkill changes them for each camera that has its
    "default" pack, with which others of the same scene may be drawn.

    Args:
        scene: Scene to which the cameras are added.
    """
    add_camera = scene.add_camera

    def add_with_formats(*args: Any, **kwargs: Any) -> Any:
        if sapien.render.get_camera_shader_dir() == SHADER_PACK:
            for name, picture_format in _PICTURE_FORMATS.items():
                sapien.render.set_picture_format(name, picture_format)
        return add_camera(*args, **kwargs)

    scene.add_camera = add_with_formats
    try:
        yield
    finally:
        del scene.add_camera  # the instance's; the method of its class is there again
