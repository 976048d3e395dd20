"""Shared pieces of the baselines."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.common.dataset import SequenceDataset, read_episodes, recorded_env_kwargs
from baselines.common.encoders import EncoderConfig, ObservationEncoder, ResNet18, cropped, network_images
from baselines.common.normalizer import ActionNormalizer, Normalizer
from baselines.common.observation import POSE, WORK_SQUARES, observation_spec, prepare, quaternion_pose, rotation_6d_pose
from baselines.common.policy import PolicyConfig, make_action_network
from baselines.common.unet import ConditionalUnet1D
from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations
from manifeel_ms3.errors import InvalidArgumentError
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG
from tests.trajectories import changed_copy

SPEC = observation_spec("tacff", (), ("right",), 64)
FIELD = SPEC.force_fields[0]
HORIZONS = dict(obs_horizon=2, pred_horizon=16, action_horizon=8)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def dataset(demos):
    return SequenceDataset(read_episodes([demos], PEG, SPEC, None), SPEC, **HORIZONS, device=CPU)


def test_samples_are_the_windows_of_the_file(demos, dataset):
    episodes = read_demonstrations(demos, SPEC.keys, PEG)
    assert len(dataset) == sum(len(e["actions"]) - 7 for e in episodes)
    second = len(episodes[0]["actions"]) - 7
    for sample, episode, t in ((10, 0, 10), (second + 5, 1, 5)):
        obs, actions = dataset.sample(torch.tensor([sample]))
        assert np.array_equal(obs[FIELD][0].numpy(), episodes[episode][FIELD][t - 1 : t + 1])
        assert np.array_equal(actions[0].numpy(), episodes[episode]["actions"][t - 1 : t + 15])


def test_windows_do_not_cross_episodes(demos, dataset):
    episodes = read_demonstrations(demos, SPEC.keys, PEG)
    last, first = len(episodes[0]["actions"]) - 8, len(episodes[0]["actions"]) - 7
    obs, actions = dataset.sample(torch.tensor([last, first]))
    assert np.array_equal(actions[0, 9:].numpy(), np.repeat(episodes[0]["actions"][-1:], 7, axis=0))
    assert np.array_equal(obs[FIELD][1, 0].numpy(), episodes[1][FIELD][0])
    assert np.array_equal(actions[1, 0].numpy(), episodes[1]["actions"][0])


def test_no_executed_action_is_padding():
    """The actions count the steps of their episode: an action that repeats its predecessor's number is padding."""
    episodes = [{"actions": np.arange(t, dtype=np.float32)[:, None], POSE: np.zeros((t + 1, 7))} for t in (100, 20, 8)]
    data = SequenceDataset(episodes, observation_spec("none", (), (), 64), **HORIZONS, device=CPU)
    assert len(data) == 93 + 13 + 1  # as in the paper's public code
    _, actions = data.sample(torch.arange(len(data)))
    executed = actions[:, 1:9, 0]
    assert (executed.diff(dim=1) == 1).all()
    assert executed[92].tolist() == list(range(92, 100))


def test_an_episode_shorter_than_the_executed_actions_has_a_sample():
    episodes = [{"actions": np.arange(t, dtype=np.float32)[:, None], POSE: np.zeros((t + 1, 7))} for t in (3, 9)]
    data = SequenceDataset(episodes, observation_spec("none", (), (), 64), **HORIZONS, device=CPU)
    assert len(data) == 1 + 2
    assert data.sample(torch.tensor([0]))[1][0, :5, 0].tolist() == [0, 0, 1, 2, 2]
    assert data.names(torch.tensor([0, 1, 2])) == "episode 0 step 0, episode 1 step 0, episode 1 step 1"


def test_the_arguments_of_the_recorded_task_are_known(demos):
    assert set(recorded_env_kwargs([demos, demos])) == {"fit"}
    assert recorded_env_kwargs([Path(__file__).parents[1] / "demonstrations/lerobot/images"]) == {}
    with pytest.raises(DemonstrationError, match=r"was recorded with fit='\w+', .* with fit=None"):
        recorded_env_kwargs([demos, observed_sample(PEG)])


