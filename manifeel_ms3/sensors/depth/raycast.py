# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# pyright: reportAttributeAccessIssue=false
# (warp reads a kernel's annotations as its own types, and its stubs do not know the vectors' operators)
"""Depth by rays: warp rays from the pad, parallel to its normal, against triangle meshes. Needs no renderer."""

from collections.abc import Sequence
from dataclasses import dataclass

import sapien
import torch
import trimesh
import warp as wp
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.structs import Actor, Link

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors.warp_device import launch_split, warp_device

from .surfaces import scene_surfaces

START = 4.2e-3  # m behind the face, where rays start: near the gel's back (4.25 mm), which no object reaches
REACH = 5.0e-3  # m in front of the face, where rays end (chosen; beyond `contact.MAX_GAP`)

wp.set_module_options({"enable_backward": False})


@dataclass
class Window:
    """Parts of a face in which depth is computed."""

    open: torch.Tensor
    """(N, rows, cols) bool: cells, evenly spread over the face, in which depth is computed."""
    size: tuple[float, float]
    """Size of the face, m."""


@wp.struct
class Hit:
    """First surface on a ray."""

    distance: float  # m
    place: int  # index in the list of near bodies, -1 for none
    normal: wp.vec3f  # body frame


@wp.func
def _nearest(
    count: wp.array(dtype=wp.int32),
    meshes: wp.array2d(dtype=wp.int64),
    pad_in_body: wp.array2d(dtype=wp.transformf),
    n: int,
    at: wp.vec2f,
    start: float,
    end: float,
) -> Hit:
    nearest = Hit()
    nearest.distance = start + end
    nearest.place = -1
    for k in range(count[n]):
        pose = pad_in_body[n, k]
        origin = wp.transform_point(pose, wp.vec3f(at[0], at[1], -start))
        ahead = wp.transform_vector(pose, wp.vec3f(0.0, 0.0, 1.0))
        hit = wp.mesh_query_ray(wp.uint64(meshes[n, k]), origin, ahead, nearest.distance)
        if hit.result:
            nearest.distance = hit.t
            nearest.place = k
            nearest.normal = hit.normal
    return nearest


@wp.kernel
def _approach(
    body: wp.array2d(dtype=wp.transformf),  # (N, B), world
    pad: wp.array(dtype=wp.transformf),  # (N,), world
    ids: wp.array2d(dtype=wp.int64),  # (N, B), 0 for none
    low: wp.array2d(dtype=wp.vec3f),  # (N, B), the mesh's box
    high: wp.array2d(dtype=wp.vec3f),
    middle: wp.vec3f,  # of the box that the rays sweep, pad frame
    half: wp.vec3f,
    count: wp.array(dtype=wp.int32),  # (N,)
    near: wp.array2d(dtype=wp.int32),  # (N, B); this and the next two describe the `count` bodies near the pad
    meshes: wp.array2d(dtype=wp.int64),
    pad_in_body: wp.array2d(dtype=wp.transformf),
):
    """List the bodies whose bounding box meets that of the space swept by the rays, in the body's axes."""
    n = wp.tid()
    found = int(0)  # noqa: RUF046 (declares a variable)
    for b in range(ids.shape[1]):
        pose = wp.transform_multiply(wp.transform_inverse(body[n, b]), pad[n])
        centre = wp.transform_point(pose, middle)
        rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
        meets = ids[n, b] != wp.int64(0)
        for axis in range(3):
            extent = wp.dot(wp.abs(rotation[axis]), half)
            meets = meets and centre[axis] + extent > low[n, b][axis] and centre[axis] - extent < high[n, b][axis]
        if meets:
            near[n, found] = b
            meshes[n, found] = ids[n, b]
            pad_in_body[n, found] = pose
            found += 1
    count[n] = found


