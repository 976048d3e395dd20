"""Bad configurations are refused by name."""

import numpy as np
import pytest

from manifeel_ms3.sensors import GelConfig, OpticsConfig, gelsight_mini, gelsight_r15
from manifeel_ms3.sensors.fit_shader import read_table
from manifeel_ms3.sensors.shader import Shader


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
    ],
)
def test_bad_value_is_named(overrides, field):
    with pytest.raises(ValueError, match=field):
        gelsight_r15("touch", "gel_right", **overrides)


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
