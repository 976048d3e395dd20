"""Visual randomization: light, colours, table and camera poses, drawn for each episode from its seed."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (SAPIEN's stubs ask for arrays of a fixed length, and know components by their base class)
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor
from sapien.render import RenderBodyComponent, RenderMaterial
from scipy.spatial.transform import Rotation

from .lights import KEY_DIRECTION, Lamp, aim_lamp
from .table import wood_texture

TABLE, FLOOR = "table", "floor"
"""Names of the actors that are not parts of a task."""
STREAM = 29
"""Number beside an episode's seed from which looks are drawn, so that they do not change where parts are placed; arbitrary."""


@dataclass(frozen=True)
class VisualRandomization:
    """Half ranges of the uniform distributions of the scene's looks; with 0, nothing changes."""

    light_direction: float = 0.0
    """Slant of the lamp's direction on each horizontal axis, as a share of its height; 0.5 is 27 degrees."""
    light_level: float = 0.0
    """Change of the brightness of all light, as a share of it."""
    part_colour: float = 0.0
    """Change of each channel of a part's colour, in linear RGB in [0, 1]; every part has its own."""
    table_colour: float = 0.0
    """Change of each channel of the table's colour, as a share of it."""
    table_texture: int = 0
    """Number of other textures that the table may have, besides the usual one; all are equally likely."""
    camera_position: float = 0.0
    """Displacement of each camera along each of its axes, in m."""
    camera_rotation: float = 0.0
    """Rotation of each camera about each of its axes, in rad."""


LARGEST = dict(
    light_direction=(1.0, "the lamp would shine from behind the wall"),
    light_level=(0.9, "nothing could be seen"),
    part_colour=(1.0, "colours have no more than that"),
    table_colour=(0.9, "the table would be black"),
    table_texture=(15, "each takes a second to paint"),
    camera_position=(0.03, "a camera would be inside the robot"),
    camera_rotation=(0.3, "the task would be out of sight"),
)
"""Largest value of each field of `VisualRandomization`, and what happens beyond it; chosen by eye."""


class RandomLooks:
    """Draws the looks of a scene and applies them.

    Args:
        ranges: What is random, and how much.
        scene: Scene of a single environment, whose bodies are all built.
        lamp: Lamp of the scene.
        cameras: Cameras of the policy, by name.
    """

    def __init__(
        self,
        ranges: VisualRandomization,
        scene: ManiSkillScene,
        lamp: Lamp,
        cameras: dict[str, sapien.render.RenderCameraComponent],
    ):
        self.ranges, self.scene, self.lamp, self.cameras = ranges, scene, lamp, cameras
        self.light = np.array(scene.ambient_light), np.array(lamp.color)
        self.poses = {name: camera.local_pose for name, camera in cameras.items()}
        parts = {name: actor for name, actor in scene.actors.items() if name not in (TABLE, FLOOR)}
        self.colours = {name: [(m, np.array(m.base_color[:3])) for m in _materials([part])] for name, part in parts.items()}
        self.table = _materials([scene.actors[TABLE]])

    def draw(self, seed: int, episode: int = 0) -> dict[str, Any]:
        """Draw the looks of an episode and apply them; return what was drawn, by name.

        Args:
            seed: Seed of the episode.
            episode: Number of earlier episodes with this seed.
        """
        ranges, start = self.ranges, [seed, STREAM, episode]

        def stream(name: str) -> np.random.Generator:
            return np.random.default_rng([*start, crc32(name.encode())])  # each stream is independent of what else is random

        def uniform(name: str, half_range: float, size: int) -> np.ndarray:
            return half_range * stream(name).uniform(-1, 1, size)

        slant = np.append(uniform("light_direction", ranges.light_direction, 2), 0.0)
        textures = ranges.table_texture + 1
        drawn = dict(
            light_direction=np.array(KEY_DIRECTION) + slant,
            light_level=1 + uniform("light_level", ranges.light_level, 1)[0],
            table_colour=1 + uniform("table_colour", ranges.table_colour, 3),
            table_texture=int(stream("table_texture").random() * textures),
        )
        drawn |= {f"{name}_colour": uniform(name, ranges.part_colour, 3) for name in self.colours}
        for name in self.cameras:
            drawn[f"{name}_position"] = uniform(f"{name}_position", ranges.camera_position, 3)
            drawn[f"{name}_rotation"] = uniform(f"{name}_rotation", ranges.camera_rotation, 3)
        self._apply(drawn)
        return drawn

    def _apply(self, drawn: dict[str, Any]) -> None:
        ambient, lamp = self.light
        self.scene.set_ambient_light(ambient * drawn["light_level"])
        self.lamp.set_color(lamp * drawn["light_level"])
        aim_lamp(self.lamp, drawn["light_direction"])
        for name, camera in self.cameras.items():
            turn = Rotation.from_rotvec(drawn[f"{name}_rotation"]).as_quat()[[3, 0, 1, 2]]  # SAPIEN's order: w first
            camera.local_pose = self.poses[name] * sapien.Pose(drawn[f"{name}_position"], turn)
        for name, materials in self.colours.items():
            for material, colour in materials:
                material.base_color = [*(colour + drawn[f"{name}_colour"]).clip(0, 1), 1.0]
        for material in self.table:
            material.base_color = [*drawn["table_colour"], 1.0]
            material.base_color_texture = wood_texture(int(drawn["table_texture"]))


def _materials(actors: Iterable[Actor]) -> list[RenderMaterial]:
    """Materials of all that is drawn of some actors."""
    return [material for actor in actors for shape in _shapes(actor) for material in _of(shape)]


def _shapes(actor: Actor) -> Iterator[sapien.render.RenderShape]:
    for entity in actor._objs:
        component = entity.find_component_by_type(RenderBodyComponent)
        yield from component.render_shapes if component else ()


def _of(shape: sapien.render.RenderShape) -> list[RenderMaterial]:
    return [part.material for part in shape.parts] if hasattr(shape, "parts") else [shape.material]
