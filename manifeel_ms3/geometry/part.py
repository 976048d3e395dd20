"""A part: one description of a rigid body's shape that yields both what is drawn and what collides."""

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import sapien
import trimesh
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor
from sapien.physx import PhysxMaterial
from sapien.render import RenderMaterial

from manifeel_ms3.arguments import one_of
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.paths import derived_file
from manifeel_ms3.rendering.looks import Look
from manifeel_ms3.sensors.depth.surfaces import give_relief

from .materials import ABS

MILLIMETRES = (1e-3, 1e-3, 1e-3)
"""Unit of the mesh files of convex hulls, in m. The engine flattens whatever lies within 0.7 thousandths of a unit of a plane:
in metres, that would flatten teeth and threads."""
UPRIGHT = [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]
"""Quaternion, w first, that turns SAPIEN's cylinders, which lie along x, to stand along z."""


@dataclass(frozen=True)
class Box:
    """Axis-aligned box in the part's frame; sizes in m."""

    size: tuple[float, float, float]
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Surface of the box."""
        return trimesh.creation.box(self.size).apply_translation(self.centre)

    def add_to(self, builder, material: PhysxMaterial, density: float, look: RenderMaterial | None) -> None:
        pose, half_size = sapien.Pose(self.centre), np.asarray(self.size) / 2
        builder.add_box_collision(pose, half_size, material, density)
        if look is not None:
            builder.add_box_visual(pose, half_size, look)


@dataclass(frozen=True)
class Cylinder:
    """Cylinder along the z of the part's frame; sizes in m."""

    radius: float
    length: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def add_to(self, builder, material: PhysxMaterial, density: float, look: RenderMaterial | None) -> None:
        pose = sapien.Pose(self.centre, UPRIGHT)
        builder.add_cylinder_collision(pose, self.radius, self.length / 2, material, density)
        if look is not None:
            builder.add_cylinder_visual(pose, self.radius, self.length / 2, look)


@dataclass(frozen=True)
class Ball:
    """Sphere in the part's frame; sizes in m."""

    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def add_to(self, builder, material: PhysxMaterial, density: float, look: RenderMaterial | None) -> None:
        pose = sapien.Pose(self.centre)
        builder.add_sphere_collision(pose, self.radius, material, density)
        if look is not None:
            builder.add_sphere_visual(pose, self.radius, look)


@dataclass(frozen=True, eq=False)
class Hulls:
    """Convex hulls of several sets of points (n, 3) in the part's frame, in m."""

    points: tuple[np.ndarray, ...]

    def add_to(self, builder, material: PhysxMaterial, density: float, look: RenderMaterial | None) -> None:
        path = str(self.file)
        builder.add_multiple_convex_collisions_from_file(path, scale=MILLIMETRES, material=material, density=density)
        if look is not None:
            builder.add_visual_from_file(path, scale=MILLIMETRES, material=look)

    @cached_property
    def file(self) -> Path:
        """Path of a file with the hulls as meshes, which the engine reads."""
        return _cached_obj([trimesh.convex.convex_hull(points / MILLIMETRES[0]) for points in self.points])


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangle mesh of a fixed part, in the part's frame, in m; it collides with convex shapes only."""

    mesh: trimesh.Trimesh

    def add_to(self, builder, material: PhysxMaterial, density: float, look: RenderMaterial | None) -> None:
        path = str(self.file)
        builder.add_nonconvex_collision_from_file(path, material=material)
        if look is not None:
            builder.add_visual_from_file(path, material=look)

    @cached_property
    def file(self) -> Path:
        """Path of a file with the mesh, which the engine reads."""
        return _cached_obj([self.mesh])


Piece = Box | Cylinder | Ball | Hulls | Solid


def _cached_obj(meshes: list[trimesh.Trimesh]) -> Path:
    """Path of a file in the cache that has these meshes as its objects; it is written once."""
    lines, first = [], 1
    for k, mesh in enumerate(meshes):
        lines.append(f"o piece{k}")
        lines += [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + first]
        first += len(mesh.vertices)
    text = "\n".join(lines)
    return derived_file(f"parts/{hashlib.sha256(text.encode()).hexdigest()[:16]}.obj", lambda: text)


