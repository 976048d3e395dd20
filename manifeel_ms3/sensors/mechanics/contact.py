# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (warp reads a kernel's annotations as its own types, and its stubs do not know the vectors' operators)
"""Gel mechanics: from the shape of what presses and the measured wrench to penetration, normal force and shear of each cell.

Each pad has one block of threads, which share the cells and add up their parts, so that the whole Newton method runs on the
device and stops when it has converged. Sums are in float64 and in a fixed order. Units are SI; the frame is the pad
frame (z out of the gel).
"""

from dataclasses import dataclass

import torch
import warp as wp

from manifeel_ms3.sensors.warp_device import warp_device

# Physical limits of the model (chosen)
MAX_TILT = 0.087  # rad, 5 degrees, on a flat face: a larger moment comes from outside the pad's view
MAX_GAP = wp.constant(wp.float64(3.0e-3))  # m: the measured force does not press on geometry further from the face
MIN_FORCE = wp.constant(wp.float64(1.0e-3))  # N: below it the pad counts as untouched
# Numerics of the two Newton methods (chosen; tests/sensors compares the results with closed forms)
LEVER = wp.constant(wp.float64(1.0e-2))  # m: times a rotation, a length like a displacement; conditions the 3 x 3 systems
CONVERGED = wp.constant(wp.float64(1.0e-11))  # m: last step of an iteration that has converged
MAX_STEP = wp.constant(wp.float64(1.0e-3))  # m: keeps the iteration finite when the whole contact slips
CONE = wp.constant(wp.float64(0.999))  # share of the cone that the sum may take, so that the system stays regular
RIDGE = wp.constant(wp.float64(1.0e-6))  # added to a system's diagonal, as a share of its trace
TINY = wp.constant(wp.float64(1.0e-15))  # m: avoids a division by zero
ITERATIONS = wp.constant(12)  # Newton steps at most
THREADS = 128  # threads per pad on a GPU

wp.set_module_options({"enable_backward": False})
vec9d = wp.types.vector(length=9, dtype=wp.float64)


@dataclass
class ContactGrid:
    """Cells over the whole gel face."""

    x: torch.Tensor
    """Centres of the cells across the finger in the pad frame, (C,) float64, m."""
    y: torch.Tensor
    """Centres of the cells along the finger in the pad frame, (C,) float64, m."""
    shape: tuple[int, int]
    """Rows and columns of the cells, C = rows * columns."""
    area: float
    """Area of a cell, m^2."""

    @classmethod
    def covering(cls, size: tuple[float, float], cell: float, device: torch.device) -> "ContactGrid":
        """Grid of about `cell` metres that covers `size` (across, along) exactly."""
        rows, cols = (max(1, round(extent / cell)) for extent in size)
        x = ((torch.arange(rows, dtype=torch.float64, device=device) + 0.5) / rows - 0.5) * size[0]
        y = ((torch.arange(cols, dtype=torch.float64, device=device) + 0.5) / cols - 0.5) * size[1]
        xx, yy = torch.meshgrid(x, y, indexing="ij")
        return cls(xx.flatten().contiguous(), yy.flatten().contiguous(), (rows, cols), size[0] * size[1] / (rows * cols))


def solve_indentation(
    height: torch.Tensor, wrench: torch.Tensor, grid: ContactGrid, stiffness: torch.Tensor, max_tilt: float = MAX_TILT
) -> torch.Tensor:
    """Plane (N, 3) to add to a surface's height so that what sticks out of the gel's face carries the measured load.

    Virtual indentation: only the object's shape matters; how deep it sits follows from the force. Find the depth d, m,
    and the tilts a, b such that the layer's pressure p = K max(0, height + d + a x + b y) has sum p dA = F_n and the measured
    first moments sum p x dA, sum p y dA. This is the minimum of a convex potential: Newton's method, started from the depth
    at zero tilt. An untouched pad gets d = -1 m.

    Args:
        height: (N, C) float32, m, height of the object's surface above (+: into) the gel's face.
        wrench: (N, 6) float64, N and N m, force and moment of the object on the pad about the pad frame's origin.
        grid: The C cells.
        stiffness: (N,) float64, K, N/m^3.
        max_tilt: Largest tilt along each axis, rad.
    """
    plane = torch.empty(len(height), 3, dtype=torch.float64, device=height.device)
    _launch(_indent, height, [height, wrench, stiffness, grid.x, grid.y, grid.area, max_tilt], [plane])
    return plane


