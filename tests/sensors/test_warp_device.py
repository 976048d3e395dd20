"""Touch runs on CUDA devices: what of it can be checked without one."""

import pytest
import torch
import warp as wp

from manifeel_ms3.sensors import imperfections
from manifeel_ms3.sensors.depth import raycast
from manifeel_ms3.sensors.mechanics import contact
from manifeel_ms3.sensors.optics import tacrgb
from manifeel_ms3.sensors.warp_device import warp_device

A100 = 80  # compute capability


def test_cuda_without_a_number_is_the_present_gpu():
    """ManiSkill's own name of the device of a simulation on a GPU is "cuda"."""
    if torch.cuda.is_available():
        assert warp_device(torch.device("cuda")).is_cuda
    else:
        with pytest.raises(RuntimeError, match="CUDA is not supported"):
            warp_device(torch.device("cuda"))


@pytest.mark.parametrize("module", [contact, raycast, tacrgb, imperfections], ids=lambda module: module.__name__.split(".")[-1])
def test_kernels_compile_for_cuda(module, tmp_path):
    (file,) = wp.compile_aot_module(module, arch=A100, module_dir=tmp_path, use_ptx=True)
    compiled = file.read_text()
    kernels = [value.key for value in vars(module).values() if isinstance(value, wp.Kernel)]
    assert kernels
    assert all(f".entry {kernel}" in compiled for kernel in kernels)
