"""An evaluation loses no episode, and ends with a result or with one line that says why not."""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest

from manifeel_ms3.errors import InUseError, InvalidFileError, ManifeelError
from manifeel_ms3.evaluation.checkpoint_config import hash_of_all_files
from manifeel_ms3.evaluation.evaluate import Args, main
from manifeel_ms3.evaluation.journal import Journal, OtherEvaluationError
from manifeel_ms3.evaluation.policy import PolicySource
from manifeel_ms3.evaluation.redaction import MARK
from manifeel_ms3.evaluation.result import read_result, result_of, write_result
from manifeel_ms3.evaluation.rollout import EpisodeOutcome
from manifeel_ms3.files import FileWriteError
from manifeel_ms3.ownership import owned
from manifeel_ms3.tasks.registry import evaluation_seeds
from tests.evaluation.policies import STUCK
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG
from tests.trust.running_evaluations import PATIENCE, alive, wait_for_episodes

REPOSITORY = Path(__file__).parents[2]
TASK = json.dumps(dict(render_backend="none", max_episode_steps=3))
IDENTITY = dict(env_id=PEG, versions=dict(torch="2"), git_commit=None)
NOBODY = 65534


def args_of(policy: str, out: Path, **changes) -> Args:
    name = policy if "://" in policy else f"tests.evaluation.policies:{policy}"
    return replace(Args(policy=name, env_id=PEG, obs_mode="tacff", cameras=(), episodes=2, env_kwargs=TASK, out=out), **changes)


def command_of(args: Args) -> list[str]:
    command = [sys.executable, "-m", "manifeel_ms3.evaluation.evaluate", "--policy", str(args.policy), "--cameras"]
    for name in ("env_id", "obs_mode", "episodes", "env_kwargs", "out", "workers"):
        command += [f"--{name.replace('_', '-')}", str(getattr(args, name))]
    return command


def outcome(seed: int) -> EpisodeOutcome:
    return made_up(seed, seed % 2 == 0, force=1.5)


def journal_of(out: Path) -> Path:
    return out.with_name(f"{out.stem}.episodes.jsonl")


# ------------------------------------------------------------------------------- interruptions


@pytest.mark.parametrize(
    ("how", "workers", "finished"),
    [(signal.SIGINT, 1, 1), (signal.SIGINT, 2, 2), (signal.SIGTERM, 2, 2), (signal.SIGKILL, 1, 1)],
)
def test_a06_ctrl_c_ends_an_evaluation_at_once_and_it_goes_on_where_it_stopped(
    how, workers, finished, tmp_path, monkeypatch, figure
):
    args = args_of("SticksInSecondEpisode", tmp_path / "evaluation.json", episodes=4, workers=workers)
    journal, errors = journal_of(args.out), tmp_path / "stderr"
    with errors.open("w") as file:
        process = subprocess.Popen(
            command_of(args),
            cwd=REPOSITORY,
            env=os.environ | {STUCK: "1"},
            stderr=file,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a suite in the background ignores Ctrl-C
        )
    try:
        wait_for_episodes(journal, finished)
        time.sleep(1)  # the second episode of each worker is stuck by now
        begin = time.monotonic()
        if how == signal.SIGINT:
            os.killpg(process.pid, how)  # as the terminal does
        else:
            process.send_signal(how)
        code = process.wait(PATIENCE)
        seconds = time.monotonic() - begin
        if how != signal.SIGKILL:
            figure("seconds from Ctrl-C to the end of an evaluation", seconds, at_most=2.0)
            assert code == 130
            assert (
                f"{finished} of 4 episodes are finished and kept in {journal}; the same command goes on" in errors.read_text()
            )
            assert "Traceback" not in errors.read_text()
            assert "leaked" not in errors.read_text()
            while alive(process.pid):  # the resource tracker of multiprocessing ends a moment after its parent
                assert time.monotonic() < begin + PATIENCE, "a process is left"
                time.sleep(0.1)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert not args.out.exists()
    kept = [json.loads(line) for line in journal.read_text().splitlines()[1:]]
    assert len(kept) == finished
    monkeypatch.delenv(STUCK, raising=False)
    episodes = read_result(main(args))["episodes"]
    assert [episode["seed"] for episode in episodes] == evaluation_seeds(4)
    assert all(episode in episodes for episode in kept)  # with the same times: they were not run again
    assert not journal.exists()


