"""Tactile representations: they have the published sizes, images alone can train them, policies can use them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from baselines.common.encoders import TACRGB_ENCODERS, EncoderConfig, ObservationEncoder, load_pretrained
from baselines.common.memory import lay_out_channels_last
from baselines.common.observation import POSE, observation_spec
from baselines.common.recent_losses import TrainingError
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.tactile_representations import pretrain
from baselines.tactile_representations.anytouch import AnyTouch
from baselines.tactile_representations.encoder import RepresentationEncoder
from baselines.tactile_representations.pretrain import patch_discriminator
from baselines.tactile_representations.sparsh import Sparsh
from baselines.tactile_representations.t3 import T3
from baselines.tactile_representations.unit import UniT
from manifeel_ms3.demonstrations import DemonstrationError, read_header, record
from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from tests.tasks_and_marks import PEG

from .released_encoders import stand_ins
from .released_encoders.networks import small_anytouch, small_sparsh, small_t3, small_unit

SPEC = observation_spec("tacrgb", (), ("right",), 32)


def millions(module: torch.nn.Module) -> float:
    return sum(parameter.numel() for parameter in module.parameters()) / 1e6


def test_representations_have_the_published_sizes():
    with torch.device("meta"):
        assert millions(T3()) == pytest.approx(86, rel=0.02)
        assert millions(AnyTouch()) == pytest.approx(305, rel=0.02)
        assert millions(Sparsh()) == pytest.approx(86, rel=0.02)
        # the published 75 M are the VQGAN and the networks that judge it in training: VGG-16's convolutions, the discriminator
        judges = 14.71 + millions(patch_discriminator())
        assert millions(UniT().vqgan) + judges == pytest.approx(75, rel=0.02)


def test_released_unit_asks_for_its_own_architecture():
    with torch.device("meta"):
        weights = {name: torch.empty(shape) for name, shape in stand_ins.unit(attention=True).items()}
        with pytest.raises(CheckpointError, match="unit_released"):
            UniT().convert_state_dict(weights)


SMALL = dict(t3=(small_t3, 32), sparsh=(small_sparsh, 32), anytouch=(small_anytouch, 42), unit=(small_unit, 32))
"""Function that makes a small network, and side of its images in pixels, by the name of the representation."""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    """A trajectory file of TacRGB: dark spots on a bright gel."""
    y, x = np.mgrid[:48, :64]
    frames = [
        200 - 120 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 60)
        for cx, cy in np.random.default_rng(0).uniform([10, 10], [54, 38], (24, 2))
    ]
    touch = np.repeat(np.array(frames)[..., None], 3, -1).astype(np.uint8)
    return trajectory_file(tmp_path_factory.mktemp("touch"), tactile_right=touch)


def trajectory_file(folder: Path, **images: np.ndarray) -> Path:
    """A trajectory file of one episode with these images, by the names of the sensors, and a camera's."""
    path = folder / "trajectory.h5"
    with h5py.File(path, "w") as file:
        for sensor, frames in (images | dict(wrist=np.zeros((24, 8, 8, 3), np.uint8))).items():
            file[f"traj_0/obs/sensor_data/{sensor}/rgb"] = frames
    episode = dict(episode_id=0, episode_seed=0, elapsed_steps=23, success=True)
    path.with_suffix(".json").write_text(json.dumps(dict(env_info=dict(env_id=PEG, env_kwargs={}), episodes=[episode])))
    return path


@pytest.mark.parametrize("name", SMALL)
def test_pictures_alone_train_a_representation(name, pictures, tmp_path, monkeypatch):
    make, size = SMALL[name]
    monkeypatch.setitem(pretrain.REPRESENTATIONS, name, make)
    sizes = dict(image_size=size, batch_size=4, steps=20, lr=2e-3, adversary_from=17, log_freq=1)
    losses = trained(name, pictures, tmp_path / "weights.safetensors", **sizes)
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:3])
    fresh = RepresentationEncoder(make(), size, features=64)
    before = [parameter.clone() for parameter in fresh.parameters()]
    load_pretrained(torch.nn.Sequential(fresh), tmp_path / "weights.safetensors")
    assert any(not torch.equal(old, new) for old, new in zip(before, fresh.parameters(), strict=True))
    assert fresh(torch.zeros(2, 3, size, size)).shape == (2, 64)


