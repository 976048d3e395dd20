"""Many pads at once: each as if it were alone."""

import numpy as np
import pytest
import sapien
import torch
import trimesh

from manifeel_ms3.sensors import GelConfig, TactileSensorConfig, grids_for, with_options
from manifeel_ms3.sensors.depth.raycast import MeshRays
from manifeel_ms3.sensors.touch_model import TouchModel
from tests.sensors.optics import dots
from tests.sensors.pads import CONFIG, CPU, EVERYTHING, LOADS, meshes, pressed


def model(pads: int, **options) -> TouchModel:
    made = TouchModel(with_options(CONFIG, options), pads, CPU)
    made.reset(torch.arange(pads), np.arange(pads))
    return made


def test_each_row_of_a_batch_is_as_if_alone():
    together = model(4, **EVERYTHING)
    for _ in range(2):  # with a history
        seen = together.observe(pressed(meshes()), LOADS)
    for i, mesh in enumerate(meshes()):
        alone = TouchModel(with_options(CONFIG, EVERYTHING), 1, CPU)
        alone.reset(torch.arange(1), np.array([i]))
        for _ in range(2):
            one = alone.observe(pressed([mesh]), LOADS[i : i + 1])
        assert (one["force_field"][0] - seen["force_field"][i]).abs().max() < 1e-6
        assert (one["penetration"][0] - seen["penetration"][i]).abs().max() < 1e-6
        assert (one["rgb"][0].int() - seen["rgb"][i].int()).abs().max() <= 1


def test_a_gel_of_another_size_needs_its_size_alone():
    """16 x 20 mm, pressed with 3 N: image and taxels cover it, and the field holds the load."""
    size = (0.016, 0.020)
    pad = TouchModel(TactileSensorConfig("touch", "finger", sapien.Pose(), GelConfig(size=size), **grids_for(size)), 1, CPU)
    load = torch.tensor([[0, 0, -3.0, 0, 0, 0]], dtype=torch.float64)
    seen = pad.observe(MeshRays([meshes()[:1]], size, CPU), load)
    for name, pitch in (("rgb", TactileSensorConfig.pixel_size), ("force_field", TactileSensorConfig.taxel_pitch)):
        covered = np.array(seen[name].shape[1:3]) * pitch
        assert covered == pytest.approx(size, abs=pitch), name
    assert seen["force_field"][..., 0].sum().item() == pytest.approx(3.0, rel=1e-3)


def test_batch_of_64_equals_itself_bit_for_bit():
    runs = []
    for _ in range(2):
        pads = model(64, **EVERYTHING, **{"optics.noise": 2.0})
        runs.append(pads.observe(pressed(meshes() * 16), LOADS.repeat(16, 1)))
    for name in runs[0]:
        assert torch.equal(runs[0][name], runs[1][name]), name


def test_reset_clears_the_shear_of_these_pads_alone():
    pads = model(3)
    ball = [meshes()[0]] * 3
    held, released = LOADS[:1].repeat(3, 1), LOADS[:1].repeat(3, 1)
    released[:, [0, 1, 5]] = 0.0
    pads.observe(pressed(ball), held)
    pads.reset(torch.tensor([1]), np.array([7]))
    locked_in = pads.observe(pressed(ball), released)["force_field"][..., 1:].abs().amax((1, 2, 3))
    assert locked_in[1] < 1e-9
    assert (locked_in[[0, 2]] > 1e-4).all()


def test_randomised_gel_sinks_otherwise_under_the_same_force():
    pads = model(8, **{"randomization.stiffness": 0.3, "randomization.friction": 0.2})
    seen = pads.observe(pressed([meshes()[0]] * 8), LOADS[:1].repeat(8, 1))
    deepest = seen["penetration"].amax((1, 2))
    assert deepest.unique().numel() == 8
    assert deepest.max() / deepest.min() < np.sqrt(1.3 / 0.7) + 0.01  # a ball: depth goes with the root of the stiffness
    assert seen["force_field"][..., 0].sum((1, 2)).tolist() == pytest.approx([5.0] * 8, rel=1e-5)


def test_the_skin_of_a_softer_gel_is_sheared_further_by_the_same_force():
    """Dots within a contact that sticks move by F / (k_t A), and k_t is the stiffness that the episode drew."""
    pads = model(4, **{"randomization.stiffness": 0.5, "optics.markers": True})
    load = torch.tensor([[1.0, -1.5, -5.0, 0, 0, 0]], dtype=torch.float64).repeat(4, 1)
    image = pads.observe(pressed([meshes()[2]] * 4), load)["rgb"]
    middle = np.array([159.5, 119.5])
    places = [places[np.linalg.norm(places - middle, axis=1).argmin()] for places, _ in map(dots, image)]
    moved = (np.array(places) - middle)[:, ::-1] * CONFIG.pixel_size  # m along x and y
    stiffness, _ = pads.config.randomization.draw_gels(np.arange(4))
    assert np.ptp(stiffness) > 0.3
    area = pads.grid.area * (pads.heights(pressed([meshes()[2]] * 4))[0] > -1e-4).sum().item()
    expected = np.outer(1 / (stiffness * CONFIG.gel.shear_stiffness * area), [1.0, -1.5])
    assert moved == pytest.approx(expected, abs=3e-5)  # a third of a pixel


