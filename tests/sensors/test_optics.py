"""The shader: flat is background, no seams, and the published calibration it was fitted to."""

from pathlib import Path

import numpy as np
import pytest
import torch

from manifeel_ms3.sensors import gelsight_r15
from manifeel_ms3.sensors.config import OpticsConfig
from manifeel_ms3.sensors.fit_shader import fit, portrait_place, read_table
from manifeel_ms3.sensors.optics import Optics
from manifeel_ms3.sensors.shader import Shader, fourier_terms, place_terms, slope_terms

TABLE = Path(__file__).parents[2].parent / "shared/data/gelsight_r15_polycalib.npz"
CONFIG = gelsight_r15("touch", "gel_right")


@pytest.fixture(scope="module")
def optics():
    return Optics(CONFIG, torch.device("cpu"))


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
    noisy = gelsight_r15("touch", "gel_right", optics=OpticsConfig(noise=3.0))
    optics = Optics(noisy, torch.device("cpu"))
    surface = torch.zeros(1, 240, 320)
    optics.reseed(1)
    first, second = optics.shade(surface), optics.shade(surface)
    optics.reseed(1)
    assert (optics.shade(surface) == first).all()
    assert (first != second).any()
    assert (first.float() - optics.background).std().item() == pytest.approx(3.0, rel=0.1)


@pytest.mark.skipif(not TABLE.is_file(), reason="the reference calibration is not at hand")
def test_shipped_coefficients_reproduce_the_published_calibration():
    table = read_table(TABLE)
    shader = Shader.load(CONFIG.optics.calibration)
    assert np.allclose(shader.weights, fit(table, CONFIG.image_shape).weights, atol=1e-2)
    rng = np.random.default_rng(0)
    r, c = rng.uniform(-1, 1, (2, 20_000))
    slope, phi = rng.uniform(0.01, 0.9, 20_000), rng.uniform(-np.pi, np.pi, 20_000)
    i, j = (slope / (np.pi / 2 / 119)).astype(int), ((phi + np.pi) / (2 * np.pi / 119)).astype(int)
    true = np.einsum("knq,nq->nk", table[:, i, j] - table[:, 0, 60][:, None], portrait_place(r, c, CONFIG.image_shape))
    terms = (fourier_terms(-phi), slope_terms(np.tan(slope)), place_terms(r, c))
    ours = np.einsum("cfkq,nf,nk,nq->nc", shader.weights, *terms, optimize=True)
    assert np.sqrt(((ours - true) ** 2).mean(0)).max() < 6.0
