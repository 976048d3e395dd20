r"""Evaluate a policy on fixed seeds.

    manifeel eval --checkpoint runs/x/checkpoints/last
    manifeel eval --entry cpu/PegInsertion/rgb+tacff
    manifeel eval --policy my_module:MyPolicy --env-id ManiFeel-PegInsertion-v1 \
        --obs-mode rgb+tacff

The result is one json file whose form `data/evaluation_schema.json` defines: versions, git commit, the policy's configuration,
the outcome of every episode, and success rates with Wilson intervals. A policy that raises an error, returns NaN or an action
of the wrong shape, or does not answer in time fails that episode, and the result holds the reason; the evaluation goes on. A
policy server that cannot be reached ends the evaluation.

Every episode is on the disk as soon as it is finished. After Ctrl-C, or whatever else ends the evaluation, the same command
goes on with the other episodes.
"""

import json
import logging
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from manifeel_ms3.arguments import is_number, require_file, require_positive
from manifeel_ms3.command_line import as_typed, json_object, missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError, WorkFailedError
from manifeel_ms3.ownership import owned
from manifeel_ms3.paths import CHECKPOINTS, EVALUATION, LAST_LINK
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR
from manifeel_ms3.tasks.checks import check_obs_mode
from manifeel_ms3.tasks.registry import evaluation_seeds, task_spec
from manifeel_ms3.text import one_line

from .checkpoint_config import CheckpointError, checkpoint_config
from .engine import Evaluation, run_episodes
from .entries import Entry, find_entry
from .journal import Journal
from .policy import BATCH_SIZES, INFERENCE_STEPS, STEP_TIMEOUT, PolicySource, checked_device
from .redaction import redacted
from .result import as_published, provenance, published_config, read_result, result_of, write_result
from .rollout import EpisodeOutcome, failed_outcome
from .seed_list import read_seeds
from .variant import BACKENDS, LENGTHS_OF_RECORDINGS, SENSING, default_arguments

log = logging.getLogger(__name__)
BACKEND = dict(sim_backend="physx_cpu")
"""Backend of the simulation, the one that demonstrations are recorded with."""
OF_A_CHECKPOINT: dict[str, type] = dict(env_id=str, env_kwargs=dict, obs_mode=str, cameras=list, tactile_sensors=list)
"""Types of the entries of a checkpoint's configuration that an evaluation reads; a stranger may have written them."""
POLICY_PADS = ("right",)
"""Finger pads that a --policy observes if none are given."""


