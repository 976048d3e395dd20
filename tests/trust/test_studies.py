"""Studies: what their jobs leave behind is whole, nobody else reaches their Ray, and a wrong file is told in one line."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import ExitStack, suppress
from importlib.metadata import requires
from pathlib import Path

import psutil
import pytest
from packaging.requirements import Requirement

from baselines.studies import __main__ as study_command
from baselines.studies import running
from baselines.studies.jobs import DONE, FAILED, STARTED, is_done, perform
from baselines.studies.planning import Job, jobs_of
from baselines.studies.study import Resources, StudyError, read_study
from manifeel_ms3.command_line import INTERRUPTED, PACKAGE
from manifeel_ms3.errors import InUseError, MachineError, WorkFailedError
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.ownership import owned
from manifeel_ms3.tasks.registry import full_id, task_spec
from tests.tasks_and_marks import PEG
from tests.trust.listening import LOOPBACK, listening
from tests.trust.tiny_training import tiny_args, train

REPOSITORY = Path(__file__).parents[2]
AUTHENTICATED = "2.59"  # the first Ray whose local clusters ask for a token by default
PATIENCE = 240  # s
GRIDS = f"grids: [{{tasks: [{PEG}]}}]\n"


# -------------------------------------------------------------------- results and status


def test_a04_a_result_counts_only_if_it_is_whole_and_of_this_checkpoint(tmp_path):
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=3))
    trained = Job("train", "a training", {})
    settings = dict(episodes=1, checkpoints=1, stop_at_success=False, half_precision=False, env_kwargs=kwargs)
    job = Job("evaluate", "an evaluation", settings, (trained,))
    checkpoint = train(tiny_args(trained.folder(tmp_path), steps=2)).resolve()
    out = job.folder(tmp_path) / "00000002.json"

    def again() -> float:
        (job.folder(tmp_path) / DONE).unlink(missing_ok=True)
        perform(job, tmp_path, Resources())
        return read_result(out)["config"]["training_seconds"]

    again()
    content, before = out.read_text(), out.stat().st_mtime_ns
    again()
    assert out.stat().st_mtime_ns == before  # nothing is done twice
    out.write_text(content[: len(content) // 2])  # as a full disk left it
    again()
    assert out.stat().st_mtime_ns != before
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps(config | dict(training_seconds=77.0)))  # trained again
    assert again() == 77.0


def test_a04_a_status_that_was_cut_off_is_none(study, tmp_path):
    record, *_ = jobs_of(read_study(study))
    record.folder(tmp_path).mkdir(parents=True)
    for content in ("", '{"secon', "[]", "\x00"):
        (record.folder(tmp_path) / DONE).write_text(content)
        assert not is_done(record, tmp_path)
    study_command.progress(read_study(study), [record], tmp_path)


def test_a04_errors_in_all_episodes_are_no_result(tmp_path):
    """The policy observes the right pad, and the evaluation has the left one."""
    trained = Job("train", "a training", {})
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=3, tactile_sensors=["left"]))
    settings = dict(episodes=2, checkpoints=1, stop_at_success=False, half_precision=False, env_kwargs=kwargs)
    job = Job("evaluate", "an evaluation", settings, (trained,))
    train(tiny_args(trained.folder(tmp_path), steps=2))
    for _ in range(2):  # also where the result is there already
        said = r"the policy failed in all 2 episodes, first with: .*tactile_right.*2\.json has every reason; mend"
        with pytest.raises(WorkFailedError, match=said):
            perform(job, tmp_path, Resources())
        assert not is_done(job, tmp_path)


def test_a03_a_job_that_another_process_does_is_left_to_it_and_awaited(study, tmp_path, monkeypatch):
    """The other process is this one. A worker of Ray finds that it holds the job; the study waits until it has done it."""
    record, *others = jobs_of(read_study(study))
    for job in others:
        job.folder(tmp_path).mkdir(parents=True)
        (job.folder(tmp_path) / DONE).write_text('{"seconds": 1}')
    started, found = record.folder(tmp_path) / STARTED, []
    is_held, progress = running._is_held, study_command.progress

    def finding(*args) -> bool:
        found.append(is_held(*args))
        return found[-1]

    def shown(*args):
        started.write_text("{}")  # as the other process writes it after it took the lock
        if any(found):
            (started.parent / DONE).write_text('{"seconds": 1}')
            other.close()
        return progress(*args)

    monkeypatch.setattr(running, "_is_held", finding)
    monkeypatch.setattr(study_command, "progress", shown)
    with ExitStack() as other:
        other.enter_context(owned(started))
        with pytest.raises(InUseError, match=f"is in use by process {os.getpid()} on"):
            perform(record, tmp_path, Resources())
        study_command.main(study_command.Args(study, tmp_path))
    assert found[0] is False  # so that a worker was started
    assert any(found)
    assert started.read_text() == "{}"
    assert not (record.folder(tmp_path) / FAILED).exists()


def test_b05_a_folder_that_cannot_be_written_is_told_before_anything_runs(study, tmp_path):
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file/inside", Path("/proc/study")):
        for arguments in (dict(), dict(dry_run=True)):
            with pytest.raises(MachineError, match=f"{root} cannot be written .*; give another --root"):
                study_command.main(study_command.Args(study, root, **arguments))


# -------------------------------------------------------------------- Ray


@pytest.mark.skipif(sys.version_info < (3, 11), reason="the option -P is of Python 3.11")
@pytest.mark.slow  # a whole Ray and a second one that is refused: minutes
def test_b03_and_a13_ray_is_reached_from_here_alone_and_imports_nothing_from_the_current_folder(study, tmp_path):
    for name in ("torch.py", "json.py"):
        (tmp_path / name).write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'executed')!r}).write_text({name!r})\n")
    root = tmp_path / "root"
    record, *_ = jobs_of(read_study(study))
    command = [sys.executable, "-P", "-m", "baselines.studies", study.name, "--root", "root"]
    environment = os.environ | dict(PYTHONPATH=str(REPOSITORY))
    process = psutil.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seen: dict[tuple[str, int], str] = {}
    try:
        until = time.monotonic() + PATIENCE
        while not (record.folder(root) / STARTED).is_file():
            assert process.poll() is None, process.communicate()[0]
            assert time.monotonic() < until
            time.sleep(0.2)
            seen |= listening(process)
        (server,) = {address for address, name in seen.items() if name == "gcs_server"} or [None]
        assert server, seen
        host, port = server[0].removeprefix("::ffff:"), server[1]  # an IPv4 address, as a socket for IPv6 may have it
        here = (
            "from ray._private import ray_constants; ray_constants.ENABLE_RAY_CLUSTER = False"  # else it asks the outer address
        )
        stranger = f"import ray; {here}; ray.init('{host}:{port}', log_to_driver=False); print(ray.cluster_resources())"
        foreign = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        foreign |= dict(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN="0" * 64, HOME=str(tmp_path))
        refused = subprocess.run(
            [sys.executable, "-P", "-c", stranger],
            env=foreign,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE,
        )
        seen |= listening(process)
    finally:
        for one in (*process.children(recursive=True), process):
            one.kill()
        process.communicate()
    assert not (tmp_path / "executed").exists(), (tmp_path / "executed").read_text()
    assert {address for address, _ in seen} <= LOOPBACK, seen
    assert refused.returncode != 0
    assert "uthentication" in refused.stderr, refused.stderr


@pytest.mark.slow  # a whole Ray: a minute
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a06_ctrl_c_and_term_end_a_study_at_once_and_say_what_is_kept(study, tmp_path, sent, figure):
    root = tmp_path / "root"
    record, *_ = jobs_of(read_study(study))
    process = subprocess.Popen(
        [sys.executable, "-m", "baselines.studies", study, "--root", root],
        cwd=REPOSITORY,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a suite in the background ignores Ctrl-C
    )
    try:
        until = time.monotonic() + PATIENCE
        while not (record.folder(root) / STARTED).is_file():
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.2)
        begin = time.monotonic()
        (os.killpg if sent == signal.SIGINT else os.kill)(process.pid, sent)  # a terminal sends Ctrl-C to every process
        errors = process.communicate(timeout=PATIENCE)[1]
        figure("seconds from Ctrl-C to the end of a study", time.monotonic() - begin, at_most=2.0)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == INTERRUPTED
    assert re.search(r"0 of \d+ jobs are done and kept in .*root; the same command goes on", errors)
    assert "Traceback" not in errors


def test_b03_only_versions_of_ray_with_authentication_are_allowed():
    (ray,) = [one for one in map(Requirement, requires(PACKAGE) or []) if one.name == "ray"]
    pinned = Requirement(re.search(r'"(ray[^"]*)"', (REPOSITORY / "pyproject.toml").read_text())[1])
    assert AUTHENTICATED in pinned.specifier
    assert "2.58.0" not in pinned.specifier
    assert ray.name == pinned.name


# -------------------------------------------------------------------- the wheel, and files


TWO_SEEDS = f"grids: [{{tasks: [{PEG}], obs_modes: [tacff], seeds: [0, 1]}}]"
ESTIMATE = """
import json, sys
from pathlib import Path
from baselines.studies import cost
from baselines.studies.planning import jobs_of
from baselines.studies.study import read_study
from baselines.studies.work import work_of
from manifeel_ms3.provenance import machine

