"""The networks that encode images, force fields and the pose."""

import pytest
import torch

from baselines.common.encoders import EncoderConfig, ObservationEncoder, ResNet18
from baselines.common.images import cropped, network_images
from baselines.common.observation import POSE, observation_spec
from manifeel_ms3.errors import InvalidArgumentError


@pytest.mark.parametrize(("name", "least"), [("image_features", 1), ("tactile_features", 1), ("crop", 0)])
def test_sizes_that_no_encoder_can_have_are_refused(name, least):
    with pytest.raises(InvalidArgumentError, match=f"{name}={least - 1} must be at least {least}"):
        EncoderConfig(**{name: least - 1})


def test_resnet18_has_group_norm_and_the_published_size():
    net = ResNet18()
    assert not any(isinstance(m, torch.nn.modules.batchnorm._BatchNorm) for m in net.modules())
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(11.2e6, rel=0.01)


@pytest.mark.parametrize("name", ["resnet18", "small"])
def test_encoder_sees_every_modality(name):
    spec = observation_spec("rgb+tacff", ("wrist",), ("right",), 64)
    image = "resnet18" if name == "resnet18" else "small_cnn"
    encoder = ObservationEncoder(EncoderConfig(image=image, image_features=32, force_field=name), spec, 2).eval()
    torch.manual_seed(0)
    obs = {
        spec.images[0]: torch.randint(0, 255, (2, 2, 64, 64, 3), dtype=torch.uint8),
        spec.force_fields[0]: torch.rand(2, 2, 10, 14, 3),
        POSE: torch.rand(2, 2, 7),
    }
    features = encoder(obs)
    assert features.shape == (2, encoder.out_features)
    for key in obs:
        changed = encoder(obs | {key: obs[key].flip(2)})
        assert not torch.allclose(changed, features)
    drawn_back = encoder(obs | {spec.force_fields[0]: -obs[spec.force_fields[0]]})
    assert not torch.allclose(drawn_back, features)
    alone = encoder({key: values[1:] for key, values in obs.items()})
    torch.testing.assert_close(features[1:], alone, rtol=1e-4, atol=1e-5)
    first, second = features.view(2, 2, -1).unbind(1)  # the steps of a window, in their order
    swapped = encoder({key: values.flip(1) for key, values in obs.items()}).view(2, 2, -1)
    torch.testing.assert_close(swapped, torch.stack([second, first], 1), rtol=1e-4, atol=1e-5)


def test_crops_are_random_in_training_and_central_in_evaluation():
    images = torch.randint(0, 255, (4, 2, 64, 64, 3), dtype=torch.uint8)
    images[:, 1] = images[:, 0]
    central = cropped(images, 48, at_random=False)
    assert torch.equal(central, images[:, :, 8:56, 8:56])
    crops = cropped(images, 48, at_random=True)
    assert crops.shape == (4, 2, 48, 48, 3)
    assert torch.equal(crops[:, 0], crops[:, 1])  # the same over a window
    assert not torch.equal(crops, central)
    windows = images[0, 0].unfold(0, 48, 1).unfold(1, 48, 1).permute(0, 1, 3, 4, 2).reshape(-1, 48, 48, 3)
    assert (windows == crops[0, 0]).flatten(1).all(1).any()


def test_random_crops_reach_all_borders_along_each_axis_by_itself():
    images = torch.arange(36, dtype=torch.uint8).view(1, 1, 6, 6, 1).expand(300, 1, 6, 6, 3)
    torch.manual_seed(0)
    corners = cropped(images, 4, at_random=True)[:, 0, 0, 0, 0]
    assert sorted(set(corners.tolist())) == [0, 1, 2, 6, 7, 8, 12, 13, 14]


