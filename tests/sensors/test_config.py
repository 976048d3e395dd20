"""Bad configurations are refused by name."""

import gymnasium as gym
import numpy as np
import pytest

from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.sensors import (
    GelConfig,
    HousingConfig,
    ImperfectionConfig,
    Light,
    LightsConfig,
    OpticsConfig,
    TouchRandomization,
    gelsight_r15,
    pad_pose,
    sensor_config,
    sensor_names,
    with_options,
)
from manifeel_ms3.sensors.optics.shader import Shader
from manifeel_ms3.sensors.optics.taxim_table import read_table
from manifeel_ms3.sensors.registry import task_sensor
from tests.tasks_and_marks import PEG


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        (dict(gel=GelConfig(thickness=0.0)), "gel.thickness"),
        (dict(gel=GelConfig(youngs_modulus=-1.0)), "gel.youngs_modulus"),
        (dict(gel=GelConfig(poisson_ratio=0.5)), "gel.poisson_ratio"),
        (dict(pixel_size=float("nan")), "pixel_size"),
        (dict(taxel_shape=(0, 14)), "taxel_shape"),
        (dict(taxel_shape=(10, 14, 2)), r"taxel_shape=\(10, 14, 2\).*must be 2 numbers"),
        (dict(image_shape=(240.0, 320.0)), r"image_shape=\(240\.0, 320\.0\).*positive and whole"),
        (dict(image_shape=240), "image_shape=240 .*must be 2 numbers"),
        (dict(gel=GelConfig(size=(0.02,))), r"gel\.size=\(0\.02,\).*must be 2 numbers"),  # pyright: ignore[reportArgumentType]
        (dict(taxel_pitch=5e-3), "taxel_shape x taxel_pitch"),
        (dict(image_shape=(480, 640)), "image_shape x pixel_size"),
        (dict(backend="magic"), "raycast"),
        (dict(backend="auto"), r"\['raycast', 'sapien'\]"),
        (dict(units="pound"), "tacsl"),
        (dict(optics=OpticsConfig(shadow=1.5)), "optics.shadow"),
        (dict(optics=OpticsConfig(noise=-1.0)), "optics.noise"),
        (dict(optics=OpticsConfig(marker_pitch=0.0)), "optics.marker_pitch"),
        (dict(randomization=TouchRandomization(stiffness=1.0)), "randomization.stiffness"),
        (dict(gel=GelConfig(curvature=(60.0, 60.0)), housing=HousingConfig(protrusion=0.02)), "folds"),
        (dict(gel=GelConfig(curvature=(30.0, 30.0))), "housing.protrusion"),
        (dict(gel=GelConfig(curvature=(16.0, 16.0))), "housing.protrusion"),  # 3.2 mm under the top, of which 3 mm stand out
        (dict(gel=GelConfig(curvature=(-1.0, 0.0))), "gel.curvature"),
        (dict(imperfections=ImperfectionConfig(hysteresis=1.0)), "imperfections.hysteresis"),
        (dict(imperfections=ImperfectionConfig(noise=-0.1)), "imperfections.noise"),
        (dict(imperfections=ImperfectionConfig(gain=(0.3, 0.1))), "imperfections.gain"),
    ],
)
def test_bad_value_is_named(overrides, field):
    with pytest.raises(ValueError, match=field):
        sensor_config("gelsight_r15", "touch", "gel_right", **overrides)


def test_options_by_dotted_name():
    config = with_options(gelsight_r15("a", "b"), {"units": "tacsl", "optics.noise": 2.0})
    assert (config.units, config.optics.noise, config.link) == ("tacsl", 2.0, "b")
    for name in ("optics.nose", "gell", "units.metre"):
        with pytest.raises(ValueError, match=name):
            with_options(config, {name: 1})
    with pytest.raises(ValueError, match=r"gel\.thickness"):
        with_options(config, {"gel.thickness": -1.0})