@wp.kernel
def _cast(
    first: int,
    count: wp.array(dtype=wp.int32),
    meshes: wp.array2d(dtype=wp.int64),
    pad_in_body: wp.array2d(dtype=wp.transformf),
    grid: wp.array(dtype=wp.vec2f),  # (C,), pad frame
    window: wp.array3d(dtype=wp.bool),  # (N, rows, cols), may be empty: look everywhere
    size: wp.vec2f,
    start: float,
    end: float,
    height: wp.array2d(dtype=wp.float32),  # (N, C)
):
    n, c = wp.tid()
    c += first
    at = grid[c]
    rows = window.shape[1]
    cols = window.shape[2]
    if rows > 0:
        row = wp.clamp(int((at[0] / size[0] + 0.5) * float(rows)), 0, rows - 1)
        col = wp.clamp(int((at[1] / size[1] + 0.5) * float(cols)), 0, cols - 1)
        if not window[n, row, col]:
            height[n, c] = -end
            return
    height[n, c] = start - _nearest(count, meshes, pad_in_body, n, at, start, end).distance


@wp.kernel
def _cast_moving(
    count: wp.array(dtype=wp.int32),
    meshes: wp.array2d(dtype=wp.int64),
    pad_in_body: wp.array2d(dtype=wp.transformf),
    near: wp.array2d(dtype=wp.int32),
    twist: wp.array2d(
        dtype=wp.spatial_vectorf
    ),  # (N, B): velocity of the pad's origin, and spin, relative to the body, pad frame
    grid: wp.array(dtype=wp.vec2f),
    start: float,
    end: float,
    height: wp.array2d(dtype=wp.float32),
    velocity: wp.array2d(dtype=wp.vec2f),
):
    n, c = wp.tid()
    hit = _nearest(count, meshes, pad_in_body, n, grid[c], start, end)
    height[n, c] = start - hit.distance
    velocity[n, c] = wp.vec2f(0.0)
    if hit.place >= 0:
        normal = wp.transform_vector(wp.transform_inverse(pad_in_body[n, hit.place]), hit.normal)
        motion = twist[n, near[n, hit.place]]
        point = wp.vec3f(grid[c][0], grid[c][1], hit.distance - start)
        v = wp.spatial_top(motion) + wp.cross(wp.spatial_bottom(motion), point)
        v -= wp.dot(v, normal) * normal
        velocity[n, c] = wp.vec2f(v[0], v[1])