@pytest.mark.parametrize(
    ("horizons", "said"),
    [
        (dict(action_horizon=16), "pred_horizon=16 must be at least 17"),
        (dict(obs_horizon=10), "pred_horizon=16 must be at least 17"),
        (dict(pred_horizon=0), "pred_horizon=0 must be at least 9"),
        (dict(action_horizon=0), "action_horizon=0 must be at least 1"),
        (dict(obs_horizon=0), "obs_horizon=0 and .* must be at least 1"),
    ],
)
def test_horizons_that_a_prediction_cannot_meet_are_refused(horizons, said):
    with pytest.raises(InvalidArgumentError, match=said):
        PolicyConfig(**HORIZONS | horizons)
    assert PolicyConfig(obs_horizon=9).action_horizon == 8  # the last action of a prediction may be executed


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        (dict(pred_horizon=18), "pred_horizon=18 must be a multiple of 4, as the U-Net halves it between its 3 scales"),
        (dict(pred_horizon=15, down_dims=(8, 16)), "pred_horizon=15 must be a multiple of 2"),
        (dict(down_dims=(12, 16)), r"down_dims=\[12\] must be multiples of n_groups=8"),
        (dict(kernel_size=4), "kernel_size=4 must be odd"),
        (dict(diffusion_step_embed_dim=2), "diffusion_step_embed_dim=2 must be an even number of at least 4"),
        (dict(diffusion_step_embed_dim=63), "diffusion_step_embed_dim=63 must be an even number"),
        (dict(noise_draws=0), "noise_draws=0 must be at least 1"),
        (dict(mlp_width=0), "mlp_width=0 must be at least 1"),
        (dict(n_groups=0), "n_groups=0 must be at least 1"),
        (dict(kernel_size=-1), "kernel_size=-1 must be at least 1"),
        (dict(down_dims=(8, 0)), "down_dims=0 must be at least 1"),
        (dict(down_dims=()), "down_dims=0 must be at least 1"),
    ],
)
def test_sizes_that_no_network_can_have_are_refused(sizes, said):
    with pytest.raises(InvalidArgumentError, match=said):
        PolicyConfig(**sizes)


@pytest.mark.parametrize(("name", "least"), [("image_features", 1), ("tactile_features", 1), ("crop", 0)])
def test_sizes_that_no_encoder_can_have_are_refused(name, least):
    with pytest.raises(InvalidArgumentError, match=f"{name}={least - 1} must be at least {least}"):
        EncoderConfig(**{name: least - 1})


def test_a_network_of_any_size_that_is_accepted_keeps_the_shape_of_actions():
    for sizes in (
        dict(pred_horizon=17, action_network="mlp"),
        dict(pred_horizon=12, kernel_size=3),
        dict(pred_horizon=18, down_dims=(8, 16)),
        dict(pred_horizon=17, down_dims=(8,), diffusion_step_embed_dim=4),
    ):
        config = PolicyConfig(**dict(down_dims=(8, 8, 8), diffusion_step_embed_dim=8) | sizes)
        actions = torch.zeros(2, config.pred_horizon, 6)
        network = make_action_network(config, 6, 5)
        assert network(actions, torch.zeros(2), torch.zeros(2, 5)).shape == actions.shape


def test_number_of_demonstrations(demos):
    assert len(read_episodes([demos], PEG, SPEC, 1)) == 1
    recorded = [len(episode["actions"]) for episode in read_demonstrations(demos, [])]
    assert recorded[0] != recorded[1]
    assert [len(episode["actions"]) for episode in read_episodes([demos, demos], PEG, SPEC, 3)] == [*recorded, recorded[0]]
    with pytest.raises(DemonstrationError, match="9 demonstrations are wanted, but the files hold"):
        read_episodes([demos], PEG, SPEC, 9)


@pytest.mark.parametrize("key", ["actions", "obs/extra/tcp_pose", f"obs/{SPEC.force_fields[0]}"])
def test_an_episode_that_is_not_finite_is_named_before_it_spoils_the_ranges_of_all(demos, tmp_path, key):
    def with_nan(values):
        values[3].flat[0] = np.nan
        return values

    copy = changed_copy(demos, tmp_path, key, with_nan)
    number = len(read_episodes([demos], PEG, SPEC, None)) - 1
    with pytest.raises(DemonstrationError, match=rf"{copy.name}: .*{key[4:]}.* of episode {number}, .* at step 3"):
        read_episodes([demos, copy], PEG, SPEC, None)


