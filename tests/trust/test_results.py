"""A result names the commit that made it, holds finite numbers and known entries, and publishes no secret."""

import importlib.util
import json
import subprocess
from pathlib import Path

import pytest

from manifeel_ms3 import provenance
from manifeel_ms3.evaluation.evaluate import Args, main
from manifeel_ms3.evaluation.redaction import MARK, redacted
from manifeel_ms3.evaluation.result import ResultError, read_result, result_of, write_result
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG

NOBODY = "tests.evaluation.policies:Nobody"
TASK = json.dumps(dict(render_backend="none"))


def result(**config) -> dict:
    episodes = [made_up(100_000, True, force=1.5)]
    return result_of(PEG, dict(obs_mode="rgb"), dict(policy_name="a:B", obs_mode="rgb") | config, episodes)


# ------------------------------------------------------------------------------- the commit


def git(folder: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=me", "-c", "user.email=me@example.org", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


def commit_seen_from(package: Path) -> str | None:
    """The commit that a copy of the package gives."""
    file = package / "provenance.py"
    file.parent.mkdir(parents=True)
    file.write_text(Path(provenance.__file__).read_text())
    spec = importlib.util.spec_from_file_location("copied_provenance", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.git_commit()


def test_a28_the_commit_is_that_of_the_package_and_of_no_repository_around_it(tmp_path, monkeypatch):
    for name in ("foreign", "own"):
        (tmp_path / name).mkdir()
        git(tmp_path / name, "init", "-q")
        (tmp_path / name / "pyproject.toml").write_text(f'[project]\nname = "{"manifeel-ms3" if name == "own" else "other"}"\n')
        git(tmp_path / name, "add", ".")
        git(tmp_path / name, "commit", "-qm", name)
    own = git(tmp_path / "own", "rev-parse", "HEAD")
    git(tmp_path / "own", "tag", "v1")
    assert commit_seen_from(tmp_path / "own/manifeel_ms3") == own  # whose provenance.py the repository does not know
    with (tmp_path / "own/pyproject.toml").open("a") as project:
        project.write("version = 1\n")
    assert commit_seen_from(tmp_path / "own/changed") == f"{own}-dirty"
    assert commit_seen_from(tmp_path / "foreign/.venv/lib/site-packages/manifeel_ms3") is None
    assert commit_seen_from(tmp_path / "foreign/manifeel_ms3") is None
    assert commit_seen_from(tmp_path / "own/.venv/lib/site-packages/manifeel_ms3") is None
    unpacked = tmp_path / "foreign/unpacked"  # the sources without their repository
    unpacked.mkdir()
    (unpacked / "pyproject.toml").write_text((tmp_path / "own/pyproject.toml").read_text())
    assert commit_seen_from(unpacked / "manifeel_ms3") is None
    here = provenance.git_commit()
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "foreign/.git"))
    assert provenance.git_commit() == here


def test_a05_without_git_the_commit_is_unknown(monkeypatch):
    monkeypatch.setenv("PATH", "/nogit")
    assert provenance.git_commit() is None
    assert result()["git_commit"] is None


# ------------------------------------------------------------------------------- what is published


def test_a18_nan_never_gets_into_a_result(tmp_path):
    path = tmp_path / "result.json"
    for bad in (float("nan"), float("inf"), -float("inf")):
        for broken in (
            result() | dict(episode_len=bad),
            result() | dict(success_once=dict(rate=bad, low=0, high=1)),
            result() | dict(episodes=[result()["episodes"][0] | dict(peak_contact_force=bad)]),
            result(lr=[bad]),
        ):
            with pytest.raises(ResultError, match="is not a result"):
                write_result(broken, path)
            assert not path.exists()
            path.write_text(json.dumps(broken))
            with pytest.raises(ResultError, match="is not a result"):
                read_result(path)
            path.unlink()
    path.write_text(json.dumps(result()).replace("1.5", "1e999"))
    with pytest.raises(ResultError, match=r"episodes/0/(peak_contact_force|force_until_success)"):
        read_result(path)
    for kwargs in ('{"gain": NaN}', '{"gain": 1e999}'):
        with pytest.raises(ResultError, match="config/policy_kwargs/gain"):
            main(Args(policy=NOBODY, env_id=PEG, obs_mode="tacff", cameras=(), env_kwargs=TASK, out=path, policy_kwargs=kwargs))


def test_results_have_no_entries_that_nobody_knows(tmp_path):
    for broken, place in (
        (result() | dict(note="x"), "the whole file"),
        (result() | dict(episodes=[result()["episodes"][0] | dict(note="x")]), "episodes/0"),
        (result() | dict(machine=result()["machine"] | dict(note="x")), "machine"),
        (result() | dict(success_once=dict(rate=1, low=0, high=1, note=0.5)), "success_once"),
    ):
        with pytest.raises(ResultError, match=f"{place}: .*'note' was unexpected"):
            write_result(broken, tmp_path / "result.json")


@pytest.mark.parametrize("text", ["[" * 10**5, '{"schema": ' + "9" * 5000 + "}", "\udcff"])
def test_a_file_that_json_cannot_read_is_no_result(text, tmp_path):
    (tmp_path / "result.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ResultError, match="cannot be read as a result"):
        read_result(tmp_path / "result.json")


def test_b08_passwords_and_tokens_are_not_published():
    secret = dict(
        token="abc1",
        hfToken="abc2",
        options=[dict(api_key="abc3", password=1234, login=dict(auth=["abc4"]))],
        address="https://me:abc5@example.org/v1?access_token=abc6&x=1",
        other="ghp_abc7abc7abc7",
        header="Bearer abc8",
        jwt="eyJhbGciOi.eyJzdWIi.abc9",
    )
    harmless = dict(gain=0.5, num_tokens=64, use_token=True, author="me", tokenizer="bpe", path="/data/x@y", key="rgb")
    text = json.dumps(result(policy_name="http://me:abc5@localhost:8000", policy_kwargs=secret | harmless))
    assert not any(piece in text for piece in ("abc1", "abc2", "abc3", "1234", "abc4", "abc5", "abc6", "abc7", "abc8", "abc9"))
    assert json.loads(text)["policy"] == f"http://{MARK}@localhost:8000"
    assert redacted(harmless) == harmless
    assert json.loads(text)["config"]["policy_kwargs"]["options"] == [dict(api_key=MARK, password=MARK, login=dict(auth=MARK))]
