# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# (warp reads a kernel's annotations as its own types)
"""Height map to TacRGB: the gel's surface around the contact, and the compact shader as one warp kernel."""

import functools
import math
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.sensors.mechanics.contact import ContactGrid
from manifeel_ms3.sensors.warp_device import launch_split, warp_device

from .shader import FOURIER_TERMS, KNOTS, Shader, place_terms, slope_terms
from .taxim_table import TABLE_CHANNELS, fit_table, read_table

COARSE = 4  # coarse cells are 4 x 4 pixels
WIDE_SIGMAS = (0.9e-3, 0.46e-3)  # m; these three are the larger kernels of Taxim's pyramid at its 0.0295 mm per pixel
NARROW_SIGMA = 0.24e-3  # m
BAND = 80  # samples of a blur that are computed as one matrix product
SEGMENTS = len(KNOTS) - 1
SHADOW_STEPS = 12  # coarse cells that a shadow is long at most
LOW_LIGHT, HIGH_LIGHT = 0.2, 0.5  # gradients of the rays from a bar's lowest and highest light: 3 to 6 mm high, 12 to 15 mm off
FLAT = 5.0e-4  # gradient below which no colour changes by a quarter of a grey level
MARKER_SPREAD = 0.25  # of the gel's thickness: sigma over which shear drags the skin along
MARKER_BULGE = 0.25  # of the gel's thickness times the slope: how far what is pressed out carries the skin
MARKER_DARKNESS = 0.75
NOISE_SAMPLES = 1 << 18

wp.set_module_options({"enable_backward": False})


@wp.func
def _between(field: wp.array3d(dtype=wp.vec3f), n: int, i: int, j: int) -> wp.vec3f:
    """Bilinear value, at a pixel, of a field on coarse cells."""
    y = wp.clamp((float(i) + 0.5) / float(wp.static(COARSE)) - 0.5, 0.0, float(field.shape[1] - 1))
    x = wp.clamp((float(j) + 0.5) / float(wp.static(COARSE)) - 0.5, 0.0, float(field.shape[2] - 1))
    r = int(y)
    c = int(x)
    down = wp.min(r + 1, field.shape[1] - 1)
    right = wp.min(c + 1, field.shape[2] - 1)
    fy = y - float(r)
    fx = x - float(c)
    above = (1.0 - fx) * field[n, r, c] + fx * field[n, r, right]
    below = (1.0 - fx) * field[n, down, c] + fx * field[n, down, right]
    return (1.0 - fy) * above + fy * below


@wp.func
def _dot_at(place: float, pitch: float) -> float:
    """Distance of a place from the nearest multiple of the pitch, a dot in the middle of the pad."""
    return place - wp.round(place / pitch) * pitch


