"""The mesh of a body is where the engine and the renderer have the body: their own bounding boxes are the measure."""

import numpy as np
import pytest
import sapien
from sapien import physx, render

from manifeel_ms3.sensors.depth.surfaces import PLANE_HALF_SIZE, entity_mesh
from tests.tasks_and_marks import needs_renderer

RADIUS, HALF_LENGTH, HALF_SIZE = 0.01, 0.03, [0.01, 0.02, 0.03]  # m
SCALE = [1e-3, 2e-3, 3e-3]
CORNERS = np.array([[0, 0, 0], [5, 0, 0], [0, 4, 0], [0, 0, 3]], np.float32)  # of a tetrahedron, in its own unit
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint32)
PLACES = {  # by where they take the axes: a box of the engine or renderer is exact only where it is not aslant
    "upright": sapien.Pose(),
    "x to y to z": sapien.Pose([0.1, -0.2, 0.3], [0.5, 0.5, 0.5, 0.5]),
}
STEEL = physx.PhysxMaterial(0.5, 0.5, 0.0)
COLLIDING = {
    "box": lambda: physx.PhysxCollisionShapeBox(HALF_SIZE, STEEL),
    "sphere": lambda: physx.PhysxCollisionShapeSphere(RADIUS, STEEL),
    "capsule": lambda: physx.PhysxCollisionShapeCapsule(RADIUS, HALF_LENGTH, STEEL),
    "cylinder": lambda: physx.PhysxCollisionShapeCylinder(RADIUS, HALF_LENGTH, STEEL),
    "convex mesh": lambda: physx.PhysxCollisionShapeConvexMesh(CORNERS, SCALE, STEEL),
    "triangle mesh": lambda: physx.PhysxCollisionShapeTriangleMesh(CORNERS, FACES, SCALE, STEEL),
}
DRAWN = {
    "box": lambda look, file: render.RenderShapeBox(HALF_SIZE, look),
    "sphere": lambda look, file: render.RenderShapeSphere(RADIUS, look),
    "capsule": lambda look, file: render.RenderShapeCapsule(RADIUS, HALF_LENGTH, look),
    "cylinder": lambda look, file: render.RenderShapeCylinder(RADIUS, HALF_LENGTH, look),
    "triangle mesh": lambda look, file: render.RenderShapeTriangleMesh(file, SCALE, look),
}


def entity(component: sapien.Component, *shapes) -> sapien.Entity:
    for shape in shapes:
        component.attach(shape)
    made = sapien.Entity()
    made.add_component(component)
    made.name = "felt"
    return made


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", COLLIDING)
def test_a_collision_shape_is_felt_where_the_engine_has_it(kind, place):
    shape, other = COLLIDING[kind](), COLLIDING["box"]()
    shape.local_pose = PLACES[place]
    other.local_pose = sapien.Pose([0.05, 0.0, 0.0])  # a body may have several shapes
    body = physx.PhysxRigidStaticComponent()
    felt = entity(body, shape, other)
    mesh = entity_mesh(felt)
    assert mesh.bounds == pytest.approx(body.get_global_aabb_fast(), abs=2e-5)  # m; a cylinder has 256 sides


@pytest.mark.parametrize("radius", [1e-2, 3e-4])
@pytest.mark.parametrize("shape", [physx.PhysxCollisionShapeCapsule, physx.PhysxCollisionShapeCylinder])
def test_round_shapes_have_closed_ends(shape, radius):
    """A pad that faces a tip feels the tip, and not the inside of the far end."""
    felt = entity(physx.PhysxRigidStaticComponent(), shape(radius, HALF_LENGTH, STEEL))
    assert entity_mesh(felt).is_watertight


@needs_renderer
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", DRAWN)
def test_a_drawn_shape_is_felt_where_the_renderer_has_it(kind, place, tmp_path):
    file = tmp_path / "shape.obj"
    file.write_text("\n".join([*("v {} {} {}".format(*v) for v in CORNERS), *("f {} {} {}".format(*f + 1) for f in FACES)]))
    shape = DRAWN[kind](render.RenderMaterial(), str(file))
    shape.local_pose = PLACES[place]
    body = render.RenderBodyComponent()
    felt = entity(body, shape)
    mesh = entity_mesh(felt)
    assert mesh.bounds == pytest.approx(body.get_global_aabb_fast(), abs=2e-5)


def test_a_plane_is_felt_below_its_own_x_axis():
    body = physx.PhysxRigidStaticComponent()
    felt = entity(body, physx.PhysxCollisionShapePlane(STEEL))
    mesh = entity_mesh(felt)
    low, high = body.get_global_aabb_fast()  # without end
    assert mesh.bounds[1] == pytest.approx(np.minimum(high, PLANE_HALF_SIZE), abs=1e-6)
    assert (mesh.bounds[0] >= low).all()
    assert mesh.bounds[0][0] < -0.01  # thicker than a gel
