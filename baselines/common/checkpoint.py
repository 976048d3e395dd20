"""Checkpoints: folders with config.json and safetensors files, which hold no code."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from manifeel_ms3.evaluation.checkpoint_config import CONFIG, TRAINING_STATE, WEIGHTS, CheckpointError, checkpoint_config
from manifeel_ms3.evaluation.result import published_config
from manifeel_ms3.files import atomic_folder, atomic_write, remove_folder
from manifeel_ms3.nested_settings import differing
from manifeel_ms3.paths import LAST_LINK

BROKEN_STATE = "older checkpoints hold no state of training: evaluate one of them, or train anew with --overwrite"
"""What the error about a broken state of training advises, since only the newest checkpoint holds one."""
HEADER_BEGINS = 8
"""Number of bytes of a safetensors file before its header, which hold the header's length."""


def save_checkpoint(
    folder: Path, config: dict[str, Any], weights: dict[str, torch.Tensor], training: dict[str, torch.Tensor]
) -> None:
    """Write a checkpoint; its folder appears complete or not at all, even if the process is killed.

    Args:
        folder: Folder of the checkpoint, which must not exist.
        config: Everything that is needed to build the policy, and "step", in types that json can hold.
        weights: The (EMA) weights of the policy.
        training: The state of training that only resuming needs, from `pack`.

    Raises:
        FileWriteError: The checkpoint cannot be written.
    """
    with atomic_folder(folder) as partial:
        for name, tensors in ((WEIGHTS, weights), (TRAINING_STATE, training)):
            write_tensors(partial / name, tensors)
        (partial / CONFIG).write_text(json.dumps(config, indent=2), encoding="utf-8")


def save_in_half_precision(checkpoint: Path, folder: Path) -> None:
    """Write a copy of a checkpoint for publication: weights rounded to half precision, no state of training, no local paths.

    Args:
        checkpoint: Folder of the checkpoint.
        folder: Folder of the copy, which must not exist.

    Raises:
        CheckpointError: The checkpoint is missing or broken.
        FileWriteError: The copy cannot be written.
    """
    config, weights = published_config(checkpoint_config(checkpoint)), read_tensors(checkpoint / WEIGHTS)
    rounded = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in weights.items()}
    with atomic_folder(folder) as partial:
        write_tensors(partial / WEIGHTS, rounded)
        (partial / CONFIG).write_text(json.dumps(config, indent=2), encoding="utf-8")