def test_options_are_changed_together_in_any_order():
    small = {"gel.size": (0.016, 0.020), "taxel_shape": [9, 12], "image_shape": (180, 224)}
    dome = {"gel.curvature": (25.0, 25.0), "housing.protrusion": 0.008}
    config = gelsight_r15("a", "b")
    for options in (small, dome):
        assert with_options(config, options) == with_options(config, dict([*options.items()][::-1]))
    assert with_options(config, small).taxel_shape == (9, 12)
    whole = with_options(config, {"gel.thickness": 0.003, "gel": GelConfig(size=(0.03, 0.04))}).gel
    assert (whole.thickness, whole.size) == (0.003, (0.03, 0.04))
    with pytest.raises(InvalidArgumentError, match="taxel_shape x taxel_pitch"):
        with_options(config, {"image_shape": (180, 224), "gel.size": (0.016, 0.020)})


def test_a_smaller_gel_has_an_image_and_a_force_field_that_fit_it():
    size = {"gel.size": [0.016, 0.020]}
    small = task_sensor("gelsight_r15", "a", "b", size, None)
    assert (small.image_shape, small.taxel_shape) == ((182, 228), (9, 12))
    assert task_sensor("gelsight_r15", "a", "b", {"gel.size": [0.03, 0.04]}, None).taxel_shape == (10, 14)
    assert task_sensor("gelsight_r15", "a", "b", size | {"taxel_shape": [4, 5]}, None).taxel_shape == (4, 5)
    with pytest.raises(InvalidArgumentError, match="smaller than a taxel"):
        task_sensor("gelsight_r15", "a", "b", {"gel.size": [1e-4, 1e-4]}, None)
    with pytest.raises(InvalidArgumentError, match=r"gel\.size"):
        task_sensor("gelsight_r15", "a", "b", {"gel.size": "small"}, None)


def test_a_task_has_a_smaller_gel_by_one_option():
    env = gym.make(PEG, obs_mode="tacff", tactile={"gel.size": (0.016, 0.020)}, render_backend="none")
    obs, _ = env.reset(seed=0)
    assert obs["sensor_data"]["tactile_right"]["force_field"].shape == (1, 9, 12, 3)
    env.close()


def test_a_sensor_with_lamps_takes_a_calibration_only_instead_of_them():
    shader = OpticsConfig().calibration
    with pytest.raises(InvalidArgumentError, match=r"optics\.calibration.*'digit'.*'optics\.lights': None"):
        task_sensor("digit", "a", "b", {"optics.calibration": shader}, None)
    calibrated = task_sensor("digit", "a", "b", {"optics.calibration": shader, "optics.lights": None}, None)
    assert (calibrated.optics.calibration, calibrated.optics.lights) == (shader, None)
    lamps = sensor_config("digit", "a", "b").optics.lights
    assert with_options(gelsight_r15("a", "b"), {"optics.lights": lamps}).optics.lights == lamps
    with pytest.raises(InvalidArgumentError, match=r"optics\.lights.*expected.*LightsConfig \| None, not 3"):
        with_options(gelsight_r15("a", "b"), {"optics.lights": 3})


def test_lamps_light_the_gel_from_behind():
    with pytest.raises(InvalidArgumentError, match=r"position=\(0\.02, 0\.0, 0\.017\).*negative"):
        Light((0.02, 0.0, 0.017), (1.0, 1.0, 1.0))
    with pytest.raises(InvalidArgumentError, match="three coordinates"):
        Light((0.02, -0.017), (1.0, 1.0, 1.0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidArgumentError, match="three coordinates"):
        Light((float("nan"), 0.0, -0.017), (1.0, 1.0, 1.0))
    for colour in ((1.0, 0.0), (-1.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)):
        with pytest.raises(InvalidArgumentError, match=r"colour=.*three numbers, none of them negative"):
            Light((0.02, 0.0, -0.017), colour)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidArgumentError, match="at least one Light"):
        LightsConfig(())
    listed = LightsConfig([Light(np.array([0.02, 0.0, -0.017]), [1.0, 1.0, 1.0])])  # pyright: ignore[reportArgumentType]
    assert listed == LightsConfig((Light((0.02, 0.0, -0.017), (1.0, 1.0, 1.0)),))
    assert hash(listed) == hash(LightsConfig((Light((0.02, 0.0, -0.017), (1.0, 1.0, 1.0)),)))


