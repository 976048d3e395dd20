"""What a program that uses the package finds on its terminal."""

import os
import subprocess
import sys
from importlib.metadata import version

import pytest
import rich
import torch

from manifeel_ms3 import progress
from manifeel_ms3.sensors.warp_device import COMPILING
from tests.tasks_and_marks import PEG, needs_renderer

STEP_WITH_IMAGES = f"""
import gymnasium as gym, manifeel_ms3
env = gym.make("{PEG}", obs_mode="rgb+tacrgb+tacff")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
"""
START_WARP = "import torch; from manifeel_ms3.sensors.warp_device import warp_device; print(warp_device(torch.device('cpu')))"


@pytest.mark.skipif(torch.cuda.is_available(), reason="warp complains only where there is no GPU")
def test_touch_starts_without_a_complaint_about_a_missing_gpu_and_says_when_it_compiles(tmp_path):
    def started() -> subprocess.CompletedProcess:
        kernels = os.environ | dict(WARP_CACHE_PATH=str(tmp_path))
        return subprocess.run([sys.executable, "-c", START_WARP], env=kernels, capture_output=True, text=True, check=True)

    first = started()
    assert (first.stdout.strip(), first.stderr) == ("cpu", f"{COMPILING}\n")
    (tmp_path / version("warp-lang") / "wp_manifeel_ms3.sensors.draws_0123456").mkdir()
    assert started().stderr == ""


@needs_renderer
def test_a_step_with_images_says_nothing():
    """With the warnings that Python hides by default, too."""
    command = [sys.executable, "-W", "default", "-c", STEP_WITH_IMAGES]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    if COMPILING in done.stderr:  # touch was never computed on this machine, and warp's compiler has warnings of its own
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stderr, done.stdout) == ("", "")


def test_a_notebook_without_widgets_shows_no_bars(monkeypatch, recwarn):
    monkeypatch.setattr(rich.get_console(), "is_jupyter", True)
    monkeypatch.setattr(progress, "find_spec", lambda name: None)
    with progress.progress_bar() as bar:
        assert list(bar.track([1, 2])) == [1, 2]
    assert not recwarn
