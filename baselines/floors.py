"""Measure the failure floors of tasks: `python -m baselines.floors ManiFeel-PegInsertion-v1 --num-eval-episodes 20`.

Three policies that have learnt nothing are evaluated on the first evaluation seeds: random actions, the mean action of
demonstrations, and the network of Diffusion Policy's preset `cpu` before training. An episode ends at success, or
when it can no longer succeed, which saves time and changes no rate of success. Tables of results show the floors
(`manifeel_ms3.evaluation.floors`).
"""

import json
import logging
import shlex
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import arg

from baselines.registry import policy_spec, preset_cli
from manifeel_ms3.arguments import several_of
from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.demonstrations.recording import observed_file
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.floors import FLOORS_SCHEMA, FORM, POLICIES, floors_file
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.files import read_json, write_json
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks, task_spec

log = logging.getLogger(__name__)
OBS_MODE = "rgb+tacff"
"""Observation mode of the untrained network."""
THEN = " && "
"""Text between the commands that measured the floors of a file, where these were several."""
BLIND: dict[str, Any] = dict(obs_mode="none", env_kwargs='{"render_backend": "none"}')
"""Arguments of the evaluation of policies that observe nothing."""


@dataclass
class Args:
    """Arguments of the command."""

    tasks: tyro.conf.Positional[tuple[str, ...]] = ()
    """Ids of the tasks; all tasks if none is given."""
    policies: tuple[str, ...] = tuple(POLICIES)
    """Names of the policies: "random", "mean action", "untrained"."""
    episodes: Annotated[int, arg(name="num-eval-episodes", aliases=["--episodes"])] = 50
    """Number of episodes for each policy."""
    workers: Annotated[int, arg(name="num-eval-envs", aliases=["--workers"])] = 1
    """Number of processes that simulate."""
    demos: Annotated[Path | None, arg(name="demo-path", aliases=["--demos"])] = None
    """Folder with trajectory files in a folder for each task, from which the mean action and the ranges of the network's inputs
    are taken; the sample of the package if not given."""
    out: Path | None = None
    """Folder of the files, one for each task; that of the package if not given. Floors of policies that are not measured
    stay."""


def main(args: Args) -> list[Path]:
    """Measure the floors, and return the paths of the files.

    Raises:
        UnknownNameError: A task is not registered.
        InvalidArgumentError: A policy is not known.
        DemonstrationError: The demonstrations of a task are missing or broken.
    """
    several_of("--policies", args.policies, POLICIES)
    return [_measure_task(env_id, args) for env_id in args.tasks or all_tasks()]


def command_of(env_id: str, args: Args) -> str:
    """The command that measures the same floors of one task, in the package's own folder of floors."""
    flags = ["--num-eval-episodes", str(args.episodes)]
    if args.policies != tuple(POLICIES):
        flags += ["--policies", *args.policies]
    if args.demos is not None:
        flags += ["--demo-path", str(args.demos)]
    return shlex.join(["python", "-m", "baselines.floors", env_id, *flags])


def _measure_task(env_id: str, args: Args) -> Path:
    spec = task_spec(env_id)
    demos = _observed_demonstrations((args.demos or data_dir() / "sample") / spec.env_id)
    path = floors_file(spec.env_id, args.out)
    floors, commands = _earlier(path, spec.revision)
    if floors.keys() <= set(args.policies):  # all are measured anew
        floors, commands = {}, []
    for number, name in enumerate(args.policies, start=1):
        with tempfile.TemporaryDirectory() as folder:
            result = _evaluate(name, spec.env_id, demos, Path(folder), args)
        numbers = dict(episodes=len(result["episodes"])) | result["success_once"]
        floors[name] = numbers
        log.info("%s, %s: %s", spec.env_id, name, numbers)
        measured = replace(args, policies=args.policies[:number])
        command = THEN.join(dict.fromkeys([*commands, command_of(spec.env_id, measured)]))
        about = dict(schema=FLOORS_SCHEMA, env_id=spec.env_id, revision=spec.revision, git_commit=result["git_commit"])
        write_json(path, about | dict(command=command, floors={known: floors[known] for known in POLICIES if known in floors}))
    return path


def _observed_demonstrations(folder: Path) -> Path:
    """The file of a task's demonstrations that holds what the untrained network observes.

    Raises:
        DemonstrationError: There is none.
    """
    path = observed_file(folder, OBS_MODE)
    modes = read_header(path)["env_info"]["env_kwargs"]["obs_mode"].split("+") if path else ()
    if path and set(OBS_MODE.split("+")) <= set(modes):
        return path
    raise DemonstrationError(f"{folder} has no trajectory file with {OBS_MODE}; record one with --obs-mode {OBS_MODE}")


def _earlier(path: Path, revision: int) -> tuple[dict[str, Any], list[str]]:
    """The floors of this revision of the task that a file holds, and the commands that measured them."""
    if not path.is_file():
        return {}, []
    content = read_json(path, FORM, "the failure floors of a task")
    return (content["floors"], content["command"].split(THEN)) if content["revision"] == revision else ({}, [])


def _evaluate(name: str, env_id: str, demos: Path, folder: Path, args: Args) -> dict[str, Any]:
    """The result of one policy."""
    if name == "untrained":
        arguments = _untrained(env_id, demos, folder)
    else:
        known = {"random": ("RandomActions", dict(env_id=env_id)), "mean action": ("MeanAction", dict(demos=str(demos)))}
        policy, kwargs = known[name]
        arguments = dict(policy=f"baselines.references:{policy}", policy_kwargs=json.dumps(kwargs)) | BLIND
    out = folder / "evaluation.json"
    amount: dict[str, Any] = dict(episodes=args.episodes, workers=args.workers, stop_at_success=True, out=out)
    evaluate.main(evaluate.Args(env_id=env_id, **arguments, **amount))
    return read_result(out)


def _untrained(env_id: str, demos: Path, folder: Path) -> dict[str, Any]:
    """Arguments that evaluate an untrained network: a checkpoint after one step, whose first weights are drawn again."""
    cameras = read_header(demos)["env_info"]["env_kwargs"]["cameras"]
    policy = policy_spec("diffusion_policy")
    sensing = ["--env-id", env_id, "--obs-mode", OBS_MODE, "--cameras", *cameras]
    train = preset_cli(
        policy, ["cpu", "--demo-path", str(demos), *sensing, "--total-iters", "1", "--run-dir", str(folder / "run")]
    )
    kwargs = json.dumps(dict(checkpoint=str(policy.train(train))))
    observed = dict(obs_mode=OBS_MODE, cameras=tuple(cameras))
    return dict(policy="baselines.references:Untrained", policy_kwargs=kwargs, **observed)


def next_step(_args: Args, made: list[Path]) -> str:
    """What the command made, and what one can do with it."""
    return f"the floors are in {', '.join(map(str, made))}; `manifeel results` shows them beside what policies reach"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
