# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# (warp reads a kernel's annotations as its own types)
"""Depth from rays: the orthographic camera in the pad as warp rays against triangle meshes. Needs no renderer."""

import torch
import warp as wp
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.structs import Link
from mani_skill.utils.structs.pose import Pose

from .surfaces import scene_surfaces
from .warp_device import warp_device

START = 2.5e-3  # m behind the face, where the rays start: deeper than any penetration
REACH = 5.0e-3  # m in front of the face, where they end


@wp.kernel
def _cast(
    meshes: wp.array2d(dtype=wp.int64),  # (N, B), 0 for none
    pad_in_body: wp.array2d(dtype=wp.transformf),  # (N, B)
    grid: wp.array(dtype=wp.vec2f),  # (C,), pad frame
    start: float,
    length: float,
    height: wp.array2d(dtype=wp.float32),  # (N, C)
):
    n, c = wp.tid()
    nearest = length
    for b in range(meshes.shape[1]):
        mesh = wp.uint64(meshes[n, b])
        if mesh != wp.uint64(0):
            pose = pad_in_body[n, b]
            origin = wp.transform_point(pose, wp.vec3f(grid[c][0], grid[c][1], -start))
            ahead = wp.transform_vector(pose, wp.vec3f(0.0, 0.0, 1.0))
            hit = wp.mesh_query_ray(mesh, origin, ahead, nearest)
            if hit.result:
                nearest = hit.t
    height[n, c] = start - nearest


class RaycastDepth:
    """Height of whatever is near one pad (N, C), m, over points of its face.

    Args:
        scene: all its actors and links are felt, but for `excluded` links.
        pad: link whose frame is the pad frame.
        size: of the face, m.
    """

    def __init__(self, scene: ManiSkillScene, pad: Link, size: tuple[float, float], excluded: set[str]):
        self.pad = pad
        self._pad_box = torch.tensor([[0, 0, (REACH - START) / 2], [size[0] / 2, size[1] / 2, (REACH + START) / 2]])
        self._pad_box = self._pad_box.to(scene.device)
        self.device = scene.device
        self.surfaces = scene_surfaces(scene, excluded)
        shape = (scene.num_envs, len(self.surfaces))
        self._ids = torch.zeros(shape, dtype=torch.int64)
        self._low, self._high = torch.zeros(*shape, 3), torch.zeros(*shape, 3)
        self._meshes: dict[bytes, wp.Mesh] = {}  # envs share equal meshes
        for b, surface in enumerate(self.surfaces):
            for env, mesh in zip(surface.env_idx.tolist(), surface.meshes, strict=True):
                self._ids[env, b] = self._upload(mesh).id
                self._low[env, b], self._high[env, b] = torch.tensor(mesh.bounds, dtype=torch.float32)
        self._ids, self._low, self._high = (t.to(self.device) for t in (self._ids, self._low, self._high))

    def _upload(self, mesh) -> wp.Mesh:
        key = mesh.vertices.tobytes() + mesh.faces.tobytes()
        if key not in self._meshes:
            device = warp_device(self.device)
            self._meshes[key] = wp.Mesh(
                points=wp.array(mesh.vertices, dtype=wp.vec3f, device=device),
                indices=wp.array(mesh.faces.flatten(), dtype=wp.int32, device=device),
            )
        return self._meshes[key]

    def heights(self, grids: list[torch.Tensor]) -> list[torch.Tensor]:
        """Height (N, C), m, of the nearest surface above (+: into) the face at each grid's points (C, 2); -REACH where none."""
        pose, ids = self._pad_in_bodies()
        out = []
        for grid in grids:
            height = torch.empty(len(ids), len(grid), device=self.device)
            wp.launch(
                _cast,
                dim=height.shape,
                inputs=[
                    wp.from_torch(ids),
                    wp.from_torch(pose, dtype=wp.transformf),
                    wp.from_torch(grid, dtype=wp.vec2f),
                    START,
                    START + REACH,
                ],
                outputs=[wp.from_torch(height)],
                device=warp_device(self.device),
            )
            out.append(height)
        return out

    def _pad_in_bodies(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Pad pose in each body's frame, (N, B, 7) as xyz + xyzw, and the meshes near enough to matter, (N, B)."""
        pad = self.pad.pose.raw_pose
        world = pad.new_zeros(len(pad), len(self.surfaces), 7)
        world[..., 3] = 1.0
        for b, surface in enumerate(self.surfaces):
            world[surface.env_idx, b] = surface.body.pose.raw_pose
        pad = pad[:, None].expand_as(world)
        relative = Pose.create(world.reshape(-1, 7)).inv() * Pose.create(pad.reshape(-1, 7))
        relative = relative.raw_pose.reshape(world.shape)
        xyzw = relative[..., [0, 1, 2, 4, 5, 6, 3]].contiguous()
        return xyzw, torch.where(self._near(relative), self._ids, torch.zeros_like(self._ids))

    def _near(self, pad_in_body: torch.Tensor) -> torch.Tensor:
        """(N, B) bool: the box that the rays sweep, boxed along the body's axes, meets the body's box."""
        rotation = quaternion_to_matrix(pad_in_body[..., 3:])
        centre = pad_in_body[..., :3] + (rotation @ self._pad_box[0])
        half = rotation.abs() @ self._pad_box[1]
        return ((centre + half > self._low) & (centre - half < self._high)).all(-1)
