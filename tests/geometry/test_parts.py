"""What is drawn is what collides: both are sampled as the engine and the renderer hold them."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import sapien
import trimesh
from sapien import physx, render
from scipy.spatial import cKDTree

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.geometry import (
    FITS,
    bulb_and_holder,
    gear_fit,
    nut_and_bolt,
    peg_fit,
    power_fit,
    reorientation_fit,
    usb_fit,
)
from manifeel_ms3.geometry.balls import ball_stand, golf_ball, tennis_ball
from manifeel_ms3.geometry.containers import battery, bowl, container
from manifeel_ms3.geometry.gears import neighbour_gear
from manifeel_ms3.geometry.part import Box, Part, Solid
from manifeel_ms3.rendering.looks import Look
from manifeel_ms3.verification.press import PadBench
from tests.tasks_and_marks import needs_renderer

PARTS = [
    *(part for fit in (*(make(name) for make in (peg_fit, usb_fit, power_fit, gear_fit) for name in FITS), reorientation_fit())
      for part in (fit.plug, fit.socket)),
    *(part for screw in (nut_and_bolt(), bulb_and_holder()) for part in (screw.held, screw.fixed)),
    neighbour_gear("small"), neighbour_gear("large"), ball_stand(), golf_ball(), tennis_ball(), battery(), container(True),
    bowl("bowl", Look((0.5, 0.5, 0.5))),
]  # fmt: skip
TOLERANCE = 5e-5  # m


@pytest.fixture(scope="module")
def bodies():
    """Every part, built in one scene."""

    def build(env):
        return [
            part.build(env.scene, "kinematic", sapien.Pose([0.5, 0.5 + 0.3 * k, 0])) for k, part in enumerate(_renamed(PARTS))
        ]

    env = PadBench(build, obs_mode="none", render_backend="cpu")
    env.reset(seed=0)
    yield env.objects
    env.close()


def _renamed(parts):
    return [dataclasses.replace(part, name=f"{part.name}_{k}") for k, part in enumerate(parts)]


def collision_points(shape) -> np.ndarray:
    """Vertices of a collision shape in the actor's frame; those of a fine mesh for what the engine keeps as a formula."""
    pose = shape.local_pose
    if isinstance(shape, physx.PhysxCollisionShapeBox):
        mesh = trimesh.creation.box(2 * np.array(shape.half_size))
    elif isinstance(shape, physx.PhysxCollisionShapeSphere):
        mesh = trimesh.creation.icosphere(4, shape.radius)
    elif isinstance(shape, physx.PhysxCollisionShapeCylinder):
        turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
        mesh = trimesh.creation.cylinder(shape.radius, 2 * shape.half_length, sections=256, transform=turn)
    else:
        mesh = trimesh.Trimesh(shape.vertices * shape.scale, process=False)
    return trimesh.transform_points(mesh.vertices, pose.to_transformation_matrix())


def visual_points(shape) -> np.ndarray:
    pose = shape.local_pose
    scale = np.ones(3)
    if isinstance(shape, render.RenderShapeTriangleMesh):
        scale = shape.scale
    vertices = np.concatenate([part.vertices for part in shape.parts])
    if isinstance(shape, render.RenderShapeBox):
        scale = np.array(shape.half_size)
    elif isinstance(shape, render.RenderShapeSphere):
        scale = np.full(3, shape.radius)
    elif isinstance(shape, render.RenderShapeCylinder):
        scale = np.array([shape.half_length, shape.radius, shape.radius])
    return trimesh.transform_points(vertices * scale, pose.to_transformation_matrix())


@needs_renderer
@pytest.mark.parametrize("k", range(len(PARTS)), ids=[f"{part.name}_{k}" for k, part in enumerate(PARTS)])
def test_what_is_drawn_is_what_collides(bodies, k):
    entity = bodies[k]._objs[0]
    solid = entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
    drawn = entity.find_component_by_type(render.RenderBodyComponent)
    collides = np.concatenate([collision_points(shape) for shape in solid.collision_shapes])
    seen = np.concatenate([visual_points(shape) for shape in drawn.render_shapes])
    for here, there in ((collides, seen), (seen, collides)):
        low, high = here.min(0), here.max(0)
        assert np.abs(low - there.min(0)).max() < TOLERANCE
        assert np.abs(high - there.max(0)).max() < TOLERANCE
    meshes = [shape for shape in solid.collision_shapes if hasattr(shape, "vertices")]
    if meshes:  # corner by corner: cooking a hull may merge and drop points
        corners = np.concatenate([collision_points(shape) for shape in meshes])
        distance, _ = cKDTree(seen).query(corners)
        assert distance.max() < TOLERANCE
        drawn_meshes = [s for s in drawn.render_shapes if isinstance(s, render.RenderShapeTriangleMesh)]
        distance, _ = cKDTree(corners).query(np.concatenate([visual_points(shape) for shape in drawn_meshes]))
        assert distance.max() < TOLERANCE


def test_a_piece_that_is_not_drawn_needs_a_relief_of_the_others():
    part = container(front_drawn=False)
    with pytest.raises(InvalidArgumentError, match=r"part 'container' has undrawn=\[0\] and no relief"):
        dataclasses.replace(part, relief=None)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (dict(pieces=()), "has no pieces"),
        (dict(pieces=(Box((0.01, -0.01, 0.01)),)), r"sizes of \[-0.01\] m"),
        (dict(density=0.0), r"densities of \[0.0\] kg/m"),
        (dict(other_frictions={1: 0.3}), r"other_frictions of the pieces \[1\], but its pieces are 0 to 0"),
        (dict(springs={7: 1e3}), r"springs of the pieces \[7\]"),
    ],
)
def test_a_part_that_would_lose_a_setting_or_have_no_mass_is_refused(changes, said):
    with pytest.raises(InvalidArgumentError, match=said):
        Part(**dict(name="block", pieces=(Box((0.01, 0.01, 0.01)),), look=Look((0.5, 0.5, 0.5))) | changes)


def test_a_part_says_which_bodies_it_can_be():
    scene: Any = None  # it is refused before anything is made
    part = Part("block", (Solid(trimesh.creation.box((0.01, 0.01, 0.01))),), Look((0.5, 0.5, 0.5)))
    with pytest.raises(InvalidArgumentError, match="body_type='dynamik'"):
        part.build(scene, "dynamik", sapien.Pose())
    with pytest.raises(InvalidArgumentError, match="has a Solid, which cannot move"):
        part.build(scene, "dynamic", sapien.Pose())