@wp.kernel
def _shade(
    first: int,
    surface: wp.array3d(dtype=wp.float32),  # (N, H, W), m into the gel
    response: wp.array4d(dtype=wp.vec3f),  # (H, W, knot, Fourier term) -> RGB
    knots: wp.array(dtype=wp.float32),
    background: wp.array2d(dtype=wp.vec3f),  # (H, W)
    gain: wp.array(dtype=wp.vec3f),  # (N,)
    phase: wp.array(dtype=wp.vec2f),  # (N,), cosine and sine of the lights' turn
    per_metre: float,  # 1 / (2 pixel size)
    light: wp.array3d(dtype=wp.vec3f),  # (N, h, w) share of light that arrives; may be empty
    moved: wp.array3d(dtype=wp.vec3f),  # (N, h, w) displacement of the skin, pixels (z unused); may be empty
    marker_pitch: float,  # pixels
    marker_radius: float,
    noise: wp.array(dtype=wp.float32),  # samples; may be empty
    noise_start: wp.array(dtype=wp.int32),  # (N,)
    image: wp.array3d(dtype=wp.vec3ub),  # (N, H, W)
):
    n, i, j = wp.tid()
    i += first
    rows = surface.shape[1]
    cols = surface.shape[2]
    gr = (surface[n, wp.min(i + 1, rows - 1), j] - surface[n, wp.max(i - 1, 0), j]) * per_metre
    gc = (surface[n, i, wp.min(j + 1, cols - 1)] - surface[n, i, wp.max(j - 1, 0)]) * per_metre
    t = wp.sqrt(gr * gr + gc * gc)
    colour = background[i, j]
    if t > wp.static(FLAT):
        cosine = (gr * phase[n][0] - gc * phase[n][1]) / t
        sine = (gr * phase[n][1] + gc * phase[n][0]) / t
        segment = int(0)
        while segment < wp.static(SEGMENTS - 1) and t > knots[segment + 1]:
            segment += 1
        upper = wp.min((t - knots[segment]) / (knots[segment + 1] - knots[segment]), 1.0)
        lower = 1.0 - upper
        low = response[i, j, segment]  # at knot 0, zero slope, all zero
        high = response[i, j, segment + 1]
        change = lower * low[0] + upper * high[0]
        change += cosine * (lower * low[1] + upper * high[1])
        change += sine * (lower * low[2] + upper * high[2])
        change += (cosine * cosine - sine * sine) * (lower * low[3] + upper * high[3])
        change += 2.0 * sine * cosine * (lower * low[4] + upper * high[4])
        colour += wp.cw_mul(gain[n], change)
    if light.shape[0] > 0:
        colour = wp.cw_mul(colour, _between(light, n, i, j))
    if moved.shape[0] > 0:
        skin = _between(moved, n, i, j)
        y = _dot_at(float(i) - 0.5 * float(rows - 1) - skin[0], marker_pitch)
        x = _dot_at(float(j) - 0.5 * float(cols - 1) - skin[1], marker_pitch)
        cover = wp.clamp(marker_radius + 0.5 - wp.sqrt(x * x + y * y), 0.0, 1.0)
        colour *= 1.0 - wp.static(MARKER_DARKNESS) * cover
    if noise.shape[0] > 0:
        k = noise_start[n] + 3 * (i * cols + j)
        for channel in range(3):
            colour[channel] += noise[(k + channel) & wp.static(NOISE_SAMPLES - 1)]
    image[n, i, j] = wp.vec3ub(
        wp.uint8(wp.clamp(colour[0] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(colour[1] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(colour[2] + 0.5, 0.0, 255.0)),
    )


@wp.func
def _height(surface: wp.array3d(dtype=wp.float32), n: int, y: float, x: float) -> float:
    y = wp.clamp(y, 0.0, float(surface.shape[1] - 1))
    x = wp.clamp(x, 0.0, float(surface.shape[2] - 1))
    r = wp.min(int(y), surface.shape[1] - 2)
    c = wp.min(int(x), surface.shape[2] - 2)
    fy = y - float(r)
    fx = x - float(c)
    above = (1.0 - fx) * surface[n, r, c] + fx * surface[n, r, c + 1]
    below = (1.0 - fx) * surface[n, r + 1, c] + fx * surface[n, r + 1, c + 1]
    return (1.0 - fy) * above + fy * below


@wp.kernel
def _cast_shadows(
    first: int,
    surface: wp.array3d(dtype=wp.float32),  # (N, h, w), m into the gel
    to_light: wp.array(dtype=wp.vec2f),  # (3,), direction of each channel's light along the skin
    phase: wp.array(dtype=wp.vec2f),
    cell: float,  # m
    strength: float,
    light: wp.array3d(dtype=wp.vec3f),
):
    n, i, j = wp.tid()
    i += first
    here = surface[n, i, j]
    arrives = wp.vec3f(1.0)
    for channel in range(3):
        d = to_light[channel]
        ahead = wp.vec2f(d[0] * phase[n][0] + d[1] * phase[n][1], -d[0] * phase[n][1] + d[1] * phase[n][0])
        steepest = float(0.0)
        for step in range(1, wp.static(SHADOW_STEPS + 1)):
            there = _height(surface, n, float(i) + float(step) * ahead[0], float(j) + float(step) * ahead[1])
            steepest = wp.max(steepest, (there - here) / (float(step) * cell))
        hidden = (steepest - wp.static(LOW_LIGHT)) / wp.static(HIGH_LIGHT - LOW_LIGHT)
        arrives[channel] = 1.0 - strength * wp.clamp(hidden, 0.0, 1.0)
    light[n, i, j] = arrives


class Optics:
    """Renders what the camera behind the gel sees of its skin, for N pads.

    What differs from episode to episode is drawn in `reset`.
    """

    def __init__(self, config: TactileSensorConfig, grid: ContactGrid, num_pads: int, device: torch.device):
        self.config, self.device = config, device
        optics, (rows, cols) = config.optics, config.image_shape
        self._response, self._background, to_light = _shading_maps(Path(optics.calibration), config.image_shape, device)
        self._to_light = wp.array(to_light, dtype=wp.vec2f, device=warp_device(device))
        self._knots = wp.array(KNOTS.astype(np.float32), dtype=wp.float32, device=warp_device(device))
        self.background = (wp.to_torch(self._background) + 0.5).clamp(0, 255).to(torch.uint8)
        coarse = (rows // COARSE, cols // COARSE)
        cell = COARSE * config.pixel_size
        self._wide = [[_blur_bands(n, sigma / cell, device) for n in coarse] for sigma in WIDE_SIGMAS]
        self._narrow = [_blur_bands(n, NARROW_SIGMA / config.pixel_size, device) for n in (rows, cols)]
        self._coat = [_blur_bands(n, optics.smoothing, device) for n in (rows, cols)] if optics.smoothing > 0 else None
        self._drag = [
            _spread(g, n, cell, config.gel.thickness * MARKER_SPREAD, device) for g, n in zip(_axes(grid), coarse, strict=True)
        ]
        self._gain = torch.ones(num_pads, 3, device=device)
        self._phase = torch.tensor([[1.0, 0.0]], device=device).repeat(num_pads, 1)
        self._frame = torch.zeros(num_pads, dtype=torch.int64, device=device)
        samples = np.random.default_rng(0).normal(0.0, 1.0, NOISE_SAMPLES if optics.noise > 0 else 0)
        self._noise = torch.as_tensor(samples, dtype=torch.float32, device=device) * optics.noise

    def reset(self, pads: torch.Tensor, seeds: np.ndarray) -> None:
        """Begin an episode on these pads: light drawn anew, noise as the seeds say."""
        limits = self.config.randomization
        for pad, seed in zip(pads.tolist(), seeds.tolist(), strict=True):
            rng = np.random.default_rng([seed, 1])
            gain, phase = 1 + limits.gain * rng.uniform(-1, 1, 3), limits.light_phase * rng.uniform(-1, 1)
            self._gain[pad] = torch.as_tensor(gain, dtype=torch.float32, device=self.device)
            self._phase[pad] = torch.tensor([math.cos(phase), math.sin(phase)], device=self.device)
            self._frame[pad] = seed

    def surface(self, penetration: torch.Tensor) -> torch.Tensor:
        """Gel surface (N, H, W), m into the gel, around an object that sits `penetration` (N, H, W), m, in it.

        In contact the gel follows the object; around it, it rises back in a skirt, by blurs from wide to narrow, after each of
        which the object pushes the gel down to where it is itself (after Taxim's pyramid; by the maximum, so that the rim of a
        shallow contact hangs in the skirt of the deep). The wide blurs are smooth: they are computed on coarse cells.
        """
        coarse = F.avg_pool2d(penetration[:, None], COARSE)[:, 0]
        skirt = coarse
        for bands in self._wide:
            skirt = torch.maximum(coarse, _blur(skirt, bands))
        surface = F.interpolate(skirt[:, None], size=penetration.shape[1:], mode="bilinear", align_corners=False)[:, 0]
        surface = torch.maximum(penetration, surface)
        surface = torch.maximum(penetration, _blur(surface, self._narrow))
        return surface if self._coat is None else _blur(surface, self._coat)

    def shade(self, surface: torch.Tensor, bristle: torch.Tensor | None = None) -> torch.Tensor:
        """TacRGB uint8 (N, H, W, 3) of a gel surface (N, H, W), m, whose skin is sheared by `bristle` (N, C, 2), m."""
        optics, pixel = self.config.optics, self.config.pixel_size
        image = torch.empty(*surface.shape, 3, dtype=torch.uint8, device=self.device)
        coarse = F.avg_pool2d(surface[:, None], COARSE)[:, 0] if optics.shadow > 0 or optics.markers else surface[:0]
        light = self._light(coarse) if optics.shadow > 0 else surface.new_empty(0, 0, 0, 3)
        moved = self._skin(coarse, bristle) if optics.markers and bristle is not None else surface.new_empty(0, 0, 0, 3)
        inputs = [
            wp.from_torch(surface.contiguous()),
            self._response,
            self._knots,
            self._background,
            wp.from_torch(self._gain, dtype=wp.vec3f),
            wp.from_torch(self._phase, dtype=wp.vec2f),
            0.5 / pixel,
            wp.from_torch(light, dtype=wp.vec3f),
            wp.from_torch(moved, dtype=wp.vec3f),
            optics.marker_pitch / pixel,
            optics.marker_radius / pixel,
            wp.from_torch(self._noise),
            wp.from_torch(self._next_noise()),
        ]
        outputs = [wp.from_torch(image, dtype=wp.vec3ub)]
        launch_split(_shade, tuple(surface.shape), inputs, outputs, self.device)
        return image

    def _next_noise(self) -> torch.Tensor:
        """Where each pad's noise starts in the samples, (N,); another place every frame."""
        self._frame = (self._frame * 6364136223846793005 + 1442695040888963407).remainder(1 << 48)  # an LCG per pad
        return (self._frame >> 16).remainder(NOISE_SAMPLES).to(torch.int32)

    def _light(self, coarse: torch.Tensor) -> torch.Tensor:
        light = torch.empty(*coarse.shape, 3, device=self.device)
        phase = wp.from_torch(self._phase, dtype=wp.vec2f)
        cell = COARSE * self.config.pixel_size
        inputs = [wp.from_torch(coarse), self._to_light, phase, cell, self.config.optics.shadow]
        launch_split(_cast_shadows, tuple(coarse.shape), inputs, [wp.from_torch(light, dtype=wp.vec3f)], self.device)
        return light

    def _skin(self, coarse: torch.Tensor, bristle: torch.Tensor) -> torch.Tensor:
        """Displacement (N, h, w, 3) of the skin, pixels, along rows and columns: dragged by shear, carried out by pressure."""
        rows, cols = self._drag
        shape = (rows.shape[1], cols.shape[1])
        dragged = torch.einsum("rx,nxyk,cy->nrck", rows, bristle.unflatten(1, shape).float(), cols)
        pressed = _blur(coarse, self._wide[0])  # what is pressed out flows as smoothly as the widest skirt
        uphill = torch.stack(torch.gradient(pressed, spacing=COARSE * self.config.pixel_size, dim=(1, 2)), dim=-1)
        moved = dragged - MARKER_BULGE * self.config.gel.thickness * uphill
        return F.pad(moved / self.config.pixel_size, (0, 1))


def _load_shader(path: Path, image_shape: tuple[int, int]) -> Shader:
    """The compact shader in a file, or the one that fits the Taxim table in it."""
    if path.is_file():
        try:
            with np.load(path) as stored:
                is_table = any(name in stored for name in TABLE_CHANNELS)
        except (OSError, ValueError):
            is_table = False  # `Shader.load` says what is wrong
        if is_table:
            return fit_table(read_table(path), image_shape)
    return Shader.load(path)


@functools.lru_cache(maxsize=4)
def _shading_maps(path: Path, image_shape: tuple[int, int], device: torch.device) -> tuple[wp.array, wp.array, np.ndarray]:
    """The shader at every pixel: response (H, W, knot, Fourier term) and background (H, W), RGB each; and the direction (3, 2)
    from which each channel's light comes."""
    shader = _load_shader(path, image_shape)
    rows, cols = image_shape
    place = place_terms(*np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij"))
    response = np.zeros((rows, cols, len(KNOTS), FOURIER_TERMS, 3), np.float32)
    response[:, :, 1:] = np.einsum("ijq,cfkq->ijkfc", place, shader.weights, optimize=True)
    background = (place @ shader.background.T).astype(np.float32)
    # a slope that rises along its gradient faces the other way: where it is brightest, the light comes from there
    brightest = (shader.weights[..., 0] @ slope_terms(np.array(0.3)))[:, 1:3]
    to_light = -brightest / np.linalg.norm(brightest, axis=1, keepdims=True).clip(1e-9)
    on = warp_device(device)
    maps = (wp.array(response, dtype=wp.vec3f, device=on), wp.array(background, dtype=wp.vec3f, device=on))
    return *maps, to_light.astype(np.float32)


def _blur_bands(count: int, sigma: float, device: torch.device) -> list[tuple[int, int, torch.Tensor]]:
    """Gaussian blur of a row of `count` samples, sigma in samples, the ends' values repeated: stretches of the result as a
    matrix times the samples from a first to a last."""
    reach = max(1, round(2.5 * sigma))
    matrix = np.zeros((count, count))
    for offset in range(-reach, reach + 1):
        matrix[np.arange(count), np.clip(np.arange(count) + offset, 0, count - 1)] += math.exp(-0.5 * (offset / sigma) ** 2)
    matrix = torch.as_tensor(matrix / matrix.sum(1, keepdims=True), dtype=torch.float32, device=device)
    bands = []
    for start in range(0, count, BAND):
        low, high = max(0, start - reach), min(count, start + BAND + reach)
        bands.append((low, high, matrix[start : start + BAND, low:high].contiguous()))
    return bands


def _blur(image: torch.Tensor, bands: list[list[tuple[int, int, torch.Tensor]]]) -> torch.Tensor:
    """Blur of (N, H, W) along rows and columns."""
    rows, cols = bands
    image = torch.cat([matrix @ image[:, low:high] for low, high, matrix in rows], dim=1)
    return torch.cat([image[:, :, low:high] @ matrix.T for low, high, matrix in cols], dim=2)


def _axes(grid: ContactGrid) -> tuple[np.ndarray, np.ndarray]:
    return grid.x.view(grid.shape)[:, 0].cpu().numpy(), grid.y.view(grid.shape)[0].cpu().numpy()


def _spread(points: np.ndarray, count: int, cell: float, sigma: float, device: torch.device) -> torch.Tensor:
    """(count, points): Gaussian average over points, m, around the centres of `count` cells, m, that lie about zero."""
    centres = (np.arange(count) - (count - 1) / 2) * cell
    weights = np.exp(-0.5 * ((centres[:, None] - points[None]) / sigma) ** 2)
    return torch.as_tensor(weights / weights.sum(1, keepdims=True), dtype=torch.float32, device=device)
