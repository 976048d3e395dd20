"""Pads that press on meshes, with their loads."""

import torch
import trimesh

from manifeel_ms3.sensors import gelsight_r15
from manifeel_ms3.sensors.depth.raycast import MeshRays

CPU = torch.device("cpu")
CONFIG = gelsight_r15("touch", "gel_right")
EVERYTHING = {"optics.shadow": 0.5, "optics.markers": True, "randomization.gain": 0.1, "randomization.stiffness": 0.3}
LOADS = torch.tensor(  # N, N m
    [[0.5, 0.2, -5.0, 0, 0, 1e-3], [0, 0, 0, 0, 0, 0], [-1.0, 0.5, -3.0, 0.002, -0.001, 0], [0, 2.0, -8.0, 0, 0, -2e-3]],
    dtype=torch.float64,
)


def pressed(meshes: list[trimesh.Trimesh | None]) -> MeshRays:
    """Rays of several pads, each with one of the meshes at rest on its face."""
    return MeshRays([meshes], CONFIG.gel.size, CPU)


def meshes() -> list[trimesh.Trimesh | None]:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.008)
    shapes = [ball.copy(), ball.copy().apply_translation([3e-3, -4e-3, 0]), trimesh.creation.box([0.01, 0.012, 0.01])]
    lifted = [shape.apply_translation([0, 0, -shape.bounds[0, 2]]) for shape in shapes]
    return [lifted[0], lifted[1], lifted[2], None]