def trained(name: str, demos: Path, out: Path, **settings) -> list[float]:
    return pretrain.main(pretrain.Args(name, (demos,), out=out, device="cpu", **settings))


def test_images_that_do_not_fit_are_named(pictures, tmp_path, monkeypatch):
    monkeypatch.setitem(pretrain.REPRESENTATIONS, "t3", small_t3)
    out = tmp_path / "weights.safetensors"
    with pytest.raises(DemonstrationError, match="hold no TacRGB"):
        trained("t3", trajectory_file(tmp_path), out)
    with pytest.raises(DemonstrationError, match=f"trajectory.h5 holds demonstrations of {PEG}, not of ManiFeel-NutBolt"):
        trained("t3", pictures, out, env_id="ManiFeel-NutBoltAssembly-v1")
    with pytest.raises(InvalidArgumentError, match="a multiple of 16, not 250; give --image-size 224"):
        trained("t3", pictures, out, image_size=250)
    with pytest.raises(InvalidArgumentError, match="--total-iters 0 must be at least 1"):
        trained("t3", pictures, out, steps=0)
    assert not out.exists()


def test_a_training_that_diverges_writes_no_weights(pictures, tmp_path, monkeypatch):
    make, size = SMALL["t3"]
    monkeypatch.setitem(pretrain.REPRESENTATIONS, "t3", make)
    out = tmp_path / "weights.safetensors"
    with pytest.raises(TrainingError, match=r"the loss of step \d+ is (nan|inf); lower --lr"):
        trained("t3", pictures, out, image_size=size, batch_size=4, steps=20, lr=1e30, log_freq=1)
    assert not out.exists()


def test_demonstrations_of_an_earlier_revision_of_the_task_are_refused(pictures, tmp_path):
    older = Path(shutil.copy(pictures, tmp_path / "older.h5"))
    header = json.loads(pictures.with_suffix(".json").read_text())
    older.with_suffix(".json").write_text(json.dumps(header | dict(revision=1)))
    with pytest.raises(DemonstrationError, match=r"older\.h5: .*revision 1"):
        trained("unit", older, tmp_path / "weights.safetensors", env_id=PEG)


def test_episodes_are_found_by_their_numbers(pictures, tmp_path):
    other = Path(shutil.copy(pictures, tmp_path / "trajectory.h5"))
    with h5py.File(other, "r+") as file:
        file.move("traj_0", "traj_7")
    other.with_suffix(".json").write_text(
        pictures.with_suffix(".json").read_text().replace('"episode_id": 0', '"episode_id": 7')
    )
    assert np.array_equal(pretrain.tacrgb_images([other], 32), pretrain.tacrgb_images([pictures], 32))


def test_a_recording_of_ours_is_of_its_task(tmp_path):
    sensing = dict(obs_mode="tacrgb", cameras=(), tactile_sensors=("right",))
    path = record.main(record.Args(PEG, 1, 1, 0, tmp_path / "peg.h5", **sensing, env_kwargs='{"fit": "paper"}'))
    assert len(pretrain.tacrgb_images([path], 32, PEG)) == read_header(path)["episodes"][0]["elapsed_steps"] + 1


