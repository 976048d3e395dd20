"""Gel mechanics against closed forms."""

import math

import pytest
import torch

from manifeel_ms3.sensors.config import GelConfig
from manifeel_ms3.sensors.mechanics.contact import ContactGrid, depth_below_face, solve_indentation, solve_shear
from manifeel_ms3.sensors.mechanics.taxels import Taxels, tacsl_field

GEL = GelConfig()
GRID = ContactGrid.covering(GEL.size, 3.5e-4, torch.device("cpu"))
K = GEL.normal_stiffness


def sphere(radius: float, x: float = 0.0, y: float = 0.0, gap: float = 0.0) -> torch.Tensor:
    """Height (1, C) of a ball whose lowest point is `gap` above the face at (x, y)."""
    r2 = (GRID.x - x) ** 2 + (GRID.y - y) ** 2
    return torch.where(r2 < radius**2, (radius**2 - r2).clamp(min=0).sqrt() - radius - gap, torch.full_like(r2, -5e-3))[
        None
    ].float()


def wrench(normal: float, x: float = 0.0, y: float = 0.0, fx: float = 0.0, fy: float = 0.0, mz: float = 0.0) -> torch.Tensor:
    """Wrench (1, 6) of a normal load that acts at (x, y), and of shear."""
    return torch.tensor([[fx, fy, -normal, -normal * y, normal * x, mz]], dtype=torch.float64)


def pressure(height: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
    return depth_below_face(height.double(), indent(height, load), GRID.x, GRID.y).clamp(min=0) * K * GRID.area


def indent(height: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
    return solve_indentation(height, load, GRID, torch.full((len(load),), K, dtype=torch.float64))


def slide(bristle: torch.Tensor, field: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
    ones = torch.ones(len(load), dtype=torch.float64)
    return solve_shear(bristle, field, load, GRID, GEL.shear_stiffness * ones, GEL.friction * ones)


@pytest.mark.parametrize("force", [1.0, 3.0, 10.0])
def test_sphere_on_winkler_layer_sinks_as_the_closed_form(force):
    radius = 0.02
    plane = indent(sphere(radius), wrench(force))
    depth = plane[0, 0].item()
    assert math.pi * K * depth**2 * (radius - depth / 3) == pytest.approx(force, rel=5e-3)  # K times the cap's volume


@pytest.mark.parametrize("gap", [-1e-3, 0.0, 1e-3])
def test_depth_follows_the_force_and_not_where_the_engine_has_the_object(gap):
    field = pressure(sphere(0.01, gap=gap), wrench(5.0))
    assert torch.allclose(field, pressure(sphere(0.01), wrench(5.0)), atol=1e-9)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (4e-3, -6e-3), (-7e-3, 9e-3)])
def test_pressure_carries_the_normal_force_where_it_acts(x, y):
    field = pressure(sphere(0.006, x, y), wrench(3.0, x, y))
    assert field.sum().item() == pytest.approx(3.0, rel=1e-3)
    assert (field * GRID.x).sum().item() / 3.0 == pytest.approx(x, abs=2e-4)
    assert (field * GRID.y).sum().item() / 3.0 == pytest.approx(y, abs=2e-4)


def test_moment_tilts_a_flat_object():
    flat = torch.zeros(1, len(GRID.x))
    field = pressure(flat, wrench(10.0, y=1e-3))
    assert (field * GRID.y).sum().item() / 10.0 == pytest.approx(1e-3, abs=1e-5)


@pytest.mark.parametrize(("about", "arm"), [(3, 0.0144), (4, 0.0108)])
def test_a_face_tilts_by_five_degrees_at_most_and_still_carries_the_force(about, arm):
    """A load so near the gel's edge that a plate would have to tilt by half a radian: its moment comes from elsewhere."""
    flat, load = torch.zeros(1, len(GRID.x)), wrench(10.0)
    load[0, about] = 10.0 * arm
    assert indent(flat, load)[0, 1:].abs().amax().item() <= 0.087 + 1e-9
    assert pressure(flat, load).sum().item() == pytest.approx(10.0, rel=1e-6)


def test_untouched_pad_has_no_pressure():
    assert pressure(sphere(0.01, gap=1e-3), wrench(0.0)).abs().max() == 0
    assert pressure(sphere(0.01, gap=4e-3), wrench(5.0)).abs().max() == 0  # a force from elsewhere is not put on the gel


def shear_of_loads(field: torch.Tensor, loads: list[torch.Tensor]) -> list[torch.Tensor]:
    bristle, out = torch.zeros(1, field.shape[1], 2, dtype=torch.float64), []
    for load in loads:
        q = slide(bristle, field, load)
        bristle = q / (GEL.shear_stiffness * GRID.area)
        out.append(q)
    return out


@pytest.mark.parametrize("load", [(1.0, 0.0, 0.0), (-2.0, 3.0, 0.0), (0.5, 0.5, 4e-3), (0.0, 0.0, -6e-3)])
def test_shear_sums_to_the_measured_shear_and_twist(load):
    fx, fy, mz = load
    field = pressure(sphere(0.02), wrench(8.0))
    (q,) = shear_of_loads(field, [wrench(8.0, fx=fx, fy=fy, mz=mz)])
    assert q[..., 0].sum().item() == pytest.approx(fx, abs=0.01)
    assert q[..., 1].sum().item() == pytest.approx(fy, abs=0.01)
    assert (GRID.x * q[..., 1] - GRID.y * q[..., 0]).sum().item() == pytest.approx(mz, abs=4e-5)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 2.0])
