"""Checks of a submission that need no simulator: its episodes, its numbers, and copies among its results."""

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.analysis.condition import condition_of
from manifeel_ms3.analysis.protocol import FEWEST_EPISODES
from manifeel_ms3.arguments import is_number
from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation.agreement import COMPARED, FORCE_TOLERANCE, FORCES
from manifeel_ms3.evaluation.result import summary_of
from manifeel_ms3.tasks.registry import TaskSpec, all_tasks, evaluation_seeds, other_revision, task_spec

from .rerun import INVENTED
from .submission import Submission, SubmissionError, read_submission
from .untrusted import quoted

log = logging.getLogger(__name__)
EPISODES = FEWEST_EPISODES
"""Number of evaluation episodes of a result: that of the paper's protocol."""
SIMULATOR = ("mani-skill", "sapien")
"""Packages whose minor version must be the one that is installed here."""
NOT_OF_A_SUBMISSION = {"sim_config", "num_envs", "render_mode", "human_render_camera_configs"}
"""Arguments of an environment with which running an episode again could take any time or memory."""
ON_THE_CPU = (None, "auto", "physx_cpu", "cpu")
"""Values of the argument `sim_backend` with which the CPU simulates a single environment."""
SENSOR_SETTINGS = ("sensor_configs", "tactile")
"""Arguments of an environment that hold settings of cameras and pads."""
MOST_PIXELS = 2048
"""Largest number in the settings of cameras and pads, whose images could otherwise fill the memory."""
MOST_FORCE = 500.0
"""Contact force in N above which a result is not believed: the arm cannot press so hard, and demonstrations stay below 90 N."""
RATE_TOLERANCE = 1e-3
"""Largest difference between rates or means that count as equal; a result rounds the ends of intervals to four decimals."""
SHOWN = 5
"""Number of wrong seeds that a message lists."""
SAME_OUTCOME = np.array([2 * FORCE_TOLERANCE if name in FORCES else 0 for name in COMPARED])
"""Differences of the compared entries up to which two episodes are the same: running one of them again would confirm the
other."""


def check(submission: Submission, to_take: bool = True) -> None:
    """Check that results are of the current tasks and the evaluation seeds, have possible numbers, and are no copies.

    Args:
        submission: The submission.
        to_take: Whether the submission is to be taken into the leaderboard; its simulator must then be the one that is
            installed.

    Raises:
        SubmissionError: Some results are not as required; the message says which and why.
    """
    faults = [
        f"{quoted(path)}: {fault}"
        for path, result in submission.results.items()
        for fault in _faults(result) + (_faults_of_the_simulator(result) if to_take else [])
    ]
    faults = faults or _faults_of_repetition(submission.results)
    if faults:
        raise SubmissionError(submission.folder, faults)


def submissions_on(board: Path) -> Iterator[Submission]:
    """The submissions in a leaderboard's folder, without results of an earlier revision of their task.

    Such results, and broken submissions, are named in the log.
    """
    for folder in sorted(path for path in board.glob("*") if path.is_dir() and not path.name.startswith(".")):
        try:
            submission = _without_outdated_results(read_submission(folder))
            if not submission.results:
                continue
            check(submission, to_take=False)
        except InvalidFileError as error:
            log.warning("left out: %s", " ".join(str(error).split()))
        else:
            yield submission


def _without_outdated_results(submission: Submission) -> Submission:
    """A submission without the results whose task has changed since; the log has how many these are."""
    outdated: dict[Path, str] = {}
    for path, result in submission.results.items():
        env_id = result["env_id"]
        if env_id in all_tasks() and (reason := other_revision(env_id, result["revision"], "they are")):
            outdated[path] = reason
    for reason, count in Counter(outdated.values()).items():
        log.warning("left out: %d results in %s: %s", count, quoted(submission.folder), reason)
    return replace(submission, results={path: one for path, one in submission.results.items() if path not in outdated})