def depth_below_face(height: torch.Tensor, plane: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Depth (N, C), m, of the surface in the gel at points x, y (C,) of the face; negative above it.

    `plane` comes from `solve_indentation`; the result has the type of `height`.
    """
    plane, x, y = plane.to(height.dtype), x.to(height.dtype), y.to(height.dtype)
    return height + plane[:, :1] + plane[:, 1:2] * x + plane[:, 2:3] * y


def solve_shear(
    bristle: torch.Tensor,
    cell_force: torch.Tensor,
    wrench: torch.Tensor,
    grid: ContactGrid,
    stiffness: torch.Tensor,
    friction: torch.Tensor,
) -> torch.Tensor:
    """Shear force (N, C, 2), N, of every cell such that the field carries the measured shear and twist.

    Every cell is a bristle with memory: its traction is k_t (z + u + theta x r) up to Coulomb's limit mu p, beyond which it
    slips. The contact moves as a rigid body by (u, theta) between two calls, the one unknown, found such that the tractions
    add up to the measured F_x, F_y, M_z (minimum of a convex, Huber-like potential; semismooth Newton). The new deflections
    are the result divided by k_t dA.

    Args:
        bristle: (N, C, 2) float64, m, deflections z after the last call.
        cell_force: (N, C) float64, N, normal force of every cell, p dA.
        wrench: (N, 6) float64, as in `solve_indentation`.
        grid: The C cells.
        stiffness: (N,) float64, k_t, N/m^3.
        friction: (N,) float64, mu.
    """
    shear = torch.empty_like(bristle)
    _launch(_slide, bristle, [bristle, cell_force, wrench, stiffness, friction, grid.x, grid.y, grid.area], [shear])
    return shear


def _launch(kernel, like: torch.Tensor, inputs: list, outputs: list[torch.Tensor]) -> None:
    device = warp_device(like.device)
    arguments = [wp.from_torch(a.contiguous()) if isinstance(a, torch.Tensor) else a for a in inputs]
    wp.launch_tiled(
        kernel,
        dim=[len(like)],
        inputs=arguments,
        outputs=[wp.from_torch(a) for a in outputs],
        block_dim=THREADS,
        device=device,
    )


@wp.func
def _total(part: vec9d) -> vec9d:
    """Sum over the threads of a block."""
    return wp.tile_extract(wp.tile_sum(wp.tile(part, preserve_type=True)), 0)


@wp.func
def _newton_step(sums: vec9d, residual: wp.vec3d) -> wp.vec3d:
    """Solve the symmetric system whose entries are sums[3..8], with a ridge on its diagonal."""
    ridge = RIDGE * (wp.float64(1.0) + sums[3] + sums[6] + sums[8])
    hessian = wp.mat33d(sums[3] + ridge, sums[4], sums[5], sums[4], sums[6] + ridge, sums[7], sums[5], sums[7], sums[8] + ridge)
    return wp.inverse(hessian) * residual


@wp.func
def _depth(
    height: wp.array2d(dtype=wp.float32),
    x: wp.array(dtype=wp.float64),
    y: wp.array(dtype=wp.float64),
    n: int,
    lane: int,
    highest: wp.float64,
    tilt: wp.vec3d,
    load: wp.float64,
    start: wp.float64,
) -> wp.float64:
    """Depth d with sum max(0, height - highest + tilts + d) = load.

    The sum is convex and increasing in d, so that Newton's method approaches the root from above after at most one step.
    """
    depth = start
    for _ in range(ITERATIONS):
        part = vec9d(wp.float64(0.0))
        for c in range(lane, height.shape[1], wp.block_dim()):
            indent = wp.float64(height[n, c]) - highest + depth + (tilt[1] * x[c] + tilt[2] * y[c]) / LEVER
            if indent > wp.float64(0.0):
                part[0] += wp.float64(1.0)
                part[1] += indent
        total = _total(part)
        if total[0] < wp.float64(0.5):
            depth += load  # nothing touches: one cell alone would need this much
        else:
            step = (load - total[1]) / total[0]
            depth += step
            if wp.abs(step) < CONVERGED:
                break
    return depth


@wp.kernel
def _indent(
    height: wp.array2d(dtype=wp.float32),
    wrench: wp.array2d(dtype=wp.float64),
    stiffness: wp.array(dtype=wp.float64),
    x: wp.array(dtype=wp.float64),
    y: wp.array(dtype=wp.float64),
    area: wp.float64,
    max_tilt: wp.float64,
    plane: wp.array2d(dtype=wp.float64),
):
    n, lane = wp.tid()
    highest = wp.float64(-1.0)
    for c in range(lane, height.shape[1], wp.block_dim()):
        highest = wp.max(highest, wp.float64(height[n, c]))
    highest = wp.tile_extract(wp.tile_max(wp.tile(highest)), 0)
    force = -wrench[n, 2]
    if force > MIN_FORCE and highest > -MAX_GAP:
        # M = r x f with f = (0, 0, -p): sum p x = M_y, sum p y = -M_x; loads as sums of the cells' penetrations, m
        per_metre = stiffness[n] * area
        load = wp.vec3d(force, wrench[n, 4] / LEVER, -wrench[n, 3] / LEVER) / per_metre
        level = wp.vec3d(wp.float64(0.0))
        move = wp.vec3d(_depth(height, x, y, n, lane, highest, level, load[0], load[0]), level[1], level[2])
        for _ in range(ITERATIONS):
            part = vec9d(wp.float64(0.0))
            for c in range(lane, height.shape[1], wp.block_dim()):
                u = x[c] / LEVER
                v = y[c] / LEVER
                indent = wp.float64(height[n, c]) - highest + move[0] + move[1] * u + move[2] * v
                if indent > wp.float64(0.0):
                    part += vec9d(indent, indent * u, indent * v, wp.float64(1.0), u, v, u * u, u * v, v * v)
            total = _total(part)
            old = move
            move += _newton_step(total, load - wp.vec3d(total[0], total[1], total[2]))
            most = max_tilt * LEVER
            move = wp.vec3d(move[0], wp.clamp(move[1], -most, most), wp.clamp(move[2], -most, most))
            if wp.length(move - old) < CONVERGED:
                break
        depth = _depth(height, x, y, n, lane, highest, move, load[0], move[0])  # the force is met whatever the tilt
        if lane == 0:
            plane[n, 0] = depth - highest
            plane[n, 1] = move[1] / LEVER
            plane[n, 2] = move[2] / LEVER
    elif lane == 0:
        plane[n, 0] = wp.float64(-1.0)
        plane[n, 1] = wp.float64(0.0)
        plane[n, 2] = wp.float64(0.0)


@wp.func
def _stretched(bristle: wp.array3d(dtype=wp.float64), n: int, c: int, move: wp.vec3d, u: wp.float64, v: wp.float64):
    """Deflection of a cell's bristle after the contact has moved, before it slips."""
    return wp.vec2d(bristle[n, c, 0] + move[0] - move[2] * v, bristle[n, c, 1] + move[1] + move[2] * u)


@wp.func
def _clamped_terms(stretched: wp.vec2d, limit: wp.float64, u: wp.float64, v: wp.float64) -> vec9d:
    """A cell's part in the residual (3 entries) and in the Hessian (6 entries), its deflection clamped to the limit."""
    s = stretched
    length = wp.length(s)
    # derivative of the clamped deflection: identity where it sticks, the tangential part shrunk where it slips
    xx = wp.float64(1.0)
    xy = wp.float64(0.0)
    yy = wp.float64(1.0)
    if length > limit:
        shrink = limit / length
        ahead = s / length
        s = ahead * limit
        xx = shrink * (wp.float64(1.0) - ahead[0] * ahead[0])
        xy = -shrink * ahead[0] * ahead[1]
        yy = shrink * (wp.float64(1.0) - ahead[1] * ahead[1])
    return vec9d(
        s[0],
        s[1],
        u * s[1] - v * s[0],
        xx,
        xy,
        u * xy - v * xx,
        yy,
        u * yy - v * xy,
        u * u * yy - wp.float64(2.0) * u * v * xy + v * v * xx,
    )


@wp.kernel
def _slide(
    bristle: wp.array3d(dtype=wp.float64),
    cell_force: wp.array2d(dtype=wp.float64),
    wrench: wp.array2d(dtype=wp.float64),
    stiffness: wp.array(dtype=wp.float64),
    friction: wp.array(dtype=wp.float64),
    x: wp.array(dtype=wp.float64),
    y: wp.array(dtype=wp.float64),
    area: wp.float64,
    shear: wp.array3d(dtype=wp.float64),
):
    n, lane = wp.tid()
    per_metre = stiffness[n] * area
    slack = friction[n] / per_metre  # m/N: times a cell's normal force, the deflection at which it slips
    part = vec9d(wp.float64(0.0))
    for c in range(lane, cell_force.shape[1], wp.block_dim()):
        part[0] += cell_force[n, c]
    normal = _total(part)[0]
    load = wp.vec3d(wrench[n, 0], wrench[n, 1], wrench[n, 5] / LEVER) / per_metre
    planar = wp.length(wp.vec2d(load[0], load[1]))
    most = CONE * slack * normal
    if planar > most:  # the contact cannot carry more
        load *= most / planar
    move = wp.vec3d(wp.float64(0.0))
    if normal > wp.float64(0.0):
        for _ in range(ITERATIONS):
            part = vec9d(wp.float64(0.0))
            for c in range(lane, cell_force.shape[1], wp.block_dim()):
                limit = slack * cell_force[n, c]
                if limit > wp.float64(0.0):
                    u = x[c] / LEVER
                    v = y[c] / LEVER
                    part += _clamped_terms(_stretched(bristle, n, c, move, u, v), limit, u, v)
            total = _total(part)
            step = _newton_step(total, load - wp.vec3d(total[0], total[1], total[2]))
            for i in range(3):
                move[i] += wp.clamp(step[i], -MAX_STEP, MAX_STEP)
            if wp.length(step) < CONVERGED:
                break
    for c in range(lane, cell_force.shape[1], wp.block_dim()):
        s = _stretched(bristle, n, c, move, x[c] / LEVER, y[c] / LEVER)
        s *= per_metre * wp.min(slack * cell_force[n, c] / wp.max(wp.length(s), TINY), wp.float64(1.0))
        shear[n, c, 0] = s[0]
        shear[n, c, 1] = s[1]