@pytest.mark.parametrize("key", ["actions", f"obs/{SPEC.force_fields[0]}"])
def test_files_of_another_sensor_or_controller_are_refused(demos, tmp_path, key):
    copy = changed_copy(demos, tmp_path, key, lambda values: values[:, 1:])
    with pytest.raises(DemonstrationError, match=rf"{copy.name}: .* has the shape \(\d.*\) at a step, and \(\d"):
        read_episodes([demos, copy], PEG, SPEC, None)


def test_one_episode_at_its_recorded_size_is_in_memory():
    spec = observation_spec("rgb", ("wrist",), (), 32)
    recorded = read_demonstrations(observed_sample(PEG), spec.keys)
    largest = max(episode[spec.images[0]].nbytes for episode in recorded)
    del recorded
    read_episodes([observed_sample(PEG)], PEG, spec, 1)  # what is imported when it is first used would count, too
    tracemalloc.start()
    episodes = read_episodes([observed_sample(PEG)], PEG, spec, None)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    prepared = sum(values.nbytes for episode in episodes for values in episode.values())
    assert peak < 1.2 * (largest + prepared)
    SequenceDataset(episodes, spec, **HORIZONS, device=CPU)
    assert episodes == []


def test_lerobot_datasets_are_read_beside_files(demos):
    pytest.importorskip("pyarrow")
    folder = Path(__file__).parents[1] / "demonstrations/lerobot/images"
    episodes = read_episodes([folder, demos], PEG, SPEC, None)
    assert [len(episode["actions"]) for episode in episodes[:2]] == [4, 3]
    steps = [len(episode["actions"]) for episode in episodes]
    assert episodes[0][POSE].shape == (5, 7)
    assert len(SequenceDataset(episodes, SPEC, 2, 16, 1, CPU)) == sum(steps)


def test_the_papers_pose_has_one_sign_for_each_rotation():
    quaternion = Rotation.random(20, random_state=0).as_quat()[:, [3, 0, 1, 2]]
    pose, flipped = np.c_[np.ones((20, 3)), quaternion], np.c_[np.ones((20, 3)), -quaternion]
    assert np.array_equal(quaternion_pose(pose), quaternion_pose(flipped))
    assert np.allclose(np.abs(quaternion_pose(pose)), np.abs(pose), atol=1e-6)


def test_quaternions_do_not_jump_where_the_wrist_can_turn():
    yaw = np.deg2rad(np.arange(45 - 166, 45 + 167))  # the range of the wrist joint
    down = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_quat([1, 0, 0, 0])
    pose = quaternion_pose(np.c_[np.zeros((len(yaw), 3)), down.as_quat()[:, [3, 0, 1, 2]]])
    assert np.abs(np.diff(pose, axis=0)).max() < 0.01


@pytest.mark.parametrize("task", ["ManiFeel-NutBoltAssembly-v1", "ManiFeel-BulbInstallation-v1"])
def test_quaternions_do_not_jump_in_demonstrations_that_screw(task):
    for episode in read_demonstrations(observed_sample(task), [POSE]):
        assert np.abs(np.diff(quaternion_pose(episode[POSE]), axis=0)).max() < 0.2
        assert np.abs(np.diff(episode[POSE], axis=0)).max() > 1  # as the simulator gives them they do


def test_rotation_6d_is_the_rotation_whatever_the_quaternions_sign():
    rotation = Rotation.random(20, random_state=0)
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    pose = np.c_[np.zeros((20, 3)), quaternion]
    flipped = np.c_[np.zeros((20, 3)), -quaternion]
    matrix = rotation.as_matrix()
    assert np.allclose(rotation_6d_pose(pose)[:, 3:], np.c_[matrix[:, :, 0], matrix[:, :, 1]], atol=1e-6)
    assert np.allclose(rotation_6d_pose(pose), rotation_6d_pose(flipped), atol=1e-6)


def test_images_are_resized_alike_for_training_and_evaluation():
    spec = observation_spec("rgb", ("wrist",), (), 64)
    images = np.random.default_rng(0).integers(0, 255, (3, 256, 256, 3), dtype=np.uint8)
    prepared = prepare(spec.images[0], images, spec)
    assert prepared.shape == (3, 64, 64, 3)
    assert np.array_equal(prepare(spec.images[0], images[1:2], spec)[0], prepared[1])


