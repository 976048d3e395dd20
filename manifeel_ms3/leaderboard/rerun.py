"""Running episodes of a submission again, drawn at random from all of its results, with the checkpoints that it names.

`docs/submitting.md` says what this proves and what it does not.
"""

import hashlib
import json
import logging
import math
import random
import secrets
from collections.abc import Iterable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import hypergeom

from manifeel_ms3.analysis.condition import Condition, condition_of
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.agreement import differences
from manifeel_ms3.evaluation.checkpoint_config import CONFIG, WEIGHTS, checkpoint_config, published_hash
from manifeel_ms3.evaluation.engine import Evaluation, run_episodes
from manifeel_ms3.evaluation.policy import INFERENCE_STEPS, PolicySource
from manifeel_ms3.evaluation.redaction import redacted
from manifeel_ms3.evaluation.result import published_config
from manifeel_ms3.evaluation.rollout import EpisodeOutcome
from manifeel_ms3.files import visible_files
from manifeel_ms3.provenance import package_versions

from .submission import ABOUT, Rerun, RerunFile, Submission, SubmissionError
from .untrusted import quoted

log = logging.getLogger(__name__)
INVENTED = 0.1
"""Smallest share of invented episodes in a row of the page that must be detected."""
CHANCE = 0.01
"""Largest probability that such a row is not detected."""
COINCIDENCE = 0.1
"""Assumed probability that an invented episode has the same outcome as its repetition, that is, the same success and forces
within 0.01 N. In nine of ten results in this repository, at most 3 of the 50 episodes have forces so near to any one value; in
one of ObjectSearch with rgb, 13 episodes do, all of them failures. An invented success agrees only where the policy
succeeds, too."""
SEED_BITS = 63
"""Number of random bits in the seed of a draw, which fits into a signed integer of 64 bits."""
SET_BY_EVALUATION = (INFERENCE_STEPS, "policy_kwargs")
"""Entries of a policy's configuration in a result that may differ from those of its checkpoint."""
SHOWN_AS = {"obs_mode": "obs_mode", "policy": "policy_name", "training_seed": "seed"}
"""Entries of a result that the page shows, and the entries of its checkpoint's configuration that they must be equal to."""


@cache
def episodes_to_run_again(total: int) -> int:
    r"""Number of episodes of a row of the page that must be run again.

    Let m = ceil(`INVENTED` N) of the N episodes of a row be invented, at any places, before the draw. Of k episodes that are
    drawn without replacement, j are invented with the hypergeometric probability C(m, j) C(N - m, k - j) / C(N, k), and each of
    those j agrees with its repetition with the probability c = `COINCIDENCE`, independently. The row passes with probability

        P(k) = sum over j of  C(m, j) C(N - m, k - j) / C(N, k)  c^j,

    at most (1 - m / N (1 - c))^k. The smallest k with P(k) < `CHANCE` is returned: 33 of 50 episodes, 49 of the 1500 of the
    full protocol. More invented episodes make P smaller.

    Args:
        total: Number of episodes N of the row.
    """
    invented = math.ceil(INVENTED * total)
    fewest = (k for k in range(1, total + 1) if chance_to_pass(total, invented, k) < CHANCE)
    return next(fewest, total)


def chance_to_pass(total: int, invented: int, drawn: int) -> float:
    """Chance that no drawn episode differs from its repetition; see `episodes_to_run_again`.

    Args:
        total: Number of episodes.
        invented: Number of those that are invented.
        drawn: Number of those that are run again.
    """
    found = np.arange(invented + 1)
    return float(hypergeom.pmf(found, total, invented, drawn) @ COINCIDENCE**found)


def checkpoints_in(folders: Iterable[Path]) -> dict[str, Path]:
    """Checkpoints by their hashes: the given folders themselves, or all that are inside of them and of no hidden folder.

    Raises:
        InvalidArgumentError: A folder is no checkpoint and holds none.
    """
    found = {}
    for folder in folders:
        here = [folder] if (folder / CONFIG).is_file() else sorted(path.parent for path in visible_files(folder, WEIGHTS))
        if not here:
            raise InvalidArgumentError(
                f"--checkpoint {folder} is no checkpoint and holds none; give a folder with {CONFIG} and {WEIGHTS}"
            )
        found.update({published_hash(checkpoint): checkpoint for checkpoint in here})
    return found