def check_is_new(submission: Submission, board: Path) -> None:
    """Check that no result is a copy of one that is on the leaderboard already.

    An earlier submission in a folder of the same name is no obstacle here, because it prevents the taking of this one.

    Args:
        submission: A submission that `check` has found without faults.
        board: Folder of the leaderboard.

    Raises:
        SubmissionError: Some results are copies; the message says of which.
    """
    others = (other for other in submissions_on(board) if other.folder.name != submission.folder.resolve().name)
    known = {other.folder / path: result for other in others for path, result in other.results.items()}
    if faults := _faults_of_copying(submission.results, known):
        raise SubmissionError(submission.folder, [*faults, "delete the earlier submission if this one is to replace it"])


def _faults_of_repetition(results: dict[Path, dict[str, Any]]) -> list[str]:
    """Results that stand for the same checkpoint twice, or have the outcomes of another result of their task."""
    places = Counter(
        (condition_of(result), result["training_seed"], result["config"].get("step", 0)) for result in results.values()
    )
    faults = [
        f"{count} results of {one.env_id}, {one.sensing} and {one.policy} are of training seed {seed}, step {step}; leave one"
        for (one, seed, step), count in places.items()
        if count > 1
    ]
    return faults + _faults_of_copying(results, {})


def _faults_of_copying(results: dict[Path, dict[str, Any]], known: dict[Path, dict[str, Any]]) -> list[str]:
    """Results that have the outcomes of a known result of their task, or of one of the results before them.

    Two results are copies where more than a share of 1 - `INVENTED` of their episodes are the same. A copy with more changes
    has so many invented episodes that running some of them again finds one.
    """
    faults, everything = [], known | results
    for env_id in sorted({result["env_id"] for result in results.values()}):
        paths = [path for path, result in everything.items() if result["env_id"] == env_id]
        outcomes = np.array([_outcomes(everything[path]) for path in paths])
        for k, path in enumerate(paths):
            same = (np.abs(outcomes[:k] - outcomes[k]) <= SAME_OUTCOME).all(-1).mean(-1)
            if path in results and (same > 1 - INVENTED).any():
                original = paths[int(same.argmax())]
                faults.append(
                    f"{quoted(path)} has the outcomes of {quoted(original)} in {same.max():.0%} of its episodes; different "
                    "training seeds and checkpoints never have, so leave one"
                )
    return faults


def _outcomes(result: dict[str, Any]) -> list[list[float]]:
    never = -1.0
    return [
        [never if (value := episode.get(name)) is None else float(value) for name in COMPARED] for episode in result["episodes"]
    ]


def _faults(result: dict[str, Any]) -> list[str]:
    if result["env_id"] not in all_tasks():
        return [f"{result['env_id']} is no task of this leaderboard; its tasks are {list(all_tasks())}"]
    return _faults_of_the_task(result) + _faults_of_the_numbers(result)


def _faults_of_the_task(result: dict[str, Any]) -> list[str]:
    """What is wrong with the episodes, the observations and the revision of the task of a result."""
    env_id, faults, seeds = result["env_id"], [], evaluation_seeds(EPISODES)
    given = [episode["seed"] for episode in result["episodes"]]
    if given != seeds:
        missing, foreign = sorted(set(seeds) - set(given)), sorted(set(given) - set(seeds))
        faults.append(
            f"its {len(given)} episodes are not those of the {EPISODES} evaluation seeds from {seeds[0]} on (missing "
            f"{missing[:SHOWN]}, foreign {foreign[:SHOWN]}, or in another order); evaluate with --num-eval-episodes {EPISODES}"
        )
    if (observed := result["env_kwargs"].get("obs_mode")) != result["obs_mode"]:
        faults.append(
            f"it is of obs_mode {result['obs_mode']!r}, but its env_kwargs have obs_mode {observed!r}, with which its episodes "
            "are run; evaluate again with the --obs-mode of the policy"
        )
    limit, most = result["env_kwargs"].get("max_episode_steps"), task_spec(env_id).max_episode_steps
    if isinstance(limit, int) and limit > most:  # running episodes again could take for ever
        faults.append(f"its env_kwargs have a time limit of {limit} steps, the task ends after {most}; evaluate without it")
    if given := sorted(NOT_OF_A_SUBMISSION & result["env_kwargs"].keys()):
        faults.append(f"its env_kwargs have {given}, which change the simulator or what is rendered; evaluate without them")
    if (simulator := result["env_kwargs"].get("sim_backend")) not in ON_THE_CPU:
        faults.append(
            f"its env_kwargs have sim_backend {simulator!r}, with which the initial states are others; evaluate with "
            "'physx_cpu'"
        )
    for name in SENSOR_SETTINGS:
        if _largest_number(result["env_kwargs"].get(name)) > MOST_PIXELS:
            faults.append(f"its {name} hold a number above {MOST_PIXELS}; evaluate with smaller images")
    if fault := other_revision(env_id, result["revision"]):
        faults.append(f"{fault}; evaluate again with manifeel-ms3 {version('manifeel-ms3')}")
    return faults


