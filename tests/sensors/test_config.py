"""Bad configurations are refused by name."""

import numpy as np
import pytest

from manifeel_ms3.sensors import GelConfig, OpticsConfig, TouchRandomization, gelsight_mini, gelsight_r15, with_options
from manifeel_ms3.sensors.optics.shader import Shader
from manifeel_ms3.sensors.optics.taxim_table import read_table


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        (dict(gel=GelConfig(thickness=0.0)), "gel.thickness"),
        (dict(gel=GelConfig(youngs_modulus=-1.0)), "gel.youngs_modulus"),
        (dict(gel=GelConfig(poisson_ratio=0.5)), "gel.poisson_ratio"),
        (dict(pixel_size=float("nan")), "pixel_size"),
        (dict(taxel_shape=(0, 14)), "taxel_shape"),
        (dict(taxel_pitch=5e-3), "taxel_shape x taxel_pitch"),
        (dict(image_shape=(480, 640)), "image_shape x pixel_size"),
        (dict(backend="magic"), "raycast"),
        (dict(units="pound"), "tacsl"),
        (dict(optics=OpticsConfig(shadow=1.5)), "optics.shadow"),
        (dict(optics=OpticsConfig(noise=-1.0)), "optics.noise"),
        (dict(optics=OpticsConfig(marker_pitch=0.0)), "optics.marker_pitch"),
        (dict(randomization=TouchRandomization(stiffness=1.0)), "randomization.stiffness"),
    ],
)
def test_bad_value_is_named(overrides, field):
    with pytest.raises(ValueError, match=field):
        gelsight_r15("touch", "gel_right", **overrides)


def test_options_by_dotted_name():
    config = with_options(gelsight_r15("a", "b"), {"units": "tacsl", "optics.noise": 2.0})
    assert (config.units, config.optics.noise, config.link) == ("tacsl", 2.0, "b")
    for name in ("optics.nose", "gell", "units.metre"):
        with pytest.raises(ValueError, match=name):
            with_options(config, {name: 1})
    with pytest.raises(ValueError, match=r"gel\.thickness"):
        with_options(config, {"gel.thickness": -1.0})


def test_presets_are_valid():
    assert gelsight_r15("a", "b").taxel_shape == (10, 14)
    assert gelsight_mini("a", "b").pixel_size == 6.5e-5


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
