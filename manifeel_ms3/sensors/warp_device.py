"""Warp without its start-up messages, on torch's devices and with torch's number of threads."""

import contextlib
import functools
import logging
import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path

import torch
import warp as wp

log = logging.getLogger(__name__)

COMPILING = "compiling the kernels of the tactile sensor: this takes 10 to 30 s, once on this machine"
STDERR = 2  # number of the file descriptor of the standard error
MIN_SPLIT_SIZE = 4_000  # threads of a launch: smaller ones are not split, since that would take longer (chosen)

_threads = ContextVar("threads that `launch_split` may use", default=1)


@functools.cache
def _start_warp() -> None:
    """Start warp without its messages; its native code writes to stderr if it finds no GPU, whatever its log level."""
    setattr(wp.config, "quiet", True)  # noqa: B010 (newer releases of warp no longer declare it)
    if hasattr(wp, "LOG_WARNING"):  # newer releases
        wp.config.log_level = wp.LOG_ERROR
    if torch.cuda.is_available():
        wp.init()
    else:
        _init_in_silence()
    if not any(Path(str(wp.config.kernel_cache_dir)).glob(f"wp_{__package__}*")):
        log.warning(COMPILING)


def _init_in_silence() -> None:
    shown = os.dup(STDERR)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), STDERR)
            wp.init()
    finally:
        os.dup2(shown, STDERR)
        os.close(shown)


def warp_device(device: torch.device):
    """Warp's device that corresponds to a device of torch; warp is started first."""
    _start_warp()
    return wp.get_device(str(device))  # `wp.device_from_torch` refuses "cuda" without a number, ManiSkill's usual device


@contextlib.contextmanager
def use_torch_threads_for_warp() -> Iterator[None]:
    """Let `launch_split` use as many CPU threads as torch has, and torch only one.

    Torch's own threads keep spinning for a while after an operation and would compete with warp's for the cores. Uses may be
    nested, and those of several threads may overlap; torch counts its threads for each thread that calls it.
    """
    before = torch.get_num_threads()
    token = _threads.set(max(before, _threads.get()))
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def launch_split(kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list, device: torch.device) -> None:
    """Launch a kernel on several CPU threads, its second index divided among them.

    Warp runs a CPU kernel on one thread, but its calls into native code release Python's lock. The first argument of the
    kernel must be the offset of its second index. On a GPU this is an ordinary launch.

    Args:
        kernel: Kernel to launch.
        dim: Size of the launch; 2 axes or more.
        inputs: Arguments of the kernel after the offset.
        outputs: Arrays that the kernel writes.
        device: Device of all arrays.
    """
    on = warp_device(device)

    def launch(start: int, stop: int) -> None:
        wp.launch(kernel, dim=(dim[0], stop - start, *dim[2:]), inputs=[start, *inputs], outputs=outputs, device=on)

    threads = 1 if on.is_cuda or math.prod(dim) < MIN_SPLIT_SIZE else min(_threads.get(), dim[1])
    kernel.module.load(on)
    bounds = [dim[1] * k // threads for k in range(threads + 1)]
    others = [_pool(threads - 1).submit(launch, *bounds[k : k + 2]) for k in range(1, threads)]
    launch(bounds[0], bounds[1])
    for other in others:
        other.result()


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    _make_new_pools_after_fork()
    return ThreadPoolExecutor(workers, thread_name_prefix="warp")


@functools.cache
def _make_new_pools_after_fork() -> None:
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
