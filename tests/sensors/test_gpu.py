"""Ray casting and the touch model on CUDA agree with the CPU."""

import torch

from manifeel_ms3.sensors import with_options
from manifeel_ms3.sensors.depth.raycast import MeshRays
from manifeel_ms3.sensors.touch_model import TouchModel, pixel_grid
from tests.sensors.pads import CONFIG, EVERYTHING, LOADS, meshes
from tests.tasks_and_marks import ON_GPU

pytestmark = ON_GPU


def rays(device: str) -> MeshRays:
    return MeshRays([meshes()], CONFIG.gel.size, torch.device(device))


def observe(device: str, steps: int = 1, **options) -> dict[str, torch.Tensor]:
    model = TouchModel(with_options(CONFIG, options), len(LOADS), torch.device(device))
    model.reset(torch.arange(len(LOADS), device=device), torch.arange(len(LOADS)).numpy())
    for _ in range(steps):
        obs = model.observe(rays(device), LOADS.to(device))
    return {name: value.cpu() for name, value in obs.items()}


def test_heights_agree_within_a_micrometre():
    heights = [rays(device).heights(pixel_grid(CONFIG, torch.device(device))).cpu() for device in ("cpu", "cuda")]
    off = (heights[0] - heights[1]).abs()
    assert (off > 1e-6).float().mean() < 1e-3  # a ray that grazes an edge may hit on one device and miss on the other


def test_velocities_agree():
    velocities = []
    for device in ("cpu", "cuda"):
        twist = torch.tensor([0.01, -0.02, 0.0, 0.0, 0.0, 0.5], device=device).expand(len(LOADS), 1, 6)
        velocities.append(rays(device).sliding(pixel_grid(CONFIG, torch.device(device)), twist)[1].cpu())
    off = (velocities[0] - velocities[1]).abs().amax(-1)
    assert (off > 1e-6).float().mean() < 1e-3


def test_force_fields_with_a_history_agree():
    cpu, cuda = observe("cpu", steps=3), observe("cuda", steps=3)
    assert (cpu["force_field"] - cuda["force_field"]).abs().max() < 1e-4  # N per taxel
    assert (cpu["penetration"] - cuda["penetration"]).abs().max() < 1e-6  # m


def test_images_agree_within_a_grey_level():
    cpu, cuda = (observe(device, **EVERYTHING)["rgb"].int() for device in ("cpu", "cuda"))
    assert ((cpu - cuda).abs() > 1).float().mean() < 1e-3


def test_noise_agrees():
    cpu, cuda = (observe(device, **{"optics.noise": 3.0})["rgb"].int() for device in ("cpu", "cuda"))
    assert ((cpu - cuda).abs() > 1).float().mean() < 1e-3


def test_partial_reset_clears_the_shear_of_these_pads_alone():
    model = TouchModel(CONFIG, len(LOADS), torch.device("cuda"))
    model.observe(rays("cuda"), LOADS.cuda())
    before = model._bristle.clone()
    model.reset(torch.tensor([2], device="cuda"), torch.tensor([5]).numpy())
    assert (model._bristle[2] == 0).all()
    assert torch.equal(model._bristle[[0, 1, 3]], before[[0, 1, 3]])


def test_same_history_gives_the_same_output_bit_for_bit():
    runs = [observe("cuda", steps=2, **EVERYTHING, **{"optics.noise": 2.0}) for _ in range(2)]
    for name, value in runs[0].items():
        assert torch.equal(value, runs[1][name]), name