@dataclass
class Args:
    """Arguments of an evaluation."""

    checkpoint: Path | None = None
    """Checkpoint folder, with config.json and weights."""
    entry: str | None = None
    """Entry of the leaderboard, such as cpu/PegInsertion/rgb+tacff, whose checkpoint is evaluated again with the settings of
    its result; the command reports in how many episodes the outcomes agree. --env-kwargs, --inference-steps, --device,
    --batch-size and --stop-at-success change single settings; the outcomes are then not compared."""
    policy: str | None = None
    """Policy to evaluate instead of a checkpoint: a class that can be imported ("module:Class"), or the address of a server
    ("http://localhost:8000")."""
    policy_kwargs: str = "{}"
    """Keyword arguments of the policy, as json. Passwords and tokens among them are left out of the result."""
    env_id: str | None = None
    """Id of the task, for a --policy; a checkpoint brings its own."""
    obs_mode: str | None = None
    """Observation mode of the policy, such as rgb+tacff, for a --policy; a checkpoint brings its own."""
    cameras: tuple[str, ...] | None = None
    """Cameras that the policy observes, for a --policy; the task's policy camera if not given. A checkpoint brings its own."""
    tactile_sensors: tuple[str, ...] | None = None
    """Finger pads that the policy observes, for a --policy: left, right, or both; the right one if not given. A checkpoint
    brings its own."""
    sensor: str | None = None
    """Sensor on the fingers, for a --policy: gelsight_r15, gelsight_mini, digit, or one of another package. A checkpoint brings
    that of its demonstrations, and --env-kwargs '{"sensor": "digit"}' evaluates it with another one."""
    out: Path | None = None
    """Path of the result file; evaluation.json in the checkpoint's run folder, or in the working directory, if not given. The
    finished episodes of an evaluation that was interrupted are in <name>.episodes.jsonl beside it."""
    overwrite: bool = False
    """Discard the finished episodes of an evaluation that was interrupted, and begin again. Without this flag the evaluation
    goes on if nothing has changed, and is refused otherwise. It cannot be known whether the policy of a server has changed."""
    overwrite_other: bool = False
    """If an evaluation was interrupted and something has changed since, begin again; if nothing has changed, go on with it."""
    episodes: Annotated[int, tyro.conf.arg(name="num-eval-episodes", aliases=["--episodes"])] = 50
    """Number of episodes; their seeds are 100000 and the following numbers."""
    seeds: Path | None = None
    """Text file with the seeds of the episodes, one per line, which replaces --num-eval-episodes: a private list of initial
    states, to which no policy can have been fitted. The result holds the seeds, too."""
    workers: Annotated[int, tyro.conf.arg(name="num-eval-envs", aliases=["--workers"])] = 1
    """Number of processes that simulate episodes side by side; one more process holds the policy of a checkpoint."""
    inference_steps: int | None = None
    """Number of denoising or integration steps for one action chunk; the checkpoint's own number if not given."""
    device: str | None = None
    """Device that computes a checkpoint's policy, such as cpu or cuda; a GPU if there is one and this is not given."""
    batch_size: int | None = None
    """Number of episodes that a checkpoint's policy answers together; 1 on the CPU and 16 on a GPU if not given. Actions of
    other batch sizes differ in the last bits."""
    stop_at_success: bool = False
    """End an episode at success or failure, which is cheaper; the result then lacks success_at_end, fail_at_end and
    success_paper. Without this flag every episode runs to the time limit of the task, as in ManiSkill's evaluation."""
    step_timeout: float = STEP_TIMEOUT
    """Longest time that the policy may take for one action, in s."""
    env_kwargs: str = "{}"
    """Arguments of the task as json, such as '{"fit": "tight"}'."""
    videos: tuple[int, ...] = ()
    """Numbers of the episodes, counted from 0, that are recorded as videos with all cameras and touch; the videos go into the
    folder videos beside the result."""


def main(args: Args) -> Path:
    """Evaluate a policy, and return the path of the result file.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        UnknownNameError: There is no such task or entry.
        PolicyError: The policy cannot be made.
        PolicyUnavailableError: The policy's server cannot be reached.
        InvalidArgumentError: The arguments do not say what to evaluate, or on which task.
        InvalidFileError: The file of --seeds is no list of seeds for evaluation.
        OtherEvaluationError: Another evaluation of this result was interrupted.
        InUseError: Another process writes this result.
        FileWriteError: The result cannot be written.
        WorkFailedError: Every episode failed because of an error of the policy; the result is written nevertheless.
    """
    entry = None if args.entry is None else find_entry(args.entry)
    if entry is not None:
        args = _like_entry(args, entry)
    evaluation = evaluation_from_args(args)
    origin = provenance(evaluation.env_id)  # of the code that runs; while it does, others may be committed
    seeds = evaluation_seeds(args.episodes) if args.seeds is None else read_seeds(args.seeds)
    out = args.out or default_out(args.checkpoint)
    _check_outputs(args, evaluation, seeds, out, origin)
    with owned(out):
        journal = Journal(out, _identity(evaluation) | origin, seeds, args.overwrite, args.overwrite_other)
        if journal.outcomes:
            log.info("%s has %d finished episodes; the evaluation goes on", journal.path, len(journal.outcomes))
        with journal.kept():
            run_episodes(evaluation, journal.remaining, args.workers, journal.add)
            write_result(_result(evaluation, journal.in_order, origin), out)
    _require_answers(journal.in_order, out)
    if entry is not None:
        log.info("%s", _comparison(entry, out, journal.in_order))
    if args.videos:
        from .video import write_video

        for number in args.videos:
            write_video(evaluation, seeds[number], out.parent / "videos")
    return out


def _require_answers(outcomes: list[EpisodeOutcome], out: Path) -> None:
    """Check that a policy has acted to the end of at least one episode.

    Raises:
        WorkFailedError: Every episode failed because of an error of the policy.
    """
    errors = [outcome.error for outcome in outcomes if outcome.error]
    if len(errors) == len(outcomes):
        raise WorkFailedError(
            f"the policy failed in all {len(errors)} episodes, first with: {one_line(errors[0])}; {out} has every reason; "
            "mend the policy, and give the same command"
        )


