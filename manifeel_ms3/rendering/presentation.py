"""Images for people: large, drawn at twice their size and averaged, with a finer shadow."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from mani_skill.render import ShaderConfig
from torch.nn.functional import avg_pool2d

from manifeel_ms3.arguments import by_name
from manifeel_ms3.errors import InvalidArgumentError

from .lights import PRESENTATION_SHADOW, Lamp, Shadow, change_shadow
from .shader_pack import camera_shader

SIZE = 768
"""Width and height of the images, in pixels; chosen by eye."""
SIZE_OF_MANY = 256
"""The same where one process has many environments, whose images would fill a GPU's memory; not tried out."""
SUPERSAMPLING = 2
"""Width and height, in drawn pixels, of the square that becomes one pixel; chosen by eye."""


def presentation_shader() -> ShaderConfig:
    """Shaders of a camera that is drawn larger by `SUPERSAMPLING` than its images are."""
    shader = camera_shader()
    return ShaderConfig(shader.shader_pack, {"Color": ["rgb"]}, {}, {"Color": lambda data: {"rgb": _reduced(data[..., :3])}})


def _reduced(image: torch.Tensor) -> torch.Tensor:
    """Image (N, H, W, 3) uint8 from one that is larger by `SUPERSAMPLING`."""
    return avg_pool2d(image.permute(0, 3, 1, 2).float(), SUPERSAMPLING).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous()


def drawn_sizes(configs: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides of the cameras' configurations, with the sizes of images replaced by those at which they are drawn.

    Args:
        configs: The argument `human_render_camera_configs` of ManiSkill's environments: fields of all cameras, and dicts of
            fields by a camera's name. Where shaders are given, too, images are not drawn larger.

    Raises:
        InvalidArgumentError: It is no dict, or a size is no whole number.
    """
    configs = by_name("human_render_camera_configs", configs, '{"width": 512, "height": 512}')
    for name in ("width", "height"):
        if not isinstance(configs.get(name, SIZE), int):
            raise InvalidArgumentError(
                f"human_render_camera_configs: {name}={configs[name]!r} must be a whole number of pixels"
            )
    if "shader_pack" in configs or "shader_config" in configs:
        return dict(width=SIZE, height=SIZE) | dict(configs)
    drawn = {name: SUPERSAMPLING * size for name, size in configs.items() if name in ("width", "height")}
    nested = {name: drawn_sizes(fields) for name, fields in configs.items() if isinstance(fields, Mapping)}
    return dict(configs) | drawn | nested


@contextmanager
def fine_shadow(lamps: list[Lamp], usual: Shadow | None) -> Iterator[None]:
    """Let lamps cast `PRESENTATION_SHADOW`, and their usual shadow again afterwards.

    Args:
        lamps: Lamps of the scene.
        usual: Shadow that they cast otherwise; None if they cast none.
    """
    for lamp in lamps:
        change_shadow(lamp, PRESENTATION_SHADOW)
    try:
        yield
    finally:
        for lamp in lamps:
            change_shadow(lamp, usual)