def test_an_error_says_what_is_kept_and_the_journal_holds_no_secret(tmp_path, caplog):
    """The policy's first episode fails with its key in the message, and the second ends the evaluation."""
    kwargs = dict(api_key="correct-horse", options=dict(url="https://me:hunter22@example.org/x", hub="hf_abcdefghijkl"))
    args = args_of("LeaksAndGoesAway", tmp_path / "evaluation.json", policy_kwargs=json.dumps(kwargs))
    with caplog.at_level("INFO"), pytest.raises(ConnectionError, match="gone"):
        main(args)
    assert "1 of 2 episodes are finished and kept in" in caplog.text
    text = journal_of(args.out).read_text()
    assert f"RuntimeError: {MARK} is refused" in text
    assert not any(secret in text for secret in ("correct-horse", "hunter22", "hf_abcdefghijkl"))
    assert not args.out.exists()


def evaluate_without_simulator(out: Path, seeds: list[int], report: int) -> None:
    """All that an evaluation writes; each seed is reported once its outcome is said to be on the disk."""
    journal = Journal(out, IDENTITY, seeds)
    with journal.kept():
        for seed in journal.remaining:
            journal.add(outcome(seed))
            os.write(report, f"{seed}\n".encode())
        write_result(result_of(PEG, {}, dict(policy_name="a:B", obs_mode="rgb"), journal.in_order), out)


def test_results_whose_names_have_a_dot_have_journals_of_their_own(tmp_path):
    for gain in (0.3, 0.5):  # both at the same time
        Journal(tmp_path / f"policy_{gain}", dict(gain=gain), [1]).add(outcome(1))
    assert list(Journal(tmp_path / "policy_0.3", dict(gain=0.3), [1]).outcomes) == [1]


