# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# (warp reads a kernel's annotations as its own types)
"""Height map to TacRGB: the gel's surface around the contact, and the compact shader as one warp kernel."""

import functools
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from .config import TactileSensorConfig
from .shader import FOURIER_TERMS, KNOTS, Shader, place_terms
from .warp_device import warp_device

SKIRT_SCALE = 4  # coarse cells are 4 x 4 pixels
WIDE_SIGMAS = (0.9e-3, 0.46e-3)  # m; these three are the larger kernels of Taxim's pyramid at its 0.0295 mm per pixel
NARROW_SIGMA = 0.24e-3  # m
SEGMENTS = len(KNOTS) - 1


@wp.kernel
def _shade(
    surface: wp.array3d(dtype=wp.float32),  # (N, H, W), m into the gel
    response: wp.array4d(dtype=wp.vec3f),  # (H, W, knot, Fourier term) -> RGB
    knots: wp.array(dtype=wp.float32),
    background: wp.array2d(dtype=wp.vec3f),  # (H, W)
    per_metre: float,  # 1 / (2 pixel size)
    image: wp.array4d(dtype=wp.uint8),  # (N, H, W, 3)
):
    n, i, j = wp.tid()
    rows = surface.shape[1]
    cols = surface.shape[2]
    gr = (surface[n, wp.min(i + 1, rows - 1), j] - surface[n, wp.max(i - 1, 0), j]) * per_metre
    gc = (surface[n, i, wp.min(j + 1, cols - 1)] - surface[n, i, wp.max(j - 1, 0)]) * per_metre
    t = wp.sqrt(gr * gr + gc * gc)
    colour = background[i, j]
    if t > 1.0e-7:
        cosine = gr / t
        sine = gc / t
        segment = int(0)
        while segment < wp.static(SEGMENTS - 1) and t > knots[segment + 1]:
            segment += 1
        upper = wp.min((t - knots[segment]) / (knots[segment + 1] - knots[segment]), 1.0)
        low = response[i, j, segment]  # at knot 0, zero slope, all zero
        high = response[i, j, segment + 1]
        for f in range(wp.static(FOURIER_TERMS)):
            fourier = float(1.0)
            if f == 1:
                fourier = cosine
            elif f == 2:
                fourier = sine
            elif f == 3:
                fourier = cosine * cosine - sine * sine
            elif f == 4:
                fourier = 2.0 * sine * cosine
            colour += fourier * ((1.0 - upper) * low[f] + upper * high[f])
    for channel in range(3):
        image[n, i, j, channel] = wp.uint8(wp.clamp(colour[channel] + 0.5, 0.0, 255.0))


class Optics:
    """Renders what the camera behind the gel sees of its skin."""

    def __init__(self, config: TactileSensorConfig, device: torch.device):
        self.config = config
        self.device = device
        self._response, self._background = _shading_maps(config.optics.calibration, config.image_shape, device)
        self._knots = wp.array(KNOTS.astype(np.float32), dtype=wp.float32, device=self._response.device)
        self.background = (wp.to_torch(self._background) + 0.5).clamp(0, 255).to(torch.uint8)
        self._wide_kernels = [_gaussian(sigma / (SKIRT_SCALE * config.pixel_size), device) for sigma in WIDE_SIGMAS]
        self._narrow_kernel = _gaussian(NARROW_SIGMA / config.pixel_size, device)
        self._smoothing_kernel = _gaussian(config.optics.smoothing, device) if config.optics.smoothing > 0 else None
        self._noise = torch.Generator(device).manual_seed(0)

    def reseed(self, seed: int) -> None:
        """Start the read noise of an episode anew."""
        self._noise.manual_seed(seed)

    def surface(self, penetration: torch.Tensor) -> torch.Tensor:
        """Gel surface (N, H, W), m into the gel, around an object that sits `penetration` (N, H, W), m, in it.

        In contact the gel follows the object; around it, it rises back in a skirt, by blurs from wide to narrow, after each of
        which the object pushes the gel down to where it is itself (after Taxim's pyramid; by the maximum, so that the rim of a
        shallow contact hangs in the skirt of the deep). The wide blurs are smooth: they are computed on coarse cells.
        """
        coarse = F.avg_pool2d(penetration[:, None], SKIRT_SCALE)
        skirt = coarse
        for kernel in self._wide_kernels:
            skirt = torch.maximum(coarse, _blur(skirt, kernel))
        surface = F.interpolate(skirt, size=penetration.shape[1:], mode="bilinear", align_corners=False)
        surface = torch.maximum(penetration[:, None], surface)
        surface = torch.maximum(penetration[:, None], _blur(surface, self._narrow_kernel))
        if self._smoothing_kernel is not None:
            surface = _blur(surface, self._smoothing_kernel)
        return surface[:, 0]

    def shade(self, surface: torch.Tensor) -> torch.Tensor:
        """TacRGB uint8 (N, H, W, 3) of a gel surface (N, H, W), m."""
        image = torch.empty(*surface.shape, 3, dtype=torch.uint8, device=self.device)
        wp.launch(
            _shade,
            dim=surface.shape,
            inputs=[
                wp.from_torch(surface.contiguous()),
                self._response,
                self._knots,
                self._background,
                0.5 / self.config.pixel_size,
            ],
            outputs=[wp.from_torch(image)],
            device=warp_device(self.device),
        )
        if self.config.optics.noise > 0:
            grey = torch.randn(image.shape, generator=self._noise, device=self.device) * self.config.optics.noise
            image = (image + grey).round().clamp(0, 255).to(torch.uint8)
        return image


@functools.lru_cache(maxsize=4)
def _shading_maps(calibration: Path, image_shape: tuple[int, int], device: torch.device) -> tuple[wp.array, wp.array]:
    """The shader at every pixel: response (H, W, knot, Fourier term) and background (H, W), RGB each."""
    shader = Shader.load(calibration)
    rows, cols = image_shape
    place = place_terms(*np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij"))
    response = np.zeros((rows, cols, len(KNOTS), FOURIER_TERMS, 3), np.float32)
    response[:, :, 1:] = np.einsum("ijq,cfkq->ijkfc", place, shader.weights, optimize=True)
    background = (place @ shader.background.T).astype(np.float32)
    on = warp_device(device)
    return wp.array(response, dtype=wp.vec3f, device=on), wp.array(background, dtype=wp.vec3f, device=on)


def _gaussian(sigma: float, device: torch.device) -> torch.Tensor:
    reach = max(1, round(2.5 * sigma))
    position = torch.arange(-reach, reach + 1, dtype=torch.float32, device=device)
    weight = torch.exp(-0.5 * (position / sigma) ** 2)
    return weight / weight.sum()


def _blur(image: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Separable blur of (N, 1, H, W), rim values repeated."""
    reach = len(kernel) // 2
    image = F.conv2d(F.pad(image, (reach, reach, 0, 0), mode="replicate"), kernel.view(1, 1, 1, -1))
    return F.conv2d(F.pad(image, (0, 0, reach, reach), mode="replicate"), kernel.view(1, 1, -1, 1))
