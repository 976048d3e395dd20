"""Result files: an evaluation writes one, and the leaderboard and the pages of results read them."""

import json
import math
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import visible_files, write_json
from manifeel_ms3.paths import data_dir
from manifeel_ms3.provenance import git_commit, machine, package_versions
from manifeel_ms3.tasks.registry import task_spec

from .gentle import is_gentle
from .redaction import redacted
from .rollout import MEAN_DECIMALS, ONLY_TO_THE_END, EpisodeOutcome, outcome_as_json
from .statistics import wilson_interval

RESULT_SCHEMA = "manifeel-evaluation-3"
"""Version of the form of result files; data/evaluation_schema.json defines it."""
EARLIER = {
    "manifeel-evaluation-1": "does not say the revision of the task",
    "manifeel-evaluation-2": "is of episodes that ended at success, with other time limits",
}
"""Earlier versions, and why their results cannot be compared with those of the present version."""
PATHS = ("demos", "run_dir", "tacrgb_weights")
"""Entries of a policy's configuration that are paths on the machine where it was trained."""
PRIVATE = ("policy_name", "policy_kwargs")
"""Entries of a policy's configuration that come from the command line, and may hold passwords and tokens."""
RATES = ("success_once", "success_at_end", "success_paper", "fail_once", "fail_at_end", "gentle_success")
"""Rates that a result can hold."""
MEANS = ("return", "reward", "episode_len")
"""Numbers of an episode whose means a result holds."""
RATE_DECIMALS = 4
"""Decimals of the ends of a success rate's interval in a file; the interval is wider by far."""
LONGEST_MESSAGE = 300
"""Number of characters of a message of jsonschema that are shown; the rest repeats the faulty data. Set once, not tuned."""


class ResultError(InvalidFileError):
    """A file is not a result, is broken, or cannot be compared with other results."""


def published_config(config: dict[str, Any]) -> dict[str, Any]:
    """A policy's configuration as results hold it: with the last part of its paths only, and without passwords and tokens."""
    config = {name: _last_part(value) if name in PATHS else value for name, value in config.items()}
    return config | {name: redacted(config[name]) for name in PRIVATE if name in config}


def is_of_config(result: dict[str, Any], config: dict[str, Any], but: Collection[str] = ()) -> bool:
    """Whether a result is of a checkpoint with this configuration.

    Args:
        result: Content of the result file.
        config: The checkpoint's configuration.
        but: Entries that may differ, beside paths.
    """
    evaluated = result["config"]
    return all(evaluated.get(name) == value for name, value in config.items() if name not in (*PATHS, *but))


def provenance(env_id: str) -> dict[str, Any]:
    """Versions, commit, revision of the task and machine of the present moment, as results hold them."""
    commit, revision = git_commit(), task_spec(env_id).revision
    return dict(versions=package_versions(), git_commit=commit, revision=revision, machine=machine())


