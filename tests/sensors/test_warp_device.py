"""Touch runs on CUDA devices: what of it can be checked without one."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from manifeel_ms3.sensors import imperfections
from manifeel_ms3.sensors.depth import raycast
from manifeel_ms3.sensors.mechanics import contact
from manifeel_ms3.sensors.optics import tacrgb
from manifeel_ms3.sensors.warp_device import use_torch_threads_for_warp, warp_device

A100 = 80  # compute capability


def test_cuda_without_a_number_is_the_present_gpu():
    """ManiSkill's own name of the device of a simulation on a GPU is "cuda"."""
    if torch.cuda.is_available():
        assert warp_device(torch.device("cuda")).is_cuda
    else:
        with pytest.raises(RuntimeError, match="CUDA is not supported"):
            warp_device(torch.device("cuda"))


@pytest.fixture
def three_threads() -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield 3
    torch.set_num_threads(before)


def test_torch_has_its_threads_again_after_nested_uses(three_threads):
    with use_torch_threads_for_warp():
        with use_torch_threads_for_warp():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == three_threads


def test_torch_has_its_threads_again_after_uses_that_overlap(three_threads):
    """As those of two environments in two threads of a process."""
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        users = [(thread, use_torch_threads_for_warp()) for thread in (first, second)]
        for thread, _ in users:
            assert thread.submit(torch.get_num_threads).result() == three_threads
        for thread, use in users:
            thread.submit(use.__enter__).result()
        for thread, use in users:
            thread.submit(use.__exit__, None, None, None).result()
            assert thread.submit(torch.get_num_threads).result() == three_threads
    assert torch.get_num_threads() == three_threads


@pytest.mark.parametrize("module", [contact, raycast, tacrgb, imperfections], ids=lambda module: module.__name__.split(".")[-1])
def test_kernels_compile_for_cuda(module, tmp_path):
    (file,) = wp.compile_aot_module(module, arch=A100, module_dir=tmp_path, use_ptx=True)
    compiled = file.read_text()
    kernels = [value.key for value in vars(module).values() if isinstance(value, wp.Kernel)]
    assert kernels
    assert all(f".entry {kernel}" in compiled for kernel in kernels)
