"""The package with one sensor that docs/sensor.md shows, installed as a third party's."""

import subprocess
from pathlib import Path

import pytest

from tests.command_process import run_code
from tests.third_party import install, own_sensor

TOUCH = """
import gymnasium, manifeel_ms3
from manifeel_ms3.sensors import sensor_names
env = gymnasium.make("ManiFeel-PegInsertion-v1", obs_mode="tacrgb+tacff", render_backend="none", sensor="my_sensor")
touch = env.reset(seed=0)[0]["sensor_data"]["tactile_right"]
grip = -env.unwrapped.agent.pad_wrench("right")[0, 2].item()
field = touch["force_field"]
print(sensor_names(), tuple(touch["rgb"].shape), tuple(field.shape), field[..., 0].sum().item() / grip)
levels = env.unwrapped._tactile_sensors["tactile_right"].model.optics.levels  # of the untouched gel
print(levels.min().item(), levels.max().item(), env.unwrapped.agent.finger.size)
"""


def python(site: Path, code: str) -> subprocess.CompletedProcess:
    return run_code(code, folder=site, OMP_NUM_THREADS="1")


@pytest.fixture
def page() -> tuple[str, str]:
    """Entry points and module of the page."""
    return own_sensor()


def test_a_sensor_of_another_package_is_on_the_robot(tmp_path, page):
    entry_points, module = page
    install(tmp_path, files={"my_sensors.py": module}, entry_points=entry_points)
    done = python(tmp_path, TOUCH)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.strip().splitlines()[-2:]
    assert "'digit', 'my_sensor'] (1, 240, 320, 3) (1, 9, 11, 3)" in first
    assert float(first.split()[-1]) == pytest.approx(1.0, abs=0.01)
    darkest, brightest, size = second.split(maxsplit=2)
    assert float(darkest) > 20  # nothing of the untouched gel is saturated
    assert float(brightest) < 245
    assert size == "(0.022, 0.02, 0.095)"


def test_a_name_of_the_packs_own_and_what_is_no_sensor_are_refused(tmp_path, page):
    entry_points, module = page
    code = "from manifeel_ms3.sensors import sensor_config; sensor_config({!r}, 'a', 'b')"
    install(tmp_path, files={"my_sensors.py": module}, entry_points=entry_points.replace("my_sensor =", "digit ="))
    assert "rename it" in python(tmp_path, code.format("digit")).stderr
    other = tmp_path / "other"
    install(other, files={"my_sensors.py": "def my_sensor(uid, link):\n    return uid"}, entry_points=entry_points)
    assert "it must return a TactileSensorConfig" in python(other, code.format("my_sensor")).stderr


@pytest.mark.slow
def test_a_sensor_of_another_package_is_verified(tmp_path, page):
    entry_points, module = page
    install(tmp_path, files={"my_sensors.py": module}, entry_points=entry_points)
    code = "from manifeel_ms3.verification.__main__ import *; print(main(Args('my_sensor', report=Path('my_sensor.html'))))"
    done = python(tmp_path, code)
    assert done.stdout.split()[-1:] == ["0"], done.stderr
    assert "<h1>my_sensor</h1>" in (tmp_path / "my_sensor.html").read_text()
