"""Publishing a study: its results become a submission of the leaderboard, with one checkpoint of each row."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

from manifeel_ms3.analysis.condition import Condition, condition_of
from manifeel_ms3.analysis.paper import DP, training_demos
from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_sha256
from manifeel_ms3.evaluation.entries import ABOUT
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.files import atomic_folder, read_json, restore_folder, write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.paths import CHECKPOINTS, data_dir
from manifeel_ms3.tasks.registry import task_spec

from .jobs import is_done
from .study import Job


def publish(jobs: list[Job], root: Path, folder: Path, name: str, authors: str) -> int:
    """Copy the results of a study's finished evaluations into a submission's folder.

    Results that the folder holds of other evaluations stay, such as those of a machine that did another part of the study.

    Args:
        jobs: Jobs of the study; of those that are evaluations, those in half precision are published.
        root: Folder of all jobs.
        folder: Folder of the submission, such as leaderboard/cpu.
        name: Name of the submission.
        authors: Names of its authors.

    Returns:
        The number of results that the folder then holds.

    Raises:
        InvalidArgumentError: No evaluation in half precision is done.
        FileExistsAlreadyError: The folder exists and is not a submission.
        FileWriteError: The folder cannot be written.
    """
    done = [job for job in jobs if job.kind == "evaluate" and job.settings["half_precision"] and is_done(job, root)]
    if not done:
        raise InvalidArgumentError(
            f"no evaluation with `half_precision: true` is done in {root}; run the study first, or give its --root"
        )
    results = [path for job in done for path in sorted(job.folder(root).glob("*.json")) if path.stem.isdigit()]
    with owned(folder):
        restore_folder(folder)
        if folder.is_dir() and not (folder / ABOUT).is_file():
            raise FileExistsAlreadyError(f"{folder} exists and is not a submission: it has no {ABOUT}; give another folder")
        with atomic_folder(folder, replace=True) as partial:
            hashes = _copy_old(folder, partial) | _publish_results(results, partial)
            hashes = {result: sha256 for result, sha256 in hashes.items() if (partial / result).is_file()}
            write_json(partial / ABOUT, dict(name=name, authors=authors, checkpoints=hashes))
    return len(hashes)


def _publish_results(results: list[Path], folder: Path) -> dict[str, str]:
    """Copy results in the place of earlier ones of the same runs, and return the hashes of their checkpoints."""
    for run in {_run_folder(folder, read_result(path)) for path in results}:
        shutil.rmtree(run, ignore_errors=True)
    hashes = {}
    for path in results:
        checkpoint = path.parent / CHECKPOINTS / path.stem
        copied = _publish_result(path, checkpoint, folder)
        hashes[copied.relative_to(folder).as_posix()] = checkpoint_sha256(checkpoint)
    return hashes


def _copy_old(folder: Path, partial: Path) -> dict[str, str]:
    """Copy what the folder holds, and return the hashes of its checkpoints by their results."""
    if not folder.is_dir():
        return {}
    shutil.copytree(folder, partial, dirs_exist_ok=True)
    schema = json.loads((data_dir() / "submission_schema.json").read_text(encoding="utf-8"))
    return read_json(folder / ABOUT, schema, "a submission")["checkpoints"]


def _run_folder(folder: Path, result: dict[str, Any]) -> Path:
    """Folder of the results of one training seed in a submission."""
    return folder / entry_name(result) / f"seed{result['training_seed']}"


def _publish_result(path: Path, checkpoint: Path, folder: Path) -> Path:
    """Copy a result, and its checkpoint if it is of the first training seed; return the copy of the result."""
    result = read_result(path)
    run = _run_folder(folder, result)
    run.mkdir(parents=True, exist_ok=True)
    if result["training_seed"] == 0:
        shutil.copytree(checkpoint, run / CHECKPOINTS / checkpoint.name)
    return Path(shutil.copyfile(path, run / path.name))


def entry_name(result: dict[str, Any]) -> str:
    """Name of the folder of a result in its submission, such as "PegInsertion/rgb+tacff".

    What differs from the paper's Table I is added: another policy, camera, number of demonstrations or argument of the task.
    """
    condition = condition_of(result)
    return "/".join((condition.task, "-".join((condition.obs_mode, *_differences(condition)))))


def _differences(condition: Condition) -> list[str]:
    found = [] if condition.policy == DP else [condition.policy]
    if condition.cameras not in ((), (task_spec(condition.env_id).policy_camera,)):
        found += condition.cameras
    if condition.num_demos != training_demos(condition.task):
        found.append(f"{condition.num_demos}demos")
    if condition.variant:
        found += _words(json.loads(condition.variant))
    return found


def _words(value: Any) -> list[str]:
    """The innermost values of arguments, as parts of a file's name."""
    if isinstance(value, dict):
        return [word for part in value.values() for word in _words(part)]
    return [re.sub(r"\W+", "_", str(value))]
