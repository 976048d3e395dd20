"""The task that most tests run on, and marks for what a test needs of the machine."""

import os

import pytest
import torch

from manifeel_ms3.rendering.backend import available_render_backend

PEG = "ManiFeel-PegInsertion-v1"
needs_renderer = pytest.mark.skipif(
    available_render_backend() == "none" and not os.environ.get("CI"), reason="no Vulkan renderer on this machine"
)
ON_GPU = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU on this machine")]