def test_sensors_by_name():
    assert sensor_names()[:3] == ["gelsight_r15", "gelsight_mini", "digit"]
    mini, digit = (sensor_config(name, "a", "b") for name in ("gelsight_mini", "digit"))
    assert np.array(mini.image_shape) * mini.pixel_size == pytest.approx([0.0143, 0.0186], rel=0.02)  # the data sheet's window
    assert digit.gel.max_sag == pytest.approx(0.005, rel=1e-3)  # TACTO's
    with pytest.raises(UnknownNameError, match=r"choose from \['gelsight_r15', 'gelsight_mini', 'digit'"):
        sensor_config("biotac", "a", "b")


def test_a_pads_pose_has_its_normal_and_the_fingertip_where_it_is_told():
    pose = pad_pose(facing=(0, -2, 0), tip=(0.3, 0.5, 0.3), at=(0.01, 0.02, 0.03)).to_transformation_matrix()
    assert pose[:3, 2] == pytest.approx([0, -1, 0], abs=1e-6)
    assert pose[:3, 1] == pytest.approx([np.sqrt(0.5), 0, np.sqrt(0.5)], abs=1e-6)
    assert pose[:3, 0] == pytest.approx(np.cross(pose[:3, 1], pose[:3, 2]), abs=1e-6)
    assert pose[:3, 3] == pytest.approx([0.01, 0.02, 0.03])
    with pytest.raises(InvalidArgumentError, match="at an angle to each other"):
        pad_pose(facing=(0, 0, 1), tip=(0, 0.1, 1), at=(0, 0, 0))


def test_sag_is_that_of_a_sphere():
    gel = GelConfig(size=(0.02, 0.03), curvature=(20.0, 20.0))
    x, y = np.array([0.0, 4e-3, -9e-3]), np.array([0.0, 7e-3, 15e-3])
    assert gel.sag(x, y) == pytest.approx(0.05 - np.sqrt(0.05**2 - x**2 - y**2))


def test_imperfections_take_a_number_or_a_range_of_known_names():
    assert ImperfectionConfig(hysteresis=0.2).hysteresis == (0.2, 0.2)
    config = task_sensor("digit", "a", "b", {"imperfections.delay": 2}, {"gain": [0.0, 0.1]})
    assert (config.imperfections.delay, config.imperfections.gain) == ((2, 2), (0.0, 0.1))
    with pytest.raises(UnknownNameError, match=r"lag.*hysteresis.*delay.*crosstalk"):
        task_sensor("digit", "a", "b", None, {"lag": 1})
    with pytest.raises(ValueError, match="whole number"):
        task_sensor("digit", "a", "b", None, {"delay": 1.5})
    with pytest.raises(ValueError, match=r"imperfections\.crosstalk"):
        task_sensor("digit", "a", "b", None, {"crosstalk": "much"})


@pytest.mark.parametrize("name", ["uid", "link"])
def test_what_the_robot_sets_is_no_option(name):
    with pytest.raises(InvalidArgumentError, match=rf"tactile options \['{name}'\] are set by the robot; leave them out"):
        task_sensor("digit", "a", "b", {name: "c"}, None)


@pytest.mark.parametrize("amount", [None, "much", "ab", [0.1], (0.0, 0.1, 0.2), (0.0, None), True, float("nan")])
def test_an_amount_that_is_no_number_or_pair_is_named_at_once(amount):
    with pytest.raises(InvalidArgumentError, match=r"imperfections\.gain=.*a number, or a pair"):
        ImperfectionConfig(gain=amount)
    with pytest.raises(InvalidArgumentError, match=r"imperfections\.delay"):
        ImperfectionConfig(delay=amount)


def test_missing_and_malformed_calibration(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        Shader.load(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(ValueError, match="not a shader file"):
        Shader.load(tmp_path / "other.npz")
    np.savez(tmp_path / "shape.npz", weights=np.zeros(3), background=np.zeros((3, 6)))
    with pytest.raises(ValueError, match="weights has shape"):
        Shader.load(tmp_path / "shape.npz")
    with pytest.raises(ValueError, match="lacks"):
        read_table(tmp_path / "other.npz")
    assert OpticsConfig().calibration.is_file()
