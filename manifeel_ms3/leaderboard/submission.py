"""A submission: a folder with submission.json and the result files of one policy, and what is checked of it."""

import json
import shutil
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from manifeel_ms3.analysis.protocol import Setup, setup_of
from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.policy import PolicySource
from manifeel_ms3.evaluation.result import ResultError, read_result
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.tasks.registry import all_tasks, evaluation_seeds, task_spec

ABOUT = "submission.json"
STARTS = 50
"""Number of evaluation episodes of a result, as in the paper."""
SIMULATOR = ("mani-skill", "sapien")  # packages whose minor version must be the one here
MOST_FORCE = 500.0  # N: more than the arm can press with
NAMED_BY = ("step", "seed", "policy_name", "env_id", "obs_mode")  # a checkpoint is told from others
FORCE_TOLERANCE = 0.01  # N: the result is rounded


@dataclass(frozen=True)
class About:
    """What submission.json says."""

    name: str
    authors: str
    link: str = ""
    """paper, code or weights"""


@dataclass(frozen=True)
class Submission:
    folder: Path
    about: About
    results: dict[Path, dict[str, Any]]

    @property
    def setups(self) -> set[Setup]:
        return {setup_of(result) for result in self.results.values()}


class SubmissionError(InvalidFileError):
    """A submission that cannot be taken; the message lists all that is wrong."""


def read_submission(folder: Path) -> Submission:
    """A submission, each of its files of the published form.

    Raises:
        SubmissionError: one is missing or is not.
    """
    wrong, results = [], {}
    about = None
    try:
        about = About(**json.loads((folder / ABOUT).read_text()))
        if not about.name or not about.authors:
            wrong.append(f"{ABOUT}: name and authors must not be empty")
    except (OSError, json.JSONDecodeError, TypeError) as error:
        wrong.append(f'{ABOUT}: {error}; it must hold {{"name": ..., "authors": ..., "link": ...}}')
    for path in sorted(path for path in folder.rglob("*.json") if path.name != ABOUT):
        try:
            results[path] = read_result(path)
        except ResultError as error:
            wrong.append(str(error))
    if not results and not wrong:
        wrong.append("it holds no result; put what evaluation.run wrote into it")
    if about is None or wrong:
        raise SubmissionError(_listed(folder, wrong))
    return Submission(folder, about, results)


def check(submission: Submission) -> None:
    """See that results are of today's tasks, on their starts, and could be true.

    Raises:
        SubmissionError: some are not.
    """
    wrong = [
        f"{path.relative_to(submission.folder)}: {fault}"
        for path, result in submission.results.items()
        for fault in _faults(result)
    ]
    if wrong:
        raise SubmissionError(_listed(submission.folder, wrong))


def _faults(result: dict[str, Any]) -> list[str]:
    if result["env_id"] not in all_tasks():
        return [f"{result['env_id']} is no task of this leaderboard"]
    return _faults_of_the_task(result) + _faults_of_the_numbers(result)


def _faults_of_the_task(result: dict[str, Any]) -> list[str]:
    """What it was evaluated on."""
    env_id, faults = result["env_id"], []
    seeds, here = evaluation_seeds(STARTS), task_spec(env_id).revision
    given = [episode["seed"] for episode in result["episodes"]]
    if given != seeds:
        missing, foreign = sorted(set(seeds) - set(given)), sorted(set(given) - set(seeds))
        faults.append(
            f"its {len(given)} starts are not the {STARTS} evaluation seeds of every task, from {seeds[0]} on (missing {missing[:5]}, foreign {foreign[:5]}, or "
            f"in another order); evaluate with --episodes {STARTS}"
        )
    if result["revision"] != here:
        faults.append(
            f"it is of revision {result['revision']} of {env_id}, here the task has revision {here}; evaluate with "
            f"manifeel-ms3 {version('manifeel-ms3')} as released"
        )
    for name in SIMULATOR:
        theirs, ours = result["versions"][name], version(name)
        if theirs.split(".")[:2] != ours.split(".")[:2]:
            faults.append(
                f"it was run with {name} {theirs}, the leaderboard takes {'.'.join(ours.split('.')[:2])}; install that"
            )
    return faults


