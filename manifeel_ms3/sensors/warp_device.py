"""Warp, started quietly, on torch's devices."""

import contextlib
import functools
import math
import os
from concurrent.futures import ThreadPoolExecutor

import torch
import warp as wp

WORTH_SPLITTING = 4_000  # threads of a launch

wp.config.quiet = True
if hasattr(wp, "LOG_WARNING"):  # newer releases
    wp.config.log_level = wp.LOG_ERROR

_lent_threads = 1


def warp_device(device: torch.device):
    """Warp's device for torch's."""
    wp.init()
    return wp.device_from_torch(device)


@contextlib.contextmanager
def lend_torch_threads():
    """Give torch's CPU threads to `launch_split`: torch's own spin on after an operation, and would be in its way."""
    global _lent_threads
    own = torch.get_num_threads()
    _lent_threads = own
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(own)
        _lent_threads = 1


def launch_split(kernel, dim: tuple[int, ...], inputs: list, outputs: list, device: torch.device) -> None:
    """Launch a kernel whose first argument says where its second index starts.

    Warp runs a CPU kernel on one thread: there, the second axis is split over the threads lent by torch. The calls into native
    code let go of Python's lock.
    """
    on = warp_device(device)

    def launch(start: int, stop: int) -> None:
        wp.launch(kernel, dim=(dim[0], stop - start, *dim[2:]), inputs=[start, *inputs], outputs=outputs, device=on)

    threads = 1 if on.is_cuda or math.prod(dim) < WORTH_SPLITTING else min(_lent_threads, dim[1])
    kernel.module.load(on)
    bounds = [dim[1] * k // threads for k in range(threads + 1)]
    others = [_pool(threads - 1).submit(launch, *bounds[k : k + 2]) for k in range(1, threads)]
    launch(bounds[0], bounds[1])
    for other in others:
        other.result()


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="warp")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