def name_checkpoints(submission: Submission, folders: Iterable[Path]) -> dict[str, str]:
    """The hash of the checkpoint of each result, found by the configuration that the result and the checkpoint hold.

    Raises:
        SubmissionError: A result fits none of the checkpoints, or several.
    """
    configs = {sha256: checkpoint_config(folder) for sha256, folder in checkpoints_in(folders).items()}
    named, faults = {}, []
    for path, result in submission.results.items():
        fitting = [sha256 for sha256, config in configs.items() if not _differing_settings(result, config)]
        if len(fitting) == 1:
            named[path.as_posix()] = fitting[0]
        else:
            faults.append(f"{quoted(path)} fits {len(fitting)} of the {len(configs)} checkpoints; give the one that it is of")
    if faults:
        raise SubmissionError(submission.folder, faults)
    return named


def checkpoint_sources(submission: Submission, folders: Iterable[Path], kwargs: str) -> dict[Path, PolicySource]:
    """The checkpoint of each result, by the hash that the submission names.

    Args:
        submission: The submission.
        folders: Checkpoints, or folders of checkpoints.
        kwargs: Keyword arguments of the policy, as json.

    Raises:
        SubmissionError: A result names no checkpoint, or one that was not given or was trained otherwise, or two results of a
            task name the same one.
    """
    found = checkpoints_in(folders)
    sources: dict[Path, PolicySource] = {}
    users: dict[tuple[str, Condition], Path] = {}
    faults = []
    for path, result in submission.results.items():
        sha256 = submission.about.checkpoints.get(path.as_posix())
        if sha256 is None:
            faults.append(f"{quoted(path)}: {ABOUT} names no checkpoint for it; add its hash with the command `hash`")
        elif sha256 not in found:
            faults.append(f"{quoted(path)}: no given checkpoint has the hash {sha256}; give it with --checkpoint")
        elif differing := _differing_settings(result, checkpoint_config(found[sha256])):
            faults.append(f"{quoted(path)} and {found[sha256]} differ in {differing}; evaluate the checkpoint again")
        elif (user := users.setdefault((sha256, condition_of(result)), path)) != path:
            faults.append(f"{quoted(path)} is of the checkpoint of {quoted(user)}; leave one of the two")
        else:
            sources[path] = PolicySource(found[sha256], kwargs=kwargs)
    if faults:
        raise SubmissionError(submission.folder, faults)
    return sources


def policy_sources(submission: Submission, policy: str, kwargs: str) -> dict[Path, PolicySource]:
    """A class or server of the user's own as the policy of all results.

    Args:
        submission: The submission.
        policy: The policy as the command line names it: nothing that a result names is imported.
        kwargs: Keyword arguments of the policy, as json.

    Raises:
        SubmissionError: A result is of another policy, or of other arguments of the policy.
    """
    name, given, faults = redacted(policy), redacted(json.loads(kwargs)), []  # as results have them
    for path, result in submission.results.items():
        evaluated = result["config"].get("policy_kwargs", {})
        if result["policy"] != name:
            faults.append(f"{quoted(path)} is not of {name}, but of {result['policy']!r}; submit it with that policy")
        elif evaluated != given:
            faults.append(
                f"{quoted(path)} was evaluated with --policy-kwargs '{json.dumps(evaluated)}', and would be run again with "
                f"'{json.dumps(given)}'; give the same"
            )
    if faults:
        raise SubmissionError(submission.folder, faults)
    return dict.fromkeys(submission.results, PolicySource(policy=policy, kwargs=kwargs))


def _differing_settings(result: dict[str, Any], config: dict[str, Any]) -> list[str]:
    """Names of what a result says of its policy, and what the configuration of a checkpoint does not."""
    evaluated, trained = result["config"], published_config(config)
    return [
        *(name for name in evaluated | trained if name not in SET_BY_EVALUATION and evaluated.get(name) != trained.get(name)),
        *(shown for shown, name in SHOWN_AS.items() if result[shown] != config.get(name)),
    ]