def test_coulombs_cone_is_never_violated(share):
    field = pressure(sphere(0.02), wrench(8.0))
    (q,) = shear_of_loads(field, [wrench(8.0, fx=share * 8.0 * GEL.friction)])
    assert (torch.linalg.norm(q, dim=-1) <= GEL.friction * field + 1e-9).all()


@pytest.mark.parametrize("share", [0.12, 0.5, 0.8, 0.95])
def test_stick_fraction_of_a_pressed_sphere(share):
    """On a Winkler paraboloid slip starts at the rim: stuck share of the area = sqrt(1 - Q / mu P)."""
    field = pressure(sphere(0.02), wrench(8.0))
    (q,) = shear_of_loads(field, [wrench(8.0, fx=share * 8.0 * GEL.friction)])
    touching = field > 0
    sticking = touching & (torch.linalg.norm(q, dim=-1) < 0.9999 * GEL.friction * field)
    assert (sticking.sum() / touching.sum()).item() == pytest.approx(math.sqrt(1 - share), abs=0.02)


def test_load_and_unload_dissipate_and_held_load_keeps_its_field():
    field = pressure(sphere(0.02), wrench(8.0))
    up = [wrench(8.0, fx=f) for f in (2.0, 4.0, 6.0)]
    held = [wrench(8.0, fx=6.0)] * 20
    back = [wrench(8.0, fx=f) for f in (4.0, 2.0, 0.0)]
    q = shear_of_loads(field, up + held + back)
    assert torch.allclose(q[2], q[22], atol=1e-6)  # 20 more calls at the same load
    assert (q[1][..., 0] - q[23][..., 0]).abs().max() > 1e-4  # 4 N on the way back is another field than on the way up
    assert q[-1][..., 0].abs().max() > 1e-4  # and at no load some stays locked in


def test_twist_gives_an_antisymmetric_swirl():
    field = pressure(sphere(0.02), wrench(8.0))
    (q,) = shear_of_loads(field, [wrench(8.0, mz=5e-3)])
    grid = q.view(*GRID.shape, 2)
    assert torch.allclose(grid, -grid.flip(0, 1), atol=1e-5)


def test_lost_contact_forgets_its_shear():
    field = pressure(sphere(0.02), wrench(8.0))
    (loaded,) = shear_of_loads(field, [wrench(8.0, fx=4.0)])
    bristle = loaded / (GEL.shear_stiffness * GRID.area)
    released = slide(bristle, torch.zeros_like(field), wrench(0.0))
    assert released.abs().max() == 0


