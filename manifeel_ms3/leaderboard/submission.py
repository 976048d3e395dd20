"""Submissions: folders with submission.json and the result files of one policy, and their checks."""

import json
import shutil
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.errors import FileExistsAlreadyError, InvalidFileError
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.evaluate import Evaluation, run_episodes
from manifeel_ms3.evaluation.policy import PolicySource
from manifeel_ms3.evaluation.result import ResultError, read_result
from manifeel_ms3.evaluation.rollout import EpisodeOutcome
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.tasks.registry import all_tasks, evaluation_seeds, task_spec

ABOUT = "submission.json"
EPISODES = 50
"""Number of evaluation episodes of a result, as in the paper."""
SIMULATOR = ("mani-skill", "sapien")
"""Packages whose minor version must be the one that is installed here."""
MOST_FORCE = 500.0
"""Contact force in N, more than the arm can press with; demonstrations stay below 60 N."""
NAMED_BY = ("step", "seed", "policy_name", "env_id", "obs_mode")
"""Entries of a policy's configuration by which a checkpoint differs from others."""
FORCE_TOLERANCE = 0.01
"""Difference in N between forces that count as the same; a result rounds them to 0.001 N."""
RATE_TOLERANCE = 1e-3
"""Difference between numbers that count as the same, where a result rounds them to four digits."""
SHOWN = 5
"""Number of wrong seeds that a message lists."""
STEP_TIMEOUT = 60.0
"""Longest time that a policy may take for one action, in s; the default of an evaluation."""


@dataclass(frozen=True)
class About:
    """The content of submission.json."""

    name: str
    """Name of the submission."""
    authors: str
    """Names of the authors."""
    link: str = ""
    """Address of the paper, the code or the weights."""


@dataclass(frozen=True)
class Submission:
    """A folder with results of one policy."""

    folder: Path
    about: About
    results: dict[Path, dict[str, Any]]
    """Contents of the result files, by their paths."""


class SubmissionError(InvalidFileError):
    """A submission cannot be accepted; the message lists everything that is wrong with it."""


def read_submission(folder: Path) -> Submission:
    """Read a submission, and check that its files have the published form.

    Raises:
        SubmissionError: A file is missing or does not have the form.
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
        wrong.append("it holds no result; add the result files that `manifeel eval` wrote")
    if about is None or wrong:
        raise SubmissionError(_listed(folder, wrong))
    return Submission(folder, about, results)


def check(submission: Submission) -> None:
    """Check that results are of the tasks as they are now, on the evaluation seeds, and of possible numbers.

    Raises:
        SubmissionError: Some results are not.
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
        return [f"{result['env_id']} is no task of this leaderboard; its tasks are {list(all_tasks())}"]
    return _faults_of_the_task(result) + _faults_of_the_numbers(result)


def _faults_of_the_task(result: dict[str, Any]) -> list[str]:
    """What is wrong with the episodes, the revision of the task and the simulator of a result."""
    env_id, faults = result["env_id"], []
    seeds, here = evaluation_seeds(EPISODES), task_spec(env_id).revision
    given = [episode["seed"] for episode in result["episodes"]]
    if given != seeds:
        missing, foreign = sorted(set(seeds) - set(given)), sorted(set(given) - set(seeds))
        faults.append(
            f"its {len(given)} episodes are not those of the {EPISODES} evaluation seeds from {seeds[0]} on (missing "
            f"{missing[:SHOWN]}, foreign {foreign[:SHOWN]}, or in another order); evaluate with --episodes {EPISODES}"
        )
    if result["revision"] != here:
        faults.append(
            f"it is of revision {result['revision']} of {env_id}, but the task has revision {here} here; evaluate again with "
            f"manifeel-ms3 {version('manifeel-ms3')}"
        )
    for name in SIMULATOR:
        theirs, ours = result["versions"][name], version(name)
        if theirs.split(".")[:2] != ours.split(".")[:2]:
            faults.append(
                f"it was run with {name} {theirs}, the leaderboard takes {'.'.join(ours.split('.')[:2])}; install that"
            )
    return faults