def test_an_encoder_crops_at_random_in_training_and_in_the_centre_in_evaluation():
    spec, small = (observation_spec("rgb", ("wrist",), (), size) for size in (32, 24))
    config = dict(image="small_cnn", image_features=8)
    encoder = ObservationEncoder(EncoderConfig(**config, crop=24), spec, 1)
    alike = ObservationEncoder(EncoderConfig(**config), small, 1)  # takes images that are cropped already
    alike.load_state_dict(encoder.state_dict())
    torch.manual_seed(0)
    images, poses = torch.randint(0, 255, (6, 1, 32, 32, 3), dtype=torch.uint8), torch.zeros(6, 1, 7)
    expected = alike({spec.images[0]: images[:, :, 4:28, 4:28], POSE: poses})
    observed = {spec.images[0]: images, POSE: poses}
    torch.testing.assert_close(encoder.eval()(observed), expected)
    first, second = (encoder.train()(observed) for _ in range(2))
    assert not torch.allclose(first, second)


def test_networks_take_colours_in_their_order_from_minus_one_to_one():
    images = torch.zeros(2, 1, 20, 30, 3, dtype=torch.uint8)
    images[1, 0, 3, 5] = torch.tensor([255, 51, 0])
    seen = network_images(images, crop=0, at_random=True)
    assert (seen.shape, seen.unique().tolist()) == ((2, 3, 20, 30), pytest.approx([-1.0, -0.6, 1.0]))
    assert seen[1, :, 3, 5].tolist() == pytest.approx([1.0, -0.6, -1.0])


@pytest.mark.parametrize(
    ("mode", "changes", "per_step"),
    [
        ("rgb+tacff", {}, 512 + 512 + 7),  # the paper's public code
        ("rgb+tacrgb", {}, 512 + 512 + 7),
        ("rgb", {}, 512 + 7),
        ("rgb+tacff", dict(image="resnet18_keypoints", image_features=64), 64 + 512 + 7),  # the paper's text
    ],
)
def test_conditions_have_the_sizes_of_the_paper(mode, changes, per_step):
    spec = observation_spec(mode, ("wrist",), ("right",), 256)
    with torch.device("meta"):
        encoder = ObservationEncoder(EncoderConfig(**changes), spec, 2)
    assert encoder.out_features == 2 * per_step


@pytest.mark.parametrize("image", ["small_cnn", "fine_cnn", "resnet18", "resnet18_keypoints"])
@pytest.mark.parametrize(("crop", "tactile_crop"), [(40, 0), (76, 0), (0, 28), (40, 76)])
def test_cameras_and_pads_have_crops_of_their_own_which_may_be_larger_than_the_images(image, crop, tactile_crop):
    spec = observation_spec("rgb+tacrgb", ("wrist",), ("right",), 48, 32)
    crops = dict(crop=crop, tactile_crop=tactile_crop)
    encoder = ObservationEncoder(EncoderConfig(image, "small_cnn", image_features=8, tactile_features=8, **crops), spec, 1)
    camera, pad = spec.images
    sizes = {}
    for key, net in zip(spec.images, encoder.images, strict=True):
        net.register_forward_pre_hook(lambda _net, inputs, key=key: sizes.update({key: inputs[0].shape[-1]}))
    obs = {key: torch.zeros(2, 1, spec.size_of(key), spec.size_of(key), 3, dtype=torch.uint8) for key in spec.images}
    assert encoder(obs | {POSE: torch.zeros(2, 1, 7)}).shape == (2, 8 + 8 + 7)
    assert sizes == {camera: min(crop or 48, 48), pad: min(tactile_crop or 32, 32)}


def test_key_points_are_pairs_of_coordinates():
    spec = observation_spec("rgb", ("wrist",), (), 64)
    with pytest.raises(InvalidArgumentError, match="7 features cannot be pairs"):
        ObservationEncoder(EncoderConfig("resnet18_keypoints", image_features=7), spec, 2)


def test_an_unknown_encoder_names_the_known_ones():
    spec = observation_spec("rgb+tacrgb+tacff", ("wrist",), ("right",), 64)
    for wrong in (dict(image="resnet1800"), dict(tacrgb="resnet1800"), dict(force_field="resnet1800")):
        with pytest.raises(ValueError, match=r"'resnet1800' is unknown; choose from .*resnet18"):
            ObservationEncoder(EncoderConfig(**wrong), spec, 2)
