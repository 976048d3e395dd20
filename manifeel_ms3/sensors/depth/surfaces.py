"""The surfaces that a pad may touch: every body of a ManiSkill scene as one triangle mesh in its own frame.

The mesh is the body's visual shape or, if nothing is drawn (`render_backend="none"`), its collision shape. Bodies need no
registration: all bodies of the scene are found that something can collide with, and not the marker of a goal, for example. A
body whose surface is not its visual shape, such as a golf ball's, which is finer, can be given a relief.
"""

import functools
from dataclasses import dataclass
from typing import cast

import numpy as np
import sapien
import sapien.physx as physx
import torch
import trimesh
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Link

from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError

SPHERE_SUBDIVISIONS = 6  # 81,920 triangles: within 0.6 micrometres of a 10 mm ball, so that TacRGB shows no facets
CAPSULE_SECTIONS = 128  # around and along a cap: within 3 micrometres of a 10 mm radius
CYLINDER_SECTIONS = 256  # around the axis: within 1 micrometre of a 10 mm radius
PLANE_HALF_SIZE = 10.0  # m: extent of the slab that stands for an infinite plane (chosen)
PLANE_THICKNESS = 0.1  # m (chosen)
RELIEF = "touch_relief"  # name of the attribute in which an actor keeps its relief


@dataclass
class Surface:
    """A body and its mesh in each environment that contains it."""

    body: Actor | Link
    """Body in the scene."""
    env_idx: torch.Tensor
    """Indices (n,) of the environments that contain the body."""
    meshes: list[trimesh.Trimesh]
    """Mesh in each of these environments, body frame, m."""


def give_relief(actor: Actor, mesh: trimesh.Trimesh) -> None:
    """Make pads feel this surface, in the actor's frame, in m, instead of the visual shape; nothing else changes."""
    setattr(actor, RELIEF, mesh)


def scene_surfaces(scene: ManiSkillScene, excluded: set[str], robot: Articulation | None = None) -> list[Surface]:
    """Surfaces of all actors and links of the scene that collide or have a relief, except some links.

    Args:
        scene: The scene.
        excluded: Names of the links that are left out.
        robot: Robot whose links these are; another one may have links of the same names. Those of all robots if not given.

    Raises:
        InvalidFileError: A body has a mesh without triangles.
        InvalidArgumentError: A body has a shape of a type that has no mesh.
    """
    # by the bodies of its links, since a robot whose environments were built apart is no articulation of the scene itself
    own = None if robot is None else {body for link in robot.links for body in link._objs}
    links = [
        link
        for articulation in scene.articulations.values()
        for link in articulation.links
        if link.name not in excluded or (own is not None and own.isdisjoint(link._objs))
    ]
    surfaces = []
    for body in [*scene.actors.values(), *links]:
        entities = [obj if isinstance(obj, sapien.Entity) else obj.entity for obj in body._objs]
        relief = getattr(body, RELIEF, None)
        found = [_felt_mesh(entity) if relief is None else relief for entity in entities]
        meshes = [mesh for mesh in found if mesh is not None]
        if meshes and len(meshes) < len(entities):
            raise InvalidArgumentError(
                f"body {body.name!r} collides in {len(meshes)} of its {len(entities)} environments, so that a pad cannot feel "
                "it in all; give it collision shapes in all of them, or in none"
            )
        if meshes:
            surfaces.append(Surface(body, body._scene_idxs, meshes))
    return surfaces


def _felt_mesh(entity: sapien.Entity) -> trimesh.Trimesh | None:
    bodies = [component for component in entity.components if isinstance(component, physx.PhysxRigidBaseComponent)]
    return entity_mesh(entity) if any(body.collision_shapes for body in bodies) else None


def entity_mesh(entity: sapien.Entity) -> trimesh.Trimesh | None:
    """All shapes of an entity as one mesh in its frame, m; None if it has no shape."""
    parts: list[trimesh.Trimesh] = []
    for component in entity.components:
        if isinstance(component, sapien.render.RenderBodyComponent):
            parts = [_placed(_drawn(shape), shape.local_pose) for shape in component.render_shapes]
            break
        if isinstance(component, physx.PhysxRigidBaseComponent):
            parts = [_placed(_colliding(shape), shape.local_pose) for shape in component.collision_shapes]
    if not parts:
        return None
    mesh = _joined(parts)
    if len(mesh.faces) == 0:
        raise InvalidFileError(f"body {entity.name!r} has a mesh without triangles, which a pad cannot feel; correct its file")
    return mesh


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, trimesh.util.concatenate(parts))


def _placed(mesh: trimesh.Trimesh, pose: sapien.Pose) -> trimesh.Trimesh:
    mesh.apply_transform(pose.to_transformation_matrix())
    return mesh


def _drawn(shape) -> trimesh.Trimesh:
    if isinstance(shape, sapien.render.RenderShapeTriangleMesh):
        parts = [trimesh.Trimesh(part.vertices * shape.scale, part.triangles, process=False) for part in shape.parts]
        return _joined(parts)
    return _primitive(shape)


def _colliding(shape) -> trimesh.Trimesh:
    if hasattr(shape, "triangles"):
        return trimesh.Trimesh(shape.vertices * shape.scale, shape.triangles, process=False)
    return _primitive(shape)


@functools.cache
def _unit_sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=SPHERE_SUBDIVISIONS)


def _primitive(shape) -> trimesh.Trimesh:
    """Mesh of a visual or collision shape that is a box, sphere, capsule, cylinder or plane.

    Capsules and cylinders are made with a radius of 1 and then scaled: trimesh leaves out triangles of less than 1e-8 square
    units, which in metres would open the tips of capsules and the ends of thin cylinders.
    """
    kind = type(shape).__name__.removeprefix("RenderShape").removeprefix("PhysxCollisionShape")
    x_from_z = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])  # SAPIEN's axis is x, trimesh's z
    if kind == "Box":
        return trimesh.creation.box(extents=2 * np.asarray(shape.half_size))
    if kind == "Sphere":
        return _unit_sphere().copy().apply_scale(shape.radius)
    if kind == "Capsule":
        count = [CAPSULE_SECTIONS, CAPSULE_SECTIONS]
        capsule = trimesh.creation.capsule(height=2 * shape.half_length / shape.radius, radius=1.0, count=count)
        return capsule.apply_scale(shape.radius).apply_transform(x_from_z)
    if kind == "Cylinder":
        cylinder = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=CYLINDER_SECTIONS)
        return cylinder.apply_scale([shape.radius, shape.radius, shape.half_length]).apply_transform(x_from_z)
    if kind == "Plane":
        slab = trimesh.creation.box(extents=(PLANE_THICKNESS, 2 * PLANE_HALF_SIZE, 2 * PLANE_HALF_SIZE))
        return slab.apply_translation([-PLANE_THICKNESS / 2, 0, 0])  # SAPIEN's plane: normal along x
    raise InvalidArgumentError(
        f"a pad cannot feel a shape of type {type(shape).__name__}; use a mesh, box, sphere, capsule or cylinder"
    )
