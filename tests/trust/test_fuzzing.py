"""Damaged files of every kind: each is read or refused by an error of this package, and memory stays bounded.

The damage is random: bytes are changed, cut out or put in, and parts of json and of h5 files are removed or replaced. A
thousand cases run by default, ten thousand with `-m slow`.
"""

import json
import random
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from baselines.common.checkpoint import read_tensors
from baselines.studies.study import read_study
from baselines.tactile_representations.released_weights import read_released
from manifeel_ms3.demonstrations import read_demonstrations
from manifeel_ms3.demonstrations.dataset import write_manifest
from manifeel_ms3.demonstrations.formats import diffusion_policy_zarr, lerobot
from manifeel_ms3.demonstrations.formats.maniskill_h5 import observation_keys, read_trajectories
from manifeel_ms3.demonstrations.summary import summary
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.demonstrations.view import read_streams
from manifeel_ms3.errors import InvalidFileError, ManifeelError, ServerError
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.journal import Journal
from manifeel_ms3.evaluation.policy import load_policy
from manifeel_ms3.evaluation.remote_policy import read_action
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.sensors.optics.shader import Shader
from tests.outcomes import made_up
from tests.sample import KEYS
from tests.tasks_and_marks import PEG

from .files_of_strangers import LEROBOT, REPOSITORY, SAMPLE
from .tiny_checkpoint import save_tiny_checkpoint

RESULT = Path(__file__).with_name("result.json")
STEPS = 12
"""Number of steps of the valid demonstration."""

# ------------------------------------------------------------------ damage

json_junk = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-9, 9), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=4,
)


def mutated(tree: Any, chance: random.Random, value: Any) -> Any:
    """The tree with one place, anywhere in it, replaced by `value` or gone."""
    if chance.random() < 0.2 or not isinstance(tree, dict | list) or not tree:
        return value
    place = chance.choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
    copy = tree.copy()
    if chance.random() < 0.3:
        del copy[place]
    else:
        copy[place] = mutated(tree[place], chance, value)
    return copy


def damage_bytes(path: Path, chance: random.Random, value: Any) -> None:
    """Cut a file, or change, remove or insert some of its bytes."""
    content = bytearray(path.read_bytes())
    place = chance.randrange(len(content) + 1)
    how = chance.choice(["cut", "flip", "number", "remove", "insert", "text"])
    if how == "cut":
        del content[place:]
    elif how == "flip":
        content[place : place + 1] = bytes([chance.randrange(256)])
    elif how == "number":  # sizes and offsets are numbers
        number = chance.choice([-1, 0, 1, 2**15, 2**31, 2**40, 2**62])
        content[place : place + 8] = struct.pack("<q", number)
    elif how == "remove":
        del content[place : place + chance.randrange(1, 40)]
    else:
        content[place:place] = (
            chance.randbytes(chance.randrange(1, 40)) if how == "insert" else str(value).encode("utf-8", "replace")
        )
    path.write_bytes(content)


def damage_json(path: Path, chance: random.Random, value: Any) -> None:
    path.write_text(json.dumps(mutated(json.loads(path.read_text()), chance, value)))


