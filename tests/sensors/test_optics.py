"""The shader: a flat gel shows the background, colours have no seam, and presses look as in the published calibration."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError
from manifeel_ms3.sensors import Light, LightsConfig, TouchRandomization, sensor_config
from manifeel_ms3.sensors.mechanics.contact import ContactGrid
from manifeel_ms3.sensors.optics.fit_shader import Pack, Presses, fit_presses, main, read_pack, read_presses, refined_circles
from manifeel_ms3.sensors.optics.lights import lamp_shader
from manifeel_ms3.sensors.optics.shader import Shader, fourier_terms, place_terms, slope_terms
from manifeel_ms3.sensors.optics.tacrgb import Optics
from manifeel_ms3.sensors.optics.taxim_table import fit_table, portrait_place, read_table
from manifeel_ms3.verification.published_colours import change_images, pressed_shapes, published_table, ssim
from tests.sensors.make_calibration import write_table
from tests.sensors.optics import CONFIG, CPU, GRID, background, dots, make_optics
from tests.sensors.readers import photometric_stereo


@pytest.fixture(scope="module")
def optics():
    return make_optics()


def ball(
    radius: float, depth: float, x: float = 0.0, y: float = 0.0, shape: tuple[int, int] = CONFIG.image_shape
) -> torch.Tensor:
    rows, cols = shape
    xx = (torch.arange(rows) - (rows - 1) / 2) * CONFIG.pixel_size - x
    yy = (torch.arange(cols) - (cols - 1) / 2) * CONFIG.pixel_size - y
    r2 = xx[:, None] ** 2 + yy[None] ** 2
    return ((radius**2 - r2).clamp(min=0).sqrt() - radius + depth).clamp(min=0)[None]


def test_flat_gel_is_the_background_exactly():
    optics, flat = make_optics(2), torch.zeros(2, 240, 320)
    assert (optics.shade(optics.surface(flat)) == background(optics)).all()


def test_more_surfaces_than_pads_are_refused(optics):
    with pytest.raises(InvalidArgumentError, match="2 gel surfaces for 1 pads"):
        optics.shade(torch.zeros(2, 240, 320))


def test_untouched_regions_stay_background(optics):
    image = optics.shade(optics.surface(ball(0.004, 5e-4, x=-6e-3, y=-10e-3)))[0]
    assert (image[160:, 200:] == background(optics)[160:, 200:]).all()
    assert (image != background(optics)).any(-1).float().mean() > 0.02


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


@pytest.mark.parametrize("shape", [(183, 229), (182, 228), (201, 203)])
def test_an_image_may_have_any_number_of_rows_and_columns(shape):
    odd = make_optics(**{"image_shape": shape, "optics.shadow": 0.6, "optics.markers": True})
    surface = odd.surface(ball(0.004, 8e-4, shape=shape))
    for axis in (1, 2):
        assert (surface - surface.flip(axis)).abs().max() < 5e-6  # m; the ball presses in the middle
    still = torch.zeros(1, len(GRID.x), 2, dtype=torch.float64)
    places, _ = dots(odd.shade(surface, still)[0])
    middle = (np.array(shape[::-1]) - 1) / 2
    around = places[np.abs(np.linalg.norm(places - middle, axis=1) - 26) < 4]
    assert len(around) == 4
    assert around.mean(0) == pytest.approx(middle, abs=0.15)  # pixels


def test_an_image_may_be_a_single_pixel():
    single = make_optics(image_shape=(1, 1))
    assert single.shade(single.surface(torch.zeros(1, 1, 1))).shape == (1, 1, 1, 3)


def test_dots_need_an_image_that_shows_how_the_skin_moves():
    with pytest.raises(InvalidArgumentError, match=r"optics\.markers.*more than 4 pixels.*image_shape=\(4, 320\)"):
        make_optics(**{"image_shape": (4, 320), "optics.markers": True})
    small = make_optics(**{"image_shape": (5, 320), "optics.markers": True})
    still = torch.zeros(1, len(GRID.x), 2, dtype=torch.float64)
    assert small.shade(small.surface(torch.zeros(1, 5, 320)), still).shape == (1, 5, 320, 3)


def test_a_very_thin_gel_has_dots_too():
    still, surface = torch.zeros(1, len(GRID.x), 2, dtype=torch.float64), torch.zeros(1, 240, 320)
    images = [
        optics.shade(optics.surface(surface), still)
        for optics in (make_optics(**{"gel.thickness": thickness, "optics.markers": True}) for thickness in (1e-5, 4e-3))
    ]
    assert torch.equal(*images)


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
    assert (optics.shade(surface) == second).all()
    for noise in (first.float() - background(optics), second.float() - background(optics)):
        assert noise.mean().item() == pytest.approx(0.0, abs=0.05)
        assert noise.std().item() == pytest.approx(3.0, rel=0.02)
    colours = (first[0].float() - background(optics)).flatten(0, 1).T
    assert (torch.corrcoef(colours) - torch.eye(3)).abs().max() < 0.02  # channels are independent


def test_an_amount_of_noise_may_be_a_whole_number():
    surface, images = torch.zeros(1, 240, 320), []
    for amount in (3, 3.0):
        optics = make_optics(**{"optics.noise": amount})
        images.append(optics.shade(surface))
    assert torch.equal(*images)


def test_episodes_differ_in_light_as_far_as_asked():
    optics = make_optics(2, **{"randomization.gain": 0.2, "randomization.light_phase": 0.2})
    pads, press = torch.arange(2), ball(0.004, 8e-4).expand(2, -1, -1)
    optics.reset(pads, np.array([1, 2]))
    image = optics.shade(optics.surface(press))
    assert (image[0] != image[1]).any()
    optics.reset(torch.tensor([1]), np.array([1]))
    image = optics.shade(optics.surface(press))
    assert (image[0] == image[1]).all()
    assert (optics.shade(torch.zeros(2, 240, 320)) == background(optics)).all()


def test_each_channel_draws_its_own_gain_and_the_lights_their_own_turn():
    gain, turn = TouchRandomization(gain=0.2, light_phase=0.5).draw_lights(np.arange(1000))
    draws = np.c_[(gain - 1) / 0.2, turn / 0.5]
    assert np.abs(np.corrcoef(draws.T) - np.eye(4)).max() < 0.1
    assert ((np.abs(draws).max(0) > 0.99) & (np.abs(draws).max(0) <= 1)).all()


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


def middle_of(weight: torch.Tensor) -> torch.Tensor:
    """Centroid (2,) of weights (240, 320), as row and column from the middle of the image, pixels."""
    axes = [torch.arange(n, dtype=weight.dtype) - (n - 1) / 2 for n in weight.shape]
    return torch.stack([weight.sum(1) @ axes[0], weight.sum(0) @ axes[1]]) / weight.sum()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_drawn_turn_of_the_lights_turns_colours_and_shadows_together(optics, seed):
    options = {"randomization.light_phase": 2.5}
    bare, shaded = make_optics(**options), make_optics(**options, **{"optics.shadow": 0.5})
    surface = optics.surface(ball(0.003, 1.2e-3))
    for one in (bare, shaded):
        one.reset(torch.arange(1), np.array([seed]))
    unturned, picture, dark = (one.shade(surface)[0].double() for one in (optics, bare, shaded))
    (turn,) = bare.config.randomization.draw_lights(np.array([seed]))[1]
    assert abs(turn) > 0.2
    for channel in range(3):
        flat = background(optics)[..., channel].double()
        at = [middle_of((image[..., channel] - flat).clamp(min=0)) for image in (unturned, picture)]  # the lit side of the bump
        angles = [torch.atan2(place[1], place[0]).item() for place in at]
        off = (angles[1] - angles[0] + turn + np.pi) % (2 * np.pi) - np.pi
        assert abs(off) < 0.35, channel
        behind = middle_of((picture - dark)[..., channel])
        assert behind @ at[1] < 0, channel


def test_sensors_have_their_own_colours():
    r15, mini, digit = (sensor_config(name, "a", "b").optics for name in ("gelsight_r15", "gelsight_mini", "digit"))
    assert (r15.lights, mini.lights) == (None, None)
    untouched = [Shader.load(Path(one.calibration)).background[:, 0] for one in (r15, mini)]  # grey levels in the middle
    assert np.abs(untouched[0] - untouched[1]).max() > 5
    red, green, blue = digit.lights.lamps
    for lamp, colour, degrees in ((red, (1, 0, 0), 30), (green, (0, 1, 0), 150), (blue, (0, 0, 1), 270)):
        assert lamp.colour == colour
        assert np.rad2deg(np.arctan2(lamp.position[1], lamp.position[0])) % 360 == pytest.approx(degrees)


def test_markers_move_with_the_shear_spread_and_swell_where_pressed():
    optics = make_optics(**{"optics.markers": True})
    flat, still = torch.zeros(1, 240, 320), torch.zeros(1, len(GRID.x), 2, dtype=torch.float64)
    rest, size = dots(optics.shade(flat, still)[0])
    moved = still.clone()
    moved[..., 1] = 3e-4
    sheared, _ = dots(optics.shade(flat, moved)[0])
    inner = rest[(np.abs(rest - [159.5, 119.5]) < [120, 90]).all(1)]
    near = sheared[np.argmin(np.linalg.norm(sheared[None] - inner[:, None] - [3e-4 / CONFIG.pixel_size, 0], axis=-1), axis=1)]
    assert (near - inner).mean(0) == pytest.approx([3e-4 / CONFIG.pixel_size, 0.0], abs=0.3)
    pressed, swollen = dots(optics.shade(optics.surface(ball(0.004, 8e-4)), still)[0])
    ring = rest[np.abs(np.linalg.norm(rest - [159.5, 119.5], axis=1) - 23.5) < 3]  # the dots around the middle one
    after = pressed[np.argmin(np.linalg.norm(pressed[None] - ring[:, None], axis=-1), axis=1)]
    out = np.linalg.norm(after - [159.5, 119.5], axis=1) - np.linalg.norm(ring - [159.5, 119.5], axis=1)
    assert len(ring) == 4
    assert (out > 0.5).all()
    middle = [np.argmin(np.linalg.norm(c - [159.5, 119.5], axis=1)) for c in (rest, pressed)]
    assert swollen[middle[1]] > 1.2 * size[middle[0]]


@pytest.fixture(scope="module")
def table_file(tmp_path_factory) -> Path:
    """Published calibration of the R1.5 in Taxim's format."""
    return write_table(tmp_path_factory.mktemp("calibration") / "polycalib.npz")


