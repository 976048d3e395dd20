"""Light of the scene: from all sides, and one lamp that casts a shadow."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (SAPIEN's stubs ask for arrays of single precision, and leave out what is internal)
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from sapien.render import RenderBodyComponent
from sapien.render import RenderDirectionalLightComponent as Lamp

AMBIENT_LIGHT, KEY_LIGHT = 0.42, 1.9
"""Intensities of the light from all sides and of the lamp; chosen by eye."""
KEY_DIRECTION = (-0.35, 0.45, -1.0)
"""Direction in which the lamp shines, base frame: from above, from in front of the robot and its right; chosen by eye."""
SHADOW_CENTRE = (0.5, 0.0, 0.0)
"""Middle of the area that the lamp's shadow map covers, in m, base frame: that of the tasks' parts."""


@dataclass(frozen=True)
class Shadow:
    """Shadow map of the lamp, around `SHADOW_CENTRE`; its sizes are chosen by eye."""

    size: int
    """Width and height of the map, in pixels."""
    half_extent: float
    """Half of the width that the map covers, in m."""
    near: float = -1.0
    """Distance from the centre at which the map begins, in m; negative, since it is towards the lamp."""
    far: float = 1.5
    """Distance from the centre at which the map ends, in m, away from the lamp."""


SHADOWS = {"normal": Shadow(512, 0.45), "fast": None}
"""Shadow by the quality of the policy's images; a larger map would take half of the time of an image."""
PRESENTATION_SHADOW = Shadow(4096, 0.8)
"""Shadow of the images for people."""


def add_lights(
    scene: ManiSkillScene, level: float, shadow: Shadow | None
) -> list[sapien.render.RenderDirectionalLightComponent]:
    """Add the scene's light.

    Args:
        scene: Scene to be lit.
        level: Share of the normal light.
        shadow: Shadow of the lamp; None if it casts none.

    Returns:
        The lamp of each environment.
    """
    scene.set_ambient_light([AMBIENT_LIGHT * level] * 3)
    lamps = []
    for sub_scene in scene.sub_scenes:
        lamp = Lamp()
        lamp.set_color([KEY_LIGHT * level] * 3)
        cast_shadow(lamp, shadow)
        entity = sapien.Entity()
        entity.name = "lamp"
        entity.add_component(lamp)
        aim_lamp(lamp, KEY_DIRECTION)
        sub_scene.add_entity(entity)
        lamps.append(lamp)
    return lamps


def change_shadow(lamp: Lamp, shadow: Shadow | None) -> None:
    """Let a lamp of a scene cast another shadow: SAPIEN looks at its settings only where a lamp is added to a scene."""
    lamp.disable()
    cast_shadow(lamp, shadow)
    lamp.enable()


def cast_shadow(lamp: Lamp, shadow: Shadow | None) -> None:
    """Let a lamp that is added to a scene later cast a shadow, or none if it is None."""
    lamp.shadow = shadow is not None
    if shadow is not None:
        lamp.shadow_map_size, lamp.shadow_half_size = shadow.size, shadow.half_extent
        lamp.shadow_near, lamp.shadow_far = shadow.near, shadow.far


def aim_lamp(lamp: Lamp, direction: Sequence[float] | np.ndarray) -> None:
    """Let a lamp shine in a direction (x, y, z), base frame, through the middle of the area that its shadow map covers."""
    unit = np.asarray(direction) / np.linalg.norm(direction)
    lamp.local_pose = sapien.Pose(SHADOW_CENTRE, sapien.math.shortest_rotation(np.array([1.0, 0.0, 0.0]), unit))


def cast_no_shadow(bodies: Iterable[Actor | Link]) -> None:
    """Leave bodies whose shadows no camera sees out of the shadow map, which saves time in every image."""
    for body in bodies:
        for entity in (obj if isinstance(obj, sapien.Entity) else obj.entity for obj in body._objs):
            component = entity.find_component_by_type(RenderBodyComponent)
            for drawn in component._internal_node.children if component else ():
                drawn.cast_shadow = False
