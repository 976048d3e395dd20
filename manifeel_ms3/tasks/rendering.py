"""Which renderer this process can use, and what to do where it has none."""

import functools
import os

import sapien
import torch

NO_RENDERER = (
    "no Vulkan renderer was found, and {wanted} needs one. Without a GPU, install Mesa 24.3 or newer (Debian 12: "
    "`apt install -t bookworm-backports mesa-vulkan-drivers` and `apt install libvulkan1 libegl1 libgl1`; Ubuntu 24.04: "
    "`apt install mesa-vulkan-drivers libvulkan1 libegl1 libgl1`); `scripts/setup.sh` does it. With an NVIDIA GPU, install its "
    "driver and libvulkan1. What needs no picture works without: obs_mode='state' or 'tacff', render_backend='none'."
)


FORKED = (
    "{wanted} needs a renderer, and this process was forked from one that has its own, which does not work on. Start it anew: "
    "multiprocessing.get_context('spawn'), AsyncVectorEnv(..., context='spawn'). What needs no picture works here: "
    "obs_mode='state' or 'tacff'."
)
_IMPORTED_IN = os.getpid()
_renders_in: int | None = None
"""the process whose renderer this is; a fork copies the answer, not the renderer"""


def available_render_backend(asked: str = "auto") -> str:
    """The `render_backend` to use: "gpu", "cpu" or "none", which is all that a process has whose parent had the renderer."""
    global _renders_in
    if asked == "none" or renderer_lost():
        return "none"
    backend = _first_that_works() if asked == "auto" else asked
    if backend != "none":
        _renders_in = os.getpid()
    return backend


def renderer_lost() -> bool:
    """Whether this process was forked from one with a renderer."""
    return _renders_in not in (None, os.getpid())


def mend_threads() -> None:
    """In a forked process torch would wait for ever for OpenMP's threads, which the fork has not copied: work without."""
    if os.getpid() != _IMPORTED_IN:
        torch.set_num_threads(1)


@functools.cache
def _first_that_works() -> str:
    candidates = ["gpu"] * torch.cuda.is_available() + ["cpu"]
    for backend in candidates:
        try:
            sapien.render.RenderSystem(sapien.Device("cuda" if backend == "gpu" else "cpu"))
            return backend
        except RuntimeError:
            continue
    return "none"