def test_shipped_coefficients_reproduce_the_published_calibration(table_file):
    table = read_table(table_file)
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


PRESSES = pressed_shapes(CONFIG)  # m above the untouched gel's face, into it


def pressed(optics: Optics, name: str) -> torch.Tensor:
    return optics.surface(torch.as_tensor(PRESSES[name].clip(min=0), dtype=torch.float32)[None])


@pytest.mark.parametrize("press", PRESSES)
def test_change_images_are_those_of_the_published_calibration(optics, press, figure):
    change, published = change_images(optics, PRESSES[press], published_table())
    figure("change images against the R1.5 table, SSIM", ssim(change, published), at_least=0.90)
    rmse = np.sqrt(((change - published) ** 2).mean())
    figure("change images against the R1.5 table, grey levels RMSE", rmse, at_most=6)


def test_taxim_table_can_be_given_with_any_number_of_bins(optics, table_file, tmp_path):
    table = read_table(table_file)
    surface = pressed(optics, "ball")
    expected = optics.shade(surface).int()
    given = make_optics(**{"optics.calibration": table_file})
    assert (given.shade(surface).int() - expected).abs().max() <= 1
    # as many bins as TacSL's tables have, read between this one's
    bins, last = 125, table.shape[1] - 1
    at = np.linspace(0, last, bins)
    low = np.minimum(at.astype(int), last - 1)
    share = (at - low)[:, None]
    rows = table[:, low] * (1 - share)[None, ..., None] + table[:, low + 1] * share[None, ..., None]
    finer = rows[:, :, low] * (1 - share) + rows[:, :, low + 1] * share
    np.savez(tmp_path / "polycalib.npz", **{f"grad_{c}": finer[i] for i, c in enumerate("rgb")}, bins=bins)
    other = make_optics(**{"optics.calibration": tmp_path / "polycalib.npz"})
    assert (other.shade(surface).int() - expected).abs().float().mean() < 1.0


