"""The bench that every task stands on: a wooden table, and the floor below it."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (ManiSkill annotates its own poses alone, and sizes as tuples)
import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from sapien.physx import PhysxMaterial

from manifeel_ms3.geometry import Box, Part
from manifeel_ms3.rendering.looks import CONCRETE
from manifeel_ms3.rendering.table import table_mesh, wood

TABLE = Box((1.6, 1.6, 0.04), (0.4, 0.0, -0.02))
TABLE_FRICTION = 0.5
"""Coulomb's coefficient."""
FLOOR = Part("floor", (Box((8.0, 8.0, 0.02), (0.0, 0.0, -0.76)),), CONCRETE)


def build_bench(scene: ManiSkillScene) -> None:
    """Add table and floor to a scene."""
    builder, pose = scene.create_actor_builder(), sapien.Pose(TABLE.centre)
    friction = PhysxMaterial(TABLE_FRICTION, TABLE_FRICTION, 0.0)
    builder.add_box_collision(pose, np.asarray(TABLE.size) / 2, friction)
    if scene.can_render():
        builder.add_visual_from_file(str(table_mesh(TABLE.size)), pose, material=wood())
    builder.initial_pose = sapien.Pose()
    builder.set_physx_body_type("static")
    builder.build("table")
    FLOOR.build(scene, "static", sapien.Pose())