@pytest.mark.parametrize("camera", ["wrist", "front", "side"])
def test_policies_can_take_the_square_in_which_the_work_is_done(camera):
    spec = observation_spec("rgb+tacrgb", (camera,), ("right",), 32, camera_view="work")
    image, pad = (np.random.default_rng(0).integers(0, 256, (2, *size, 3), np.uint8) for size in ((256, 256), (240, 320)))
    key, touch = spec.images
    top, left, side = (round(share * 256) for share in WORK_SQUARES[camera])
    seen = prepare(key, image, spec)
    assert seen.shape == (2, 32, 32, 3)
    elsewhere = np.zeros_like(image)
    elsewhere[:, top : top + side, left : left + side] = image[:, top : top + side, left : left + side]
    assert np.array_equal(prepare(key, elsewhere, spec), seen)
    assert not np.array_equal(prepare(key, image, observation_spec("rgb", (camera,), (), 32)), seen)
    whole = observation_spec("tacrgb", (), ("right",), 32)
    assert np.array_equal(prepare(touch, pad, spec), prepare(touch, pad, whole))
    with pytest.raises(InvalidArgumentError, match=r"camera_view='half'.*\['whole', 'work'\]"):
        observation_spec("rgb", (camera,), (), 32, camera_view="half")


def test_tacrgb_has_a_size_of_its_own():
    spec = observation_spec("rgb+tacrgb", ("wrist",), ("right",), 64, 48)
    camera, pad = (prepare(key, np.zeros((2, 80, 80, 3), np.uint8), spec) for key in spec.images)
    assert (camera.shape, pad.shape) == ((2, 64, 64, 3), (2, 48, 48, 3))


@pytest.mark.parametrize("sizes", [(0, 64), (64, -1)])
def test_images_that_are_too_small_are_refused(sizes):
    with pytest.raises(InvalidArgumentError, match=r"image_size=.*at least 16 pixels"):
        observation_spec("rgb+tacrgb", ("wrist",), ("right",), *sizes)


def test_an_unknown_form_of_the_pose_names_the_known_ones():
    with pytest.raises(InvalidArgumentError, match=r"pose='euler'.*quaternion.*rotation_6d"):
        observation_spec("rgb", ("wrist",), (), 64, pose="euler")


@pytest.mark.parametrize("mode", ["state", "rgb+depth", "pointcloud"])
def test_policies_do_not_take_privileged_or_unknown_modes(mode):
    with pytest.raises(ValueError, match="policies take"):
        observation_spec(mode, ("wrist",), ("right",), 64)


def test_normalizer_maps_the_datas_range_and_back():
    data = torch.tensor([[0.0, 5.0, 2.0], [10.0, 7.0, 2.0]])
    normalizer = Normalizer(3)
    normalizer.fit(data)
    assert normalizer.normalize(data)[:, :2].tolist() == [[-1, -1], [1, 1]]
    assert torch.allclose(normalizer.restore(normalizer.normalize(data)), data)
    assert normalizer.normalize(data)[:, 2].abs().max() == 0  # what never moved stays small


@pytest.mark.parametrize("pairs", [[], [(0, 1), (3, 4)]])
def test_small_actions_have_more_room_on_the_root_scale(pairs):
    actions = torch.cat([torch.rand(100, 6) * 2 - 1, torch.eye(6), -torch.eye(6), torch.zeros(1, 6)])
    linear, root = ActionNormalizer(6), ActionNormalizer(6, root=True, pairs=pairs)
    for normalizer in (linear, root):
        normalizer.fit(actions)
        assert torch.allclose(normalizer.restore(normalizer.normalize(actions)), actions, atol=1e-6)
        assert normalizer.normalize(actions).abs().max() <= 1 + 1e-6
    slide = 0.04 * torch.eye(6)
    assert torch.allclose(linear.normalize(slide).diagonal(), torch.full((6,), 0.04), atol=0.02)
    assert torch.allclose(root.normalize(slide).diagonal(), torch.full((6,), 0.2), atol=0.02)


