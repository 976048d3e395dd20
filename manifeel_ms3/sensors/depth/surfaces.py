"""The surfaces that a pad may touch: every body of a ManiSkill scene as one triangle mesh in its own frame.

A body is taken as it is drawn; where nothing is drawn (`render_backend="none"`), as it collides. No registration: whatever the
scene holds is found here. A body whose surface is finer than what is drawn, such as a golf ball's, can be given a relief.
"""

import functools
from dataclasses import dataclass

import numpy as np
import sapien
import sapien.physx as physx
import torch
import trimesh
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link

SPHERE_SUBDIVISIONS = 6  # 81,920 triangles: 0.6 micrometres off on a 10 mm ball, and no facets in TacRGB
PLANE_HALF_SIZE = 10.0  # m
RELIEF = "touch_relief"


@dataclass
class Surface:
    """A body and its mesh in each environment that holds it."""

    body: Actor | Link
    env_idx: torch.Tensor
    meshes: list[trimesh.Trimesh]


def give_relief(actor: Actor, mesh: trimesh.Trimesh) -> None:
    """Have pads, and pads alone, feel this surface, m, in the actor's frame, instead of what is drawn."""
    setattr(actor, RELIEF, mesh)


def scene_surfaces(scene: ManiSkillScene, excluded: set[str]) -> list[Surface]:
    """Surfaces of all actors and links of the scene, but for the links named in `excluded`.

    Raises:
        RuntimeError: a body is drawn with a mesh that has no triangles.
    """
    links = [link for articulation in scene.articulations.values() for link in articulation.links]
    surfaces = []
    for body in [*scene.actors.values(), *(link for link in links if link.name not in excluded)]:
        entities = [obj if isinstance(obj, sapien.Entity) else obj.entity for obj in body._objs]
        relief = getattr(body, RELIEF, None)
        meshes = [entity_mesh(entity) for entity in entities] if relief is None else [relief] * len(entities)
        if all(mesh is not None for mesh in meshes):
            surfaces.append(Surface(body, body._scene_idxs, meshes))
    return surfaces


def entity_mesh(entity: sapien.Entity) -> trimesh.Trimesh | None:
    """All of an entity's shapes as one mesh in its frame, m; None where it has no shape."""
    parts = []
    for component in entity.components:
        if isinstance(component, sapien.render.RenderBodyComponent):
            parts = [_placed(_drawn(shape), shape.local_pose) for shape in component.render_shapes]
            break
        if isinstance(component, physx.PhysxRigidBaseComponent):
            parts = [_placed(_colliding(shape), shape.local_pose) for shape in component.collision_shapes]
    if not parts:
        return None
    mesh = trimesh.util.concatenate(parts)
    if len(mesh.faces) == 0:
        raise RuntimeError(f"body {entity.name!r} has a mesh without triangles; a tactile sensor cannot feel it: mend its file")
    return mesh


def _placed(mesh: trimesh.Trimesh, pose: sapien.Pose) -> trimesh.Trimesh:
    return mesh.apply_transform(pose.to_transformation_matrix())


def _drawn(shape) -> trimesh.Trimesh:
    if isinstance(shape, sapien.render.RenderShapeTriangleMesh):
        parts = [trimesh.Trimesh(part.vertices * shape.scale, part.triangles, process=False) for part in shape.parts]
        return trimesh.util.concatenate(parts)
    return _primitive(shape)


def _colliding(shape) -> trimesh.Trimesh:
    if hasattr(shape, "triangles"):
        return trimesh.Trimesh(shape.vertices * shape.scale, shape.triangles, process=False)
    return _primitive(shape)


@functools.cache
def _unit_sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=SPHERE_SUBDIVISIONS)


def _primitive(shape) -> trimesh.Trimesh:
    """Box, sphere, capsule, cylinder and plane, drawn or colliding: their names differ in the prefix alone."""
    kind = type(shape).__name__.removeprefix("RenderShape").removeprefix("PhysxCollisionShape")
    x_from_z = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])  # SAPIEN's axis is x, trimesh's z
    if kind == "Box":
        return trimesh.creation.box(extents=2 * np.asarray(shape.half_size))
    if kind == "Sphere":
        return _unit_sphere().copy().apply_scale(shape.radius)
    if kind == "Capsule":
        capsule = trimesh.creation.capsule(height=2 * shape.half_length, radius=shape.radius, count=[128, 128])
        return capsule.apply_transform(x_from_z)
    if kind == "Cylinder":
        cylinder = trimesh.creation.cylinder(radius=shape.radius, height=2 * shape.half_length, sections=256)
        return cylinder.apply_transform(x_from_z)
    if kind == "Plane":
        slab = trimesh.creation.box(extents=(0.1, 2 * PLANE_HALF_SIZE, 2 * PLANE_HALF_SIZE))
        return slab.apply_translation([-0.05, 0, 0])  # SAPIEN's plane: normal along x
    raise RuntimeError(f"a shape of type {type(shape).__name__} cannot be felt; use a mesh, box, sphere, capsule or cylinder")
