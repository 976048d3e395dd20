# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (warp reads a kernel's annotations as its own types, and its stubs do not know the vectors' operators)
"""From the height of what presses to TacRGB: the gel's surface around the contact, and the compact shader as a warp kernel."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own usage)
import warp as wp

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.files import names_in_npz
from manifeel_ms3.sensors.config import LightsConfig, TactileSensorConfig
from manifeel_ms3.sensors.mechanics.contact import ContactGrid
from manifeel_ms3.sensors.warp_device import launch_split, warp_device

from .blur import GaussianBlur
from .lights import lamp_shader
from .shader import FOURIER_TERMS, KNOTS, Shader, place_terms, slope_terms
from .taxim_table import TABLE_CHANNELS, fit_table, read_table

COARSE = 4  # pixels along each side of a coarse cell; the wide blurs vary little over it
# Standard deviations, m: the larger kernels of Taxim's pyramid at its 0.0295 mm per pixel
WIDE_SIGMAS = (0.9e-3, 0.46e-3)
NARROW_SIGMA = 0.24e-3
SEGMENTS = len(KNOTS) - 1
SHADOW_STEPS = 12  # coarse cells: greatest length of a shadow, 4.2 mm on the R1.5
# Gradients of the rays from a light bar's lowest and highest point: 3 mm high at 15 mm, 6 mm high at 12 mm (chosen)
LOW_LIGHT, HIGH_LIGHT = 0.2, 0.5
MIN_GRADIENT = 5.0e-4  # below it no channel of the R1.5's shader changes by a quarter of a grey level
LIGHT_GRADIENT = 0.3  # gradient at which the brightest direction is read from the shader: the middle of its range
MIN_DIRECTION = 1e-9  # grey levels: avoids a division by zero in a channel without light
CACHED_SHADERS = 4  # number of sensors whose shading maps are kept in memory (chosen)
MARKER_SPREAD = 0.25  # of the gel's thickness: sigma over which shear drags the skin along (chosen by eye)
MARKER_BULGE = 0.25  # of the gel's thickness times the slope: how far pressed-out gel carries the skin (chosen by eye)
MARKER_DARKNESS = 0.75  # share of the light that a dot absorbs (chosen by eye)

wp.set_module_options({"enable_backward": False})


@wp.func
def _bilinear(field: wp.array3d(dtype=Any), n: int, y: float, x: float):
    """Value of a field at a place between its samples; beyond the outermost samples, the value at the rim."""
    y = wp.clamp(y, 0.0, float(field.shape[1] - 1))
    x = wp.clamp(x, 0.0, float(field.shape[2] - 1))
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
def _coarse_index(pixel: int) -> float:
    """Place of a pixel's centre among the coarse cells' centres."""
    return (float(pixel) + 0.5) / float(wp.static(COARSE)) - 0.5


@wp.func
def _dot_at(place: float, pitch: float) -> float:
    """Distance of a place from the nearest multiple of the pitch; one dot is in the middle of the pad."""
    return place - wp.round(place / pitch) * pitch


@wp.func
def _colour_change(
    response: wp.array4d(dtype=wp.vec3f),
    knots: wp.array(dtype=wp.float32),
    i: int,
    j: int,
    t: float,
    cosine: float,
    sine: float,
) -> wp.vec3f:
    """The shader's sum at pixel (i, j) for a gradient of size t in the direction (cosine, sine)."""
    segment = int(0)  # noqa: RUF046 (declares a variable)
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
    return change


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
    noise: wp.array(dtype=wp.float32),  # (N,), standard deviation, grey levels
    drift: wp.array(dtype=wp.vec3f),  # (N,), grey levels
    seed: wp.array(dtype=wp.int32),  # (N,), of the episode's noise
    frame: wp.array(dtype=wp.int32),  # (N,), images since the episode's beginning
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
    if t > wp.static(MIN_GRADIENT):
        cosine = (gr * phase[n][0] - gc * phase[n][1]) / t
        sine = (gr * phase[n][1] + gc * phase[n][0]) / t
        colour += wp.cw_mul(gain[n], _colour_change(response, knots, i, j, t, cosine, sine))
    if light.shape[0] > 0:
        colour = wp.cw_mul(colour, _bilinear(light, n, _coarse_index(i), _coarse_index(j)))
    if moved.shape[0] > 0:
        skin = _bilinear(moved, n, _coarse_index(i), _coarse_index(j))
        y = _dot_at(float(i) - 0.5 * float(rows - 1) - skin[0], marker_pitch)
        x = _dot_at(float(j) - 0.5 * float(cols - 1) - skin[1], marker_pitch)
        cover = wp.clamp(marker_radius + 0.5 - wp.sqrt(x * x + y * y), 0.0, 1.0)
        colour *= 1.0 - wp.static(MARKER_DARKNESS) * cover
    colour += drift[n]
    if noise[n] > 0.0:
        state = wp.rand_init(seed[n], (frame[n] * rows + i) * cols + j)
        colour += noise[n] * wp.vec3f(wp.randn(state), wp.randn(state), wp.randn(state))
    image[n, i, j] = wp.vec3ub(
        wp.uint8(wp.clamp(colour[0] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(colour[1] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(colour[2] + 0.5, 0.0, 255.0)),
    )


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
            there = _bilinear(surface, n, float(i) + float(step) * ahead[0], float(j) + float(step) * ahead[1])
            steepest = wp.max(steepest, (there - here) / (float(step) * cell))
        hidden = (steepest - wp.static(LOW_LIGHT)) / wp.static(HIGH_LIGHT - LOW_LIGHT)
        arrives[channel] = 1.0 - strength * wp.clamp(hidden, 0.0, 1.0)
    light[n, i, j] = arrives


class Optics:
    """Renders the image of the camera behind the gel, for N pads.

    Args:
        config: Configuration of the pads.
        grid: Cells of `TouchModel`, whose deflections move the markers.
        num_pads: Number N of pads.
        device: Device on which everything is computed.

    Raises:
        InvalidArgumentError: The image is too small for dots on the skin.
    """

    def __init__(self, config: TactileSensorConfig, grid: ContactGrid, num_pads: int, device: torch.device):
        self.config, self.device = config, device
        optics, shape = config.optics, config.image_shape
        if optics.markers and min(shape) <= COARSE:  # the skin's motion needs two coarse cells along each side
            raise InvalidArgumentError(
                f"optics.markers of tactile sensor {config.uid!r} needs an image of more than {COARSE} pixels along each side, "
                f"and image_shape={tuple(shape)}"
            )
        coarse, cell = tuple(-(-pixels // COARSE) for pixels in shape), COARSE * config.pixel_size
        calibration = Path(optics.calibration)
        file = (calibration, calibration.stat().st_mtime_ns if calibration.is_file() else 0)
        recipe = (file, optics.lights, config.gel.curvature, tuple(shape), config.pixel_size)
        self._response, self._background, to_light = _shading_maps(*recipe, device)
        self._to_light = wp.array(to_light, dtype=wp.vec2f, device=warp_device(device))
        self._knots = wp.array(KNOTS.astype(np.float32), dtype=wp.float32, device=warp_device(device))
        self.levels = wp.to_torch(self._background)
        """Levels (H, W, 3) of the untouched gel's image before they are rounded, grey levels."""
        self._wide = [GaussianBlur(coarse, sigma / cell, device) for sigma in WIDE_SIGMAS]
        self._narrow = GaussianBlur(shape, NARROW_SIGMA / config.pixel_size, device)
        self._coat = GaussianBlur(shape, optics.smoothing, device) if optics.smoothing > 0 else None
        drag = config.gel.thickness * MARKER_SPREAD
        centres = [_cell_centres(pixels, config.pixel_size) for pixels in shape]
        self._drag = [_spread(x, at, drag, device) for x, at in zip(_axes(grid), centres, strict=True)]
        self._gain = torch.ones(num_pads, 3, device=device)
        self._phase = torch.tensor([[1.0, 0.0]], device=device).repeat(num_pads, 1)
        self._seed, self._frame = torch.zeros(2, num_pads, dtype=torch.int32, device=device)
        self.noise = torch.full((num_pads,), optics.noise, dtype=torch.float32, device=device)  # an option may be an int
        """Standard deviation (N,) of the read noise, grey levels."""
        self.drift = torch.zeros(num_pads, 3, device=device)
        """Drift (N, 3) of the colours in the next image, grey levels."""

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """What the next image depends on besides the gel's surface, (N, ...) each; not copies."""
        return dict(image_frame=self._frame)

    def reset(self, pads: torch.Tensor, seeds: np.ndarray) -> None:
        """Begin an episode on these pads: light and noise follow from the seeds, one for each pad."""
        gain, phase = self.config.randomization.draw_lights(seeds)
        self._gain[pads] = torch.as_tensor(gain, dtype=torch.float32, device=self.device)
        turn = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        self._phase[pads] = torch.as_tensor(turn, dtype=torch.float32, device=self.device)
        self._seed[pads] = torch.as_tensor(seeds.astype(np.int64), device=self.device).to(torch.int32)  # its lowest 32 bits
        self._frame[pads] = 0

    def surface(self, penetration: torch.Tensor) -> torch.Tensor:
        """Gel surface (N, H, W), m into the gel, around an object that sits `penetration` (N, H, W), m, in it.

        In contact the gel follows the object. Around it, the gel rises back in a skirt, by blurs from wide to narrow, after
        each of which the object pushes the gel down to its own depth (after Taxim's pyramid; by the maximum, so that the rim
        of a shallow contact hangs in the skirt of a deep one). The wide blurs are smooth and computed on coarse cells.
        """
        coarse = _coarse(penetration)
        skirt = coarse
        for blur in self._wide:
            skirt = torch.maximum(coarse, blur(skirt))
        pixels = [COARSE * cells for cells in skirt.shape[1:]]
        fine = F.interpolate(skirt[:, None], size=pixels, mode="bilinear", align_corners=False)[:, 0]
        surface = torch.maximum(penetration, fine[:, : penetration.shape[1], : penetration.shape[2]])
        surface = torch.maximum(penetration, self._narrow(surface))
        return surface if self._coat is None else self._coat(surface)

    def shade(self, surface: torch.Tensor, bristle: torch.Tensor | None = None) -> torch.Tensor:
        """TacRGB uint8 (N, H, W, 3) of a gel surface (N, H, W), m, whose skin is sheared by `bristle` (N, C, 2), m.

        Raises:
            InvalidArgumentError: The number of surfaces is not the number of pads.
        """
        if len(surface) != len(self._gain):  # the kernel reads the pads' properties by the surface's number, unchecked
            raise InvalidArgumentError(
                f"got {len(surface)} gel surfaces for {len(self._gain)} pads; expected one surface (H, W) for each pad"
            )
        optics, pixel = self.config.optics, self.config.pixel_size
        image = torch.empty(*surface.shape, 3, dtype=torch.uint8, device=self.device)
        coarse = _coarse(surface) if optics.shadow > 0 or optics.markers else surface[:0]
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
            wp.from_torch(self.noise),
            wp.from_torch(self.drift, dtype=wp.vec3f),
            wp.from_torch(self._seed),
            wp.from_torch(self._frame),
        ]
        outputs = [wp.from_torch(image, dtype=wp.vec3ub)]
        launch_split(_shade, tuple(surface.shape), inputs, outputs, self.device)
        self._frame += 1
        return image

    def _light(self, coarse: torch.Tensor) -> torch.Tensor:
        """Share (N, h, w, 3) of each channel's light that arrives at the coarse cells."""
        light = torch.empty(*coarse.shape, 3, device=self.device)
        phase = wp.from_torch(self._phase, dtype=wp.vec2f)
        cell = COARSE * self.config.pixel_size
        inputs = [wp.from_torch(coarse), self._to_light, phase, cell, self.config.optics.shadow]
        launch_split(_cast_shadows, tuple(coarse.shape), inputs, [wp.from_torch(light, dtype=wp.vec3f)], self.device)
        return light

    def _skin(self, coarse: torch.Tensor, bristle: torch.Tensor) -> torch.Tensor:
        """Displacement (N, h, w, 3) of the skin, pixels, along rows and columns: by shear, and outward by pressing."""
        rows, cols = self._drag
        shape = (rows.shape[1], cols.shape[1])
        dragged = torch.einsum("rx,nxyk,cy->nrck", rows, bristle.unflatten(1, shape).float(), cols)
        pressed = self._wide[0](coarse)  # the gel that is pressed out flows as smoothly as the widest skirt
        uphill = torch.stack(torch.gradient(pressed, spacing=COARSE * self.config.pixel_size, dim=(1, 2)), dim=-1)
        moved = dragged - MARKER_BULGE * self.config.gel.thickness * uphill
        return F.pad(moved / self.config.pixel_size, (0, 1))


def _shader(
    calibration: Path,
    lights: LightsConfig | None,
    curvature: tuple[float, float],
    image_shape: tuple[int, int],
    pixel_size: float,
) -> Shader:
    """The shader that the lamps give; without lamps, the one in a file, or the one that fits the Taxim table in it."""
    if lights is not None:
        return lamp_shader(lights, curvature, image_shape, pixel_size)
    if calibration.is_file() and set(TABLE_CHANNELS) & set(names_in_npz(calibration, "a shader file or a Taxim table")):
        return fit_table(read_table(calibration), image_shape)
    return Shader.load(calibration)


@functools.lru_cache(maxsize=CACHED_SHADERS)
def _shading_maps(
    file: tuple[Path, int],
    lights: LightsConfig | None,
    curvature: tuple[float, float],
    image_shape: tuple[int, int],
    pixel_size: float,
    device: torch.device,
) -> tuple[wp.array, wp.array, np.ndarray]:
    """The shader at every pixel.

    `file` is the path of the calibration and the time of its last change, so that a file that is written anew is read anew.

    Returns:
        Response (H, W, knot, Fourier term) and background (H, W), RGB each, and the direction (3, 2), along rows and columns,
        from which each channel's light comes.
    """
    shader = _shader(file[0], lights, curvature, image_shape, pixel_size)
    rows, cols = image_shape
    place = place_terms(*np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij"))
    response = np.zeros((rows, cols, len(KNOTS), FOURIER_TERMS, 3), np.float32)
    response[:, :, 1:] = np.einsum("ijq,cfkq->ijkfc", place, shader.weights, optimize=True)
    background = (place @ shader.background.T).astype(np.float32)
    # a slope faces against its gradient: the light comes from where the brightest slope faces
    brightest = (shader.weights[..., 0] @ slope_terms(np.array(LIGHT_GRADIENT)))[:, 1:3]
    to_light = -brightest / np.linalg.norm(brightest, axis=1, keepdims=True).clip(MIN_DIRECTION)
    on = warp_device(device)
    maps = (wp.array(response, dtype=wp.vec3f, device=on), wp.array(background, dtype=wp.vec3f, device=on))
    return *maps, to_light.astype(np.float32)


def _axes(grid: ContactGrid) -> tuple[np.ndarray, np.ndarray]:
    """Places of the cells' rows and columns, m."""
    return grid.x.view(grid.shape)[:, 0].cpu().numpy(), grid.y.view(grid.shape)[0].cpu().numpy()


def _coarse(image: torch.Tensor) -> torch.Tensor:
    """Means (N, h, w) of images (N, H, W) over the coarse cells; the rim is repeated where the last cells reach beyond it."""
    beyond = (0, -image.shape[2] % COARSE, 0, -image.shape[1] % COARSE)
    whole = F.pad(image[:, None], beyond, mode="replicate") if any(beyond) else image[:, None]
    return F.avg_pool2d(whole, COARSE)[:, 0]


def _cell_centres(pixels: int, pixel_size: float) -> np.ndarray:
    """Centres of the coarse cells along a side of the image, m from its middle."""
    count = -(-pixels // COARSE)
    beyond = (COARSE * count - pixels) * pixel_size
    return (np.arange(count) - (count - 1) / 2) * (COARSE * pixel_size) + beyond / 2


def _spread(points: np.ndarray, centres: np.ndarray, sigma: float, device: torch.device) -> torch.Tensor:
    """Weights (centres, points) of a Gaussian average over points around centres, all in m."""
    away = (centres[:, None] - points[None]) ** 2
    nearest = away.min(1, keepdims=True)  # subtracted, so that the weight of the nearest point is not rounded to zero
    weights = np.exp(-0.5 * (away - nearest) / sigma**2)
    return torch.as_tensor(weights / weights.sum(1, keepdims=True), dtype=torch.float32, device=device)