class MeshRays:
    """Rays from N pads, each against the meshes of B bodies. Bodies and pads are at the origin until `move` is called.

    Args:
        meshes: B lists of N meshes, None where an environment lacks the body. Equal meshes are stored once.
        size: Size of the pads' face across and along the finger, m.
        device: Device on which rays are cast.
        sag: Depth of a domed face's corners under its highest point, m: rays start deeper by this much.
    """

    def __init__(
        self,
        meshes: Sequence[Sequence[trimesh.Trimesh | None]],
        size: tuple[float, float],
        device: torch.device,
        sag: float = 0.0,
    ):
        self.device, self._start = device, START + sag
        shape = (len(meshes[0]), len(meshes))
        ids, low, high = torch.zeros(shape, dtype=torch.int64), torch.zeros(*shape, 3), torch.zeros(*shape, 3)
        self._meshes: dict[bytes, wp.Mesh] = {}
        for b, row in enumerate(meshes):
            for n, mesh in enumerate(row):
                if mesh is not None:
                    ids[n, b] = self._upload(mesh).id
                    low[n, b], high[n, b] = torch.tensor(mesh.bounds, dtype=torch.float32)
        self._boxes = [t.to(device) for t in (ids, low, high)]
        middle, half = (REACH - self._start) / 2, (REACH + self._start) / 2
        self._swept = wp.vec3f(0.0, 0.0, middle), wp.vec3f(size[0] / 2, size[1] / 2, half)
        self._count = torch.zeros(shape[0], dtype=torch.int32, device=device)
        self._near = torch.zeros(shape, dtype=torch.int32, device=device)
        self._near_ids = torch.zeros(shape, dtype=torch.int64, device=device)
        self._near_poses = torch.zeros(*shape, 7, device=device)
        self._everywhere = torch.zeros(0, 0, 0, dtype=torch.bool, device=device)

        at_origin = torch.tensor([0.0, 0, 0, 0, 0, 0, 1], device=device)
        self.move(at_origin.expand(*shape, 7), at_origin.expand(shape[0], 7))

    def _upload(self, mesh: trimesh.Trimesh) -> wp.Mesh:
        key = mesh.vertices.tobytes() + mesh.faces.tobytes()
        if key not in self._meshes:
            device = warp_device(self.device)
            self._meshes[key] = wp.Mesh(
                points=wp.array(mesh.vertices, dtype=wp.vec3f, device=device),
                indices=wp.array(mesh.faces.flatten(), dtype=wp.int32, device=device),
            )
        return self._meshes[key]

    def move(self, bodies: torch.Tensor, pads: torch.Tensor) -> None:
        """Set the poses of the bodies (N, B, 7) and of the pads (N, 7) in the world, m and xyzw."""
        ids, low, high = self._boxes
        inputs = [_transforms(bodies), _transforms(pads), ids, _vectors(low), _vectors(high), *self._swept]
        outputs = [self._count, self._near, self._near_ids, _transforms(self._near_poses)]
        self._launch(_approach, self._count.shape, inputs, outputs)

    def heights(self, grid: torch.Tensor, window: Window | None = None) -> torch.Tensor:
        """Height (N, C), m, of the nearest surface above (+: into) the face at points (C, 2); -REACH if there is none."""
        height = torch.empty(len(self._near), len(grid), device=self.device)
        where, size = (self._everywhere, (1.0, 1.0)) if window is None else (window.open, window.size)
        face = [wp.from_torch(grid, dtype=wp.vec2f), wp.from_torch(where), wp.vec2f(*size)]
        inputs = [*self._found(), *face, self._start, REACH]
        launch_split(_cast, tuple(height.shape), inputs, [wp.from_torch(height)], self.device)
        return height

    def sliding(self, grid: torch.Tensor, twist: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Heights as `heights` returns, and velocity (N, C, 2), m/s, of the pads along the surfaces that they face.

        Args:
            grid: (C, 2), m, points of the face.
            twist: (N, B, 6), m/s and rad/s, velocity of the pad's origin and its spin relative to each body, pad frame.
        """
        height = torch.empty(len(self._near), len(grid), device=self.device)
        velocity = torch.empty(*height.shape, 2, device=self.device)
        motion = wp.from_torch(twist.contiguous(), dtype=wp.spatial_vectorf)
        inputs = [*self._found(), self._near, motion, wp.from_torch(grid, dtype=wp.vec2f), self._start, REACH]
        self._launch(_cast_moving, height.shape, inputs, [height, wp.from_torch(velocity, dtype=wp.vec2f)])
        return height, velocity

    def _found(self) -> list:
        return [wp.from_torch(self._count), wp.from_torch(self._near_ids), _transforms(self._near_poses)]

    def _launch(self, kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        arguments = [[wp.from_torch(a) if isinstance(a, torch.Tensor) else a for a in group] for group in (inputs, outputs)]
        wp.launch(kernel, dim=tuple(dim), inputs=arguments[0], outputs=arguments[1], device=warp_device(self.device))


def _transforms(poses: torch.Tensor) -> wp.array:
    return wp.from_torch(poses.contiguous(), dtype=wp.transformf)


def _vectors(vectors: torch.Tensor) -> wp.array:
    return wp.from_torch(vectors, dtype=wp.vec3f)


class RaycastDepth:
    """Height of everything near one pad of a robot over points of its face, and the pad's velocity along it.

    Args:
        scene: Scene whose actors and links are felt.
        pad: Link that carries the pad.
        pad_pose: Pose of the pad frame in that link's frame.
        size: Size of the face, m.
        excluded: Names of the links of the pad's robot that are not felt.
        sag: Depth of a domed face's corners under its highest point, m.

    Raises:
        InvalidArgumentError: The scene has no body that could be felt.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        pad: Link,
        pad_pose: sapien.Pose,
        size: tuple[float, float],
        excluded: set[str],
        sag: float = 0.0,
    ):
        self.pad, self.device = pad, torch.device(scene.device)
        self._pad_pose = pad_pose
        self.surfaces = scene_surfaces(scene, excluded, pad.articulation)
        if not self.surfaces:
            raise InvalidArgumentError(
                "the scene has nothing that this pad could feel; make its sensor after the scene's other bodies, since those "
                "that are added later are not felt"
            )
        meshes = [_by_env(s.env_idx, s.meshes, scene.num_envs) for s in self.surfaces]
        self._rays = MeshRays(meshes, size, self.device, sag)
        self._mass_centres = [_mass_centres(s.body, self.device) for s in self.surfaces]
        self._pad_mass_centre = _mass_centres(pad, self.device)
        self._world = torch.zeros(scene.num_envs, len(self.surfaces), 7, device=scene.device)
        self._world[..., 3] = 1.0

    def look(self) -> None:
        """Read the present poses, also those of static bodies, which a task may move when an episode begins."""
        for b, surface in enumerate(self.surfaces):
            self._world[surface.env_idx, b] = surface.body.pose.raw_pose
        self._pad_world = (self.pad.pose * self._pad_pose).raw_pose
        self._rays.move(_xyzw(self._world), _xyzw(self._pad_world))

    def heights(self, grid: torch.Tensor, window: Window | None = None) -> torch.Tensor:
        """Height (N, C), m, of the nearest surface above (+: into) the face at points (C, 2).

        It is -REACH if there is none, and where the window is not open.
        """
        return self._rays.heights(grid, window)

    def sliding(self, grid: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Heights (N, C), m, and velocity (N, C, 2), m/s, pad frame, of the pad along the surface that it faces."""
        origin = self._pad_world[:, :3]
        pad_linear, pad_spin = _motion(self.pad, self._pad_mass_centre, origin)
        twist = torch.zeros(*self._world.shape[:2], 6, device=self.device)
        for b, surface in enumerate(self.surfaces):
            env = surface.env_idx
            linear, spin = _motion(surface.body, self._mass_centres[b], origin[env])
            twist[env, b] = torch.cat([pad_linear[env] - linear, pad_spin[env] - spin], dim=-1)
        return self._rays.sliding(grid, in_pad_frames(twist, self._pad_world))


def in_pad_frames(twist: torch.Tensor, pads: torch.Tensor) -> torch.Tensor:
    """Twists (N, B, 6), velocity and spin, of the world's frame in the frames of pads at poses (N, 7), m and wxyz."""
    to_pad = quaternion_to_matrix(pads[:, 3:]).transpose(1, 2)[:, None, None]
    return (to_pad @ twist.unflatten(-1, (2, 3))[..., None])[..., 0].flatten(-2)


def _by_env(env_idx: torch.Tensor, meshes: list[trimesh.Trimesh], num_envs: int) -> list[trimesh.Trimesh | None]:
    row: list[trimesh.Trimesh | None] = [None] * num_envs
    for env, mesh in zip(env_idx.tolist(), meshes, strict=True):
        row[env] = mesh
    return row


def _is_static(body: Actor | Link) -> bool:
    return isinstance(body, Actor) and body.px_body_type == "static"


def _mass_centres(body: Actor | Link, device: torch.device) -> torch.Tensor:
    """Centres of mass (n, 3), m, of a body in the environments that have it, in its own frame; zeros for a static one."""
    if _is_static(body):
        return torch.zeros(len(body._bodies), 3, device=device)
    return torch.stack([torch.as_tensor(one.cmass_local_pose.p) for one in body._bodies]).to(device)


def _motion(body: Actor | Link, mass_centre: torch.Tensor, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Velocity, m/s, of the body's point that is at `at` (n, 3), and its spin, rad/s; (n, 3) each, world frame.

    The engine's velocity is that of the centre of mass, which `mass_centre` (n, 3), m, gives in the body's frame.
    """
    if _is_static(body):
        return torch.zeros_like(at), torch.zeros_like(at)
    spin, pose = body.angular_velocity, body.pose.raw_pose
    centre = pose[:, :3] + (quaternion_to_matrix(pose[:, 3:]) @ mass_centre[..., None])[..., 0]
    return body.linear_velocity + torch.linalg.cross(spin, at - centre), spin


def _xyzw(pose: torch.Tensor) -> torch.Tensor:
    """Poses (..., 7) with their quaternions in warp's order instead of SAPIEN's wxyz."""
    return pose[..., [0, 1, 2, 4, 5, 6, 3]]