def default_out(checkpoint: Path | None) -> Path:
    """Path of a result for which none is given: in the run folder of a checkpoint, or else in the working folder."""
    checkpoints = checkpoint.resolve().parent if checkpoint else Path()  # a relative path may be as short as `last` or `.`
    return checkpoints.parent / EVALUATION if checkpoints.name == CHECKPOINTS else Path(EVALUATION)


def _like_entry(args: Args, entry: Entry) -> Args:
    """The arguments with which the result of an entry was made, except for those that are given.

    Without --out, the result comes into the working folder.

    Raises:
        InvalidArgumentError: Another policy is given as well, or --env-kwargs is no json object.
    """
    if args.checkpoint is not None or args.policy is not None:
        raise InvalidArgumentError("--entry brings its checkpoint; leave out --checkpoint and --policy")
    made, inference = entry.result, entry.result["inference"]
    return replace(
        args,
        checkpoint=entry.checkpoint,
        out=args.out or Path(EVALUATION),
        device=args.device or inference["device"],
        batch_size=inference["batch_size"] if args.batch_size is None else args.batch_size,
        inference_steps=made["config"].get(INFERENCE_STEPS) if args.inference_steps is None else args.inference_steps,
        stop_at_success=args.stop_at_success or made["stop_at_success"],
        env_kwargs=json.dumps(made["env_kwargs"] | json_object("--env-kwargs", args.env_kwargs)),
        policy_kwargs=json.dumps(made["config"].get("policy_kwargs", {}) | json_object("--policy-kwargs", args.policy_kwargs)),
    )


def _comparison(entry: Entry, out: Path, outcomes: list[EpisodeOutcome]) -> str:
    """Sentence that compares the outcomes with those of the entry, or says why they cannot be compared."""
    if not (unlike := entry.unlike(read_result(out))):
        return entry.agreement(outcomes)
    named = ", ".join(unlike)
    return f"the episodes are not compared with those of the entry {entry.name}, which was evaluated with other {named}"


def _check_outputs(args: Args, evaluation: Evaluation, seeds: list[int], out: Path, origin: dict[str, Any]) -> None:
    """Check before the first episode what would otherwise fail after the last one.

    Raises:
        InvalidArgumentError: The result is a folder or a file of a recording, or a video of an episode that does not
            exist is requested.
        ResultError: The arguments cannot be part of a result.
        MissingExtraError: Videos are requested, and the extra `report` is not installed.
    """
    try:
        require_file("--out", out, EVALUATION)
        if out.suffix in (".json", ".h5") and (recording := out.with_suffix(".h5")).exists():
            raise InvalidArgumentError(f"--out {out} would replace a file of the recording {recording}; give another path")
    except OSError as error:
        raise InvalidArgumentError(f"--out {out} cannot be written ({error.strerror}); give another path") from error
    if wrong := [number for number in args.videos if not 0 <= number < len(seeds)]:
        raise InvalidArgumentError(f"--videos {wrong} cannot be recorded: the episodes are 0 to {len(seeds) - 1}")
    if args.videos:
        with missing_extras_named():
            from . import video  # noqa: F401  (only to see whether it can be imported)
    as_published(_result(evaluation, [failed_outcome(seeds[0], None, args.stop_at_success)], origin), out)


def _identity(evaluation: Evaluation) -> dict[str, Any]:
    """Everything that outcomes depend on beside `provenance`, as far as it can be known."""
    return dict(
        env_id=evaluation.env_id,
        env_kwargs=evaluation.env_kwargs,
        policy_hash=evaluation.source.fingerprint(),
        policy_kwargs=redacted(json.loads(evaluation.source.kwargs)),
        config=published_config(evaluation.config),
        step_timeout=evaluation.step_timeout,
        stop_at_success=evaluation.stop_at_success,
        inference=dict(device=evaluation.source.device, batch_size=evaluation.source.batch_size),
    )


def _result(evaluation: Evaluation, outcomes: list[EpisodeOutcome], origin: dict[str, Any]) -> dict[str, Any]:
    source = evaluation.source
    inference = dict(device=source.device, batch_size=source.batch_size)
    return result_of(evaluation.env_id, evaluation.env_kwargs, evaluation.config, outcomes, inference, origin)