def test_training_takes_the_size_and_the_statistics_of_the_images(pictures, tmp_path, monkeypatch):
    monkeypatch.setitem(pretrain.REPRESENTATIONS, "t3", small_t3)
    trained("t3", pictures, tmp_path / "weights.safetensors", env_id=PEG, steps=1, batch_size=1)
    (tmp_path / "weights.safetensors").rename(tmp_path / "weights.pt")  # a file's content says its format
    other = small_t3()
    other.load(tmp_path / "weights.pt")
    images = pretrain.tacrgb_images([pictures], T3.size) / 255
    assert torch.allclose(other.normalisation.mean, torch.as_tensor(images.mean((0, 1, 2)), dtype=torch.float32))
    assert torch.allclose(other.normalisation.std, torch.as_tensor(images.std((0, 1, 2)), dtype=torch.float32))


def observation() -> dict[str, torch.Tensor]:
    return {POSE: torch.rand(2, 1, 7), SPEC.images[0]: torch.randint(0, 255, (2, 1, 32, 32, 3), dtype=torch.uint8)}


@pytest.mark.parametrize("frozen", [True, False])
def test_a_frozen_representation_stays_as_it_was(frozen, monkeypatch):
    monkeypatch.setattr("baselines.tactile_representations.encoder.T3", small_t3)
    encoder = ObservationEncoder(EncoderConfig(tacrgb="t3", freeze_tacrgb=frozen), SPEC, 1)
    encoder(observation()).square().mean().backward()
    (network,) = encoder.images
    assert network.out.weight.grad is not None
    trained = [parameter for parameter in network.representation.parameters() if parameter.grad is not None]
    assert bool(trained) is not frozen


def test_settings_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(ValueError, match="a multiple of 16, not 30; give --tactile-image-size 224"):
        ObservationEncoder(EncoderConfig(tacrgb="sparsh"), replace(SPEC, tactile_image_size=30), 1)
    for setting in (dict(tacrgb_sensor="mini"), dict(freeze_tacrgb=True)):
        with pytest.raises(ValueError, match="'resnet18' has no pretrained weights"), torch.device("meta"):
            ObservationEncoder(EncoderConfig(**setting), SPEC, 1)
    with pytest.raises(ValueError, match=r"'gs_pink' is not a sensor of T3; choose from \['mini'"), torch.device("meta"):
        ObservationEncoder(EncoderConfig(tacrgb="t3", tacrgb_sensor="gs_pink"), SPEC, 1)
    with pytest.raises(ValueError, match="no network of this policy takes them"), torch.device("meta"):
        load_pretrained(ObservationEncoder(EncoderConfig(), SPEC, 1), tmp_path / "weights.safetensors")


@pytest.mark.parametrize("make", [small_t3, small_anytouch, small_sparsh, small_unit])
def test_all_that_a_policy_trains_has_a_gradient(make):
    """Several processes that train one policy wait for the gradient of every parameter."""
    network = make()
    encoder = RepresentationEncoder(network, network.size, 8)
    encoder(torch.rand(2, 3, network.size, network.size)).sum().backward()
    trained = {name: parameter.grad for name, parameter in encoder.named_parameters() if parameter.requires_grad}
    assert len(trained) > 4
    assert [name for name, gradient in trained.items() if gradient is None] == []


def test_a_frozen_unit_trains_its_head():
    encoder = RepresentationEncoder(SMALL["unit"][0](), 32, features=24)
    encoder.freeze()
    features = encoder(torch.rand(2, 3, 32, 32) * 2 - 1)
    assert features.shape == (2, 24)
    features.square().mean().backward()
    assert all(parameter.grad is not None for parameter in encoder.out.parameters())
    assert all(parameter.grad is None for parameter in encoder.representation.parameters())


@pytest.mark.parametrize("make", [T3, AnyTouch, Sparsh, UniT, lambda: UniT(attention=True)])
@pytest.mark.parametrize("size", [0, 250])
def test_the_advice_on_a_size_that_does_not_fit_can_be_followed(make, size):
    with torch.device("meta"):
        representation = make()
        with pytest.raises(InvalidArgumentError, match=f"not {size}; give --tactile-image-size") as caught:
            RepresentationEncoder(representation, size, features=512)
        advised = int(str(caught.value).rpartition(" ")[2])
        encoder = RepresentationEncoder(representation, advised, features=512)
        assert encoder(torch.zeros(2, 3, advised, advised)).shape == (2, 512)


