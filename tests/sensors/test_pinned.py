"""The default sensor gives what it gave when the samples in `data/sample` were recorded.

`python -m tests.sensors.test_pinned` writes new numbers after a change that is intended.
"""

from pathlib import Path

import numpy as np
import torch

from manifeel_ms3.sensors import with_options
from manifeel_ms3.sensors.touch_model import TouchModel
from tests.sensors.pads import CONFIG, CPU, LOADS, meshes, pressed

PINNED = Path(__file__).with_name("r15_touch.npz")
OPTIONS = {"plain": {}, "all": {"optics.shadow": 0.5, "optics.markers": True, "optics.noise": 2.0}}
EVERY = 8  # pixels


def touched() -> dict[str, np.ndarray]:
    out = {}
    for label, options in OPTIONS.items():
        model = TouchModel(with_options(CONFIG, options), len(LOADS), CPU)
        model.reset(torch.arange(len(LOADS)), np.arange(len(LOADS)))
        for _ in range(3):
            obs = model.observe(pressed(meshes()), LOADS)
        out[f"{label}_rgb"] = obs["rgb"][:, ::EVERY, ::EVERY].numpy()
    return out | {name: obs[name].numpy() for name in ("force_field", "penetration")}


def test_default_sensor_is_unchanged():
    with np.load(PINNED) as pinned:
        for name, value in touched().items():
            # the same bits on the machine that wrote them; other processors add up in other orders
            assert value.dtype == pinned[name].dtype
            assert np.allclose(value, pinned[name], rtol=0, atol=1 if value.dtype == np.uint8 else 1e-6), name
            if value.dtype == np.uint8:
                assert (value == pinned[name]).mean() > 0.999, name


if __name__ == "__main__":
    np.savez_compressed(PINNED, **touched())
