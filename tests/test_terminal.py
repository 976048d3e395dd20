"""What a program that uses the package finds on its terminal."""

import subprocess
import sys

import pytest
import torch

START_WARP = "import torch; from manifeel_ms3.sensors.warp_device import warp_device; print(warp_device(torch.device('cpu')))"


@pytest.mark.skipif(torch.cuda.is_available(), reason="warp complains only where there is no GPU")
def test_touch_starts_without_a_complaint_about_a_missing_gpu():
    done = subprocess.run([sys.executable, "-c", START_WARP], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "cpu"
    assert done.stderr == ""
