"""What is checked of a study before its first job begins, with the functions that its jobs use."""

import json
from collections.abc import Iterable
from pathlib import Path

from baselines.common.train_args import check_evaluation, check_run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import checked_device
from manifeel_ms3.tasks.registry import make_env

from .command_lines import training_args
from .jobs import is_done
from .planning import Job
from .study import OF_THE_STUDY, StudyError


def require_valid_flags(jobs: Iterable[Job]) -> None:
    """Check that `manifeel train` takes the flags of every training of a study, before the first job begins.

    Raises:
        StudyError: A flag is not known, or its value is not one that it takes, in which case the parser's own message names it
            on stderr; or two settings of a run contradict each other.
    """
    checked = set()
    for job in (job for job in jobs if job.kind == "train"):
        of_the_grid = {name: value for name, value in job.settings["flags"].items() if name not in OF_THE_STUDY}
        if (key := json.dumps([job.settings["policy"], job.settings["preset"], of_the_grid])) in checked:
            continue
        checked.add(key)
        try:
            args = training_args(job)
            check_run(args)
            check_evaluation(args)
        except SystemExit as error:
            policy = f"{job.settings['policy']} {job.settings['preset']}"
            raise StudyError(
                f"{job.title}: `manifeel train {policy}` does not take one of its flags, {of_the_grid}; correct `train` or "
                "`encoder_flags` in the study's file"
            ) from error
        except InvalidArgumentError as error:
            raise StudyError(f"{job.title}: {error}; correct `train` or `encoder_flags` in the study's file") from error


def require_devices(jobs: Iterable[Job], root: Path) -> None:
    """Check that this machine has the devices that the flags of trainings name, before the first job begins.

    Args:
        jobs: Every job of the study.
        root: Folder of the output of all jobs.

    Raises:
        StudyError: A name is not that of a device.
        MachineError: This machine does not have a device.
    """
    left = [job for job in jobs if job.kind == "train" and not is_done(job, root)]
    for device in {str(job.settings["flags"]["device"]) for job in left if "device" in job.settings["flags"]}:
        try:
            checked_device(device)
        except InvalidArgumentError as error:
            raise StudyError(f"{error}, in `train` in the study's file") from error


def require_valid_environments(jobs: Iterable[Job], root: Path) -> None:
    """Check that the tasks of a study can be made with the arguments in its file, before the first job begins.

    Only tasks of jobs that are left are made, once with each set of arguments, which takes about a second. They have the camera
    and the pad that the jobs observe, but no renderer: a value that only the renderer refuses is found by the first job.

    Args:
        jobs: Every job of the study.
        root: Folder of the output of all jobs.

    Raises:
        StudyError: A task cannot be made with its arguments; the message says which is wrong.
    """
    made = set()
    for job in (job for job in jobs if job.kind in ("record", "evaluate") and not is_done(job, root)):
        record = job if job.kind == "record" else job.needs[0].needs[0]
        env_id, camera, env_kwargs = record.settings["env_id"], record.settings["camera"], job.settings["env_kwargs"]
        if env_kwargs == "{}" or (key := (env_id, camera, env_kwargs)) in made:
            continue
        made.add(key)
        unobserved = dict(obs_mode="none", cameras=(camera,), render_backend="none", sim_backend="physx_cpu")
        try:
            make_env(env_id, **unobserved | json.loads(env_kwargs)).close()
        except InvalidArgumentError as error:
            raise StudyError(f"{job.title}: {error}; correct `task_args` or `evaluation_args` in the study's file") from error