def test_rows_of_a_batch_are_independent():
    heights = torch.cat([sphere(r, x) for r, x in ((0.01, 0.0), (0.02, 2e-3), (0.005, -4e-3))])
    loads = torch.cat([wrench(1.0, fx=0.3), wrench(10.0, 2e-3, fy=-2.0), wrench(0.0)])
    field = pressure(heights, loads)
    shear = slide(torch.zeros(*field.shape, 2, dtype=torch.float64), field, loads)
    for i in range(3):
        alone = pressure(heights[i : i + 1], loads[i : i + 1])
        assert torch.allclose(field[i], alone[0], atol=1e-12)
        q = slide(torch.zeros(*alone.shape, 2, dtype=torch.float64), alone, loads[i : i + 1])
        assert torch.allclose(shear[i], q[0], atol=1e-12)


TAXELS = Taxels(GRID, (10, 14), 1.634e-3)
MU = torch.tensor([GEL.friction], dtype=torch.float64)


def test_taxels_own_the_whole_gel():
    ones = torch.ones(1, len(GRID.x), 1, dtype=torch.float64)
    shares = TAXELS.add_up(ones)
    assert shares.sum().item() == pytest.approx(len(GRID.x))
    assert (shares > 0).all()
    assert shares[0, 0, 0].item() > 2 * shares[0, 5, 5].item()  # a corner taxel owns the gel beyond it, too


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (9e-3, 0.0), (-9e-3, 13e-3)])
def test_taxels_keep_the_moment_about_the_normal_even_beyond_their_centres(x, y):
    """A flat-ended post, 6 mm wide, that twists; its outer part lies beyond the outermost taxel centres."""
    post = torch.where(((GRID.x - x).abs() < 3e-3) & ((GRID.y - y).abs() < 3e-3), 0.0, -5e-3)[None].float()
    load = wrench(10.0, x, y, fx=2.0, fy=-1.0, mz=(-x - 2 * y) + 4e-3)
    field = pressure(post, load)
    (q,) = shear_of_loads(field, [load])
    forces = TAXELS.forces(field, q, MU)
    at = TAXELS.centres
    moment = (at[..., 0] * forces[0, ..., 2] - at[..., 1] * forces[0, ..., 1]).sum()
    assert moment.item() == pytest.approx((GRID.x * q[..., 1] - GRID.y * q[..., 0]).sum().item(), rel=0.01, abs=2e-5)
    assert forces.sum((0, 1, 2)).tolist() == pytest.approx([10.0, 2.0, -1.0], rel=0.01)
    assert (torch.linalg.norm(forces[..., 1:], dim=-1) <= GEL.friction * forces[..., 0] + 1e-9).all()


def test_a_twist_that_slips_costs_little_of_the_shear():
    """A plate under a twist near what friction holds: taxels at the cone's edge are cut, and the sums lose some shear."""
    face = torch.where((GRID.x.abs() < 10e-3) & (GRID.y.abs() < 15e-3), 0.0, -5e-3)[None].float()
    load = wrench(20.0, fx=2.7, fy=-0.6, mz=-0.15)
    field = pressure(face, load)
    (q,) = shear_of_loads(field, [load])
    assert q.sum(1)[0].tolist() == pytest.approx([2.7, -0.6], abs=1e-6)
    off = (TAXELS.forces(field, q, MU).sum((0, 1, 2)) - torch.tensor([20.0, 2.7, -0.6])) / 20.0
    assert off[0].item() == pytest.approx(0.0, abs=1e-9)
    assert 0.001 < torch.linalg.norm(off[1:]).item() < 0.03


def test_tacsl_field_is_penetration_and_bounded_speed():
    """f_n = d, f_t = -min(0.1 |v|, 2 d) v / |v| (Akinola et al. 2024, with the gains of the paper's public code)."""
    depth = torch.tensor([[1e-3, 1e-4, 0.0]])
    velocity = torch.tensor([[[0.003, -0.004], [0.03, 0.04], [1.0, 0.0]]])
    field = tacsl_field(depth, velocity)[0]
    assert field[0].tolist() == pytest.approx([1e-3, -3e-4, 4e-4])
    assert field[1].tolist() == pytest.approx([1e-4, -2e-4 * 0.6, -2e-4 * 0.8])
    assert field[2].tolist() == [0.0, 0.0, 0.0]