def write_tensors(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Write a safetensors file. Each name has values of its own there, also where a module uses one weight under two names.

    Raises:
        OSError: The file cannot be written, as when the disk is full.
    """
    separate: dict[str, torch.Tensor] = {}
    memories: set[int] = set()
    for name, tensor in tensors.items():
        whole = tensor.contiguous()
        separate[name] = whole.clone() if (memory := whole.untyped_storage().data_ptr()) in memories else whole
        memories.add(memory)
    try:
        save_file(separate, path)
    except SafetensorError as error:
        raise OSError(str(error)) from error


def make_last(folder: Path) -> None:
    """Make the link `last`, beside a checkpoint, point to it.

    Raises:
        CheckpointError: There is a folder in the place of the link.
        FileWriteError: The link cannot be written.
    """
    last = folder.with_name(LAST_LINK)
    if last.is_dir() and not last.is_symlink():
        raise CheckpointError(
            f"{last} is a folder and not a link, as a program leaves it that follows links when it copies a run, such as scp; "
            "remove it if its checkpoint is beside it under its step, such as 00005000, and rename it to that otherwise"
        )
    with atomic_write(last) as partial:
        partial.unlink(missing_ok=True)  # left by a process that was killed here
        partial.symlink_to(folder.name)


def saved_checkpoints(checkpoints: Path) -> list[Path]:
    """The checkpoints in a folder, which need not exist, in the order of their steps."""
    return sorted(path for path in checkpoints.glob("*") if path.name.isdigit())


def newest_checkpoint(checkpoints: Path) -> Path:
    """The checkpoint of the last step; `last` leads to an older one if a process was killed before it moved the link.

    Raises:
        CheckpointError: There is no checkpoint.
    """
    if not (saved := saved_checkpoints(checkpoints)):
        raise CheckpointError(f"{checkpoints} has no checkpoint from which training could continue; leave out --resume")
    return saved[-1]


def prune(checkpoints: Path, keep: int, in_use: set[Path]) -> None:
    """Delete old checkpoints, and the state of training of all but the newest. The one that `last` names always stays whole.

    Args:
        checkpoints: Folder of the checkpoints.
        keep: Number of the newest checkpoints that stay.
        in_use: Older checkpoints that stay, too.
    """
    folders = saved_checkpoints(checkpoints)
    last = (checkpoints / LAST_LINK).resolve()
    for folder in folders[:-1]:
        if folder.resolve() != last:
            (folder / TRAINING_STATE).unlink(missing_ok=True)
    for folder in folders[:-keep]:
        if folder not in in_use and folder.resolve() != last:
            remove_folder(folder)


def read_tensors(path: Path, mend: str = "the checkpoint is broken, use another") -> dict[str, torch.Tensor]:
    """The tensors of a safetensors file.

    Args:
        path: Path of the file.
        mend: What the message of an error advises.

    Raises:
        CheckpointError: The file is missing or broken.
    """
    try:
        if not Path(path).is_file():  # opening a named pipe would wait forever
            raise FileNotFoundError("no such file")
        return load_file(path)
    except (OSError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); {mend}") from error


def holds_safetensors(path: Path) -> bool:
    """Whether a file has the format safetensors, in which a json header follows its own length, whatever its suffix is."""
    if not Path(path).is_file():
        return Path(path).suffix == ".safetensors"
    with Path(path).open("rb") as file:
        return file.read(HEADER_BEGINS + 1)[HEADER_BEGINS:] == b"{"


def require_fit(module: torch.nn.Module, weights: dict[str, torch.Tensor], source: Path) -> None:
    """Check that weights have the names and shapes of a module's own.

    Args:
        module: The module, which may be on torch's device "meta".
        weights: The weights by their names.
        source: The checkpoint or file that they are from, for the error's message.

    Raises:
        CheckpointError: Names or shapes differ, so the weights belong to another architecture.
    """
    own = module.state_dict()
    wrong = [n for n in own if n not in weights or weights[n].shape != own[n].shape] + [n for n in weights if n not in own]
    if wrong:
        raise CheckpointError(
            f"{source} holds another architecture: {len(wrong)} tensors do not fit, first {wrong[0]!r}; "
            "build the policy from the checkpoint's own config.json"
        )


def require_same_config(saved: dict[str, Any], wanted: dict[str, Any], free: set[str], source: Path) -> None:
    """Refuse to resume a run with other settings.

    Args:
        saved: Settings of the checkpoint.
        wanted: Settings of the run that resumes.
        free: Names of the settings that may differ.
        source: The checkpoint, for the error's message.

    Raises:
        CheckpointError: Some settings differ; the message lists them.
    """
    wanted = {name: value for name, value in json.loads(json.dumps(wanted)).items() if name not in free}
    saved = json.loads(json.dumps(saved))
    unequal = differing({name: saved.get(name) for name in wanted}, wanted)
    if lines := ", ".join(f"{name}: {old!r} there, {new!r} now" for name, old, new in unequal):
        raise CheckpointError(
            f"{source} was trained with other settings ({lines}); resume with the same, or choose another --run-dir"
        )


def random_state() -> dict[str, torch.Tensor]:
    """The states of torch's random number generators in this process, as named tensors."""
    state = dict(random=torch.get_rng_state())
    return state | dict(cuda_random=torch.cuda.get_rng_state()) if torch.cuda.is_available() else state


def pack(
    optimizer: torch.optim.Optimizer, model: torch.nn.Module, random_states: list[dict[str, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """The optimiser's state, the weights without EMA and the states of random number generators, as named tensors.

    Args:
        optimizer: The optimiser.
        model: The policy.
        random_states: What `random_state` gives in each process, in the order of their ranks.
    """
    packed = {f"model.{name}": t for name, t in model.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        packed |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    for rank, state in enumerate(random_states):
        packed |= {_of_rank(name, rank): value for name, value in state.items()}
    return packed


def _of_rank(name: str, rank: int) -> str:
    """Name of a process's own tensor among those that are packed; the first process's has no number."""
    return f"{name}.{rank}" if rank else name


def unpack(
    packed: dict[str, torch.Tensor], optimizer: torch.optim.Optimizer, model: torch.nn.Module, source: Path, rank: int
) -> None:
    """Restore what `pack` saved.

    Args:
        packed: The named tensors.
        optimizer: The optimiser.
        model: The policy.
        source: The checkpoint, for the error's message.
        rank: Rank of this process, whose own random states are restored.

    Raises:
        CheckpointError: The weights belong to another architecture, or something is missing or damaged.
    """
    weights = {name.removeprefix("model."): t for name, t in packed.items() if name.startswith("model.")}
    require_fit(model, weights, source)
    model.load_state_dict(weights)
    try:
        _restore_optimizer(packed, optimizer)
        torch.set_rng_state(packed[_of_rank("random", rank)])
        if (on_gpu := _of_rank("cuda_random", rank)) in packed and torch.cuda.is_available():
            torch.cuda.set_rng_state(packed[on_gpu])
    except (LookupError, ValueError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{source}: the state of training cannot be restored ({error}); train anew") from error


def _restore_optimizer(packed: dict[str, torch.Tensor], optimizer: torch.optim.Optimizer) -> None:
    """Restore the optimiser's moments, in the memory layout of their weights, which fused optimisers expect."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for name, tensor in packed.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            own = parameters[int(index)]
            state.setdefault(int(index), {})[key] = torch.empty_like(own).copy_(tensor) if tensor.shape == own.shape else tensor
    optimizer.load_state_dict(optimizer.state_dict() | dict(state=state))
