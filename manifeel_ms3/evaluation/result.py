"""Result files: what an evaluation writes, and leaderboard and report read."""

import json
import subprocess
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import write_json
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import task_spec

from .provenance import machine
from .rollout import EpisodeOutcome
from .statistics import wilson_interval

SCHEMA = "manifeel-evaluation-2"
PATHS = ("demos", "run_dir", "tacrgb_weights")  # a config's, on the machine it was trained on


class ResultError(InvalidFileError):
    """A file that is not a result."""


def result_of(
    env_id: str, env_kwargs: dict[str, Any], config: dict[str, Any], outcomes: list[EpisodeOutcome]
) -> dict[str, Any]:
    """The content of a result file; `config`: the policy's, of whose paths the last part is kept: results are published."""
    config = {name: _last_part(value) if name in PATHS else value for name, value in config.items()}
    rates = {}
    for name in ("success_once", "success_at_end"):
        won = sum(getattr(outcome, name) for outcome in outcomes)
        low, high = wilson_interval(won, len(outcomes))
        rates[name] = dict(rate=won / len(outcomes), low=round(low, 4), high=round(high, 4))
    return dict(
        schema=SCHEMA,
        env_id=env_id,
        env_kwargs=env_kwargs,
        obs_mode=config["obs_mode"],
        policy=config["policy_name"],
        training_seed=config.get("seed"),
        config=config,
        versions={name: version(name) for name in ("manifeel-ms3", "mani-skill", "sapien", "torch")},
        git_commit=_git_commit(),
        revision=task_spec(env_id).revision,
        machine=machine(),
        **rates,
        mean_length=float(np.mean([outcome.length for outcome in outcomes])),
        episodes=[asdict(outcome) for outcome in outcomes],
    )


def write_result(result: dict[str, Any], path: Path) -> None:
    """Write a result that is of the published form."""
    result = json.loads(json.dumps(result, default=str))
    check_result(result, path)
    write_json(path, result)


def read_result(path: Path) -> dict[str, Any]:
    """The content of a result file.

    Raises:
        ResultError: it is missing, no json, of another version, or not of the published form.
    """
    try:
        result = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ResultError(f"{path} cannot be read as a result ({error}); give one that evaluation.run wrote") from error
    check_result(result, path)
    return result


def results_in(*folders: Path) -> list[dict[str, Any]]:
    """Every checkpoint's result under some folders: files named by its gradient step, as 00002000.json.

    Raises:
        ResultError: there is none, or one is broken.
    """
    found = [path for folder in folders for path in sorted(folder.rglob("*.json")) if path.stem.isdigit()]
    if not found:
        raise ResultError(
            f"{[str(folder) for folder in folders]} hold no results; train with --eval-episodes 50, or run "
            "`python -m baselines.studies`"
        )
    return [read_result(path) for path in found]


def check_result(result: Any, source: Path) -> None:
    """See that a result is of the published form.

    Raises:
        ResultError: it is not; the message names the place.
    """
    given = result.get("schema") if isinstance(result, dict) else None
    if given != SCHEMA:
        raise ResultError(f"{source} has the schema {given!r}, this version reads {SCHEMA!r}; evaluate again, or update")
    schema = json.loads((data_dir() / "evaluation_schema.json").read_text())
    for error in jsonschema.Draft202012Validator(schema).iter_errors(result):
        place = "/".join(str(part) for part in error.absolute_path) or "the whole file"
        raise ResultError(f"{source} is not a result: {place}: {error.message[:300]}")


def _last_part(path: Any) -> Any:
    if isinstance(path, (list, tuple)):
        return [_last_part(one) for one in path]
    return Path(path).name if path else path


def _git_commit() -> str | None:
    answer = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    return answer.stdout.strip() or None
