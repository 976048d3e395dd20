"""Feed our recordings to the data loader of ManiSkill's Diffusion Policy:
`python examples/diffusion_policy_loader.py peg.h5 --maniskill ManiSkill/examples/baselines/diffusion_policy`.

ManiSkill's loader is the class `SmallDemoDataset_DiffusionPolicy` of `train_rgbd.py` in that folder of its repository; its
package does not contain it. It turns each observation into `rgb` and `state` with a function `obs_process_fn`. Ours is below.
To train with that script, give it this function, and wrap the environments of its `make_eval_envs` as
`FlattenRGBDObservationWrapper(PadsAsCamerasWrapper(env))`, which makes `rgb` and `state` in the same way: images of pads become
channels of `rgb`, in the size of the cameras' images, and force fields become a part of `state`.

ManiSkill's loader takes the last component of an action for the gripper's and repeats it after an episode's end. Record with
`--env-kwargs '{"control_mode": "pd_ee_delta_pose"}'`, whose actions have one, to train with it.

Without `--maniskill`, similar windows are made by the class `DiffusionPolicyDataset` below, which
repeats the whole last action after an episode's end.
"""

import importlib
import logging
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch.utils.data import DataLoader, Dataset

from manifeel_ms3.demonstrations.formats.demonstration_format import DemonstrationError
from manifeel_ms3.demonstrations.formats.maniskill_h5 import group_of, open_trajectories, read_header
from manifeel_ms3.wrappers import resized

OBS_HORIZON, PRED_HORIZON = 2, 16  # the defaults of ManiSkill's script


def leaves(tree):
    """Arrays (T + 1, ...) of a group of the file, or of the dictionary that ManiSkill reads, in their order."""
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
        header = read_header(path)
        with open_trajectories(path) as file:
            episodes = [group_of(file, entry) for entry in header["episodes"]]
            if not all("obs" in episode for episode in episodes):
                raise DemonstrationError(f"{path} holds no observations; `manifeel render-observations` makes a file with them")
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


def maniskills_dataset(path: Path, folder: Path) -> Dataset:
    """ManiSkill's own dataset of a recording.

    Args:
        path: Trajectory file with observations.
        folder: Folder `examples/baselines/diffusion_policy` of a clone of ManiSkill, whose `train_rgbd.py` is imported.
    """
    if not (folder / "train_rgbd.py").is_file():
        raise SystemExit(
            f"--maniskill {folder} has no train_rgbd.py; give examples/baselines/diffusion_policy of a clone of ManiSkill"
        )
    sys.path.insert(0, str(folder))
    script = importlib.import_module("train_rgbd")
    recorded = read_header(path)["env_info"]
    env = gym.make(recorded["env_id"], **recorded["env_kwargs"])
    script.args = script.Args(control_mode=env.unwrapped.control_mode, obs_horizon=OBS_HORIZON, pred_horizon=PRED_HORIZON)
    space = env.observation_space
    env.close()
    return script.SmallDemoDataset_DiffusionPolicy(str(path), obs_process_fn, space, True, False, "cpu", None)


def main(path: tyro.conf.Positional[Path], maniskill: Path | None = None, batch_size: int = 8) -> dict:
    """Read a recording, and return its first batch.

    Args:
        path: Trajectory file with observations.
        maniskill: Folder `examples/baselines/diffusion_policy` of a clone of ManiSkill, whose loader reads the recording.
        batch_size: Number of windows in a batch.
    """
    dataset = maniskills_dataset(path, maniskill) if maniskill else DiffusionPolicyDataset(path)
    loader = DataLoader(dataset, batch_size=batch_size, shuffle=True)
    batch = next(iter(loader))
    for name, values in (*batch["observations"].items(), ("actions", batch["actions"])):
        logging.info("%s %s %s", name, tuple(values.shape), values.dtype)
    return batch


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tyro.cli(main)