@dataclass(frozen=True)
class Part:
    """A rigid body made of pieces."""

    name: str
    """Name of the actor in the scene."""
    pieces: tuple[Piece, ...]
    """Shapes that collide and, but for `undrawn` and `relief`, are drawn and touched."""
    look: Look
    """Look of the surface."""
    density: float = ABS
    """Density in kg/m^3 of a dynamic part: that of the material it is drawn as. A light part between stiff pads needs a high
    physics rate; see `VisuotactileEnv.physics_rate`."""
    friction: float = 0.5
    """Coulomb's friction coefficient; that of the public code for held parts by default."""
    other_looks: dict[int, Look] = field(default_factory=dict)
    """Looks of single pieces, by index in `pieces`."""
    other_densities: dict[int, float] = field(default_factory=dict)
    """Densities of single pieces, by index in `pieces`."""
    other_frictions: dict[int, float] = field(default_factory=dict)
    """Friction coefficients of single pieces, by index in `pieces`."""
    undrawn: frozenset[int] = frozenset()
    """Indices in `pieces` of those that collide, but are neither drawn nor touched; they need a `relief` of the others."""
    springs: dict[int, float] = field(default_factory=dict)
    """Stiffness of compliant pieces, in N/m at each contact point, by index in `pieces`."""
    relief: trimesh.Trimesh | None = None
    """Surface that the pads touch, where it has details too fine for cameras and contacts, or not all pieces."""

    def __post_init__(self):
        if not self.pieces:
            raise InvalidArgumentError(f"part {self.name!r} has no pieces; give at least one shape")
        densities = (self.density, *self.other_densities.values())
        if wrong := [number for piece in self.pieces for number in _sizes(piece) if not number > 0]:
            raise InvalidArgumentError(f"part {self.name!r} has sizes of {wrong} m; they must be above 0")
        if wrong := [density for density in densities if not density > 0]:
            raise InvalidArgumentError(f"part {self.name!r} has densities of {wrong} kg/m^3; they must be above 0")
        for name in ("other_looks", "other_densities", "other_frictions", "springs", "undrawn"):
            if wrong := sorted(set(getattr(self, name)).difference(range(len(self.pieces)))):
                raise InvalidArgumentError(
                    f"part {self.name!r} has {name} of the pieces {wrong}, but its pieces are 0 to {len(self.pieces) - 1}"
                )
        if self.undrawn and self.relief is None:  # without a renderer, pads touch what collides
            raise InvalidArgumentError(
                f"part {self.name!r} has undrawn={sorted(self.undrawn)} and no relief; give the surface of its other pieces "
                "as `relief`, so that the pads touch the same with and without a renderer"
            )

    def build(self, scene: ManiSkillScene, body_type: str, initial_pose: sapien.Pose) -> Actor:
        """Add the part to a scene.

        Args:
            scene: Scene in which the actor is made.
            body_type: "dynamic", "kinematic" or "static".
            initial_pose: Pose of the actor when the scene starts.

        Raises:
            InvalidArgumentError: The body type is unknown, or the part has a `Solid`, which cannot move, and is to be dynamic.
        """
        one_of("body_type", body_type, ("dynamic", "kinematic", "static"))
        if body_type == "dynamic" and any(isinstance(piece, Solid) for piece in self.pieces):
            raise InvalidArgumentError(f"part {self.name!r} has a Solid, which cannot move; give Hulls of convex parts")
        builder = scene.create_actor_builder()
        for k, piece in enumerate(self.pieces):
            look = None
            if scene.can_render() and k not in self.undrawn:  # a render material cannot even be made without a renderer
                look = self.other_looks.get(k, self.look).material()
            # the engine takes negative restitution as a spring, and averages it with the other body's
            friction = self.other_frictions.get(k, self.friction)
            material = PhysxMaterial(friction, friction, -2 * self.springs.get(k, 0.0))
            piece.add_to(builder, material, self.other_densities.get(k, self.density), look)
        builder.initial_pose = initial_pose  # pyright: ignore[reportAttributeAccessIssue]  (ManiSkill annotates its own poses alone)
        builder.set_physx_body_type(body_type)
        actor = builder.build(self.name)
        if self.relief is not None:
            give_relief(actor, self.relief)
        return actor


def _sizes(piece: Piece) -> tuple[float, ...]:
    """Sizes of a piece, in m, that must be above 0."""
    if isinstance(piece, Box):
        return piece.size
    if isinstance(piece, Cylinder):
        return piece.radius, piece.length
    return (piece.radius,) if isinstance(piece, Ball) else ()