def test_a_calibration_that_is_written_anew_is_read_anew(tmp_path):
    path = tmp_path / "shader.npz"
    shader = Shader.load(CONFIG.optics.calibration)
    levels = []
    for brightness in (1.0, 0.5):
        Shader(shader.weights, brightness * shader.background).save(path)
        levels.append(make_optics(**{"optics.calibration": path}).levels)
    assert torch.allclose(levels[1], 0.5 * levels[0])


@pytest.mark.parametrize("press", ["ball", "rod", "wedge"])
def test_height_comes_back_from_the_picture(optics, press, figure):
    surface = pressed(optics, press)
    shader = Shader.load(CONFIG.optics.calibration)
    height = photometric_stereo(optics.shade(surface)[0].numpy(), shader, CONFIG.pixel_size)
    off = np.abs(height - surface[0, ::2, ::2].numpy()).max()
    figure("height from the picture by photometric stereo, mm off", 1e3 * off, at_most=0.1)
    assert height.max() > 0.7 * surface.max().item()


def test_shader_is_fitted_from_ball_presses(optics, tmp_path):
    radius, rng, presses = 0.003, np.random.default_rng(0), []
    shader = make_optics(**{"optics.smoothing": 0.0})
    for k in range(60):
        x, y = rng.uniform(-1, 1, 2) * [0.009, 0.0125]
        depth = rng.uniform(4e-4, 1.2e-3)
        contact = np.sqrt(radius**2 - (radius - depth) ** 2) / CONFIG.pixel_size
        surface = ball(radius, depth, x, y)  # no skirt: only what lies within the circle counts
        cv2.imwrite(str(tmp_path / f"{k}.png"), shader.shade(surface)[0].numpy()[..., ::-1])
        row, col = x / CONFIG.pixel_size + 119.5, y / CONFIG.pixel_size + 159.5
        presses.append(f"{k}.png,{row},{col},{contact - 1.5}")
    cv2.imwrite(str(tmp_path / "background.png"), background(shader).numpy()[..., ::-1])
    (tmp_path / "presses.csv").write_text("\n".join(["file,row,col,radius", *presses]))
    known = dict(folder=tmp_path, ball_radius=radius, pixel_size=CONFIG.pixel_size)
    main(Presses(**known, out=tmp_path / "out" / "shader.npz"))
    fitted = make_optics(**{"optics.calibration": tmp_path / "out" / "shader.npz"})
    surface = optics.surface(ball(0.005, 5e-4, 2e-3, -3e-3))
    difference = (fitted.shade(surface).int() - optics.shade(surface).int()).abs().float()
    assert difference.mean() < 1.0
    assert difference.max() < 12
    with pytest.raises(ValueError, match="larger than the ball"):
        main(Presses(**known | dict(ball_radius=5e-4), out=tmp_path / "x.npz"))
    with pytest.raises(ValueError, match=r"presses\.csv"):
        main(Presses(**known | dict(folder=tmp_path / "out"), out=tmp_path / "x.npz"))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["file,x,y,r", "0.png,1,2,3"], "must have the columns file, row, col, radius"),
        (["file,row,col,radius"], "at least one press"),
        (["file,row,col,radius", "0.png,1,two,3"], r"'col': 'two'.*numbers of pixels"),
        (["file,row,col,radius", "0.png,1,2"], r"'radius': None.*numbers of pixels"),
        (["file,row,col,radius", "0.png,1,2,nan"], r"'radius': 'nan'.*numbers of pixels"),
        (["file,row,col,radius", ",1,2,3"], r"'file': ''.*the name of a file"),
    ],
)
def test_a_list_of_presses_that_cannot_be_read_is_named(lines, said, tmp_path):
    (tmp_path / "presses.csv").write_text("\n".join(lines))
    with pytest.raises(InvalidFileError, match=said):
        main(Presses(folder=tmp_path, ball_radius=0.003, pixel_size=CONFIG.pixel_size, out=tmp_path / "x.npz"))