def test_randomised_friction_bounds_the_shear_of_each_pad():
    """Under more shear than friction holds, a field carries the friction coefficient times the load."""
    drawn = {"randomization.stiffness": 0.3, "randomization.friction": 0.2}
    pads = TouchModel(with_options(CONFIG, drawn), 4, CPU, ("force_field",))
    pads.reset(torch.arange(4), np.arange(4))
    load = torch.tensor([[9.0, 0, -5.0, 0, 0, 0]], dtype=torch.float64).repeat(4, 1)
    seen = pads.observe(pressed([meshes()[2]] * 4), load)["force_field"].sum((1, 2))
    _, friction = pads.config.randomization.draw_gels(np.arange(4))
    assert np.ptp(friction) > 0.05
    assert (seen[:, 1] / 5.0).tolist() == pytest.approx(CONFIG.gel.friction * friction, rel=0.01)


def test_a_penetration_is_cut_at_its_limit_and_the_force_is_not():
    plain, cut = model(1), model(1, **{"gel.max_penetration": 3e-4})
    seen, limited = (pad.observe(pressed(meshes()[:1]), LOADS[:1]) for pad in (plain, cut))
    assert seen["penetration"].max() > 1e-3
    assert limited["penetration"].max().item() == pytest.approx(3e-4, rel=1e-3)
    assert torch.equal(limited["force_field"], seen["force_field"])
    levels = (cut.optics.levels + 0.5).to(torch.uint8)
    middle = (slice(100, 140), slice(140, 180))  # the plateau of what is pressed in deeper than the limit
    assert torch.equal(limited["rgb"][0][middle], levels[middle])
    assert not torch.equal(seen["rgb"][0][middle], levels[middle])


def test_the_picture_is_that_of_depth_at_every_pixel():
    """Depth is measured near the contact alone; edges and corners that lie between the cells are no exception."""
    shapes = [mesh and mesh.copy().apply_translation([1.3e-4, 2.1e-4, 0.0]) for mesh in meshes()]
    near, everywhere = pressed(shapes), pressed(shapes)
    everywhere.heights = lambda grid, window=None: MeshRays.heights(everywhere, grid)
    pictures = [TouchModel(CONFIG, 4, CPU, ("rgb",)).observe(depth, LOADS)["rgb"] for depth in (near, everywhere)]
    assert torch.equal(*pictures)


def test_only_what_is_asked_for_is_computed():
    depth = pressed(meshes()[:1])
    looked, heights = [], depth.heights
    depth.heights = lambda grid, window=None: (looked.append(len(grid)), heights(grid, window))[1]
    field = TouchModel(CONFIG, 1, CPU, ("force_field",)).observe(depth, LOADS[:1])
    assert field.keys() == {"force_field", "penetration"}
    assert looked == [69 * 91]  # cells, no pixels
    picture = TouchModel(CONFIG, 1, CPU, ("rgb",)).observe(depth, LOADS[:1])
    assert picture.keys() == {"rgb"}


def test_gel_and_light_are_drawn_anew_for_the_reset_pads_alone():
    drawn = {"stiffness": 0.3, "friction": 0.2, "gain": 0.2, "light_phase": 0.5}
    pads, others = (model(3, **{f"randomization.{name}": amount for name, amount in drawn.items()}) for _ in range(2))
    load, balls = LOADS[:1].repeat(3, 1), pressed([meshes()[0]] * 3)
    load[:, 0] = 9.0  # more shear than friction holds
    pads.reset(torch.tensor([1]), np.array([7]))
    seen, expected = pads.observe(balls, load), others.observe(balls, load)
    for name, values in seen.items():
        assert torch.equal(values[[0, 2]], expected[name][[0, 2]]), name
        assert not torch.allclose(values[1].double(), expected[name][1].double(), rtol=0.01), name


@pytest.mark.parametrize(("x", "y"), [(4e-3, 0.0), (-3e-3, 7e-3), (3e-3, -6e-3)])
def test_picture_and_force_field_show_a_touch_where_it_is(x, y, figure):
    """A ball of 10 mm that presses with 3 N at (x, y) of the pad frame, x along rows and y along columns."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.005).apply_translation([x, y, 0.005])
    load = torch.tensor([[0, 0, -3.0, -3.0 * y, 3.0 * x, 0]], dtype=torch.float64)
    seen = model(1).observe(pressed([ball]), load)
    flat = model(1).observe(pressed([None]), torch.zeros(1, 6, dtype=torch.float64))["rgb"]
    change = (seen["rgb"][0].double() - flat[0].double()).abs().sum(-1)
    change[change < 20] = 0.0  # grey levels, of all colours
    for name, shown, pitch in (
        ("TacRGB", change, CONFIG.pixel_size),
        ("TacFF", seen["force_field"][0, ..., 0].double(), CONFIG.taxel_pitch),
    ):
        rows, cols = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * pitch for n in shown.shape)
        centre = torch.stack([shown.sum(1) @ rows, shown.sum(0) @ cols]) / shown.sum()
        off = (centre - torch.tensor([x, y], dtype=torch.float64)).abs().max().item()
        figure(f"a touch in {name} beside where it is, mm", 1e3 * off, at_most=0.7)
