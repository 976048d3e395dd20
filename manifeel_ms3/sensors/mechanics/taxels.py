"""From the cells of the gel to the taxels of the force field, sums and moments kept."""

import torch

from .contact import ContactGrid

# TacSL's penalty field as the public code of the paper runs it (damping off): unit-less gains on penetration and speed
TACSL_NORMAL_GAIN = 1.0
TACSL_SHEAR_GAIN = 0.1
TACSL_FRICTION = 2.0


class Taxels:
    """A grid of `shape` taxels at `pitch`, m, centred on the pad; the border taxels own the rest of the gel.

    A cell's force is shared linearly between the taxel centres around it. So sums are kept, and first moments, but for what
    lies outside the outermost centres: there the taxels' moment about the normal is mended by a swirl, as far as Coulomb's cone
    allows, so that it is the cells'.
    """

    def __init__(self, grid: ContactGrid, shape: tuple[int, int], pitch: float):
        self.grid, self.shape = grid, shape
        x, y = grid.x.view(grid.shape)[:, 0], grid.y.view(grid.shape)[0]
        self._rows, self._cols = _shares(x, shape[0], pitch), _shares(y, shape[1], pitch)
        centres = [(torch.arange(n, dtype=torch.float64, device=x.device) - (n - 1) / 2) * pitch for n in shape]
        self.centres = torch.stack(torch.meshgrid(*centres, indexing="ij"), dim=-1)
        """(rows, cols, 2), m, pad frame."""

    def add_up(self, values: torch.Tensor) -> torch.Tensor:
        """Sums (N, rows, cols, K) of cell values (N, C, K)."""
        values = values.unflatten(1, self.grid.shape)
        return torch.einsum("rx,nxyk,cy->nrck", self._rows, values, self._cols)

    def forces(self, pressure: torch.Tensor, shear: torch.Tensor, friction: torch.Tensor) -> torch.Tensor:
        """Force field (N, rows, cols, 3), N, of cell forces (N, C) and (N, C, 2); `friction` (N,)."""
        field = self.add_up(torch.cat([pressure[..., None], shear], dim=-1))
        normal, tangential = field[..., 0], field[..., 1:]
        cells = (self.grid.x * shear[..., 1] - self.grid.y * shear[..., 0]).sum(1)
        missing = cells - _moment(self.centres, tangential)
        total = normal.sum((1, 2)).clamp(min=1e-9)
        middle = torch.einsum("nrc,rck->nk", normal, self.centres) / total[:, None]
        arm = self.centres - middle[:, None, None]
        swirl = normal[..., None] * torch.stack([-arm[..., 1], arm[..., 0]], dim=-1)  # adds up to no force
        turn = missing / _moment(self.centres, swirl).clamp(min=1e-12)
        tangential = tangential + turn[:, None, None, None] * swirl
        limit = friction[:, None, None] * normal / torch.linalg.norm(tangential, dim=-1).clamp(min=1e-15)
        return torch.cat([field[..., :1], tangential * limit.clamp(max=1.0)[..., None]], dim=-1)


def tacsl_field(penetration: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """TacSL's field (N, T, 3): k_n d and -min(k_t |v|, mu k_n d) v / |v|, penetration d (N, T), m, sliding v (N, T, 2), m/s."""
    normal = TACSL_NORMAL_GAIN * penetration
    speed = torch.linalg.norm(velocity, dim=-1)
    size = torch.minimum(TACSL_SHEAR_GAIN * speed, TACSL_FRICTION * normal)
    return torch.cat([normal[..., None], -(size / speed.clamp(min=1e-9))[..., None] * velocity], dim=-1)


def _shares(position: torch.Tensor, count: int, pitch: float) -> torch.Tensor:
    """Share (count, n) that each of a row of taxels has in points (n,): linear between centres."""
    index = (position / pitch + (count - 1) / 2).clamp(0, count - 1)
    taxels = torch.arange(count, dtype=position.dtype, device=position.device)
    return (1.0 - (index[None] - taxels[:, None]).abs()).clamp(min=0.0)


def _moment(at: torch.Tensor, tangential: torch.Tensor) -> torch.Tensor:
    """Moment about the normal (N,) of tangential forces (N, rows, cols, 2) at places (rows, cols, 2)."""
    return (at[..., 0] * tangential[..., 1] - at[..., 1] * tangential[..., 0]).sum((1, 2))