def _largest_number(settings: Any) -> float:
    """The largest number in nested settings; 0 if there is none above it."""
    if isinstance(settings, dict | list):
        return max(map(_largest_number, settings.values() if isinstance(settings, dict) else settings), default=0)
    return settings if is_number(settings) else 0


def _faults_of_the_simulator(result: dict[str, Any]) -> list[str]:
    faults = []
    for name in SIMULATOR:
        theirs, ours = result["versions"][name], version(name)
        if theirs.split(".")[:2] != ours.split(".")[:2]:
            faults.append(
                f"it was run with {name} {theirs}, the leaderboard takes {'.'.join(ours.split('.')[:2])}; install that"
            )
    return faults


def _faults_of_the_numbers(result: dict[str, Any]) -> list[str]:
    """Numbers of a result that contradict each other, or are not possible."""
    episodes, spec = result["episodes"], task_spec(result["env_id"])
    faults = ["its episodes end at success; evaluate without --stop-at-success"] if result["stop_at_success"] else []
    if len(lengths := {episode["episode_len"] for episode in episodes if not episode["error"]}) > 1:
        faults.append(f"its episodes without an error have from {min(lengths)} to {max(lengths)} steps, but one time limit")
    summary = summary_of(episodes, spec.force_limit)
    for name in [*summary, *(name for name in ("success_paper", "gentle_success") if name in result and name not in summary)]:
        expected, given = summary.get(name), result.get(name)
        if isinstance(expected, dict):
            agrees = isinstance(given, dict) and all(abs(given[part] - expected[part]) <= RATE_TOLERANCE for part in expected)
        else:
            agrees = expected is not None and given is not None and abs(given - expected) <= RATE_TOLERANCE
        if not agrees:
            faults.append(f"{name} says {given}, its episodes come to {expected}")
    return faults + [fault for episode in episodes for fault in _faults_of_an_episode(episode, spec)]


def _faults_of_an_episode(episode: dict[str, Any], spec: TaskSpec) -> list[str]:
    faults, place = [], f"episode of seed {episode['seed']}"
    length, first, force = (episode[name] for name in ("episode_len", "first_success", "force_until_success"))
    if length > spec.max_episode_steps:
        faults.append(f"{place}: {length} steps, the task ends after {spec.max_episode_steps}")
    for what in ("success", "fail"):
        if episode.get(f"{what}_at_end") and not episode[f"{what}_once"]:
            faults.append(f"{place}: {what} at the end, but never")
    if (episode["success_once"] or episode.get("success_paper")) and (episode["error"] or length == 0):
        faults.append(f"{place}: succeeds after {length} steps, with the error {episode['error']}")
    if (first is not None, force is not None) != (episode["success_once"],) * 2 or (first or 0) > length:
        faults.append(f"{place}: its first success is at step {first} of {length}, with {force} N until then")
    if max(force or 0.0, episode["peak_contact_force"]) > MOST_FORCE:
        faults.append(f"{place}: {episode['peak_contact_force']} N, more than the arm can press with")
    if (force or 0.0) > episode["peak_contact_force"]:
        faults.append(f"{place}: {force} N until its first success, more than in the whole episode")
    return faults
