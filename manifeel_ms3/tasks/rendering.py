"""Which renderer this machine has, and what to install where it has none."""

import functools

import sapien
import torch

NO_RENDERER = (
    "no Vulkan renderer was found, and {wanted} needs one. Without a GPU, install Mesa 24.3 or newer (Debian 12: "
    "`apt install -t bookworm-backports mesa-vulkan-drivers` and `apt install libvulkan1 libegl1 libgl1`; Ubuntu 24.04: "
    "`apt install mesa-vulkan-drivers libvulkan1 libegl1 libgl1`); `scripts/setup.sh` does it. With an NVIDIA GPU, install its "
    "driver and libvulkan1. What needs no picture works without: obs_mode='state' or 'tacff', render_backend='none'."
)


@functools.cache
def available_render_backend() -> str:
    """The `render_backend` that works here: "gpu", "cpu" or "none"."""
    candidates = ["gpu"] * torch.cuda.is_available() + ["cpu"]
    for backend in candidates:
        try:
            sapien.render.RenderSystem(sapien.Device("cuda" if backend == "gpu" else "cpu"))
            return backend
        except RuntimeError:
            continue
    return "none"
