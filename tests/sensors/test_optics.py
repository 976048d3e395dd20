"""The shader: flat is background, no seams, and the published calibration it was fitted to."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from manifeel_ms3.sensors import gelsight_r15, with_options
from manifeel_ms3.sensors.contact import ContactGrid
from manifeel_ms3.sensors.optics import Optics
from manifeel_ms3.sensors.shader import Shader, fourier_terms, place_terms, slope_terms
from manifeel_ms3.sensors.taxim_table import fit_table, portrait_place, read_table

TABLE = Path(__file__).parents[2].parent / "shared/data/gelsight_r15_polycalib.npz"
CONFIG = gelsight_r15("touch", "gel_right")


CPU = torch.device("cpu")
GRID = ContactGrid.covering(CONFIG.gel.size, 3.5e-4, CPU)


def make_optics(num_pads: int = 1, **fields) -> Optics:
    return Optics(with_options(CONFIG, fields), GRID, num_pads, CPU)


@pytest.fixture(scope="module")
def optics():
    return make_optics()


def ball(radius: float, depth: float, x: float = 0.0, y: float = 0.0) -> torch.Tensor:
    rows, cols = CONFIG.image_shape
    xx = (torch.arange(rows) - (rows - 1) / 2) * CONFIG.pixel_size - x
    yy = (torch.arange(cols) - (cols - 1) / 2) * CONFIG.pixel_size - y
    r2 = xx[:, None] ** 2 + yy[None] ** 2
    return ((radius**2 - r2).clamp(min=0).sqrt() - radius + depth).clamp(min=0)[None]


def test_flat_gel_is_the_background_exactly(optics):
    flat = torch.zeros(2, 240, 320)
    assert (optics.shade(optics.surface(flat)) == optics.background).all()


def test_untouched_regions_stay_background(optics):
    image = optics.shade(optics.surface(ball(0.004, 5e-4, x=-6e-3, y=-10e-3)))[0]
    assert (image[160:, 200:] == optics.background[160:, 200:]).all()
    assert (image != optics.background).any(-1).float().mean() > 0.02


def test_colour_has_no_seam_over_the_direction_of_the_gradient():
    shader = Shader.load(CONFIG.optics.calibration)
    phi = np.linspace(-np.pi, np.pi, 721)
    terms = np.einsum(
        "pf,k,q->pfkq", fourier_terms(phi), slope_terms(np.array(0.3)), place_terms(np.array(0.2), np.array(-0.4))
    )
    colour = np.einsum("cfkq,pfkq->pc", shader.weights, terms)
    assert np.allclose(colour[0], colour[-1], atol=1e-4)
    assert np.abs(np.diff(colour, axis=0)).max() < 1.5  # grey levels per half degree


def test_surface_has_a_skirt_that_falls_from_the_contact(optics):
    surface = optics.surface(ball(0.004, 8e-4))[0, 120]
    contact = ball(0.004, 8e-4)[0, 120]
    outside = contact == 0
    assert surface[outside].max() > 1e-5
    right = surface[160:]
    assert (right.diff() <= 1e-9).all()
    assert surface[0] < 1e-6


def test_noise_is_seeded():
    optics = make_optics(2, **{"optics.noise": 3.0})
    surface = torch.zeros(2, 240, 320)
    pads = torch.arange(2)
    optics.reset(pads, np.array([1, 2]))
    first, second = optics.shade(surface), optics.shade(surface)
    optics.reset(pads, np.array([1, 2]))
    assert (optics.shade(surface) == first).all()
    assert (first != second).any()
    assert (first[0] != first[1]).any()
    assert (first.float() - optics.background).std().item() == pytest.approx(3.0, rel=0.1)


def test_episodes_differ_in_light_as_far_as_asked():
    optics = make_optics(2, **{"randomization.gain": 0.2, "randomization.light_phase": 0.2})
    pads, press = torch.arange(2), ball(0.004, 8e-4).expand(2, -1, -1)
    optics.reset(pads, np.array([1, 2]))
    image = optics.shade(optics.surface(press))
    assert (image[0] != image[1]).any()
    optics.reset(torch.tensor([1]), np.array([1]))
    image = optics.shade(optics.surface(press))
    assert (image[0] == image[1]).all()
    assert (optics.shade(torch.zeros(2, 240, 320)) == optics.background).all()


def test_shadow_darkens_behind_the_bump_and_nowhere_else(optics):
    shaded = make_optics(**{"optics.shadow": 0.5})
    surface = optics.surface(ball(0.003, 1.2e-3))
    change = shaded.shade(surface).int() - optics.shade(surface).int()
    assert change.max() <= 0
    assert change.min() < -10
    far = torch.ones(240, 320, dtype=torch.bool)
    far[50:190, 90:230] = False
    assert (change[0][far] == 0).all()
    for channel in range(3):  # the middle of the darkness lies on the side away from where the channel's light comes from
        dark = -change[0, ..., channel].double()
        middle = torch.stack([(dark.sum(1 - axis) * torch.arange(n)).sum() / dark.sum() for axis, n in ((0, 240), (1, 320))])
        away = middle - torch.tensor([119.5, 159.5])
        assert (away * torch.as_tensor(optics._to_light.numpy()[channel])).sum() < -1


def dot_centres(image: torch.Tensor) -> np.ndarray:
    count, _, _, centres = cv2.connectedComponentsWithStats((image.numpy().astype(int).sum(-1) < 180).astype(np.uint8))
    return centres[1:]


def test_markers_move_with_the_shear_and_spread_where_pressed():
    optics = make_optics(**{"optics.markers": True})
    flat, still = torch.zeros(1, 240, 320), torch.zeros(1, len(GRID.x), 2, dtype=torch.float64)
    rest = dot_centres(optics.shade(flat, still)[0])
    moved = still.clone()
    moved[..., 1] = 3e-4
    sheared = dot_centres(optics.shade(flat, moved)[0])
    inner = rest[(np.abs(rest - [159.5, 119.5]) < [120, 90]).all(1)]
    near = sheared[np.argmin(np.linalg.norm(sheared[None] - inner[:, None] - [3e-4 / CONFIG.pixel_size, 0], axis=-1), axis=1)]
    assert (near - inner).mean(0) == pytest.approx([3e-4 / CONFIG.pixel_size, 0.0], abs=0.3)
    pressed = dot_centres(optics.shade(optics.surface(ball(0.004, 8e-4)), still)[0])
    ring = rest[np.abs(np.linalg.norm(rest - [159.5, 119.5], axis=1) - 23.5) < 3]  # the dots around the middle one
    after = pressed[np.argmin(np.linalg.norm(pressed[None] - ring[:, None], axis=-1), axis=1)]
    out = np.linalg.norm(after - [159.5, 119.5], axis=1) - np.linalg.norm(ring - [159.5, 119.5], axis=1)
    assert len(ring) == 4
    assert (out > 0.5).all()


@pytest.mark.skipif(not TABLE.is_file(), reason="the reference calibration is not at hand")
def test_shipped_coefficients_reproduce_the_published_calibration():
    table = read_table(TABLE)
    shader = Shader.load(CONFIG.optics.calibration)
    assert np.allclose(shader.weights, fit_table(table, CONFIG.image_shape).weights, atol=1e-2)
    rng = np.random.default_rng(0)
    r, c = rng.uniform(-1, 1, (2, 20_000))
    slope, phi = rng.uniform(0.01, 0.9, 20_000), rng.uniform(-np.pi, np.pi, 20_000)
    i, j = (slope / (np.pi / 2 / 119)).astype(int), ((phi + np.pi) / (2 * np.pi / 119)).astype(int)
    true = np.einsum("knq,nq->nk", table[:, i, j] - table[:, 0, 60][:, None], portrait_place(r, c, CONFIG.image_shape))
    terms = (fourier_terms(-phi), slope_terms(np.tan(slope)), place_terms(r, c))
    ours = np.einsum("cfkq,nf,nk,nq->nc", shader.weights, *terms, optimize=True)
    assert np.sqrt(((ours - true) ** 2).mean(0)).max() < 6.0