@pytest.mark.parametrize("kills", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_kills_at_random_moments_lose_no_episode(kills, tmp_path, figure):
    seeds, chance, interrupted = evaluation_seeds(50), random.Random(0), 0
    undisturbed = tmp_path / "undisturbed.json"
    for path in (tmp_path / "first.json", undisturbed):  # the first run takes longer than all others
        begun = time.perf_counter()
        evaluate_without_simulator(path, seeds, os.open(os.devnull, os.O_WRONLY))
        duration = time.perf_counter() - begun  # a machine with a fast disk ends within milliseconds
    for number in range(kills):
        out = tmp_path / f"{number}.json"
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                evaluate_without_simulator(out, seeds, writer)
            finally:
                os._exit(0)
        os.close(writer)
        time.sleep(chance.uniform(0, duration))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        reported = {int(line) for line in os.read(reader, 10**6).split()}
        os.close(reader)
        if not out.exists():
            interrupted += 1
            assert reported <= set(Journal(out, IDENTITY, seeds).outcomes)
        evaluate_without_simulator(out, seeds, os.open(os.devnull, os.O_WRONLY))
        assert out.read_text() == undisturbed.read_text()
        assert not journal_of(out).exists()
    figure("share of the kills that interrupted an evaluation", interrupted / kills, at_least=0.1)


def test_a_line_that_broke_off_is_dropped_and_what_is_broken_is_refused(tmp_path):
    journal = Journal(tmp_path / "x.json", IDENTITY, [1, 2, 3])
    for seed in (1, 2):
        journal.add(outcome(seed))
    whole = journal.path.read_bytes()
    for cut in range(1, len(whole.splitlines()[-1]) + 1):
        journal.path.write_bytes(whole[:-cut])
        assert list(Journal(tmp_path / "x.json", IDENTITY, [1, 2, 3]).outcomes) == [1]
    for broken in (b"", b"{\n", b"[" * 10**5 + b"\n", whole + b"{}\n", whole + b"\xff\n", whole.replace(b"1.5", b"NaN")):
        journal.path.write_bytes(broken)
        with pytest.raises(InvalidFileError, match=r"does not hold the episodes of an .*--overwrite"):
            Journal(tmp_path / "x.json", IDENTITY, [1, 2, 3])
        assert journal.path.read_bytes() == broken
    for allowed in (dict(overwrite=True), dict(overwrite_other=True)):  # as a command's user may ask, and a training does
        journal.path.write_bytes(b"\x00" * 64 + b"\n")
        assert Journal(tmp_path / "x.json", IDENTITY, [1, 2, 3], **allowed).remaining == [1, 2, 3]


def test_another_unfinished_evaluation_is_refused_unless_it_may_be_discarded(tmp_path, caplog):
    args = args_of("Nobody", tmp_path / "evaluation.json")
    journal = Journal(args.out, IDENTITY, evaluation_seeds(2))
    journal.add(outcome(100_000))
    before = journal.path.read_text()
    with pytest.raises(OtherEvaluationError, match=r"holds 1 episodes of .* another config, env_kwargs.*--overwrite"):
        main(args)
    assert journal.path.read_text() == before
    for changed, name in ((dict(git_commit="0" * 40), "git_commit"), (dict(versions=dict(torch="3")), "versions.torch")):
        with pytest.raises(OtherEvaluationError, match=f"with another {name};"):
            Journal(args.out, IDENTITY | changed, evaluation_seeds(2))
    with pytest.raises(OtherEvaluationError, match="another seeds"):
        Journal(args.out, IDENTITY, evaluation_seeds(3))
    same = Journal(args.out, IDENTITY, evaluation_seeds(2), overwrite_other=True)
    assert (list(same.outcomes), same.remaining) == ([100_000], [100_001])
    with caplog.at_level("INFO"):
        other = Journal(args.out, IDENTITY | dict(git_commit="0" * 40), evaluation_seeds(2), overwrite_other=True)
    assert other.remaining == evaluation_seeds(2)
    assert "begins again, because" in caplog.text
    assert "with another git_commit" in caplog.text
    with pytest.raises(ManifeelError, match="Nobody cannot be made"):
        main(replace(args, overwrite=True))
    assert not journal.path.exists()


def test_a_policy_is_identified_by_its_files(tmp_path, monkeypatch):
    (tmp_path / "config.json").write_text("{}")
    before = hash_of_all_files(tmp_path)
    (tmp_path / "training.safetensors").write_text("deleted from older checkpoints")
    assert hash_of_all_files(tmp_path) == before
    (tmp_path / "model.safetensors").write_text("other weights")
    assert hash_of_all_files(tmp_path) != before
    monkeypatch.syspath_prepend(tmp_path)
    hashes = set()
    for content in ("", "# changed"):
        (tmp_path / "policy_of_mine.py").write_text(content)
        hashes.add(PolicySource(policy="policy_of_mine:Policy").fingerprint())
    assert len(hashes - {None}) == 2
    assert PolicySource(policy="no_such_module.x:Policy").fingerprint() is None


def test_two_evaluations_cannot_write_one_result(tmp_path):
    args = args_of("Nobody", tmp_path / "evaluation.json")
    with owned(args.out), pytest.raises(InUseError, match="is in use by process"):
        main(args)


# ------------------------------------------------------------------------------- places that cannot be written


@contextmanager
def small_disk(kilobytes: int):
    """A small file system, which is soon full."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", folder]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("only root can mount a small disk")
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


def fill(folder: Path) -> Path:
    with suppress(OSError), (folder / "filling").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1024))
    return folder / "filling"


def add_all(journal: Journal) -> None:
    for seed in journal.remaining:
        journal.add(outcome(seed))


def test_a04_a_full_disk_leaves_the_old_result_and_all_finished_episodes():
    with small_disk(64) as folder:
        out, seeds = folder / "evaluation.json", list(range(2000))
        write_result(result_of(PEG, {}, dict(policy_name="a:B", obs_mode="rgb"), [outcome(100_000)]), out)
        old = out.read_text()
        journal = Journal(out, IDENTITY, seeds)
        filling = fill(folder)
        with pytest.raises(FileWriteError, match=r"evaluation.episodes.jsonl cannot be written \(.*No space left"):
            add_all(journal)
        assert 0 < len(journal.outcomes) < len(seeds)
        with pytest.raises(FileWriteError, match="No space left"):
            write_result(result_of(PEG, {}, dict(policy_name="a:B", obs_mode="rgb"), [outcome(k) for k in seeds]), out)
        assert out.read_text() == old
        filling.unlink()
        assert Journal(out, IDENTITY, seeds).outcomes == journal.outcomes
        assert {path.name for path in folder.iterdir()} == {"evaluation.json", "evaluation.episodes.jsonl"}


def test_b05_a_full_disk_is_named_before_the_first_episode():
    with small_disk(64) as folder:
        fill(folder)
        with pytest.raises(ManifeelError, match="cannot be written"):
            main(args_of("Nobody", folder / "evaluation.json"))


def test_b05_an_out_that_cannot_be_written_is_named_before_the_first_episode(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for out, reason in (
        (Path("/proc/none/x.json"), "cannot be written"),
        (tmp_path / "file/x.json", "cannot be written"),
        (tmp_path / "folder", "is a folder; give the path of a file"),
        (tmp_path / ("x" * 300), "cannot be written"),
    ):
        with pytest.raises(ManifeelError, match=reason) as raised:  # and not of the policy, which cannot be made
            main(args_of("Nobody", out))
        assert "\n" not in str(raised.value)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder"}


def test_b05_a_read_only_folder_is_named_before_the_first_episode():
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o555)
        child = os.fork()
        if child == 0:
            try:
                if os.getuid() == 0:
                    os.setuid(NOBODY)
                main(args_of("Nobody", Path(folder) / "x.json"))
            except ManifeelError as error:
                os._exit(7 if "cannot be written" in str(error) else 1)
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert not list(Path(folder).iterdir())


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be two users")
def test_two_users_of_one_machine_take_turns_with_a_file():
    """The second finds the lock and the name of the holder that the first, killed, has left, and may not delete them."""
    with tempfile.TemporaryDirectory() as shared:
        Path(shared).chmod(0o1777)  # as /tmp: nobody may delete what is another's
        out = Path(shared) / "evaluation.json"
        for user in (NOBODY, NOBODY - 1):
            child = os.fork()
            if child == 0:
                try:
                    os.setuid(user)
                    with owned(out):
                        evaluate_without_simulator(
                            out.with_name(f"{user}.json"), evaluation_seeds(3), os.open(os.devnull, os.O_WRONLY)
                        )
                        try:
                            with owned(out):
                                os._exit(3)
                        except InUseError as error:
                            named = f"process {os.getpid()}" if user == NOBODY else "another process"
                            os._exit(0 if f"in use by {named}" in str(error) else 4)
                finally:
                    os._exit(1)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
            assert len(read_result(out.with_name(f"{user}.json"))["episodes"]) == 3


def test_a_bare_environment_gives_a_result(tmp_path):
    """No git, no HOME, an ASCII locale, and a path with spaces and umlauts."""
    folder = tmp_path / "Prüfung von Größen"
    folder.mkdir()
    args = args_of("StandStill", folder / "ergebnis für mich.json", episodes=1)
    bare = dict(PATH="/nogit", LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", OMP_NUM_THREADS="1")
    done = subprocess.run(
        command_of(args), cwd=REPOSITORY, env=bare | dict(PYTHONPATH=str(REPOSITORY)), capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert read_result(args.out)["git_commit"] is None
    assert {path.name for path in folder.iterdir() if not path.name.startswith(".")} == {args.out.name}
