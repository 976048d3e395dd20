"""Wrench on a link, including friction, from the force that the link's joint carries."""

import sapien
import torch
from mani_skill.utils.structs import Articulation, Link


class WrenchGauge:
    """Measures the force and moment of the world on one link, in a frame fixed to it, about that frame's origin.

    The engine's spatial force of a joint is what the parent link exerts on the child (PhysX's incoming joint force), in the
    joint's frame. On a link at rest, it balances the force of the world, which therefore has the opposite sign. SAPIEN's joint
    frames are turned against the link's (by half a turn about x for fixed joints). Contact queries would leave out friction.
    The wrench includes the link's own inertia, and its weight unless its gravity is off, as on ManiSkill's robots.

    Args:
        articulation: Robot that the link belongs to.
        link: Link on which the wrench acts.
        frame: Frame of the wrench, given in the link's frame; the link's own by default.
    """

    def __init__(self, articulation: Articulation, link: Link, frame: sapien.Pose | None = None):
        self.articulation = articulation
        self._index = int(link.index[0])
        joint = ((frame or sapien.Pose()).inv() * link.joint._objs[0].pose_in_child).to_transformation_matrix()
        self._rotation = torch.as_tensor(joint[:3, :3].T, dtype=torch.float64, device=articulation.device)
        self._arm = torch.as_tensor(joint[:3, 3], dtype=torch.float64, device=articulation.device)

    def read(self) -> torch.Tensor:
        """Wrench (N, 6): force, N, and moment, N m."""
        spatial = self.articulation.get_link_incoming_joint_forces()[:, self._index].to(torch.float64)
        force, moment = -spatial[:, :3] @ self._rotation, -spatial[:, 3:] @ self._rotation
        return torch.cat([force, moment + torch.linalg.cross(self._arm.expand_as(force), force)], dim=1)
