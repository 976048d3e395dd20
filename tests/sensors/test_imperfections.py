"""Each imperfection does what its field says, and nothing else."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.integrate import trapezoid

from manifeel_ms3.sensors import ImperfectionConfig, gelsight_r15, sensor_config, with_options
from manifeel_ms3.sensors.depth.raycast import MeshRays
from manifeel_ms3.sensors.draws import pad_seeds, uniform_draws
from manifeel_ms3.sensors.imperfections import Imperfections
from manifeel_ms3.sensors.touch_model import OUTPUTS, TouchModel

CPU = torch.device("cpu")
TAXELS = (10, 14)
FIELD = ("force_field",)


def plate() -> trimesh.Trimesh:
    return trimesh.creation.box([0.010, 0.014, 0.01]).apply_translation([0, 0, 0.005])


class Pad:
    """One pad, or several, under a plate."""

    def __init__(self, outputs=FIELD, seeds=(0,), units="newton", **amounts):
        config = sensor_config("gelsight_r15", "a", "b", imperfections=ImperfectionConfig(**amounts), units=units)
        self.model = TouchModel(config, len(seeds), CPU, outputs)
        self.rays = MeshRays([[plate()] * len(seeds)], config.gel.size, CPU)
        self.count = len(seeds)
        self.reset(seeds)

    def reset(self, seeds):
        self.model.reset(torch.arange(len(seeds)), np.array(seeds))

    def under(self, load: float, rows: float = 0.0, pads: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        wrench = torch.tensor([[rows, 0, -load, 0, 0, 0]], dtype=torch.float64)
        return self.model.observe(self.rays, wrench.repeat(self.count, 1), pads)

    def field(self, load: float, rows: float = 0.0) -> np.ndarray:
        return self.under(load, rows)["force_field"].double().numpy()

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        return {name: values.numpy() for name, values in self.model.drawn_imperfections.items()}


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_area_of_the_loading_loop(share):
    pad, loads = Pad(hysteresis=share), np.linspace(0.0, 10.0, 101)
    up = [pad.field(load)[0, ..., 0].sum() for load in loads]
    down = [pad.field(load)[0, ..., 0].sum() for load in loads[::-1]][::-1]
    area = [trapezoid(curve, loads) for curve in (up, down)]
    assert (area[1] - area[0]) / area[0] == pytest.approx(share, abs=0.01)
    assert up == pytest.approx(loads, abs=1e-6)
    assert down[0] == pytest.approx(0.0, abs=1e-6)


def test_hysteresis_keeps_shear_in_proportion_and_the_gel_pressed_in():
    pad, perfect = Pad(OUTPUTS, hysteresis=0.4), Pad(OUTPUTS)
    for one in (pad, perfect):
        one.under(10.0, 2.0)
    late, now = pad.under(6.5, 2.0), perfect.under(6.5, 2.0)
    ratio = late["force_field"].sum((1, 2)) / now["force_field"].sum((1, 2))
    assert ratio[0, 0].item() == pytest.approx(10 / 6.5, rel=1e-4)
    assert ratio[0, 1].item() == pytest.approx(10 / 6.5, rel=1e-3)
    at_most = Pad(OUTPUTS).under(10.0, 2.0)["rgb"]
    assert (late["rgb"] == at_most).float().mean() > 0.99  # of the picture under 10 N


def test_delay_in_steps_for_all_outputs():
    pad, perfect = Pad(OUTPUTS, delay=3), Pad(OUTPUTS)
    loads = [2.0, 3.0, 5.0, 8.0, 1.0, 4.0]
    late, now = [pad.under(load) for load in loads], [perfect.under(load) for load in loads]
    for t in range(len(loads)):
        for name, value in late[t].items():
            assert torch.equal(value, now[max(t - 3, 0)][name]), (name, t)


def test_drift_and_delay_count_the_ends_of_steps():
    """However often the observation of a step is asked for."""
    config = sensor_config("gelsight_r15", "a", "b", imperfections=ImperfectionConfig(delay=1, drift=0.2))
    sensed, nothing = Imperfections(config, 1, CPU), torch.zeros(1, *TAXELS, 3)
    for _ in range(3):
        assert not sensed.sense_forces(nothing).any()
        sensed.delayed(dict(force_field=nothing))
    sensed.end_step()
    for _ in range(3):
        assert sensed.sense_forces(nothing).any()
        assert not sensed.delayed(dict(force_field=nothing + 1.0))["force_field"].any()
    sensed.end_step()
    assert sensed.delayed(dict(force_field=nothing))["force_field"].eq(1.0).all()


def test_delay_may_differ_from_pad_to_pad():
    pads = Pad(seeds=range(40), delay=(0, 2))
    assert set(pads.drawn["delay"]) == {0, 1, 2}
    for load in (1.0, 2.0, 3.0):
        seen = pads.field(load)[..., 0].sum((1, 2))
    assert seen == pytest.approx(3.0 - pads.drawn["delay"], rel=1e-4)


def test_crosstalk_gives_neighbours_their_share_and_keeps_the_sum():
    pad, true = Pad(crosstalk=0.2), Pad().field(5.0, 1.0)[0]
    read = pad.field(5.0, 1.0)[0]
    expected = np.zeros_like(true)
    for i, j in np.ndindex(*TAXELS):
        beside = [(i + a, j + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)) if 0 <= i + a < 10 and 0 <= j + b < 14]
        expected[i, j] += (1 - 0.05 * len(beside)) * true[i, j]
        for place in beside:
            expected[place] += 0.05 * true[i, j]
    assert read == pytest.approx(expected, abs=1e-6)
    assert read.sum((0, 1)) == pytest.approx(true.sum((0, 1)), rel=1e-5)


def test_dead_taxels_say_nothing_in_any_state():
    pad, true = Pad(dead_taxels=0.25, noise=0.1), Pad().field(5.0)
    dead = pad.drawn["dead_taxels"][0]
    assert dead.sum() == round(0.25 * 140)
    for load in (0.0, 5.0, 20.0):
        seen = pad.under(load)
        assert (seen["force_field"][0][dead] == 0).all()
        assert (seen["penetration"][0][dead] == 0).all()
    expected = Pad().under(20.0)["penetration"][0]
    assert (expected[dead] > 0).any()
    assert torch.equal(seen["penetration"][0][~dead], expected[~dead])  # noise does not act on it
    assert Pad(dead_taxels=0.25).field(5.0)[0][~dead] == pytest.approx(true[0][~dead])


def test_gain_is_that_of_the_taxel():
    pad, true = Pad(gain=0.3), Pad().field(5.0, 1.0)[0]
    gain = pad.drawn["gain"][0]
    assert pad.field(5.0, 1.0)[0] == pytest.approx(gain[..., None] * true, abs=1e-6)
    assert np.abs(gain - 1).max() <= 0.3
    assert gain.std() == pytest.approx(0.3 / np.sqrt(3), rel=0.15)


def test_drift_grows_steadily_in_force_and_colour():
    pad, perfect = Pad(OUTPUTS, drift=0.2), Pad(OUTPUTS)
    seen = [pad.under(0.0) for _ in range(51)]
    flat = perfect.under(0.0)["rgb"].float()
    rate = 0.6 / 100 * pad.drawn["drift_force"][0]  # N a step
    for t in (0, 25, 50):
        assert seen[t]["force_field"][0].numpy() == pytest.approx(t * rate, abs=1e-6)
        colour = (seen[t]["rgb"].float() - flat).mean((0, 1, 2)).numpy()
        assert colour == pytest.approx(t * 2.55 * pad.drawn["drift_colour"][0], abs=0.6)  # rounded to grey levels
    assert np.abs(pad.drawn["drift_force"]).max() <= 0.2
    assert np.abs(pad.drawn["drift_force"]).max() > 0.19


def test_noise_is_seeded_and_as_large_as_asked():
    pad = Pad(OUTPUTS, noise=0.02, seeds=(3, 4))
    true = Pad(OUTPUTS).under(8.0)
    first, second = pad.under(8.0), pad.under(8.0)
    noise = (torch.stack([first["force_field"], second["force_field"]]) - true["force_field"]).numpy()
    assert noise.std() == pytest.approx(0.02 * 0.6, rel=0.06)
    assert (first["rgb"].float() - true["rgb"].float()).std().item() == pytest.approx(0.02 * 255, rel=0.03)
    assert np.abs(np.corrcoef(noise.reshape(4, -1)) - np.eye(4)).max() < 0.2  # pads and steps are independent
    pad.reset((3, 4))
    assert torch.equal(pad.under(8.0)["force_field"], first["force_field"])


def test_noise_with_the_papers_units_is_a_share_of_the_greatest_penetration():
    pad = Pad(units="tacsl", noise=0.05)
    pad.rays.sliding = lambda grid, twist=None: (torch.full((1, len(grid)), -5e-3), torch.zeros(1, len(grid), 2))
    assert pad.field(0.0).std() == pytest.approx(0.05 * 2e-3, rel=0.1)


def test_an_episode_draws_its_own_amounts_from_its_seed():
    amounts = dict(hysteresis=(0.1, 0.3), crosstalk=(0.0, 0.4), noise=(0.01, 0.02), dead_taxels=(0.0, 0.5), gain=0.2, drift=0.1)
    drawn = Pad(seeds=range(200), **amounts).drawn
    for name in ("hysteresis", "crosstalk", "noise"):
        low, high = amounts[name]
        assert low <= drawn[name].min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < drawn[name].max() <= high
    again = Pad(seeds=(7,), **amounts).drawn
    for name, values in again.items():
        assert np.array_equal(values[0], drawn[name][7]), name
        if name != "delay":
            assert not np.array_equal(drawn[name][6], drawn[name][7]), name


def test_streams_and_seeds_of_draws_are_independent():
    draws = np.stack([uniform_draws(np.arange(2000), stream, 1)[:, 0] for stream in (0, 1, 16)])
    assert np.abs(np.corrcoef(draws) - np.eye(3)).max() < 0.1
    assert np.abs(np.corrcoef(draws[:, 1:], draws[:, :-1]) - np.eye(6)).max() < 0.1


def test_no_two_episodes_of_any_seed_and_pad_draw_alike():
    seeds, episodes = (grid.ravel() for grid in np.meshgrid(np.arange(100), np.arange(50)))
    drawn = [pad_seeds(seeds, episodes, pad) for pad in ("tactile_right", "tactile_left")]
    assert len(np.unique(drawn)) == 2 * len(seeds)
    assert np.array_equal(pad_seeds(np.arange(100), np.zeros(100, int), "tactile_right"), np.arange(100))


def test_reset_forgets_in_the_reset_pads_alone():
    pads = Pad(seeds=(0, 1), hysteresis=0.5, delay=1)
    for load in (8.0, 8.0):
        pads.field(load)
    pads.model.reset(torch.tensor([1]), np.array([5]))
    read = pads.field(2.0)[..., 0].sum((1, 2))
    assert read == pytest.approx([8.0, 2.0], rel=1e-4)  # the first is late, and the second begins
    assert pads.field(2.0)[..., 0].sum((1, 2)) == pytest.approx([4.0, 2.0], rel=1e-4)


def test_drift_counts_the_steps_of_each_pads_own_episode():
    pads = Pad(seeds=(0, 1), drift=0.2)
    for _ in range(10):
        pads.field(0.0)
    pads.model.reset(torch.tensor([0]), np.array([0]))
    first, second = np.abs(pads.field(0.0)).max((1, 2, 3))
    assert first == 0.0
    assert second > 0.0


def test_the_noise_of_the_camera_and_that_of_the_imperfections_add_up_as_independent_ones_do():
    config = with_options(gelsight_r15("a", "b"), {"optics.noise": 3.0, "imperfections.noise": 0.02})
    noisy, clean = (TouchModel(one, 1, CPU, ("rgb",)) for one in (config, gelsight_r15("a", "b")))
    nothing = MeshRays([[None]], config.gel.size, CPU), torch.zeros(1, 6, dtype=torch.float64)
    difference = noisy.observe(*nothing)["rgb"].float() - clean.observe(*nothing)["rgb"].float()
    assert difference.std().item() == pytest.approx(np.hypot(3.0, 0.02 * 255), rel=0.03)


EVERYTHING = dict(hysteresis=0.3, delay=(0, 3), noise=0.02, drift=0.2, crosstalk=0.1, gain=0.1, dead_taxels=0.1)


@pytest.mark.parametrize("amounts", [{}, EVERYTHING], ids=["perfect", "imperfect"])
def test_a_pad_that_is_not_read_keeps_its_last_reading_and_all_that_it_remembers(amounts):
    pads, alone = (Pad(OUTPUTS, seeds=(3, 4, 5), **amounts) for _ in range(2))
    loads = [(8.0, 3.0), (5.0, 1.0), (6.0, 2.0), (3.0, -1.0), (4.0, 1.0)]
    for t, load in enumerate(loads):
        seen, expected = pads.under(*load), alone.under(*load)
        assert all(torch.equal(value[[0, 2]], expected[name][[0, 2]]) for name, value in seen.items()), t
        if t == 1:  # the episode of one pad begins anew
            pads.model.reset(torch.tensor([1]), np.array([7]))
            for rows in (-2.0, 0.5):
                kept = pads.under(9.0, rows, pads=torch.tensor([1]))
            assert all(torch.equal(value[[0, 2]], seen[name][[0, 2]]) for name, value in kept.items())
            assert not torch.equal(kept["force_field"][1], seen["force_field"][1])


def test_a_pad_that_is_not_yet_read_remembers_nothing():
    """The first reading of all is that of one pad, under a load that the other one never sees."""
    pads, fresh = (Pad(("rgb",), seeds=(3, 4), hysteresis=0.5) for _ in range(2))
    pads.under(8.0, pads=torch.tensor([1]))
    assert torch.equal(pads.under(5.0)["rgb"][0], fresh.under(5.0)["rgb"][0])


def test_info_says_what_an_episode_drew(make_env):
    options = dict(obs_mode="tacff", render_backend="none", imperfections=dict(gain=(0.0, 0.2), delay=(0, 2), dead_taxels=0.1))
    env = make_env(**options)
    _, info = env.reset(seed=3)
    drawn = info["imperfections"]["tactile_right"]
    assert drawn["dead_taxels"].sum().item() == 14
    own = ImperfectionConfig(**options["imperfections"]).draw(np.array([3]), TAXELS)  # of the right pad, from the seed itself
    assert np.array_equal(drawn["gain"].numpy(), own["gain"])
    obs, _, _, _, later = env.step(np.zeros(6))
    assert torch.equal(later["imperfections"]["tactile_right"]["gain"], drawn["gain"])
    assert (obs["sensor_data"]["tactile_right"]["force_field"][0][drawn["dead_taxels"][0]] == 0).all()
    assert torch.equal(env.reset(seed=3)[1]["imperfections"]["tactile_right"]["gain"], drawn["gain"])
    assert not torch.equal(env.reset(seed=4)[1]["imperfections"]["tactile_right"]["gain"], drawn["gain"])
    assert "imperfections" not in make_env(obs_mode="tacff", render_backend="none").reset(seed=0)[1]