def damage_h5(path: Path, chance: random.Random, value: Any) -> None:
    """Remove a part, or replace it by an array of another form."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = chance.choice(names)
        del file[name]
        how = chance.choice(["remove", "group", "array", "value", "declared"])
        if how == "group":
            file.create_group(name)
        elif how == "array":
            shape = tuple(chance.choice([0, 1, 3, STEPS, STEPS + 1]) for _ in range(chance.randrange(5)))
            file.create_dataset(name, data=np.full(shape, chance.choice([0, 1e30]), chance.choice("fd")))
        elif how == "value":
            file.create_dataset(name, data=str(value).replace("\0", ""))
        elif how == "declared":
            shape = tuple(chance.choice([1, STEPS, 2**20]) for _ in range(chance.randrange(1, 5)))
            file.create_dataset(name, shape, "f4", chunks=True, compression="gzip")


def damage_folder(path: Path, chance: random.Random, value: Any) -> None:
    """Damage the structure of a json file in a folder, or the bytes of a file, or delete a file."""
    files = sorted(file for file in path.rglob("*") if file.is_file())
    described = [file for file in files if file.suffix == ".json" or file.name.startswith(".z")]
    how = chance.random()
    if how < 0.5 and described:
        damage_json(chance.choice(described), chance, value)
    elif how < 0.9:
        damage_bytes(chance.choice(files), chance, value)
    else:
        chance.choice(files).unlink()


# ------------------------------------------------------------------ what reads


@dataclass
class Reader:
    """One kind of file, what reads it, and what damages it."""

    make: Callable[[Path], Path]
    """Puts a valid file or folder into a folder, and returns its path."""
    reads: tuple[Callable[[Path], Any], ...]
    """What reads it; each of these is called with the path of the file or folder."""
    damage: tuple[Callable[[Path, random.Random, Any], None], ...] = (damage_bytes,)


def copied(file: Path) -> Callable[[Path], Path]:
    return lambda folder: Path(shutil.copy(file, folder))


def made_trajectory(folder: Path) -> Path:
    """The first steps of one episode of the sample, with all of its parts."""
    with h5py.File(SAMPLE) as sample, h5py.File(folder / "trajectory.h5", "w") as file:

        def shorten(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                values = item[: STEPS + (len(item) > len(sample["traj_0/actions"]))]
                if name == "success":
                    values[-1] = True  # without it, the episode is no demonstration
                chunks = (1, *values.shape[1:]) if values.ndim > 1 else None
                file.create_dataset(f"traj_0/{name}", data=values, chunks=chunks, compression="gzip" if chunks else None)

        sample["traj_0"].visititems(shorten)
    header = json.loads(SAMPLE.with_suffix(".json").read_text())
    header["episodes"] = [header["episodes"][0] | dict(elapsed_steps=STEPS)]
    (folder / "trajectory.json").write_text(json.dumps(header))
    return folder / "trajectory.h5"


def made_lerobot(kind: str) -> Callable[[Path], Path]:
    return lambda folder: shutil.copytree(LEROBOT / kind, folder / "set")


def made_zarr(folder: Path) -> Path:
    pytest.importorskip("zarr")
    diffusion_policy_zarr.write_zarr(made_trajectory(folder), folder / "store")
    return folder / "store"


def made_set(folder: Path) -> Path:
    (folder / PEG).mkdir()
    made_trajectory(folder / PEG)
    write_manifest(folder)
    return folder / "manifest.json"


def made_released(folder: Path) -> Path:
    weights = {f"layer.{i}.{name}": torch.randn(4, 3) for i in range(3) for name in ("weight", "bias")}
    torch.save(dict(model=weights, epoch=3, other=[random.Random(0)]), folder / "released.ckpt")
    return folder / "released.ckpt"


def made_checkpoint(folder: Path) -> Path:
    return save_tiny_checkpoint(folder / "00000001")


READ_TRAJECTORY: tuple[Callable[[Path], Any], ...] = (
    lambda path: read_demonstrations(path, KEYS),
    summary,
    lambda path: read_streams(path, 0),
    lambda path: list(read_trajectories(path, observation_keys(path))),
)
READ_ZARR = diffusion_policy_zarr.count_episodes, lambda path: list(diffusion_policy_zarr.read_zarr(path, KEYS))
READ_LEROBOT = lerobot.count_episodes, lambda path: list(lerobot.read_lerobot(path, KEYS))


def of_json(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """What reads a trajectory file, given the json beside it."""
    return lambda path: read(path.with_suffix(".h5"))


def made_answer(folder: Path) -> Path:
    np.savez_compressed(folder / "answer.npz", action=np.linspace(-1, 1, 6))
    return folder / "answer.npz"


def read_answer(path: Path) -> None:
    try:
        read_action(path.read_bytes())
    except ServerError as error:  # it cannot name a file
        raise InvalidFileError(f"{path}: {error}") from error


IDENTITY = dict(env_id=PEG)
SEEDS = [100_000, 100_001]


def made_journal(folder: Path) -> Path:
    journal = Journal(folder / "evaluation.json", IDENTITY, SEEDS)
    for seed in SEEDS:
        journal.add(made_up(seed, True, force=1.5))
    return journal.path


def read_journal(path: Path) -> None:
    Journal(path.with_name("evaluation.json"), IDENTITY, SEEDS)


READERS = {
    "server's answer": Reader(made_answer, (read_answer,)),
    "journal": Reader(made_journal, (read_journal,)),
    "trajectory": Reader(made_trajectory, READ_TRAJECTORY, (damage_bytes, damage_h5)),
    "trajectory's json": Reader(
        lambda folder: made_trajectory(folder).with_suffix(".json"),
        tuple(map(of_json, READ_TRAJECTORY)),
        (damage_bytes, damage_json),
    ),
    "manifest": Reader(made_set, (lambda path: validate(path.parent),), (damage_bytes, damage_json)),
    "zarr": Reader(made_zarr, READ_ZARR, (damage_folder,)),
    "lerobot, images": Reader(made_lerobot("images"), READ_LEROBOT, (damage_folder,)),
    "lerobot, videos": Reader(made_lerobot("videos"), READ_LEROBOT, (damage_folder,)),
    "checkpoint": Reader(made_checkpoint, (load_policy,), (damage_folder,)),
    "safetensors": Reader(lambda folder: made_checkpoint(folder) / "model.safetensors", (read_tensors,)),
    "released weights": Reader(made_released, (read_released,)),
    "config.json": Reader(
        lambda folder: made_checkpoint(folder) / "config.json",
        (lambda path: checkpoint_config(path.parent),),
        (damage_bytes, damage_json),
    ),
    "result": Reader(copied(RESULT), (read_result,), (damage_bytes, damage_json)),
    "shader": Reader(copied(REPOSITORY / "data/gelsight_r15_shader.npz"), (Shader.load,)),
    "study": Reader(copied(REPOSITORY / "configs/smoke.yaml"), (read_study,)),
}
CASES = {"lerobot, videos": 30, "checkpoint": 50}
"""Number of cases in the default run, of readers that are slow; the others have `DEFAULT_CASES`."""
DEFAULT_CASES = 77


def refused_or_read(read: Callable[[Path], Any], path: Path) -> None:
    """Read, or be refused by an error that names the file or its folder; any other error is a fault."""
    try:
        read(path)
    except ManifeelError as error:
        if str(path.parent) not in str(error):
            raise AssertionError("the error does not name the file") from error


def test_the_set_of_demonstrations_has_no_fault_before_it_is_damaged(tmp_path):
    assert validate(made_set(tmp_path).parent) == []


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("times", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_damaged_files_are_read_or_refused(name, times, tmp_path, monkeypatch, bounded_memory):
    reader = READERS[name]
    valid = tmp_path / "valid"
    valid.mkdir()
    made = reader.make(valid).relative_to(valid)
    for read in reader.reads:
        read(valid / made)  # undamaged, it is read
    monkeypatch.chdir(valid)
    before = sorted(path for path in tmp_path.rglob("*"))

    @settings(
        max_examples=times * CASES.get(name, DEFAULT_CASES),
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(chance=st.randoms(use_true_random=False), value=json_junk, damage=st.sampled_from(reader.damage))
    def case(chance, value, damage):
        folder = tmp_path / "damaged"
        shutil.copytree(valid, folder)
        try:
            damage(folder / made, chance, value)
            for read in reader.reads:
                refused_or_read(read, folder / made)
        finally:
            shutil.rmtree(folder)

    with bounded_memory("a damaged file"):
        case()
    assert sorted(path for path in tmp_path.rglob("*")) == before  # nothing was written, nothing outside was touched