def _faults_of_the_numbers(result: dict[str, Any]) -> list[str]:
    """Numbers of a result that contradict each other, or are not possible."""
    faults, episodes = [], result["episodes"]
    for name in ("success_once", "success_at_end"):
        succeeded = sum(episode[name] for episode in episodes)
        expected = (succeeded / len(episodes), *wilson_interval(succeeded, len(episodes)))
        given = tuple(result[name][key] for key in ("rate", "low", "high"))
        if not np.allclose(given, expected, atol=RATE_TOLERANCE):
            faults.append(f"{name} says {given}, its episodes come to {tuple(round(x, 4) for x in expected)}")
    mean = float(np.mean([episode["length"] for episode in episodes]))
    if abs(mean - result["mean_length"]) > RATE_TOLERANCE:
        faults.append(f"mean_length says {result['mean_length']}, its episodes come to {mean:.3f}")
    limit = task_spec(result["env_id"]).max_episode_steps
    return faults + [fault for episode in episodes for fault in _faults_of_an_episode(episode, limit)]


def _faults_of_an_episode(episode: dict[str, Any], limit: int) -> list[str]:
    faults, place = [], f"episode of seed {episode['seed']}"
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
    """Run some episodes of one of the results again, and check that they have the same outcomes.

    Args:
        submission: The submission.
        source: The policy that the result is of, as the command line gives it: nothing that a result names is imported.
        episodes: Number of episodes.
        seed: Seed of the choice of episodes.

    Raises:
        SubmissionError: No result is of this policy, or an outcome differs.
    """
    matching = [(path, result) for path, result in submission.results.items() if _is_of(result, source)]
    if not matching:
        raise SubmissionError(_listed(submission.folder, [f"no result is of {source.checkpoint or source.policy}"]))
    path, result = matching[0]
    chosen = np.random.default_rng(seed).choice(len(result["episodes"]), min(episodes, len(result["episodes"])), replace=False)
    evaluation = Evaluation(source, result["env_id"], result["env_kwargs"], result["config"])
    submitted = [result["episodes"][k] for k in sorted(chosen)]
    outcomes = run_episodes(evaluation, [episode["seed"] for episode in submitted], 1, step_timeout=STEP_TIMEOUT)
    file = path.relative_to(submission.folder)
    wrong = [
        f"{file}: seed {episode['seed']}: {difference}"
        for episode, outcome in zip(submitted, outcomes, strict=True)
        for difference in _differences(episode, outcome)
    ]
    if wrong:
        theirs, ours = result["versions"]["torch"], version("torch")
        if theirs != ours:
            wrong.append(
                f"{file} was made with torch {theirs}, here it is {ours}, which may round differently: install {theirs}"
            )
        raise SubmissionError(_listed(submission.folder, wrong))


def _differences(episode: dict[str, Any], outcome: EpisodeOutcome) -> list[str]:
    found = []
    for name in ("success_once", "success_at_end", "length", "peak_contact_force"):
        tolerance = FORCE_TOLERANCE if name == "peak_contact_force" else 0
        before, now = episode[name], getattr(outcome, name)
        if abs(before - now) > tolerance:
            found.append(f"{name} says {before}, run again it is {now}")
    return found


def _is_of(result: dict[str, Any], source: PolicySource) -> bool:
    """Whether a result is of a policy."""
    if source.checkpoint is None:
        return result["policy"] == source.policy
    config = checkpoint_config(source.checkpoint)
    return all(result["config"].get(name) == config.get(name) for name in NAMED_BY)


def take(submission: Submission, board: Path) -> Path:
    """Copy a checked submission into a leaderboard's folder, and return the copy.

    Raises:
        FileExistsAlreadyError: The leaderboard has a submission of the same name.
    """
    target = board / submission.folder.resolve().name
    if target.exists():
        raise FileExistsAlreadyError(f"{target} exists already; rename the folder of the new submission, or delete the old one")
    shutil.copytree(submission.folder, target)
    return target


def _listed(folder: Path, wrong: list[str]) -> str:
    return f"{folder} cannot be accepted:\n" + "\n".join(f"- {fault}" for fault in wrong)
