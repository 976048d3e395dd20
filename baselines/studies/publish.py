"""Publishing a study: its results become a submission of the leaderboard, with the checkpoints of the training seed 0."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

from manifeel_ms3.analysis.condition import Condition, condition_of
from manifeel_ms3.analysis.paper import DP, training_demos
from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import published_hash
from manifeel_ms3.evaluation.entries import ABOUT, VIDEO_SUFFIX, VIDEOS
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.files import atomic_folder, read_json, restore_folder, write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.paths import CHECKPOINTS, data_dir
from manifeel_ms3.tasks.registry import task_spec

from .jobs import is_done
from .planning import Job


def publish(jobs: list[Job], root: Path, folder: Path, name: str | None = None, authors: str | None = None) -> int:
    """Copy the results of a study's finished evaluations into a submission's folder.

    Results that the folder holds of other evaluations stay, such as those of a machine that did another part of the study.
    Results of the same set-up and training seed are replaced.

    Args:
        jobs: Jobs of the study; of those that are evaluations, those in half precision are published.
        root: Folder of all jobs.
        folder: Folder of the submission, such as leaderboard/cpu.
        name: Name of the submission; if None, that which it has, or that of its folder.
        authors: Names of its authors; if None, those that it has.

    Returns:
        The number of results that the folder then holds.

    Raises:
        InvalidArgumentError: No evaluation in half precision is done, two results would have the same place, or the authors of
            a new submission are not given.
        FileExistsAlreadyError: The folder exists and is not a submission, or results of another set-up have the place of new
            ones.
        ResultError: A result is broken.
        CheckpointError: A checkpoint is missing or broken.
        FileWriteError: The folder cannot be written.
    """
    done = [job for job in jobs if job.kind == "evaluate" and job.settings["half_precision"] and is_done(job, root)]
    if not done:
        raise InvalidArgumentError(
            f"no evaluation with `half_precision: true` is done in {root}; run the study first, or give its --root"
        )
    files = [path for job in done for path in sorted(job.folder(root).glob("*.json")) if path.stem.isdigit()]
    results = {path: read_result(path) for path in files}
    with owned(folder):
        restore_folder(folder)
        if folder.is_dir() and not (folder / ABOUT).is_file():
            raise FileExistsAlreadyError(f"{folder} exists and is not a submission: it has no {ABOUT}; give another folder")
        _check_places(results, folder)
        with atomic_folder(folder, replace=True) as partial:
            given = {key: value for key, value in dict(name=name, authors=authors).items() if value}
            about: dict[str, Any] = dict(name=folder.absolute().name) | _copy_old(folder, partial) | given
            if "authors" not in about:
                raise InvalidArgumentError(f"{folder} is a new submission; give --authors, the names of those who made it")
            hashes = about.get("checkpoints", {}) | _publish_results(results, partial)
            hashes = {result: sha256 for result, sha256 in hashes.items() if (partial / result).is_file()}
            write_json(partial / ABOUT, about | dict(checkpoints=hashes))
    return len(hashes)


def _check_places(results: dict[Path, dict[str, Any]], folder: Path) -> None:
    """Check that no two results have the same place, and that an entry's folder has results of one condition only.

    Raises:
        InvalidArgumentError: Two of the results would have the same place.
        FileExistsAlreadyError: The folder holds results of another condition in the place of one of them.
    """
    new: dict[Path, tuple[Path, Condition]] = {}
    places: set[Path] = set()
    for path, result in results.items():
        entry, place, condition = folder / entry_name(result), _run_folder(folder, result) / path.name, condition_of(result)
        other, known = new.setdefault(entry, (path, condition))
        if known != condition or place in places:
            raise InvalidArgumentError(
                f"{other} of {known} and {path} of {condition} would both be published in {entry}"
                f"{_differing_settings(known, condition)}; publish them from two studies into two folders"
            )
        places.add(place)
    for entry, (path, condition) in new.items():
        for old in sorted(entry.glob("seed*/*.json")):
            if (known := condition_of(read_result(old))) != condition:
                raise FileExistsAlreadyError(
                    f"{old} is of {known}, and {path} of {condition} would be published beside it or in its place"
                    f"{_differing_settings(known, condition)}; remove {entry}, or give another folder"
                )


def _differing_settings(first: Condition, second: Condition) -> str:
    """Words that name the settings in which two conditions differ; "" if there are none."""
    names = sorted({name for name, _ in set(first.settings) ^ set(second.settings)})
    return f" (they differ in {', '.join(names)})" if names else ""


def _publish_results(results: dict[Path, dict[str, Any]], folder: Path) -> dict[str, str]:
    """Copy results in the place of earlier ones of the same runs, and the checkpoints of those of the first training seed.

    Returns:
        The hash of the checkpoint of each result, by the path of the copy in the folder.
    """
    for run in {_run_folder(folder, result) for result in results.values()}:
        shutil.rmtree(run, ignore_errors=True)
    hashes = {}
    for path, result in results.items():
        checkpoint = path.parent / CHECKPOINTS / path.stem
        run = _run_folder(folder, result)
        run.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, run / path.name)
        hashes[(run / path.name).relative_to(folder).as_posix()] = published_hash(checkpoint)
        if result["training_seed"] == 0:
            (folder / VIDEOS / f"{entry_name(result)}{VIDEO_SUFFIX}").unlink(
                missing_ok=True
            )  # which is of the earlier checkpoint
            shutil.copytree(checkpoint, run / CHECKPOINTS / checkpoint.name)
    return hashes


def _copy_old(folder: Path, partial: Path) -> dict[str, Any]:
    """Copy what the folder holds, and return the content of its submission.json."""
    if not folder.is_dir():
        return {}
    shutil.copytree(folder, partial, dirs_exist_ok=True)
    schema = json.loads((data_dir() / "submission_schema.json").read_text(encoding="utf-8"))
    return read_json(folder / ABOUT, schema, "a submission")


def _run_folder(folder: Path, result: dict[str, Any]) -> Path:
    """Folder of the results of one training seed in a submission."""
    return folder / entry_name(result) / f"seed{result['training_seed']}"


def entry_name(result: dict[str, Any]) -> str:
    """Name of the folder of a result in its submission, such as "PegInsertion/rgb+tacff".

    What differs from the paper's Table I is added: another policy, encoder of TacRGB than that of the cameras, camera, finger
    pad, number of demonstrations or argument of the task. Two conditions that only differ in other settings share a name.
    """
    condition = condition_of(result)
    return "/".join((condition.task, "-".join((condition.obs_mode, *_differences(condition)))))


def _differences(condition: Condition) -> list[str]:
    found = [] if condition.policy == DP else [condition.policy]
    if condition.encoder not in ("", condition.network):
        found.append(condition.encoder)
    if condition.cameras not in ((), (task_spec(condition.env_id).policy_camera,)):
        found += condition.cameras
    if condition.pads not in ((), ("right",)):
        found += condition.pads
    if condition.num_demos != training_demos(condition.task):
        found.append(f"{condition.num_demos}demos")
    if condition.variant:
        found += _words(json.loads(condition.variant))
    return found


def _words(arguments: dict[str, Any]) -> list[str]:
    """The innermost arguments of a task as parts of a file's name: texts alone, as "dim", others as "drift_0_1"."""
    words = []
    for name, value in arguments.items():
        text = value if isinstance(value, str) else f"{name}_{value}"
        words += _words(value) if isinstance(value, dict) else [re.sub(r"\W+", "_", text).strip("_")]
    return words
