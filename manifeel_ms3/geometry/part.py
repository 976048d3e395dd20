"""A part: one description of a rigid body's shape that yields both what is drawn and what collides."""

from dataclasses import dataclass

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor
from sapien.physx import PhysxMaterial
from sapien.render import RenderMaterial


@dataclass(frozen=True)
class Box:
    """Axis-aligned box in the part's frame, m."""

    size: tuple[float, float, float]
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Part:
    """A rigid body made of boxes. `density` in kg/m^3, `friction` Coulomb's coefficient, `colour` RGB in [0, 1]."""

    name: str
    boxes: tuple[Box, ...]
    colour: tuple[float, float, float]
    density: float = 1000.0
    friction: float = 0.5

    def build(self, scene: ManiSkillScene, body_type: str, initial_pose: sapien.Pose) -> Actor:
        """Add the part to a scene as a "dynamic", "kinematic" or "static" actor."""
        builder = scene.create_actor_builder()
        material = PhysxMaterial(self.friction, self.friction, 0.0)
        for box in self.boxes:
            pose, half_size = sapien.Pose(box.centre), np.asarray(box.size) / 2
            builder.add_box_collision(pose, half_size, material, self.density)
            if scene.can_render():  # a render material cannot even be made without a renderer
                look = RenderMaterial(base_color=[*self.colour, 1.0], roughness=0.6, specular=0.3)
                builder.add_box_visual(pose, half_size, look)
        builder.initial_pose = initial_pose
        builder.set_physx_body_type(body_type)
        return builder.build(self.name)
