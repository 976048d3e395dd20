"""What policies observe: the forms of the pose, and sizes and squares of images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.common.observation import (
    POSE,
    WORK_SQUARES,
    observation_spec,
    prepare,
    quaternion_pose,
    rotation_6d_pose,
    work_square,
)
from manifeel_ms3.demonstrations import read_demonstrations
from manifeel_ms3.errors import InvalidArgumentError
from tests.sample import observed_sample


def test_the_papers_pose_has_one_sign_for_each_rotation():
    quaternion = Rotation.random(20, random_state=0).as_quat()[:, [3, 0, 1, 2]]
    pose, flipped = np.c_[np.ones((20, 3)), quaternion], np.c_[np.ones((20, 3)), -quaternion]
    assert np.array_equal(quaternion_pose(pose), quaternion_pose(flipped))
    assert np.allclose(np.abs(quaternion_pose(pose)), np.abs(pose), atol=1e-6)


def test_quaternions_do_not_jump_where_the_wrist_can_turn():
    yaw = np.deg2rad(np.arange(45 - 166, 45 + 167))  # the range of the wrist joint
    for lean in (0.0, 0.1, -0.1):  # rad
        down = (
            Rotation.from_euler("z", yaw[:, None]) * Rotation.from_rotvec([0.0, lean, 0.0]) * Rotation.from_quat([1, 0, 0, 0])
        )
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


@pytest.mark.parametrize("camera", WORK_SQUARES)
@pytest.mark.parametrize("shape", [(240, 320), (320, 240)])
def test_the_work_is_cut_from_the_middle_of_wide_and_tall_images(camera, shape):
    images = np.random.default_rng(0).integers(0, 256, (1, *shape, 3), dtype=np.uint8)
    middle = images[:, :, 40:280] if shape[1] > 240 else images[:, 40:280]
    part = work_square(images, camera)
    assert part.shape[1] == part.shape[2]
    assert np.array_equal(part, work_square(middle, camera))


def test_a_pixel_of_a_smaller_image_is_the_mean_of_the_pixels_that_it_stands_for():
    images = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    means = images.reshape(2, 32, 2, 32, 2, 3).mean((2, 4))
    assert np.abs(prepare("sensor_data/wrist/rgb", images, observation_spec("rgb", ("wrist",), (), 32)) - means).max() <= 0.5


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


@pytest.mark.parametrize("sizes", [(60_000, 64), (64, 2049)])
def test_images_that_would_fill_the_memory_are_refused(sizes):
    with pytest.raises(InvalidArgumentError, match=r"image_size=.*at most 2048 pixels"):
        observation_spec("rgb+tacrgb", ("wrist",), ("right",), *sizes)


def test_an_unknown_form_of_the_pose_names_the_known_ones():
    with pytest.raises(InvalidArgumentError, match=r"pose='euler'.*quaternion.*rotation_6d"):
        observation_spec("rgb", ("wrist",), (), 64, pose="euler")


@pytest.mark.parametrize("mode", ["state", "rgb+depth", "pointcloud"])
def test_policies_do_not_take_privileged_or_unknown_modes(mode):
    with pytest.raises(ValueError, match="policies take"):
        observation_spec(mode, ("wrist",), ("right",), 64)