def lofted(sections: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """Points (m, 3) of several outlines (n, 2), each at its own height; all in m."""
    return np.concatenate([np.c_[outline, np.full(len(outline), z)] for outline, z in sections])


def extruded(outline: np.ndarray, bottom: float, top: float) -> np.ndarray:
    """Points (2 n, 3) of an outline (n, 2) at two heights; all in m."""
    return lofted([(outline, bottom), (outline, top)])


def ring_of_wedges(
    count: int, bore: float, rim: Callable[[np.ndarray], np.ndarray], bottom: float, top: float
) -> list[np.ndarray]:
    """Points (8, 3), in m, of each convex wedge of a ring about z, whose inner faces touch the bore's circle.

    Args:
        count: Number of wedges.
        bore: Radius of the bore, in m.
        rim: Function from angles (n,), in rad, to the outer radii there, in m.
        bottom: Height of the underside, in m.
        top: Height of the top, in m.
    """
    wedges = []
    for k in range(count):
        angles = 2 * np.pi * (k + np.array([0.0, 1.0])) / count
        radii = (np.full(2, bore / np.cos(np.pi / count)), rim(angles))
        outline = [[r * np.cos(a), r * np.sin(a)] for at in radii for r, a in zip(at, angles, strict=True)]
        wedges.append(extruded(np.array(outline), bottom, top))
    return wedges


def bevelled_box(box: Box, width: float, sides: Collection[str]) -> Box | Hulls:
    """Box whose upper edges on some sides are cut off at 45 degrees; the box itself if the cut has no width.

    Args:
        box: The whole box.
        width: Width of the cut, in m.
        sides: Sides of the edges: "-x", "+x", "-y", "+y".
    """
    if width == 0 or not sides:
        return box
    low, high = np.array(box.centre) - np.array(box.size) / 2, np.array(box.centre) + np.array(box.size) / 2
    shift = width * np.array([["-x" in sides, "-y" in sides], [-("+x" in sides), -("+y" in sides)]])
    corners = np.array([low[:2], high[:2]])
    points = []
    for z, inset in ((low[2], 0.0), (high[2] - width, 0.0), (high[2], 1.0)):
        (left, front), (right, back) = corners + inset * shift
        points += [(x, y, z) for x in (left, right) for y in (front, back)]
    return Hulls((np.array(points),))


Holes = list[tuple[tuple[float, float], tuple[float, float]]]
"""((size x, size y), (centre x, centre y)) of each hole of a slab, in m; they must not overlap along x."""


def block_with_holes(outer: tuple[float, float], depth: float, holes: Holes, bottom: float = 0.0) -> tuple[Box, ...]:
    """Boxes of a slab with rectangular through holes.

    Args:
        outer: Size of the slab along x and y, in m.
        depth: Size along z, in m.
        holes: The holes.
        bottom: Height of the underside, in m.

    Raises:
        InvalidArgumentError: Holes overlap along x, or reach beyond the slab.
    """
    return tuple(box for box, _ in _walls(outer, depth, holes, bottom, 0.0))


def block_with_chamfered_holes(
    outer: tuple[float, float], depth: float, holes: Holes, bottom: float, chamfer: float
) -> tuple[Box | Hulls, ...]:
    """Convex pieces of a slab as `block_with_holes` makes it, each hole with a chamfer of 45 degrees around its upper mouth.

    Args:
        outer: Size of the slab along x and y, in m.
        depth: Size along z, in m.
        holes: The holes.
        bottom: Height of the underside, in m.
        chamfer: Width of the chamfer, in m; 0 for none.

    Raises:
        InvalidArgumentError: Holes overlap along x, or reach beyond the slab, or the chamfers are wider than the walls.
    """
    return tuple(bevelled_box(box, chamfer, sides) for box, sides in _walls(outer, depth, holes, bottom, chamfer))


def _walls(
    outer: tuple[float, float], depth: float, holes: Holes, bottom: float, chamfer: float
) -> list[tuple[Box, list[str]]]:
    """Boxes of a slab around its holes, and the sides of each that have chamfers."""
    z, walls, left, cut = bottom + depth / 2, [], -outer[0] / 2, list[str]()
    for (size_x, size_y), (x, y) in sorted(holes, key=lambda hole: hole[1][0]):
        if x - size_x / 2 <= left or x + size_x / 2 >= outer[0] / 2 or abs(y) + size_y / 2 >= outer[1] / 2:
            raise InvalidArgumentError(
                f"hole {size_x} x {size_y} m at ({x}, {y}) overlaps another along x, or the rim of a slab of {outer} m; "
                "move it, or make it smaller"
            )
        strip = Box((x - size_x / 2 - left, outer[1], depth), ((x - size_x / 2 + left) / 2, 0.0, z))
        walls.append((strip, [*cut, "+x"]))
        for low, high, side in ((-outer[1] / 2, y - size_y / 2, "+y"), (y + size_y / 2, outer[1] / 2, "-y")):
            # as wide as the chamfers beside it, so that they end at the hole's corners
            wall = Box((size_x + 2 * chamfer, high - low, depth), (x, (low + high) / 2, z))
            walls.append((wall, [side]))
        left, cut = x + size_x / 2, ["-x"]
    walls.append((Box((outer[0] / 2 - left, outer[1], depth), ((left + outer[0] / 2) / 2, 0.0, z)), cut))
    for wall, sides in walls:
        cuts = [sum(axis in side for side in sides) for axis in "xy"] + [1]
        if any(chamfer * count > size for count, size in zip(cuts, wall.size, strict=True)):
            raise InvalidArgumentError(
                f"chamfer {chamfer} m is wider than a wall of {wall.size} m; make it narrower, or the slab larger"
            )
    return walls
