"""Gel mechanics: from the shape of what presses and the measured wrench to pressure, shear and penetration of every cell.

All functions are batched torch in float64 (rows are independent pads), run a fixed number of iterations and never synchronise
with the host. Units are SI; the frame is the pad frame (z out of the gel).
"""

from dataclasses import dataclass
from functools import cached_property

import torch

MAX_TILT = 0.087  # rad, 5 degrees: further off, the moment comes from outside what the pad sees
MAX_GAP = 3.0e-3  # m; geometry further from the face than this is not what the measured force presses on
MIN_FORCE = 1.0e-3  # N; below it the pad is untouched
INDENTATION_ITERATIONS = 8
DEPTH_ITERATIONS = 10
SHEAR_ITERATIONS = 10
LEVER = 1e-2  # m; rotations times this are lengths like the displacements, which conditions the 3 x 3 systems


@dataclass
class ContactGrid:
    """Cells over the whole gel face.

    `x`, `y`: (C,) centres in the pad frame, m. `shape`: rows, columns with C = rows * columns. `area`: of a cell, m^2.
    """

    x: torch.Tensor
    y: torch.Tensor
    shape: tuple[int, int]
    area: float

    @classmethod
    def covering(cls, size: tuple[float, float], cell: float, device: torch.device) -> "ContactGrid":
        """Grid of about `cell` metres that covers `size` (across, along) exactly."""
        rows, cols = (max(1, round(extent / cell)) for extent in size)
        x = ((torch.arange(rows, dtype=torch.float64, device=device) + 0.5) / rows - 0.5) * size[0]
        y = ((torch.arange(cols, dtype=torch.float64, device=device) + 0.5) / cols - 0.5) * size[1]
        xx, yy = torch.meshgrid(x, y, indexing="ij")
        return cls(xx.flatten(), yy.flatten(), (rows, cols), size[0] * size[1] / (rows * cols))

    @cached_property
    def plane_basis(self) -> torch.Tensor:
        """(3, C): height change per depth and per tilt x LEVER about each axis."""
        return torch.stack([torch.ones_like(self.x), self.x / LEVER, self.y / LEVER])

    @cached_property
    def motion_basis(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(3, C) twice: displacement along x and y per rigid motion (u_x, u_y, theta x LEVER)."""
        one, zero = torch.ones_like(self.x), torch.zeros_like(self.x)
        return torch.stack([one, zero, -self.y / LEVER]), torch.stack([zero, one, self.x / LEVER])

    @cached_property
    def plane_products(self) -> torch.Tensor:
        """(C, 9): products of `plane_basis` with itself, for Hessians as one matrix product."""
        return _products(self.plane_basis, self.plane_basis)

    @cached_property
    def motion_products(self) -> torch.Tensor:
        """(3 C, 9): xx, xy + yx and yy products of `motion_basis`."""
        jx, jy = self.motion_basis
        return torch.cat([_products(jx, jx), _products(jx, jy) + _products(jy, jx), _products(jy, jy)])


def _products(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a[:, None] * b[None]).reshape(9, -1).T.contiguous()


def solve_indentation(height: torch.Tensor, wrench: torch.Tensor, grid: ContactGrid, stiffness: float) -> torch.Tensor:
    """Plane (N, 3) to add to a surface's height so that what sticks out of the gel's face carries the measured load.

    Virtual indentation: of the object only the shape matters; how deep it sits follows from the force. Find the depth d, m,
    and the tilts a, b such that the layer's pressure p = K max(0, height + d + a x + b y) has sum p dA = F_n and the measured
    first moments sum p x dA, sum p y dA. This is the minimum of a convex potential: Newton's method, started from the depth
    at zero tilt. An untouched pad gets d = -1 m.

    Args:
        height: (N, C), m, of the object's surface above (+: into) the gel's face.
        wrench: (N, 6), N and N m, force and moment of the object on the pad about the pad frame's origin.
        stiffness: K, N/m^3.
    """
    force = (-wrench[:, 2]).clamp(min=0.0)
    moment_x, moment_y = wrench[:, 4], -wrench[:, 3]  # sum of p x and p y: M = r x f with f = (0, 0, -p)
    highest = height.amax(dim=1)
    loaded = (force > MIN_FORCE) & (highest > -MAX_GAP)
    target = force / (stiffness * grid.area)  # m: sum of the cells' penetrations
    load = torch.stack([target, moment_x / LEVER, moment_y / LEVER], dim=1)
    load[:, 1:] /= stiffness * grid.area
    surface = height - highest[:, None]  # <= 0, so that float errors do not depend on the gap
    depth = _depth(surface, target, start=target)  # one cell alone would need this much: certainly too deep
    plane = torch.stack([depth, torch.zeros_like(depth), torch.zeros_like(depth)], dim=1)
    for _ in range(INDENTATION_ITERATIONS):
        indent = (surface + plane @ grid.plane_basis).clamp(min=0.0)
        hessian = ((indent > 0).to(height.dtype) @ grid.plane_products).view(-1, 3, 3)
        plane = plane + _solve(hessian, load - indent @ grid.plane_basis.T)
        plane = torch.cat([plane[:, :1], plane[:, 1:].clamp(-MAX_TILT * LEVER, MAX_TILT * LEVER)], dim=1)
    tilted = surface + plane[:, 1:] @ grid.plane_basis[1:]
    depth = _depth(tilted, target, start=plane[:, 0])  # the normal force is met whatever the tilt
    offset = torch.where(loaded, depth - highest, torch.full_like(depth, -1.0))
    return torch.stack([offset, plane[:, 1] / LEVER, plane[:, 2] / LEVER], dim=1)


def penetration(height: torch.Tensor, plane: torch.Tensor, x: torch.Tensor, y: torch.Tensor, limit: float) -> torch.Tensor:
    """Penetration (N, C), m, at points x, y (C,) of the face, for the plane of `solve_indentation`."""
    offset = plane[:, :1] + plane[:, 1:2] * x + plane[:, 2:3] * y
    return (height + offset.to(height.dtype)).clamp(0.0, limit)


def _depth(surface: torch.Tensor, load: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Depth d (N,) with sum max(0, surface + d) = load (N,), for a surface (N, C).

    The sum is convex and increasing in d, so that Newton's method falls onto the root from above, after one step at most.
    """
    depth = start
    for _ in range(DEPTH_ITERATIONS):
        depth = torch.maximum(depth, -surface.amax(dim=1))
        indent = (surface + depth[:, None]).clamp(min=0.0)
        count = (indent > 0).sum(dim=1).clamp(min=1)
        depth = depth - (indent.sum(dim=1) - load) / count
    return depth


def solve_shear(
    bristle: torch.Tensor,
    pressure: torch.Tensor,
    wrench: torch.Tensor,
    grid: ContactGrid,
    stiffness: float,
    friction: float,
) -> torch.Tensor:
    """Shear traction force (N, C, 2), N, of every cell such that the field carries the measured shear and twist.

    Every cell is a bristle with memory: its traction is k_t (z + u + theta x r) until Coulomb's limit mu p, beyond which it
    slips. The contact moves as a rigid body by (u, theta) between two calls, the one unknown, found such that the tractions
    add up to the measured F_x, F_y, M_z (minimum of a convex, Huber-like potential; semismooth Newton).

    Args:
        bristle: (N, C, 2), m, deflections z after the last call.
        pressure: (N, C), N, normal force of every cell.
        wrench: (N, 6), as in `solve_indentation`.
        stiffness: k_t, N/m^3.

    Returns the tractions; the new deflections are tractions / (k_t dA).
    """
    k = stiffness * grid.area
    limit = friction * pressure / k  # (N, C), m: deflection at which a cell slips; 0 where nothing touches
    jx, jy = grid.motion_basis
    load = torch.stack([wrench[:, 0], wrench[:, 1], wrench[:, 5] / LEVER], dim=1) / k
    planar = torch.linalg.norm(load[:, :2], dim=1, keepdim=True)
    load = load * (0.999 * limit.sum(dim=1, keepdim=True) / planar.clamp(min=1e-12)).clamp(max=1.0)  # the cone rules
    move = torch.zeros_like(load)
    for step in range(SHEAR_ITERATIONS + 1):
        sx, sy = bristle[..., 0] + move @ jx, bristle[..., 1] + move @ jy
        length = torch.sqrt(sx * sx + sy * sy).clamp(min=1e-15)
        shrink = (limit / length).clamp(max=1.0)
        qx, qy = sx * shrink, sy * shrink
        if step == SHEAR_ITERATIONS:
            return torch.stack([qx, qy], dim=-1) * k
        # derivative of the clamped deflection: identity where it sticks, the tangential part times shrink where it slips
        slip = (shrink < 1.0) * shrink
        nx, ny = sx / length, sy / length
        parts = torch.cat([shrink - slip * nx * nx, -slip * nx * ny, shrink - slip * ny * ny], dim=1)
        hessian = (parts @ grid.motion_products).view(-1, 3, 3)
        residual = load - qx @ jx.T - qy @ jy.T
        move = move + _solve(hessian, residual).clamp(-1e-3, 1e-3)  # m: a runaway in full slip stays finite
    raise AssertionError("unreachable")


def _solve(hessian: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """Newton step (N, 3), with a part in a million of the Hessian's trace on its diagonal, so that it can be inverted."""
    eye = torch.eye(3, dtype=hessian.dtype, device=hessian.device)
    ridge = 1e-6 * (1.0 + hessian.diagonal(dim1=1, dim2=2).sum(1))
    return torch.linalg.solve(hessian + ridge[:, None, None] * eye, residual)


def taxel_weights(grid: ContactGrid, shape: tuple[int, int], pitch: float) -> torch.Tensor:
    """Share (T, C) of every cell that each taxel owns: linear between taxel centres, rim taxels own what lies outside.

    Column sums are 1, so that forces are kept; so are first moments, inside the taxel centres.
    """

    def along(position: torch.Tensor, count: int) -> torch.Tensor:
        index = (position / pitch + (count - 1) / 2).clamp(0, count - 1)
        taxels = torch.arange(count, dtype=position.dtype, device=position.device)
        return (1.0 - (index[None] - taxels[:, None]).abs()).clamp(min=0.0)  # (count, C)

    rows, cols = along(grid.x, shape[0]), along(grid.y, shape[1])
    return (rows[:, None] * cols[None]).reshape(shape[0] * shape[1], -1)
