"""A result says which code, which task and which machine it comes from."""

import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from manifeel_ms3 import provenance
from manifeel_ms3.evaluation.result import ResultError, read_result, result_of, write_result
from manifeel_ms3.provenance import machine, package_versions
from manifeel_ms3.tasks.registry import task_spec
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG


@pytest.fixture
def result():
    config = dict(policy_name="diffusion_policy", obs_mode="rgb", run_dir="/home/me/runs/x")
    return result_of(PEG, dict(cameras=["wrist"]), config, [made_up(100_000, True)])


def test_a_result_carries_versions_commit_and_the_revision_of_its_task(result, monkeypatch):
    assert result["versions"] == {name: version(name) for name in ("manifeel-ms3", "mani-skill", "sapien", "torch")}
    assert result["versions"] == package_versions()
    assert result["revision"] == task_spec(PEG).revision
    monkeypatch.setattr(task_spec(PEG), "revision", 7)
    again = result_of(PEG, {}, result["config"], [made_up(100_000, True)])
    assert again["revision"] == 7


def test_the_commit_is_the_one_that_git_says(result):
    repository = Path(provenance.__file__).parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(repository), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    if not (repository / ".git").exists():
        assert result["git_commit"] is None
        return
    changed = git("status", "--porcelain", "--untracked-files=no")
    assert result["git_commit"] == git("rev-parse", "HEAD") + ("-dirty" if changed else "")


def test_a_result_without_commit_or_revision(result, tmp_path):
    """The commit may be unknown, as in a wheel; the revision may not."""
    write_result(result | dict(git_commit=None), tmp_path / "result.json")
    assert read_result(tmp_path / "result.json")["git_commit"] is None
    with pytest.raises(ResultError, match="'revision' is a required property"):
        write_result({name: value for name, value in result.items() if name != "revision"}, tmp_path / "result.json")


def test_the_machine_is_named(result):
    here = machine()
    assert set(here) == {"cpu", "cores", "gpu", "system"}
    assert here["cpu"]
    assert here["cores"] >= 1
    assert result["machine"] == here