def result_of(
    env_id: str,
    env_kwargs: dict[str, Any],
    config: dict[str, Any],
    outcomes: list[EpisodeOutcome],
    inference: dict[str, Any] | None = None,
    origin: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of a result file.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make`.
        config: Configuration of the policy; `published_config` says what is left out of it, since results are published.
        outcomes: Outcomes of all episodes.
        inference: Device and batch size of the policy, where they are known.
        origin: What `provenance` said when the evaluation began; that of the present moment if not given.
    """
    config, episodes = published_config(config), [outcome_as_json(outcome) for outcome in outcomes]
    return dict(
        schema=RESULT_SCHEMA,
        env_id=env_id,
        env_kwargs=env_kwargs,
        obs_mode=config["obs_mode"],
        policy=config["policy_name"],
        training_seed=config.get("seed"),
        config=config,
        inference=inference or dict(device=None, batch_size=None),
        **(origin or provenance(env_id)),
        **summary_of(episodes, task_spec(env_id).force_limit),
        episodes=episodes,
    )


def summary_of(episodes: list[dict[str, Any]], force_limit: float | None) -> dict[str, Any]:
    """The rates and means of a result file.

    Args:
        episodes: Episodes as result files hold them.
        force_limit: The task's limit of the contact force for gentle success, in N; None without one.
    """
    to_the_end = all(name in episode for name in ONLY_TO_THE_END for episode in episodes)
    summary: dict[str, Any] = dict(stop_at_success=not to_the_end)
    for name in ("success_once", "fail_once", *(ONLY_TO_THE_END if to_the_end else ())):
        summary[name] = _rate([episode[name] for episode in episodes])
    if (by_the_paper := successes_by_the_paper(episodes)) is not None:
        summary["success_paper"] = _rate(by_the_paper)
    if force_limit is not None:
        gentle = [is_gentle(episode, force_limit) for episode in episodes]
        summary |= dict(force_limit=force_limit, gentle_success=_rate(gentle))
    return summary | {name: round(float(np.mean([episode[name] for episode in episodes])), MEAN_DECIMALS) for name in MEANS}


def successes_by_the_paper(episodes: list[dict[str, Any]]) -> list[bool] | None:
    """Whether each episode met the threshold of the paper's public code; None where that is not known of all of them.

    Episodes of which nothing could be measured, such as those of a policy that crashed, have no such entry: they did not.
    """
    measured = [episode for episode in episodes if "success_paper" in episode or not episode["error"]]
    if not measured or not all("success_paper" in episode for episode in measured):
        return None
    return [episode.get("success_paper", False) for episode in episodes]


def _rate(happened: list[bool]) -> dict[str, float]:
    low, high = wilson_interval(sum(happened), len(happened))
    return dict(rate=sum(happened) / len(happened), low=round(low, RATE_DECIMALS), high=round(high, RATE_DECIMALS))


def write_result(result: dict[str, Any], path: Path) -> None:
    """Check that a result has the published form, and write it.

    Raises:
        ResultError: The result does not have the published form.
        FileWriteError: The file cannot be written; an old one stays as it was.
    """
    write_json(path, as_published(result, path))


def as_published(result: dict[str, Any], path: Path) -> dict[str, Any]:
    """A result in types that json knows.

    Args:
        result: The content of a result file.
        path: Path of the file, for messages.

    Raises:
        ResultError: The result does not have the published form.
    """
    result = json.loads(json.dumps(result, default=str))
    check_result(result, path)
    return result


def read_result(path: Path) -> dict[str, Any]:
    """The content of a result file.

    Raises:
        ResultError: The file is missing, is not json, is of another version, or does not have the published form.
    """
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ResultError(f"{path} cannot be read as a result ({error}); give a file that `manifeel eval` wrote") from error
    check_result(result, path)
    return result


def results_in(*folders: Path) -> dict[Path, dict[str, Any]]:
    """The results of all checkpoints in some folders, by the paths of their files.

    Such a file is named by the gradient step, such as 00002000.json. Hidden folders are left out, such as one that a killed
    process was copying results into.

    Raises:
        ResultError: There is no result, or one is broken.
    """
    if missing := [str(folder) for folder in folders if not folder.is_dir()]:
        raise ResultError(f"{missing} is no folder; give the folders that hold the results")
    found = [path for folder in folders for path in visible_files(folder, "*.json") if path.stem.isdigit()]
    if not found:
        raise ResultError(
            f"{[str(folder) for folder in folders]} hold no results named by the gradient step, such as 00007000.json; train "
            "with --num-eval-episodes 50, run `manifeel study`, or give `manifeel eval` such a name as --out"
        )
    return {path: read_result(path) for path in found}


def check_result(result: Any, source: Path) -> None:
    """Check that a result has the published form, and that all its numbers are finite.

    Args:
        result: The content of a result file.
        source: Path of the file, for messages.

    Raises:
        ResultError: The result does not have the form; the message names the place.
    """
    given = result.get("schema") if isinstance(result, dict) else None
    if isinstance(given, str) and given in EARLIER:
        raise ResultError(
            f"{source} has the schema {given!r}, which {EARLIER[given]}; this version reads {RESULT_SCHEMA!r}: evaluate "
            "the policy again, after training it again if its checkpoint is refused, too"
        )
    if given != RESULT_SCHEMA:
        raise ResultError(
            f"{source} has the schema {given!r}, this version reads {RESULT_SCHEMA!r}; evaluate the policy again, or update "
            "manifeel-ms3"
        )
    for error in _validator().iter_errors(result):
        place = "/".join(str(part) for part in error.absolute_path) or "the whole file"
        raise ResultError(f"{source} is not a result: {place}: {error.message[:LONGEST_MESSAGE]}")
    if place := not_finite(result):
        raise ResultError(f"{source} is not a result: {place}: it is NaN or infinite; all numbers of a result are finite")


@cache
def _validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(result_schema())


def result_schema() -> dict[str, Any]:
    """The json schema of result files."""
    return json.loads((data_dir() / "evaluation_schema.json").read_text(encoding="utf-8"))


def not_finite(value: Any) -> str | None:
    """The place of a NaN or an infinity in a json value; None if all numbers are finite."""
    places = [("", value)]
    while places:
        place, value = places.pop()
        if isinstance(value, float) and not math.isfinite(value):
            return place[1:]
        entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        places += [(f"{place}/{name}", entry) for name, entry in entries]
    return None


def _last_part(path: Any) -> Any:
    if isinstance(path, (list, tuple)):
        return [_last_part(one) for one in path]
    return Path(path).name if path else path