def _faults_of_the_numbers(result: dict[str, Any]) -> list[str]:
    """Whether they fit each other, and what is possible."""
    faults, episodes = [], result["episodes"]
    for name in ("success_once", "success_at_end"):
        won = sum(episode[name] for episode in episodes)
        expected = (won / len(episodes), *wilson_interval(won, len(episodes)))
        told = tuple(result[name][key] for key in ("rate", "low", "high"))
        if not np.allclose(told, expected, atol=1e-3):
            faults.append(f"{name} says {told}, its episodes come to {tuple(round(x, 4) for x in expected)}")
    mean = float(np.mean([episode["length"] for episode in episodes]))
    if abs(mean - result["mean_length"]) > 1e-3:
        faults.append(f"mean_length says {result['mean_length']}, its episodes come to {mean:.3f}")
    limit = gym.spec(result["env_id"]).max_episode_steps
    for episode in episodes:
        place = f"episode of seed {episode['seed']}"
        if episode["length"] > limit:
            faults.append(f"{place}: {episode['length']} steps, the task ends after {limit}")
        if episode["success_at_end"] and not episode["success_once"]:
            faults.append(f"{place}: succeeds at the end, but never")
        if episode["success_once"] and (episode["error"] or episode["length"] == 0):
            faults.append(f"{place}: succeeds after {episode['length']} steps, with the error {episode['error']}")
        if episode["peak_contact_force"] > MOST_FORCE:
            faults.append(f"{place}: {episode['peak_contact_force']} N, more than the arm can press with")
    return faults


def run_again(submission: Submission, source: PolicySource, episodes: int, seed: int = 0) -> None:
    """Roll some episodes of one of the results out again, and see that they go as it says.

    Args:
        source: the policy that the result is of.
        seed: of the choice of episodes.

    Raises:
        SubmissionError: no result is of this policy, or an episode went otherwise.
    """
    same = [(path, result) for path, result in submission.results.items() if _is_of(result, source)]
    if not same:
        raise SubmissionError(_listed(submission.folder, [f"no result is of {source.checkpoint or source.policy}"]))
    path, result = same[0]
    chosen = np.random.default_rng(seed).choice(len(result["episodes"]), min(episodes, len(result["episodes"])), replace=False)
    evaluation = evaluate.Evaluation(source, result["env_id"], result["env_kwargs"], result["config"])
    told = [result["episodes"][k] for k in sorted(chosen)]
    seen = evaluate.run_episodes(evaluation, [episode["seed"] for episode in told], 1, step_timeout=60.0)
    wrong, file = [], path.relative_to(submission.folder)
    for episode, outcome in zip(told, seen, strict=True):
        for name in ("success_once", "success_at_end", "length", "peak_contact_force"):
            tolerance = FORCE_TOLERANCE if name == "peak_contact_force" else 0
            before, now = episode[name], getattr(outcome, name)
            if abs(before - now) > tolerance:
                wrong.append(f"{file}: seed {episode['seed']}: {name} says {before}, run again it is {now}")
    if wrong:
        theirs, ours = result["versions"]["torch"], version("torch")
        if theirs != ours:
            wrong.append(f"{file} was made with torch {theirs}, here it is {ours}, which rounds otherwise: install that")
        raise SubmissionError(_listed(submission.folder, wrong))


def _is_of(result: dict[str, Any], source: PolicySource) -> bool:
    if source.checkpoint is None:
        return result["policy"] == source.policy
    config = checkpoint_config(source.checkpoint)
    return all(result["config"].get(name) == config.get(name) for name in NAMED_BY)


def take(submission: Submission, board: Path) -> Path:
    """Copy a checked submission into a leaderboard's folder.

    Raises:
        FileExistsError: there is one of that name.
    """
    target = board / submission.folder.resolve().name
    if target.exists():
        raise FileExistsError(f"{target} is there already; rename the folder of the new one, or delete the old one")
    shutil.copytree(submission.folder, target)
    return target


def _listed(folder: Path, wrong: list[str]) -> str:
    return f"{folder} cannot be taken:\n" + "\n".join(f"- {fault}" for fault in wrong)