def test_the_advice_on_a_crop_that_does_not_fit_can_be_followed():
    cropped = EncoderConfig(tacrgb="unit", tactile_crop=230)
    spec = replace(SPEC, tactile_image_size=256)
    with torch.device("meta"):
        with pytest.raises(
            InvalidArgumentError, match=r"not 230; give --tactile-image-size 256 --policy.encoder.tactile-crop 0$"
        ):
            ObservationEncoder(cropped, spec, 1)
        ObservationEncoder(replace(cropped, tactile_crop=0), spec, 1)
        with pytest.raises(InvalidArgumentError, match=r"needs an even number$"):  # no advice about the crop, which fits
            ObservationEncoder(replace(cropped, tacrgb="resnet18_keypoints", tactile_features=9), spec, 1)


def test_a_policy_takes_the_statistics_of_its_demonstrations_and_its_weights_keep_them(monkeypatch):
    monkeypatch.setattr("baselines.tactile_representations.encoder.T3", small_t3)
    config = DiffusionConfig(encoder=EncoderConfig(tacrgb="t3"), down_dims=(16, 32))
    policy, other = (DiffusionPolicy(config, SPEC, 6) for _ in range(2))
    images = torch.randint(0, 100, (5, 32, 32, 3), dtype=torch.uint8)
    policy.fit_normalizers({POSE: torch.rand(5, 7), SPEC.images[0]: images}, torch.rand(5, 6))
    other.load_state_dict(policy.state_dict())
    for fitted in (policy, other):
        (network,) = (module for module in fitted.modules() if isinstance(module, T3))
        assert torch.allclose(network.normalisation.mean, images.float().mean((0, 1, 2)) / 255)
        assert torch.allclose(network.normalisation.std, images.float().flatten(0, 2).std(0, correction=0) / 255)


@pytest.mark.parametrize("name", TACRGB_ENCODERS)
def test_every_network_of_touch_can_be_laid_out_for_training(name):
    with torch.device("meta"):
        encoder = TACRGB_ENCODERS[name](224, 512)
    lay_out_channels_last(encoder)  # weights of other ranks, such as those of video patches, stay as they are
    laid_out = [p.is_contiguous(memory_format=torch.channels_last) for p in encoder.parameters() if p.dim() == 4]
    assert all(laid_out)


def test_earlier_weights_stay_unless_they_are_to_be_overwritten(pictures, tmp_path, monkeypatch):
    monkeypatch.setitem(pretrain.REPRESENTATIONS, "t3", small_t3)
    out, short = tmp_path / "weights.safetensors", dict(steps=1, batch_size=1)
    trained("t3", pictures, out, **short)
    before = out.read_bytes()
    with pytest.raises(FileExistsAlreadyError, match="holds weights already; give another --out, or --overwrite"):
        trained("t3", pictures, out, seed=1, **short)
    assert out.read_bytes() == before
    trained("t3", pictures, out, seed=1, overwrite=True, **short)
    assert out.read_bytes() != before


@pytest.mark.parametrize(
    ("asked", "size"), [(dict(representation="t3"), 224), (dict(representation="unit", image_size=96), 96)]
)
def test_the_command_that_trains_a_policy_has_the_size_of_the_images(asked, size):
    args = pretrain.Args(demos=(), **asked)
    weights = f"{asked['representation']}.safetensors"
    said = pretrain.next_step(args, [])
    assert f"--tacrgb-weights {weights} --tactile-image-size {size}`" in said


def test_weights_that_would_replace_a_folder_are_refused_before_the_training(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is a folder; give the path of a file"):
        pretrain.main(pretrain.Args("unit", (tmp_path / "not_read.h5",), out=tmp_path))