study = read_study(Path("study.yaml"))
jobs = jobs_of(study)
first, second = (job for job in jobs if job.kind == "train")
first.folder(Path()).mkdir(parents=True)
status = dict(seconds=5.0, units=10, parallel=1, machine=machine(), work=work_of(first, 0))
(first.folder(Path()) / "done.json").write_text(json.dumps(status))
print(cost.__file__, cost.estimate(second, Path(), 1).seconds)
"""


def test_a07_a_study_from_the_wheel_needs_no_sample_data(tmp_path):
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)], cwd=REPOSITORY, check=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as archive:
        archive.extractall(tmp_path / "site")
    assert not (tmp_path / "site/manifeel_ms3/data/sample").exists()
    (tmp_path / "study.yaml").write_text(TWO_SEEDS)
    environment = os.environ | dict(PYTHONPATH=str(tmp_path / "site"))
    done = subprocess.run(
        [sys.executable, "-c", ESTIMATE], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    place, seconds = done.stdout.split()
    assert Path(place).is_relative_to(tmp_path)
    assert float(seconds) == 0.5 * 1000 * 300  # 1000 epochs of 50 demonstrations of 48 samples (55 steps), in batches of 8


def test_a07_tasks_have_the_measured_length_of_their_demonstrations():
    table = (REPOSITORY / "docs/tasks.md").read_text()
    rows = re.findall(r"^\| ([\w, ]+?)(?:, tight)? \| [\w ]+ \| (\d+) \| [\d.]+ \|$", table, flags=re.MULTILINE)
    measured = {name: int(steps) for names, steps in rows for name in names.split(", ") if "tight" not in names}
    assert len(measured) == 10
    assert {name: task_spec(full_id(name)).demo_steps for name in measured} == measured


WRONG = {
    "include itself": ("include: [study.yaml]", "includes itself"),
    "include in a ring": ("include: [other.yaml]", "includes itself"),
    "include 5": ("include: 5", "`include` has the wrong type"),
    "include [5]": ("include: [5]", "`include` has the wrong type"),
    "include a folder": ("include: ['.']", "cannot be read as a study"),
    "include nothing": ("include: [nothing.yaml]", "cannot be read as a study"),
    "deep": ("[" * 100_000, "cannot be read as a study"),
    "long number": ("grids: " + "1" * 5000, "cannot be read as a study|wrong type"),
    "broken": ("grids: [\n- {", "cannot be read as a study"),
    "no day": ("grids: 2020-99-99", "cannot be read as a study"),
    "nothing": ("", "is not a study"),
    "null": ("grids: null", "wrong type"),
    "latin-1": ("# Prüfung\n".encode("latin-1") + GRIDS.encode(), "cannot be read as a study"),
    "zero bytes": (b"\x00" * 100, "cannot be read as a study"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a29_a_wrong_study_is_told_in_one_line(name, tmp_path):
    content, said = WRONG[name]
    path = tmp_path / "study.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "other.yaml").write_text("include: [study.yaml]")
    with pytest.raises(StudyError, match=said) as error:
        read_study(path)
    assert len(str(error.value).splitlines()) == 1
    assert len(str(error.value)) < 1000


def test_a29_two_files_may_include_a_third(tmp_path):
    (tmp_path / "third.yaml").write_text(GRIDS)
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text("include: [third.yaml]")
    (tmp_path / "study.yaml").write_text("include: [one.yaml, two.yaml]")
    assert len(read_study(tmp_path / "study.yaml").grids) == 2


def test_a29_a_study_is_utf8_in_every_locale(tmp_path):
    (tmp_path / "Prüfung.yaml").write_text("# Prüfung\n" + GRIDS, encoding="utf-8")
    script = "import sys; from pathlib import Path; from baselines.studies.study import read_study\n"
    script += "read_study(next(Path().glob('*.yaml')))"
    environment = os.environ | dict(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", PYTHONPATH=str(REPOSITORY))
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