@pytest.mark.parametrize(
    ("circle", "sizes", "said"),
    [
        ((20.0, 20.0, 0.0), (0.003, 1e-4), "with a radius of 0 pixels covers nothing"),
        ((20.0, 300.0, 8.0), (0.003, 1e-4), "row 20 and column 300 .* covers nothing of an image of 40 rows and 40 columns"),
        ((20.0, 20.0, 8.0), (0.003, -1e-4), r"pixel_size=-0\.0001 are lengths in m, above 0"),
        ((20.0, 20.0, 8.0), (0.0, 1e-4), r"ball_radius=0\.0 and"),
    ],
)
def test_presses_that_show_nothing_are_refused(circle, sizes, said):
    picture = np.zeros((40, 40, 3), np.uint8)
    with pytest.raises(InvalidArgumentError, match=said):
        fit_presses(picture, picture[None], np.array([circle]), *sizes)


def test_a_list_of_presses_may_begin_with_a_byte_order_mark_and_must_be_utf8(tmp_path):
    listing = tmp_path / "presses.csv"
    cv2.imwrite(str(tmp_path / "background.png"), np.zeros((40, 40, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((40, 40, 3), np.uint8))
    listing.write_text("file,row,col,radius\n0.png,1,2,3\n", encoding="utf-8-sig")
    assert read_presses(tmp_path)[2].tolist() == [[1, 2, 3]]
    listing.write_text("file,row,col,radius\nstoß.png,1,2,3\n", encoding="latin-1")
    with pytest.raises(InvalidFileError, match="is not text in UTF-8"):
        read_presses(tmp_path)


@pytest.mark.parametrize(("f0", "imgs"), [((8, 9), (2, 8, 9)), ((8, 9, 3), (3, 8, 9, 3)), ((8, 9, 3), (2, 8, 8, 3))])
def test_a_pack_of_other_shapes_is_named(f0, imgs, tmp_path):
    arrays = dict(
        f0=np.zeros(f0, np.uint8), imgs=np.zeros(imgs, np.uint8), touch_center=np.zeros((2, 2)), touch_radius=np.ones(2)
    )
    np.savez(tmp_path / "dataPack.npz", **arrays)
    with pytest.raises(InvalidFileError, match=r"f0 must be \(H, W, 3\), and imgs one such image for each circle"):
        read_pack(tmp_path / "dataPack.npz")


def test_one_press_alone_cannot_be_refined():
    picture, circle = np.zeros((40, 40, 3), np.uint8), np.array([[20.0, 20.0, 8.0]])
    with pytest.raises(InvalidArgumentError, match=r"give more presses, or leave out --refine"):
        refined_circles(picture, picture[None], circle, 0.003, CONFIG.pixel_size)


def test_circles_that_were_drawn_by_hand_are_shifted_to_where_the_ball_was(tmp_path):
    radius, rng, shader = 0.003, np.random.default_rng(0), make_optics(**{"optics.smoothing": 0.0})
    rows, cols = slice(80, 160), slice(110, 210)
    images, true, radii = [], [], []
    for _ in range(6):
        x, y = rng.uniform(-1, 1, 2) * 0.001
        depth = rng.uniform(6e-4, 1.2e-3)
        images.append(shader.shade(ball(radius, depth, x, y))[0].numpy()[rows, cols, ::-1])
        true.append((x / CONFIG.pixel_size + 39.5, y / CONFIG.pixel_size + 49.5))
        radii.append(np.sqrt(radius**2 - (radius - depth) ** 2) / CONFIG.pixel_size - 3)
    drawn = np.array(true) + rng.integers(-6, 7, (6, 2))
    pack = dict(f0=background(shader).numpy()[rows, cols, ::-1], imgs=np.stack(images), touch_center=drawn[:, ::-1])
    np.savez(tmp_path / "dataPack.npz", **pack, touch_radius=radii)
    untouched, read, circles = read_pack(tmp_path / "dataPack.npz")
    assert circles[:, :2] == pytest.approx(drawn)
    refined = refined_circles(untouched, read, circles, radius, CONFIG.pixel_size, uniform=True)
    error = [np.linalg.norm(found[:, :2] - true, axis=1).mean() for found in (circles, refined)]
    assert error[1] < 0.65 * error[0]
    known = dict(ball_radius=radius, pixel_size=CONFIG.pixel_size, uniform=True, out=tmp_path / "shader.npz")
    main(Pack(pack=tmp_path / "dataPack.npz", **known))
    fitted = Shader.load(tmp_path / "shader.npz").weights
    assert (fitted[..., 1:] == 0).all()  # the same all over the image
    assert (fitted[:, 0] == 0).all()  # and nothing that is the same in all directions
    np.savez(tmp_path / "other.npz", f0=pack["f0"])
    with pytest.raises(ValueError, match=r"not a dataPack\.npz in Taxim's format.*imgs"):
        main(Pack(pack=tmp_path / "other.npz", **known))


LAMP = Light((0.0, 0.03, -0.01), (1.0, 1.0, 0.0))  # towards the fingertip


def test_a_slope_towards_a_lamp_is_lit_by_lamberts_law():
    lights = LightsConfig((LAMP,), level=60.0)
    shader = lamp_shader(lights, (0.0, 0.0), (240, 320), CONFIG.pixel_size)
    place = np.array([1.0, 0, 0, 0, 0, 0])  # of the middle
    for slope in (0.0, 0.3, 0.6):
        for phi, faces in ((-np.pi / 2, 1.0), (np.pi / 2, -1.0)):  # the gel rises away from the lamp: its slope faces the lamp
            terms = fourier_terms(np.array(phi)), slope_terms(np.array(slope))
            level = np.einsum("cfkq,f,k,q->c", shader.weights, *terms, place) + shader.background @ place
            elevation = np.arctan2(0.01, 0.03)
            expected = np.sin(elevation + faces * np.arctan(slope)).clip(min=0) / np.sin(elevation)
            flat = shader.background[0] @ place
            assert max(level[0] / flat, 0.0) == pytest.approx(expected, abs=0.12)
            assert level[2] == 0  # no lamp is blue
    mean = (place_terms(*np.meshgrid(*[np.linspace(-1, 1, 9)] * 2)) @ shader.background.T).mean((0, 1))
    assert mean == pytest.approx([60, 60, 0], abs=0.1)
    near, far = (np.array([1, 0, c, 0, 0, c * c]) @ shader.background[0] for c in (1, -1))
    assert near > 1.5 * far


@pytest.mark.parametrize("curvature", [(0.0, 0.0), (8.0, 12.0)])
def test_levels_of_several_lamps_fall_with_the_square_of_their_distance(curvature):
    """I = sum of a (n . l) / r^2 over the lamps, on a flat face and on a dome; each lit channel has the given mean."""
    lamps = (Light((0.05, -0.03, -0.04), (2.0, 0.0, 0.5)), Light((-0.04, 0.05, -0.06), (1.0, 0.0, 3.0)))
    shader = lamp_shader(LightsConfig(lamps, level=80.0), curvature, (240, 320), CONFIG.pixel_size)
    r, c = (places.ravel() for places in np.meshgrid(*[np.linspace(-1, 1, 9)] * 2, indexing="ij"))
    x, y = 119.5 * CONFIG.pixel_size * r, 159.5 * CONFIG.pixel_size * c
    along = np.array(curvature)
    skin = np.c_[x, y, -(along[0] * x**2 + along[1] * y**2) / 2]  # of a dome that is shallow
    normal = np.c_[-along[0] * x, -along[1] * y, -np.ones_like(x)]  # towards the lamps
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.zeros((len(x), 3))
    for lamp in lamps:
        ray = np.array(lamp.position) - skin
        distance = np.linalg.norm(ray, axis=1)
        level += ((normal * ray).sum(1) / distance**3)[:, None] * np.array(lamp.colour)
    lit = [0, 2]
    found = place_terms(r, c) @ shader.background.T
    assert found[:, lit] == pytest.approx(80.0 * level[:, lit] / level[:, lit].mean(0), rel=0.02)
    assert (found[:, 1] == 0).all()


@pytest.mark.parametrize("sensor", ["gelsight_mini", "digit"])
def test_height_comes_back_from_the_picture_of_other_sensors(sensor, figure):
    config = sensor_config(sensor, "touch", "gel_right")
    optics = Optics(config, ContactGrid.covering(config.gel.size, 3.5e-4, CPU), 1, CPU)
    x, y = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * config.pixel_size for n in config.image_shape), indexing="ij")
    height = (np.sqrt(np.maximum(0.004**2 - x**2 - y**2, 0)) - 0.004 + 6e-4).clip(min=0)
    surface = optics.surface(torch.as_tensor(height, dtype=torch.float32)[None])
    lights, calibration = config.optics.lights, config.optics.calibration
    gel = (config.gel.curvature, config.image_shape, config.pixel_size)
    shader = lamp_shader(lights, *gel) if lights else Shader.load(Path(calibration))
    found = photometric_stereo(optics.shade(surface)[0].numpy(), shader, config.pixel_size, step=4)
    off = np.abs(found - surface[0, ::4, ::4].numpy()).max()
    figure(f"height from the {sensor}'s picture by photometric stereo, mm off", 1e3 * off, at_most=0.1)
    assert (optics.shade(torch.zeros(1, 240, 320)) == background(optics)).all()
