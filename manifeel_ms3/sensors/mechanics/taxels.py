"""From the cells of the gel to the taxels of the force field, with the same sums and moments."""

import torch

from .contact import ContactGrid

# TacSL's penalty field with the values of ManiFeel's public code, which switches damping off; the force field has no unit
TACSL_NORMAL_GAIN = 1.0
TACSL_SHEAR_GAIN = 0.1
TACSL_FRICTION = 2.0
# Smallest divisors; what they stand for is far larger on a touched pad
MIN_SUM = 1e-9  # N, or m/s
MIN_SWIRL = 1e-12  # N m^2
MIN_SHEAR = 1e-15  # N


class Taxels:
    """A grid of taxels centred on the pad; the taxels at its border also take the rest of the gel.

    A cell's force is shared linearly between the taxel centres around it. This keeps sums and first moments, except those of
    forces outside the outermost centres: a swirl of shear restores the cells' moment about the normal. Each taxel's shear is
    then cut at Coulomb's cone, which costs a little of the sum where much of the contact slips.

    Args:
        grid: Cells of the gel.
        shape: Rows and columns of the taxels.
        pitch: Distance of neighbouring taxels, m.
    """

    def __init__(self, grid: ContactGrid, shape: tuple[int, int], pitch: float):
        self.grid, self.shape = grid, shape
        x, y = grid.x.view(grid.shape)[:, 0], grid.y.view(grid.shape)[0]
        self._rows, self._cols = _shares(x, shape[0], pitch), _shares(y, shape[1], pitch)
        centres = [(torch.arange(n, dtype=torch.float64, device=x.device) - (n - 1) / 2) * pitch for n in shape]
        self.centres = torch.stack(torch.meshgrid(*centres, indexing="ij"), dim=-1)
        """Taxel centres (rows, cols, 2) in the pad frame, m."""

    def add_up(self, values: torch.Tensor) -> torch.Tensor:
        """Sums (N, rows, cols, K) of cell values (N, C, K)."""
        values = values.unflatten(1, self.grid.shape)
        return torch.einsum("rx,nxyk,cy->nrck", self._rows, values, self._cols)

    def forces(self, cell_force: torch.Tensor, shear: torch.Tensor, friction: torch.Tensor) -> torch.Tensor:
        """Force field (N, rows, cols, 3), N, of the cells' forces.

        Args:
            cell_force: (N, C), N, normal forces of the cells.
            shear: (N, C, 2), N, shear forces of the cells along x and y.
            friction: (N,), Coulomb coefficients.
        """
        field = self.add_up(torch.cat([cell_force[..., None], shear], dim=-1))
        normal, tangential = field[..., 0], field[..., 1:]
        cells = (self.grid.x * shear[..., 1] - self.grid.y * shear[..., 0]).sum(1)
        missing = cells - _moment(self.centres, tangential)
        total = normal.sum((1, 2)).clamp(min=MIN_SUM)
        middle = torch.einsum("nrc,rck->nk", normal, self.centres) / total[:, None]
        arm = self.centres - middle[:, None, None]
        swirl = normal[..., None] * torch.stack([-arm[..., 1], arm[..., 0]], dim=-1)  # adds up to no force
        turn = missing / _moment(self.centres, swirl).clamp(min=MIN_SWIRL)
        tangential = tangential + turn[:, None, None, None] * swirl
        limit = friction[:, None, None] * normal / torch.linalg.norm(tangential, dim=-1).clamp(min=MIN_SHEAR)
        return torch.cat([field[..., :1], tangential * limit.clamp(max=1.0)[..., None]], dim=-1)


def tacsl_field(penetration: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """TacSL's field (N, T, 3) for penetration d (N, T), m, and sliding velocity v (N, T, 2), m/s, of T taxels.

    Normal component k_n d, shear -min(k_t |v|, mu k_n d) v / |v| (Akinola et al. 2024).
    """
    normal = TACSL_NORMAL_GAIN * penetration
    speed = torch.linalg.norm(velocity, dim=-1)
    size = torch.minimum(TACSL_SHEAR_GAIN * speed, TACSL_FRICTION * normal)
    return torch.cat([normal[..., None], -(size / speed.clamp(min=MIN_SUM))[..., None] * velocity], dim=-1)


def _shares(position: torch.Tensor, count: int, pitch: float) -> torch.Tensor:
    """Shares (count, n) of a row of taxels in points (n,), m, linear between the taxels' centres."""
    index = (position / pitch + (count - 1) / 2).clamp(0, count - 1)
    taxels = torch.arange(count, dtype=position.dtype, device=position.device)
    return (1.0 - (index[None] - taxels[:, None]).abs()).clamp(min=0.0)


def _moment(at: torch.Tensor, tangential: torch.Tensor) -> torch.Tensor:
    """Moment about the normal (N,) of tangential forces (N, rows, cols, 2) at places (rows, cols, 2)."""
    return (at[..., 0] * tangential[..., 1] - at[..., 1] * tangential[..., 0]).sum((1, 2))
