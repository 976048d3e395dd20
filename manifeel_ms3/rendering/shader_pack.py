"""The package's own shaders, which SAPIEN compiles when the first camera is made, and the configuration of cameras for them.

They are written for any Vulkan driver, and tested with Mesa's lavapipe, on the CPU. Where a driver does not compile them,
`gym.make(..., sensor_configs=dict(shader_pack="minimal"))` renders with ManiSkill's own.
"""

from pathlib import Path

import sapien
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


def set_picture_formats() -> None:
    """Set the formats that the shaders write, for cameras that are made from now on.

    SAPIEN's formats are those of the process, and ManiSkill changes them for each camera that has its "default" pack.
    """
    for name, picture_format in _PICTURE_FORMATS.items():
        sapien.render.set_picture_format(name, picture_format)
