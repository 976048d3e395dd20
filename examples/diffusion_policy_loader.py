"""Feed our recordings to the data loader of ManiSkill's Diffusion Policy: `python examples/diffusion_policy_loader.py peg.h5`.

`train_rgbd.py` of ManiSkill's `examples/baselines/diffusion_policy` reads a file with its `load_demo_dataset` and then turns
each observation into `rgb` and `state` with a function `obs_process_fn`. Ours is below. Put it into that script, and wrap the
environments of its `make_eval_envs` as `FlattenRGBDObservationWrapper(PadsAsCamerasWrapper(env))`, which makes `rgb` and
`state` in the same way: images of pads become channels of `rgb`, in the size of the cameras' images, and force fields become a
part of `state`.
"""

import logging
from pathlib import Path

import numpy as np
import torch
import tyro
from torch.utils.data import DataLoader, Dataset

from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.wrappers import resized

OBS_HORIZON, PRED_HORIZON = 2, 16  # the defaults of ManiSkill's script


def leaves(tree):
    """Arrays (T + 1, ...) of a group of the file, in the order in which they were observed."""
    for value in tree.values():
        yield from leaves(value) if hasattr(value, "values") else [value[()]]


def obs_process_fn(obs) -> dict[str, np.ndarray]:
    """Observations of one episode, a group of the file, as ManiSkill's Diffusion Policy takes them: `rgb` and `state`."""
    rest = [leaf.reshape(len(leaf), -1) for name in ("agent", "extra") if name in obs for leaf in leaves(obs[name])]
    sensors = sorted(obs["sensor_data"].items(), key=lambda item: item[0].startswith("tactile_"))  # cameras, then pads
    images = [torch.from_numpy(sensor["rgb"][()]) for _, sensor in sensors if "rgb" in sensor]
    fields = [sensor["force_field"][()] for _, sensor in sensors if "force_field" in sensor]
    fields = [field.reshape(len(field), -1) for field in fields]
    processed = dict(state=np.concatenate([*rest, *fields], axis=1).astype(np.float32))
    if images:
        size = images[0].shape[1:3]
        processed["rgb"] = torch.cat([resized(image, (size[0], size[1])) for image in images], dim=-1).numpy()
    return processed


class DiffusionPolicyDataset(Dataset):
    """Windows of a recording: `OBS_HORIZON` observations and `PRED_HORIZON` actions, padded at the ends of episodes."""

    def __init__(self, path: Path):
        with open_trajectories(path) as file:
            episodes = [file[f"traj_{i}"] for i in range(len(file))]
            self.observations = [obs_process_fn(episode["obs"]) for episode in episodes]
            self.actions = [episode["actions"][()] for episode in episodes]
        self.windows = [(i, t) for i, actions in enumerate(self.actions) for t in range(len(actions))]

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> dict:
        episode, t = self.windows[index]
        actions = self.actions[episode]
        before = np.arange(t - OBS_HORIZON + 1, t + 1).clip(min=0)
        after = np.arange(t - OBS_HORIZON + 1, t - OBS_HORIZON + 1 + PRED_HORIZON).clip(0, len(actions) - 1)
        return dict(
            observations={name: values[before] for name, values in self.observations[episode].items()}, actions=actions[after]
        )


def main(path: tyro.conf.Positional[Path], batch_size: int = 8) -> dict:
    """Read a recording, and return its first batch.

    Args:
        path: Trajectory file with observations.
        batch_size: Number of windows in a batch.
    """
    loader = DataLoader(DiffusionPolicyDataset(path), batch_size=batch_size, shuffle=True)
    batch = next(iter(loader))
    for name, values in (*batch["observations"].items(), ("actions", batch["actions"])):
        logging.info("%s %s %s", name, tuple(values.shape), values.dtype)
    return batch


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tyro.cli(main)
