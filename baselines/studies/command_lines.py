"""The commands that do a study's jobs; a job runs with exactly the arguments that are printed here."""

import shlex
from functools import cache
from pathlib import Path
from typing import Any

from baselines.registry import policy_spec, preset_cli
from manifeel_ms3.paths import CHECKPOINTS

from .planning import Job
from .study import OBS_MODE, Kind, Resources

STEP = "$step"
"""Variable of the shell that holds the name of a checkpoint."""


def trajectory_of(job: Job, root: Path) -> Path:
    """File of the demonstrations that a recording writes."""
    return job.folder(root) / "trajectory.h5"


def device_arguments(kind: Kind, gpus: float) -> list[str]:
    """Arguments that keep a job on the CPU if the study gives it no GPU, since Ray does not hide the machine's GPUs from it.

    A recording computes nothing with torch on a GPU, which may render for it.
    """
    if gpus or kind == "record":
        return []
    return ["--device", "cpu", *(["--precision", "fp32", "--no-compile"] if kind == "train" else [])]


def record_arguments(job: Job, root: Path, workers: int) -> list[str]:
    """Arguments of `manifeel record` for a job."""
    settings = job.settings
    sensing = ["--obs-mode", OBS_MODE, "--cameras", settings["camera"], "--tactile-sensors", "right"]
    amount = ["--num", str(settings["num"]), "--num-procs", str(workers)]
    out = ["--env-kwargs", settings["env_kwargs"], "--out", str(trajectory_of(job, root))]
    return [settings["env_id"], *amount, *sensing, *out]


def weights_of(job: Job, root: Path) -> Path:
    """File of the weights that the pretraining of an encoder writes."""
    return job.folder(root) / "weights.safetensors"


def pretrain_arguments(job: Job, root: Path, gpus: float) -> list[str]:
    """Arguments of `python -m baselines.tactile_representations.pretrain` for a job."""
    (record,) = job.needs
    files = ["--demo-path", str(trajectory_of(record, root)), "--out", str(weights_of(job, root)), "--overwrite"]
    return [job.settings["encoder"], *device_arguments(job.kind, gpus), *files]


def train_arguments(job: Job, root: Path, gpus: float) -> list[str]:
    """Arguments of `manifeel train <policy>` for a job; the first is the preset. A study's own flags come last and prevail."""
    record, *pretrained = job.needs
    preset, *flags = train_flags(job.settings)
    files = ["--demo-path", str(trajectory_of(record, root)), "--run-dir", str(job.folder(root))]
    weights = [text for need in pretrained for text in ("--tacrgb-weights", str(weights_of(need, root)))]
    return [preset, *device_arguments(job.kind, gpus), *files, *flags, *weights]


def train_flags(settings: dict[str, Any]) -> list[str]:
    """Preset and flags of a training job, without its data and its folder."""
    return [settings["preset"], *(text for name, value in settings["flags"].items() for text in _flag(name, value))]


def _flag(name: str, value: Any) -> list[str]:
    """A flag with its value, as `manifeel train` takes it: what is on or off is said by the flag's name alone."""
    if isinstance(value, bool):
        *groups, last = name.split(".")
        return ["--" + ".".join((*groups, last if value else f"no-{last}"))]
    return [f"--{name}", *map(str, value if isinstance(value, list) else [value])]


def half_precision_arguments(checkpoint: str, copy: str) -> list[str]:
    """Arguments of `python -m baselines.studies.half_precision` for one checkpoint, whose copy is then evaluated."""
    return [checkpoint, "--out", copy]


def evaluate_arguments(job: Job, needs: Resources, checkpoint: str, out: str) -> list[str]:
    """Arguments of `manifeel eval` for one checkpoint of a job."""
    amount = ["--num-eval-episodes", str(job.settings["episodes"]), "--num-eval-envs", str(needs.workers)]
    amount += device_arguments(job.kind, needs.gpus)
    stop = ["--stop-at-success"] if job.settings["stop_at_success"] else []
    return ["--checkpoint", checkpoint, *amount, *stop, "--env-kwargs", job.settings["env_kwargs"], "--out", out]


def training_args(job: Job, root: Path = Path(), gpus: float = 0) -> Any:
    """The `TrainArgs` of a training job, of its policy's own class."""
    return _parsed(job.settings["policy"], *train_arguments(job, root, gpus))


@cache
def _parsed(policy: str, *arguments: str) -> Any:
    return preset_cli(policy_spec(policy), list(arguments))


def shell_command(job: Job, root: Path, needs: Resources) -> str:
    """One line of shell that does a job by hand; the jobs that it needs must be done before."""
    if job.kind == "record":
        return shlex.join(["manifeel", "record", *record_arguments(job, root, needs.workers)])
    if job.kind == "pretrain":
        module = "baselines.tactile_representations.pretrain"
        return shlex.join(["python", "-m", module, *pretrain_arguments(job, root, needs.gpus)])
    if job.kind == "train":
        return shlex.join(["manifeel", "train", job.settings["policy"], *train_arguments(job, root, needs.gpus)])
    return _shell_evaluation(job, root, needs)


def _shell_evaluation(job: Job, root: Path, needs: Resources) -> str:
    """One line of shell that evaluates the last checkpoints of a training, in half precision if the job does so."""
    (train,) = job.needs
    trained, folder = train.folder(root) / CHECKPOINTS, job.folder(root)
    checkpoint, command = str(trained / STEP), ""
    if job.settings["half_precision"]:
        copy = str(folder / CHECKPOINTS / STEP)
        rounding = ["python", "-m", "baselines.studies.half_precision", *half_precision_arguments(checkpoint, copy)]
        checkpoint, command = copy, f"{_joined(rounding)} && "
    command += _joined(["manifeel", "eval", *evaluate_arguments(job, needs, checkpoint, str(folder / f"{STEP}.json"))])
    steps = f"ls {shlex.quote(str(trained))} | grep -x '[0-9]*' | tail -n {job.settings['checkpoints']}"
    return f"for step in $({steps}); do {command}; done"


def _joined(arguments: list[str]) -> str:
    """A command whose arguments are quoted, apart from the variable `STEP` of the shell in them."""
    parts = ([shlex.quote(part) if part else "" for part in argument.split(STEP)] for argument in arguments)
    return " ".join(STEP.join(quoted) for quoted in parts)