def test_the_root_of_a_vector_turns_as_the_vector_does():
    turn = torch.as_tensor(Rotation.from_euler("z", 0.7).as_matrix(), dtype=torch.float32)
    actions = torch.rand(50, 6) * 2 - 1
    turned = torch.cat([actions[:, :3] @ turn.T, actions[:, 3:] @ turn.T], dim=1)
    normalizer = ActionNormalizer(6, root=True, pairs=[(0, 1), (3, 4)])  # its range is [-1, 1] before it is fitted
    expected = normalizer.normalize(actions)
    expected = torch.cat([expected[:, :3] @ turn.T, expected[:, 3:] @ turn.T], dim=1)
    assert torch.allclose(normalizer.normalize(turned), expected, atol=1e-6)


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
    seen = network_images("sensor_data/wrist/rgb", images, crop=0, at_random=True)
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
@pytest.mark.parametrize("crop", [40, 76])
def test_crops_are_of_cameras_alone_and_may_be_larger_than_the_images(image, crop):
    spec = observation_spec("rgb+tacrgb", ("wrist",), ("right",), 48, 32)
    encoder = ObservationEncoder(EncoderConfig(image, "small_cnn", image_features=8, tactile_features=8, crop=crop), spec, 1)
    camera, pad = spec.images
    sizes = {}
    for key, net in zip(spec.images, encoder.images, strict=True):
        net.register_forward_pre_hook(lambda _net, inputs, key=key: sizes.update({key: inputs[0].shape[-1]}))
    obs = {key: torch.zeros(2, 1, spec.size_of(key), spec.size_of(key), 3, dtype=torch.uint8) for key in spec.images}
    assert encoder(obs | {POSE: torch.zeros(2, 1, 7)}).shape == (2, 8 + 8 + 7)
    assert sizes == {camera: min(crop, 48), pad: 32}


def test_key_points_are_pairs_of_coordinates():
    spec = observation_spec("rgb", ("wrist",), (), 64)
    with pytest.raises(InvalidArgumentError, match="7 features cannot be pairs"):
        ObservationEncoder(EncoderConfig("resnet18_keypoints", image_features=7), spec, 2)


def test_an_unknown_encoder_names_the_known_ones():
    spec = observation_spec("rgb+tacrgb+tacff", ("wrist",), ("right",), 64)
    for wrong in (dict(image="resnet1800"), dict(tacrgb="resnet1800"), dict(force_field="resnet1800")):
        with pytest.raises(ValueError, match=r"'resnet1800' is unknown; choose from .*resnet18"):
            ObservationEncoder(EncoderConfig(**wrong), spec, 2)


@pytest.mark.parametrize("kind", ["unet", "mlp"])
def test_action_networks_map_actions_to_noise_and_use_step_and_condition(kind):
    config = PolicyConfig(action_network=kind, down_dims=(16, 32, 64), mlp_width=32)
    net = make_action_network(config, action_dim=6, condition_dim=10).eval()
    actions, condition = torch.randn(3, 16, 6), torch.randn(3, 10)
    out = net(actions, torch.tensor([0, 50, 99]), condition)
    assert out.shape == actions.shape
    assert not torch.allclose(out, net(actions, torch.tensor([1, 51, 98]), condition))
    assert not torch.allclose(out, net(actions, torch.tensor([0, 50, 99]), -condition))
    alone = net(actions[1:2], torch.tensor([50]), condition[1:2])
    torch.testing.assert_close(out[1:2], alone, rtol=1e-4, atol=1e-5)


def test_papers_unet_has_the_published_channels():
    net = ConditionalUnet1D(6, 146)
    assert [block[0].second[0].out_channels for block in net.down] == [512, 1024, 2048]


def test_force_fields_are_normalised_taxel_by_taxel():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([[1.0, 0.1], [0.01, 0.0]])[None, ..., None]  # N, of four taxels: a corner, two inside, one untouched
    fields = size * torch.rand(50, 2, 2, 3, generator=generator)
    normalizer = Normalizer.of_taxels((2, 2))
    normalizer.fit(fields)
    seen = normalizer.normalize(fields)
    assert seen[:, 0].amax((0, 1)).tolist() == pytest.approx([1, 1, 1])
    assert seen[:, 0, 1].std(0).min() > 0.4  # a tenth of the corner's force is seen as large as that
    assert 0.1 < seen[:, 1, 0].abs().max() < 0.3  # less than a twentieth is not magnified as far
    assert (seen[:, 1, 1] == 0).all()
    assert torch.allclose(normalizer.restore(seen), fields, atol=1e-6)


def test_touch_in_the_papers_units_fills_the_range_too():
    fields = 1e-4 * torch.rand(50, 3, 4, 3, generator=torch.Generator().manual_seed(0))  # m
    normalizer = Normalizer.of_taxels((3, 4))
    normalizer.fit(fields)
    assert normalizer.normalize(fields).abs().amax((0, 3)).min().item() == pytest.approx(1.0)