def draw(submission: Submission, most: int | None, seed: int) -> dict[Path, list[int]]:
    """Draw the episodes to run again, and return their numbers, counted from 0, by result file.

    From each row of the page, as many episodes are drawn as it needs, from all of its files.

    Args:
        submission: The submission.
        most: Largest number of episodes of a row; as many as `episodes_to_run_again` says if not given.
        seed: Seed of the draw.
    """
    generator = random.Random(seed)
    rows: dict[Condition, list[tuple[Path, int]]] = {}
    for path, result in sorted(submission.results.items()):
        rows.setdefault(condition_of(result), []).extend((path, k) for k in range(len(result["episodes"])))
    drawn: dict[Path, list[int]] = {}
    for episodes in rows.values():
        count = episodes_to_run_again(len(episodes)) if most is None else min(most, len(episodes))
        for path, k in sorted(generator.sample(episodes, count)):
            drawn.setdefault(path, []).append(k)
    return drawn


def run_again(
    submission: Submission,
    sources: dict[Path, PolicySource],
    most: int | None = None,
    seed: int | None = None,
    workers: int = 1,
) -> Rerun:
    """Run episodes again, check that they have the same outcomes, and return which they were.

    Args:
        submission: The submission.
        sources: The policy of each result.
        most: Largest number of episodes of a row of the page; as many as are needed if not given.
        seed: Seed of the draw, to repeat an earlier one; a new one from the system's random numbers if not given.
        workers: Number of processes that run episodes side by side.

    Raises:
        SubmissionError: An outcome differs.
        MachineError: This machine does not have the device that computed a result.
    """
    seed = secrets.randbits(SEED_BITS) if seed is None else seed
    drawn = draw(submission, most, seed)
    log.info("%d episodes of %d results are run again, drawn with --seed %d", sum(map(len, drawn.values())), len(drawn), seed)
    faults, files = [], {}
    for path, numbers in drawn.items():
        result = submission.results[path]
        submitted = [result["episodes"][k] for k in numbers]
        stop = result["stop_at_success"]
        evaluation = Evaluation(sources[path].as_in(result), result["env_id"], result["env_kwargs"], result["config"], stop)
        seeds = [episode["seed"] for episode in submitted]
        outcomes = run_episodes(evaluation, seeds, workers)
        faults += _faults_of_a_result(path, result, submitted, outcomes)
        files[path.as_posix()] = RerunFile(hashlib.sha256(submission.files[path]).hexdigest(), seeds)
    if faults:
        raise SubmissionError(submission.folder, faults)
    return Rerun(seed, package_versions(), files)


def _faults_of_a_result(
    path: Path, result: dict[str, Any], submitted: list[dict[str, Any]], outcomes: list[EpisodeOutcome]
) -> list[str]:
    faults = [
        f"{quoted(path)}: seed {episode['seed']}: {difference}"
        for episode, outcome in zip(submitted, outcomes, strict=True)
        for difference in differences(episode, outcome)
    ]
    theirs, ours = result["versions"]["torch"], version("torch")
    if faults and theirs != ours:
        faults.append(
            f"{quoted(path)} was made with torch {theirs}, here it is {ours}, which may round differently: install {theirs}"
        )
    return faults


def rerun_of(submission: Submission, paths: Iterable[Path]) -> tuple[int, int]:
    """Numbers of episodes that were run again, and of all episodes, in some results of the leaderboard.

    An entry of rerun.json counts only for the very file that was checked.
    """
    run, total = 0, 0
    for path in paths:
        total += len(submission.results[path]["episodes"])
        entry = submission.rerun.files.get(path.as_posix()) if submission.rerun else None
        if entry and entry.sha256 == hashlib.sha256(submission.files[path]).hexdigest():
            run += len(set(entry.episodes))
    return run, total


def about_with_checkpoints(submission: Submission, named: dict[str, str]) -> dict[str, Any]:
    """The content of submission.json with the hashes of checkpoints."""
    return json.loads(submission.files[ABOUT]) | dict(checkpoints=named)
