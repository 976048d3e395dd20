"""The renderer that this process can use, and messages for users where it has none."""

import functools
import gc
import logging
import os

import sapien
import torch
from mani_skill.envs.utils.system.backend import render_backend_name_mapping

log = logging.getLogger(__name__)
NO_RENDERER = (
    "no Vulkan renderer was found, and {wanted} needs one. Without a GPU, install Mesa 24.3 or newer (Debian 12: "
    "`apt install -t bookworm-backports mesa-vulkan-drivers` and `apt install libvulkan1 libegl1 libgl1`; Ubuntu 24.04: "
    "`apt install mesa-vulkan-drivers libvulkan1 libegl1 libgl1`); `scripts/setup.sh` does it. With an NVIDIA GPU, install its "
    "driver and libvulkan1. What needs no image works without: obs_mode='state' or 'tacff', render_backend='none'."
)
"""Message where no renderer was found; `wanted` is what needs one."""
OTHER_DEVICE = (
    "{wanted} needs images of a simulation on a GPU, which the same GPU has to draw, but the renderer is on the CPU. Install "
    "the Vulkan part of the GPU's driver (in a container: NVIDIA_DRIVER_CAPABILITIES=all) and leave out render_backend. What "
    "needs no image works without."
)
"""Message where the CPU would have to draw what a GPU simulates; `wanted` is what needs images."""
FORKED = (
    "{wanted} needs a renderer, and this process was forked from one that has its own, which does not survive a fork. Start "
    "it anew: multiprocessing.get_context('spawn'), AsyncVectorEnv(..., context='spawn'). What needs no image works here: "
    "obs_mode='state' or 'tacff'."
)
"""Message in a process that was forked from one with a renderer; `wanted` is what needs a renderer."""
_IMPORTED_IN = os.getpid()
"""Id of the process that has imported this module; a forked process has another one."""
_renders_in: int | None = None
"""Id of the process that has a renderer, None if none has; a fork copies this number, but not the renderer."""
_renders_on: str | None = None
"""Where this process renders, such as "gpu" or "cpu"; None if it has no renderer. SAPIEN renders on one device per process."""


def available_render_backend(asked: str = "auto") -> str:
    """The `render_backend` to use: "gpu", "cpu", "none", or what is asked for.

    A process that was forked from one with a renderer has none. Where there is no GPU, the CPU renders in its place, with a
    warning, as in ManiSkill, whose tools ask for one. It does not where a certain GPU is asked for by its number or address.

    Args:
        asked: A name of ManiSkill's, such as "gpu", "cuda:1" or "cpu"; "none", or "auto" for the one that this process uses
            already, or else the first that works.
    """
    global _renders_in, _renders_on
    if asked == "none" or renderer_lost():
        return "none"
    backend = (_renders_on or _first_that_works()) if asked == "auto" else asked
    if backend == "none" or not _works(backend):
        if backend == "none" or _device_of(backend) != "cuda" or not _works("cpu"):
            return "none"
        log.warning("render_backend=%r: there is no such device; the CPU renders in its place", asked)
        backend = "cpu"
    _renders_in, _renders_on = os.getpid(), backend
    _keep_inherited_objects_after_fork()
    return backend


@functools.cache
def _keep_inherited_objects_after_fork() -> None:
    """Keep forked processes from collecting the objects that they inherit.

    If they destroyed the parent's Vulkan objects, they would wait for ever for the driver's threads, which a fork loses.
    """
    os.register_at_fork(after_in_child=gc.freeze)


def renderer_lost() -> bool:
    """Whether this process was forked from one with a renderer."""
    return _renders_in not in (None, os.getpid())


def restrict_torch_after_fork() -> None:
    """Let torch use one thread and no GPU in a forked process.

    It would wait for ever for OpenMP's other threads. ManiSkill saves the random state of every GPU that torch counts when it
    builds a scene, which torch refuses in a process that was forked from one that has used CUDA.
    """
    if os.getpid() != _IMPORTED_IN:
        torch.set_num_threads(1)
    if torch.cuda._is_in_bad_fork():  # also where this package was imported after the fork
        torch.cuda.device_count = lambda: 0


@functools.cache
def _first_that_works() -> str:
    candidates = ["gpu"] * torch.cuda.is_available() + ["cpu"]
    for backend in candidates:
        if _works(backend):
            return backend
    return "none"


@functools.cache
def _works(backend: str) -> bool:
    """Whether SAPIEN can render in this process on the device that ManiSkill calls `backend`, such as "gpu" or "cuda:1"."""
    try:
        sapien.render.RenderSystem(sapien.Device(_device_of(backend)))
        return True
    except RuntimeError:
        return False


def is_gpu(backend: str) -> bool:
    """Whether a GPU renders on the device that ManiSkill calls `backend`, such as "gpu" or "cuda:1"."""
    return _device_of(backend).partition(":")[0] in ("cuda", "pci")


def _device_of(backend: str) -> str:
    """SAPIEN's name of the device that ManiSkill calls `backend`, such as "cuda" for "gpu"."""
    name, *address = backend.split(":")
    return ":".join([render_backend_name_mapping.get(name, name).removeprefix("sapien_"), *address])