def evaluation_from_args(args: Args) -> Evaluation:
    """The evaluation that the arguments, and the checkpoint's configuration if there is one, describe.

    Raises:
        CheckpointError: The checkpoint's configuration is missing or incomplete.
        UnknownNameError: The task is not registered.
        InvalidArgumentError: Neither a checkpoint nor a policy is given, or both, or a policy without its task, a checkpoint
            with another task or other observations than its own, or a number that is not allowed.
    """
    require_positive(num_eval_envs=args.workers, inference_steps=args.inference_steps)
    if not (is_number(args.step_timeout) and args.step_timeout > 0):
        raise InvalidArgumentError(f"--step-timeout {args.step_timeout} must be a number of seconds above 0")
    if (args.checkpoint is None) == (args.policy is None):
        raise InvalidArgumentError("give either --checkpoint, or --policy with --env-id and --obs-mode")
    given = json_object("--env-kwargs", args.env_kwargs)
    policy_kwargs = json_object("--policy-kwargs", args.policy_kwargs)
    if args.checkpoint is not None:
        if of_flags := [name for name in ("device", "batch_size", INFERENCE_STEPS) if name in policy_kwargs]:
            raise InvalidArgumentError(
                f"--policy-kwargs {of_flags} of a --checkpoint have flags of their own: {_flags(of_flags)}"
            )
        return _of_checkpoint(args, policy_kwargs | {INFERENCE_STEPS: args.inference_steps}, given)
    if args.env_id is None or args.obs_mode is None:
        raise InvalidArgumentError("a --policy of your own needs --env-id and --obs-mode")
    if unused := [name for name in ("device", "batch_size", INFERENCE_STEPS) if getattr(args, name) is not None]:
        raise InvalidArgumentError(
            f"only a --checkpoint takes {_flags(unused)}; --policy-kwargs gives arguments to a --policy of your own"
        )
    env_id = task_spec(args.env_id).env_id
    check_obs_mode("--env-kwargs", given, args.obs_mode)
    pads = POLICY_PADS if args.tactile_sensors is None else args.tactile_sensors
    sensing = dict(obs_mode=args.obs_mode, cameras=args.cameras, tactile_sensors=pads, sensor=args.sensor)
    source = PolicySource(policy=args.policy, kwargs=args.policy_kwargs, answer_timeout=args.step_timeout)
    config = dict(policy_name=redacted(args.policy), policy_kwargs=policy_kwargs, obs_mode=args.obs_mode)
    env_kwargs = {n: v for n, v in sensing.items() if v is not None} | BACKEND | given
    return Evaluation(source, env_id, env_kwargs, config, args.stop_at_success, args.step_timeout)


def _of_checkpoint(args: Args, kwargs: dict[str, Any], given: dict[str, Any]) -> Evaluation:
    checkpoint = args.checkpoint
    assert checkpoint is not None
    config = checkpoint_config(checkpoint)
    if missing := [name for name in ("env_id", *SENSING) if name not in config]:
        raise CheckpointError(f"{checkpoint}: its config.json lacks {missing}; train the policy again")
    read = {name: config[name] for name in OF_A_CHECKPOINT if name in config}
    if wrong := [name for name, value in read.items() if not isinstance(value, OF_A_CHECKPOINT[name])]:
        raise CheckpointError(
            f"{checkpoint}: {wrong} in its config.json have another form; the checkpoint is broken, use another"
        )
    # recorded in the result, because it changes the actions
    config |= {name: value for name, value in kwargs.items() if name == INFERENCE_STEPS and value}
    if own := {name: value for name, value in kwargs.items() if name != INFERENCE_STEPS}:
        config |= dict(policy_kwargs=own)
    env_id = task_spec(config["env_id"]).env_id
    _require_own(args, config | dict(env_id=env_id))
    recorded = config.get("env_kwargs", {})
    trained = {name: value for name, value in recorded.items() if name not in LENGTHS_OF_RECORDINGS}
    sensing = {name: config[name] for name in SENSING}
    if args.sensor not in (None, learnt := trained.get("sensor", DEFAULT_SENSOR)):
        raise InvalidArgumentError(
            f"--sensor {args.sensor}: the demonstrations of {checkpoint} were recorded with {learnt}; leave it out, or give "
            f'--env-kwargs \'{{"sensor": "{args.sensor}"}}\' if another sensor is meant'
        )
    check_obs_mode("--env-kwargs", given, config["obs_mode"])
    _name_differences(env_id, recorded | sensing, given)
    device = checked_device(args.device)
    if args.batch_size is not None and args.batch_size < 1:
        raise InvalidArgumentError(f"--batch-size {args.batch_size} is less than 1; leave it out, or give 1 or more")
    batch_size = args.batch_size or BATCH_SIZES.get(device.partition(":")[0], 1)
    # not the link `last`, which training may move meanwhile
    source = PolicySource(checkpoint.resolve(), None, json.dumps(kwargs), device, batch_size)
    return Evaluation(source, env_id, trained | sensing | BACKEND | given, config, args.stop_at_success, args.step_timeout)


