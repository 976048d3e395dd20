"""Evaluating any policy: bad ones fail their episodes with a reason, and the run goes on."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from manifeel_ms3.errors import InvalidArgumentError, ServerError, UnknownNameError, WorkFailedError
from manifeel_ms3.evaluation import entries
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.evaluate import Args, default_out, main, next_step
from manifeel_ms3.evaluation.policy import PolicyError
from manifeel_ms3.evaluation.remote_policy import RemotePolicy, flat_observation
from manifeel_ms3.evaluation.result import ResultError, read_result, results_in
from manifeel_ms3.tasks.registry import evaluation_seeds
from tests.command_process import run_module
from tests.tasks_and_marks import PEG
from tests.trust.files_of_strangers import rewrite_json
from tests.trust.listening import free_port

BARE = json.dumps(dict(render_backend="none", max_episode_steps=12))
SERVER = Path(__file__).parents[2] / "examples/policy_server.py"


def evaluated(policy: str, out: Path, **changes) -> dict:
    return read_result(main(arguments_of(policy, out, **changes)))


def failed(policy: str, out: Path, **changes) -> dict:
    """The result of a policy that fails by an error in every episode."""
    with pytest.raises(WorkFailedError, match=r"the policy failed in all \d episodes, first with: .*has every reason"):
        main(args := arguments_of(policy, out, **changes))
    return read_result(args.out)


def arguments_of(policy: str, out: Path, **changes) -> Args:
    settings = dict(env_id=PEG, obs_mode="tacff", cameras=(), episodes=2, env_kwargs=BARE, out=out / "evaluation.json")
    name = policy if "://" in policy else f"tests.evaluation.policies:{policy}"
    return Args(policy=name, **settings | changes)


def test_a_policy_of_ones_own_is_evaluated(tmp_path):
    result = evaluated("StandStill", tmp_path)
    assert [episode["seed"] for episode in result["episodes"]] == evaluation_seeds(2)
    assert [(e["episode_len"], e["success_once"], e["error"]) for e in result["episodes"]] == [(12, False, None)] * 2
    assert result["policy"] == "tests.evaluation.policies:StandStill"
    assert result["success_once"]["rate"] == 0.0
    assert result["env_kwargs"]["obs_mode"] == "tacff"


def test_episodes_end_at_failure_if_they_are_asked_to_end(tmp_path):
    kwargs = json.dumps(dict(render_backend="none", control_mode="pd_ee_delta_pose", max_episode_steps=20))
    result = evaluated("LetsGo", tmp_path, episodes=1, env_kwargs=kwargs, stop_at_success=True)
    (episode,) = result["episodes"]
    assert (result["stop_at_success"], episode["fail_once"], episode["ending"]) == (True, True, "lost")
    assert episode["episode_len"] < 20
    assert not {"success_at_end", "fail_at_end"} & result.keys()


def test_an_entry_without_a_copy_of_the_repository_says_where_entries_are(tmp_path, monkeypatch):
    monkeypatch.setattr(entries, "leaderboard_dir", lambda: tmp_path / "leaderboard")
    with pytest.raises(UnknownNameError, match="only a copy of the repository has the entries"):
        main(Args(entry="cpu/PegInsertion/rgb+tacff"))


@pytest.mark.parametrize("name", ["peg.json", "peg.h5"])
def test_a_result_does_not_replace_a_recording(name, tmp_path):
    (tmp_path / "peg.h5").write_text("episodes")
    (tmp_path / "peg.json").write_text("their json")
    with pytest.raises(InvalidArgumentError, match=r"would replace a file of the recording .*peg\.h5; give another path"):
        main(Args(policy="tests.evaluation.policies:StandStill", env_id=PEG, obs_mode="tacff", episodes=1, out=tmp_path / name))
    assert {path.read_text() for path in tmp_path.iterdir()} == {"episodes", "their json"}


def test_the_result_of_a_runs_checkpoint_comes_into_the_runs_folder_from_whatever_folder_it_is_named(tmp_path, monkeypatch):
    checkpoint = tmp_path / "run/checkpoints/00000002"
    checkpoint.mkdir(parents=True)
    checkpoint.with_name("last").symlink_to(checkpoint.name)
    names = {tmp_path: "run/checkpoints/last", tmp_path / "run": "checkpoints/last", checkpoint.parent: "last", checkpoint: "."}
    for folder, name in names.items():
        monkeypatch.chdir(folder)
        assert default_out(Path(name)).absolute() == tmp_path / "run/evaluation.json"
    monkeypatch.chdir(tmp_path)
    for elsewhere in (None, Path("run"), Path("run/zero")):  # in no run's folder of checkpoints
        assert default_out(elsewhere) == Path("evaluation.json")


def test_a_result_names_the_commit_at_which_its_evaluation_began(tmp_path, monkeypatch):
    """The repository may go on to other commits while the code that was loaded runs."""
    commits = iter(letter * 40 for letter in "abcdef")
    monkeypatch.setattr("manifeel_ms3.evaluation.result.git_commit", lambda: next(commits))
    assert evaluated("StandStill", tmp_path, episodes=1)["git_commit"] == "a" * 40
    monkeypatch.setattr("manifeel_ms3.evaluation.result.git_commit", lambda: f"{'a' * 40}-dirty")
    assert evaluated("StandStill", tmp_path, episodes=1)["git_commit"] == f"{'a' * 40}-dirty"


@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        ("Raises", "step 0: RuntimeError: out of ideas"),
        ("SaysNaN", "step 3: the action holds NaN"),
        ("SaysWords", "step 0: the action is no array of numbers"),
        ("Sleeps", "step 0: no answer within 1 s"),
        ("Crashes", "exit code 7"),
        ("Leaves", "exit code 70"),
        ("Exits", "step 0: SystemExit: 0"),
    ],
)
def test_a_bad_policy_fails_its_episodes_with_the_reason(policy, reason, tmp_path):
    result = failed(policy, tmp_path, step_timeout=1.0)
    assert len(result["episodes"]) == 2
    for episode in result["episodes"]:
        assert reason in episode["error"]
        assert not episode["success_once"]


def test_a_wrong_number_of_actions_is_named(tmp_path):
    result = failed("StandStill", tmp_path, policy_kwargs='{"size": 9}', episodes=1)
    assert "shape (9,), the task takes (6,)" in result["episodes"][0]["error"]


def test_a_policy_may_answer_as_a_batch_of_one_environment(tmp_path):
    out = main(arguments_of("StandStill", tmp_path, policy_kwargs='{"size": [1, 6]}', episodes=1))
    assert read_result(out)["episodes"][0]["error"] is None


def test_the_command_says_how_many_episodes_the_policy_failed_by_an_error(tmp_path):
    out = tmp_path / "evaluation.json"
    failed("Raises", tmp_path)
    said = next_step(Args(), out)
    assert "0 of 2 episodes succeed, and 2 failed because of an error of the policy" in said
    assert "(the first: step 0: RuntimeError: out of ideas)" in said
    rewrite_json(out, lambda result: result["episodes"][0].update(error="step 0: <html>\n\x1b[31m" + "x" * 999))
    assert "(the first: step 0: <html> [31mxxx" in (said := next_step(Args(), out))
    assert len(said) < 600
    evaluated("StandStill", tmp_path)
    assert "0 of 2 episodes succeed; " in next_step(Args(), out)


def test_the_command_that_films_a_result_names_the_policy_unless_it_lies_beside_the_result(tmp_path):
    evaluated("StandStill", tmp_path, episodes=1)
    out, own = tmp_path / "evaluation.json", "tests.evaluation.policies:StandStill"
    last, other = tmp_path / "checkpoints/last", tmp_path / "other run/checkpoints/last"
    assert f"`manifeel film {out} --out FILE.mp4`" in next_step(Args(last), out)
    assert f"`manifeel film {out} --checkpoint '{other}' --out FILE.mp4`" in next_step(Args(other), out)
    kwargs = """--policy-kwargs '{"size": 6, "token": "(redacted)"}'"""
    given = Args(policy=own, policy_kwargs='{"size": 6, "token": "abcd1234"}')
    assert f"`manifeel film {out} --policy {own} {kwargs} --out FILE.mp4`" in next_step(given, out)
    entry = "cpu/PegInsertion/rgb+tacff"
    assert f"--checkpoint {entries.find_entry(entry).checkpoint} --out" in next_step(Args(entry=entry), out)


def test_the_command_that_comes_next_takes_a_result_of_this_name(tmp_path):
    evaluated("StandStill", tmp_path, episodes=1)
    out, last, step = tmp_path / "evaluation.json", tmp_path / "checkpoints/last", tmp_path / "a run/00007000.json"
    assert f"`manifeel report --run-dir {tmp_path}` writes a page about the run" in next_step(Args(last), out)
    with pytest.raises(ResultError, match=r"hold no results named by the gradient step.*as --out"):
        results_in(tmp_path)
    assert "`manifeel results` reads files named by the step, as 00007000.json" in next_step(Args(tmp_path / "x"), out)
    step.parent.mkdir()
    out.rename(step)
    assert f"`manifeel results --results '{step.parent}'` sets it beside the paper's" in next_step(Args(last), step)
    assert len(results_in(tmp_path)) == 1


def test_a_policy_that_cannot_be_made_stops_the_run(tmp_path):
    with pytest.raises(PolicyError, match=r"OSError: no weights.*--policy-kwargs"):
        evaluated("CannotBeMade", tmp_path)
    with pytest.raises(PolicyError, match="give module:Class"):
        evaluated("Nobody", tmp_path)
    with pytest.raises(PolicyError, match="has no 'CannotBeMad'; did you mean 'CannotBeMade'"):
        evaluated("CannotBeMad", tmp_path)
    assert not (tmp_path / "evaluation.json").exists()


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        (dict(), "either --checkpoint, or --policy"),
        (dict(policy="a:B"), "--env-id"),
        (dict(policy="a:B", env_id=PEG, obs_mode="rgb", episodes=2, videos=(2,)), "the episodes are 0 to 1"),
        (dict(policy="a:B", env_id=PEG, obs_mode="rgb", inference_steps=4), "only a --checkpoint takes --inference-steps"),
        (
            dict(checkpoint=Path("x"), policy_kwargs='{"inference_steps": 4, "device": "cpu"}'),
            "of a --checkpoint have flags of their own: --device and --inference-steps",
        ),
    ],
)
def test_what_is_missing_is_named(settings, word):
    with pytest.raises(ValueError, match=word):
        main(Args(**settings))


def test_the_task_is_made_with_the_observations_that_the_result_names(tmp_path):
    with pytest.raises(InvalidArgumentError, match="have obs_mode 'state', but the policy observes 'tacff'"):
        evaluated("StandStill", tmp_path, env_kwargs=json.dumps(dict(obs_mode="state")))
    config = dict(policy_name="diffusion_policy", env_id=PEG, obs_mode="rgb", cameras=[], tactile_sensors=[])
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(InvalidArgumentError, match="have obs_mode 'state', but the policy observes 'rgb'"):
        main(Args(tmp_path, env_kwargs=json.dumps(dict(obs_mode="state"))))


def test_an_unknown_task_is_named_before_anything_is_made(tmp_path):
    with pytest.raises(UnknownNameError, match=r"'ManiFeel-Knitting-v1' is not registered; registered are .*PegInsertion"):
        evaluated("CannotBeMade", tmp_path, env_id="ManiFeel-Knitting-v1")


def test_a_checkpoint_whose_task_names_a_module_does_not_import_it(tmp_path):
    config = dict(policy_name="diffusion_policy", obs_mode="rgb", cameras=[], tactile_sensors=[])
    (tmp_path / "config.json").write_text(json.dumps(config | dict(env_id="this:ManiFeel-Knitting-v1")))
    with pytest.raises(UnknownNameError, match="'ManiFeel-Knitting-v1' is not registered"):
        main(Args(tmp_path))
    assert "this" not in sys.modules
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"lacks \['env_id'\]; train the policy again"):
        main(Args(tmp_path))


@pytest.fixture
def server():
    port = free_port()
    process = subprocess.Popen([sys.executable, str(SERVER), "--port", str(port)])
    policy = RemotePolicy(f"http://127.0.0.1:{port}", timeout=10)
    for _ in range(50):
        try:
            policy.reset()
            break
        except ConnectionError:
            time.sleep(0.1)
    yield policy
    process.terminate()
    process.wait()


def test_a_policy_in_another_process_is_asked(server, tmp_path):
    result = evaluated(server.address, tmp_path, episodes=1)
    assert result["episodes"][0]["episode_len"] == 12
    assert result["episodes"][0]["error"] is None
    assert result["policy"] == server.address


def test_a_servers_error_and_its_absence_are_named(server):
    with pytest.raises(ServerError, match="500: ValueError"):
        server._post("act", b"nonsense")
    with pytest.raises(ConnectionError, match="start the server first"):
        RemotePolicy("http://127.0.0.1:9").reset()


def test_observations_travel_by_their_paths():
    obs = dict(extra=dict(tcp_pose=np.zeros((1, 7))), sensor_data=dict(wrist=dict(rgb=np.zeros((1, 4, 4, 3), np.uint8))))
    flat = dict(flat_observation(obs))
    assert {name: array.shape for name, array in flat.items()} == {"extra/tcp_pose": (7,), "sensor_data/wrist/rgb": (4, 4, 3)}


@pytest.fixture
def result_file(tmp_path):
    evaluated("StandStill", tmp_path, episodes=1)
    return tmp_path / "evaluation.json"


def test_results_that_are_not_of_the_published_form_are_refused(result_file):
    good = json.loads(result_file.read_text())
    for broken, word in (
        (good | dict(schema="manifeel-evaluation-9"), "has the schema 'manifeel-evaluation-9'.*update"),
        (good | dict(schema="manifeel-evaluation-2"), "episodes that ended at success, with other .*evaluate the policy again"),
        (good | dict(schema="manifeel-evaluation-1"), "does not say the revision of the task.*evaluate the policy again"),
        (good | dict(success_once=dict(rate=1.5, low=0, high=1)), "success_once/rate"),
        ({name: value for name, value in good.items() if name != "episodes"}, "'episodes' is a required property"),
        (good | dict(episodes=[good["episodes"][0] | dict(episode_len="long")]), "episodes/0/episode_len"),
        (good | dict(config=good["config"] | dict(step=None)), "config/step"),
        (good | dict(config=good["config"] | dict(training_seconds="3 h")), "config/training_seconds"),
        (good | dict(config=good["config"] | dict(trained_on=dict(gpu="H100"))), "config/trained_on"),
        ([1], "has the schema None"),
    ):
        result_file.write_text(json.dumps(broken))
        with pytest.raises(ResultError, match=word):
            read_result(result_file)
    result_file.write_text("{")
    with pytest.raises(ResultError, match="cannot be read as a result"):
        read_result(result_file)


@pytest.fixture
def example(tmp_path) -> str:
    """The policy of the documentation, which lies in the folder of the test."""
    page = (SERVER.parents[1] / "docs/evaluation.md").read_text()
    (code,) = re.findall(r"```python\n# my_module.py\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "my_module.py").write_text(code)
    return code


def test_the_example_of_the_documentation_runs(example, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    settings = dict(env_id=PEG, obs_mode="tacff", cameras=(), episodes=1, env_kwargs=BARE, policy_kwargs='{"gain": 0.3}')
    result = read_result(main(Args(policy="my_module:MyPolicy", out=tmp_path / "evaluation.json", **settings)))
    assert result["episodes"][0]["error"] is None
    assert len([line for line in example.splitlines() if line.strip()]) <= 20


@pytest.mark.usefixtures("example")
def test_the_command_finds_a_policy_in_its_working_folder(tmp_path):
    flags = ("--policy", "my_module:MyPolicy", "--env-id", PEG, "--obs-mode", "tacff", "--episodes", 1, "--env-kwargs", BARE)
    done = run_module("manifeel_ms3.cli", "eval", *flags, folder=tmp_path, on_path=False)
    assert done.returncode == 0, done.stderr
    assert [episode["error"] for episode in read_result(tmp_path / "evaluation.json")["episodes"]] == [None]