def _require_own(args: Args, config: dict[str, Any]) -> None:
    """Check that what a checkpoint brings is not asked for in another form.

    Raises:
        InvalidArgumentError: The task, the observation mode, the cameras or the pads that are given are not the checkpoint's.
    """
    lists = {name: None if (names := getattr(args, name)) is None else [*names] for name in ("cameras", "tactile_sensors")}
    given = dict(env_id=args.env_id and task_spec(args.env_id).env_id, obs_mode=args.obs_mode) | lists
    for name, value in given.items():
        if value not in (None, own := config[name]):
            raise InvalidArgumentError(
                f"{_flags([name])} {value}: the policy of {args.checkpoint} was trained with {own}; leave it out. Other "
                "arguments of its task are given by --env-kwargs"
            )


def _name_differences(env_id: str, trained: dict[str, Any], given: dict[str, Any]) -> None:
    """Warn of arguments that differ from those of a policy's demonstrations, and of a time limit that is not taken over."""
    defaults = {name: value for name, value in default_arguments(env_id).items() if name not in BACKENDS}
    learnt = defaults | trained
    for name, value in given.items():
        if name in learnt and json.dumps(learnt[name], default=str) != json.dumps(value):
            log.warning("--env-kwargs: %s is %r here, but %r in the demonstrations of the policy", name, value, learnt[name])
    if (limit := trained.get("max_episode_steps")) and "max_episode_steps" not in given:
        log.warning(
            "the demonstrations of the policy had max_episode_steps %r; the evaluation has the task's own limit, "
            "unless --env-kwargs gives another",
            limit,
        )


def _flags(names: list[str]) -> str:
    return " and ".join(f"--{name.replace('_', '-')}" for name in names)


def next_step(args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    episodes = read_result(made)["episodes"]
    outcome = f"{made}: {sum(episode['success_once'] for episode in episodes)} of {len(episodes)} episodes succeed"
    if errors := [episode["error"] for episode in episodes if episode["error"]]:
        outcome = f"{outcome}, and {len(errors)} failed because of an error of the policy (the first: {one_line(errors[0])})"
    film = as_typed("manifeel", "film", made, *_policy_flags(args, made), "--out", "FILE.mp4")
    return f"{outcome}; {film} shows one, {_page_of(args, made)}"


def _page_of(args: Args, made: Path) -> str:
    """Which command makes a page with a result: that of all results if the file is named by a gradient step."""
    if made.stem.isdigit():
        return f"{as_typed('manifeel', 'results', '--results', made.parent)} sets it beside the paper's"
    checkpoints = (made.parent / CHECKPOINTS).resolve()
    if args.checkpoint is not None and made.name == EVALUATION and args.checkpoint.resolve().parent == checkpoints:
        return f"{as_typed('manifeel', 'report', '--run-dir', made.parent)} writes a page about the run"
    return "`manifeel results` reads files named by the step, as 00007000.json"


def _policy_flags(args: Args, made: Path) -> list[str]:
    """Flags that name the policy of a result to `manifeel film`, which else takes checkpoints/last beside the result."""
    checkpoint = find_entry(args.entry).checkpoint if args.entry else args.checkpoint
    flags = []
    if args.policy is not None:
        flags += ["--policy", redacted(args.policy)]
    elif checkpoint is not None and checkpoint.resolve() != (made.parent / CHECKPOINTS / LAST_LINK).resolve():
        flags += ["--checkpoint", str(checkpoint)]
    if kwargs := json_object("--policy-kwargs", args.policy_kwargs):
        flags += ["--policy-kwargs", json.dumps(redacted(kwargs))]
    return flags


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
