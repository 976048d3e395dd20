"""The package that docs/extending.md shows, installed as a third party's, works in real processes with nothing stubbed."""

import json
import re
import subprocess
from pathlib import Path

import gymnasium as gym
import pytest
import torch

from manifeel_ms3.errors import PluginError
from manifeel_ms3.tasks.registry import register_task
from tests.command_process import run_module
from tests.tasks_and_marks import PEG, needs_renderer
from tests.third_party import entry_points_of, install

REPOSITORY = Path(__file__).parents[1]
PAGE = (REPOSITORY / "docs/extending.md").read_text()
TASK = "My-LiftBlock-v1"
NO_RENDERER = json.dumps(dict(render_backend="none"))
SHORT = json.dumps(dict(render_backend="none", max_episode_steps=3))
STUDY = f"""
grids:
  - {{tasks: [{TASK}], obs_modes: [rgb+tacff], policies: [regression], seeds: [0], preset: cpu, episodes: 2, checkpoints: 1}}
"""


def manifeel(site: Path, *arguments: object) -> subprocess.CompletedProcess:
    """Run a command in a process that finds what is installed at `site`."""
    return run_module("manifeel_ms3.cli", *arguments, folder=site, OMP_NUM_THREADS="1", COLUMNS="200")


def done(site: Path, *arguments: object) -> str:
    """The output of a command that must succeed."""
    ran = manifeel(site, *arguments)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def refusal(site: Path, *arguments: object) -> str:
    """The line with which a command refuses; it begins with "error: "."""
    ran = manifeel(site, *arguments)
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr
    (line,) = [line for line in ran.stderr.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder on the path with the page's package."""
    site = tmp_path_factory.mktemp("site")
    files = dict(re.findall(r"```python\n# (my_package/\w+\.py)\n(.*?)```", PAGE, flags=re.DOTALL))
    assert set(files) == {f"my_package/{name}.py" for name in ("lift_block", "encoders", "regression", "count")}
    (toml,) = re.findall(r"```toml\n# pyproject.toml\n(.*?)```", PAGE, flags=re.DOTALL)
    install(site, files=files | {"my_package/__init__.py": ""}, entry_points=entry_points_of(toml))
    return site


@pytest.fixture(scope="module")
def demos(site) -> Path:
    """Two demonstrations of the page's task."""
    path = site / "lift.h5"
    sensing = ["--obs-mode", "tacrgb+tacff", "--tactile-sensors", "right", "--env-kwargs", NO_RENDERER]
    done(site, "record", TASK, "-n", 2, "--workers", 1, *sensing, "--out", path)
    return path


@pytest.fixture(scope="module")
def checkpoint(site, demos) -> Path:
    """The page's policy with the page's encoder, trained for four steps."""
    flags = ["--demos", demos, "--env-id", TASK, "--obs-mode", "tacrgb+tacff", "--run-dir", site / "run"]
    flags += ["--steps", 4, "--batch-size", 2, "--policy.encoder.tacrgb", "flat"]
    done(site, "train", "regression", "cpu", *flags)
    return site / "run/checkpoints/last"


def test_a_task_is_listed_and_recorded(site, demos):
    (listed,) = [line for line in done(site, "tasks").splitlines() if "My-LiftBlock" in line]
    assert "Lift the block." in listed
    assert "lifts it by 30 mm" in done(site, "tasks", TASK)
    header = json.loads(demos.with_suffix(".json").read_text())
    assert header["env_info"]["env_id"] == f"my_package.lift_block:{TASK}"
    assert [episode["success"] for episode in header["episodes"]] == [True, True]
    done(site, "replay", demos)


def test_a_command_runs(site, demos):
    assert "Count the episodes" in done(site, "--help")
    assert done(site, "count", demos).strip() == "2 episodes"


def test_a_policy_is_trained_and_evaluated_and_its_result_is_taken(site, checkpoint):
    config = json.loads((checkpoint / "config.json").read_text())
    assert (config["policy_name"], config["policy"]["encoder"]["tacrgb"]) == ("regression", "flat")
    folder = site / "submission"
    done(site, "eval", "--checkpoint", checkpoint, "--episodes", 50, "--env-kwargs", SHORT, "--out", folder / "00000004.json")
    result = json.loads((folder / "00000004.json").read_text())
    assert (result["env_id"], result["policy"], result["revision"]) == (TASK, "regression", 1)
    assert [episode["error"] for episode in result["episodes"]] == [None] * 50
    (folder / "submission.json").write_text(json.dumps(dict(name="Regression", authors="A page")))
    done(site, "leaderboard", "hash", folder, "--checkpoint", checkpoint)
    done(site, "leaderboard", "submit", folder, "--checkpoint", checkpoint, "--rerun", 1, "--check-only")


def test_a_policy_of_this_package_is_trained_and_evaluated_with_the_encoder(site, demos):
    flags = ["--demos", demos, "--env-id", TASK, "--obs-mode", "tacrgb", "--run-dir", site / "run_of_another"]
    flags += ["--steps", 2, "--batch-size", 2, "--policy.encoder.tacrgb", "flat"]
    done(site, "train", "diffusion_policy", "cpu", *flags)
    checkpoint, result = site / "run_of_another/checkpoints/last", site / "of_another.json"
    done(site, "eval", "--checkpoint", checkpoint, "--episodes", 1, "--env-kwargs", SHORT, "--out", result)
    assert [episode["error"] for episode in json.loads(result.read_text())["episodes"]] == [None]


@needs_renderer
def test_a_study_plans_a_task_and_a_policy(site):
    (site / "study.yaml").write_text(STUDY)
    table = done(site, "study", "study.yaml", "--dry-run")
    assert "LiftBlock, regression, cpu, rgb+tacff, wrist, 10 demonstrations" in table
    assert "all jobs that are left" in table
    assert f"manifeel record {TASK} --num 10" in done(site, "study", "study.yaml", "--print-commands")


def test_a_policy_learns(site, monkeypatch):
    monkeypatch.syspath_prepend(site)
    from my_package.regression import RegressionPolicy  # pyright: ignore[reportMissingImports]

    from baselines.common.encoders import EncoderConfig
    from baselines.common.observation import POSE, observation_spec
    from baselines.common.policy import PolicyConfig

    spec = observation_spec("tacrgb+tacff", (), ("right",), 32)
    encoder = EncoderConfig(tacrgb="small_cnn", force_field="small")
    torch.manual_seed(0)
    policy = RegressionPolicy(PolicyConfig(encoder=encoder, down_dims=(32, 64)), spec, 6)
    optimizer = torch.optim.Adam(policy.parameters(), 3e-3)
    obs = {
        POSE: torch.rand(3, 2, 7),
        spec.images[0]: torch.randint(0, 255, (3, 2, 32, 32, 3), dtype=torch.uint8),
        spec.force_fields[0]: torch.rand(3, 2, 10, 14, 3),
    }
    actions, losses = torch.rand(3, 16, 6) * 2 - 1, []
    for _ in range(60):
        loss = policy(obs, actions)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    assert policy.sample(obs, 1, [torch.Generator()] * 3).shape == (3, 8, 6)


# -------------------------------------------------------------------- bad plug-ins


def test_a_task_plugin_that_does_not_import_is_named_and_others_work(tmp_path):
    install(tmp_path, files={"broken.py": "import no_such_library"}, entry_points="[manifeel.tasks]\nbroken = broken\n")
    ran = manifeel(tmp_path, "tasks")
    assert ran.returncode == 0
    assert "the plug-in 'broken' of broken (my_package) cannot be loaded" in ran.stderr
    said = refusal(tmp_path, "tasks", "Knitting")
    assert "'Knitting' is not registered; registered are ['ManiFeel-PegInsertion-v1'" in said
    assert said.endswith("(plug-ins that do not import: broken)")


def test_a_policy_or_a_command_that_does_not_import_is_one_line(tmp_path):
    broken = {"broken.py": "raise KeyError('what')"}
    install(tmp_path / "policy", files=broken, entry_points="[manifeel.policies]\nbroken = broken:SPEC\n")
    said = refusal(tmp_path / "policy", "train", "broken")
    assert "the plug-in 'broken' of broken:SPEC (my_package) cannot be loaded (KeyError: 'what')" in said
    assert "Registered in manifeel.policies are ['broken', 'diffusion_policy'" in said
    others = manifeel(tmp_path / "policy", "train", "diffusion_policy", "cpu", "--num-demos", 0, "--demo-path", "peg.h5")
    assert "--num-demos 0 must be at least 1" in others.stderr
    assert "the plug-in 'broken' of broken:SPEC (my_package) cannot be loaded" in others.stderr
    install(tmp_path / "command", files=broken, entry_points="[manifeel.commands]\nbroken = broken:COMMAND\n")
    said = refusal(tmp_path / "command", "broken")
    assert "the plug-in 'broken' of broken:COMMAND (my_package) cannot be loaded" in said
    assert "Registered in manifeel.commands are ['broken', 'study', 'train']" in said
    assert refusal(tmp_path / "command", "--help") == said  # the list of all commands
    for working in (["tasks"], ["train", "--help"], ["--version"]):
        assert manifeel(tmp_path / "command", *working).returncode == 0


def test_a_task_that_is_registered_twice_is_refused(tmp_path):
    again = (
        "from manifeel_ms3.tasks import PegInsertionEnv\n"
        "from manifeel_ms3.tasks.registry import register_task\n"
        "@register_task('ManiFeel-PegInsertion-v1', max_episode_steps=5, category='insertion', paper_demos=1)\n"
        "class Other(PegInsertionEnv): ...\n"
    )
    install(tmp_path, files={"again.py": again}, entry_points="[manifeel.tasks]\nagain = again\n")
    ran = manifeel(tmp_path, "tasks")
    assert "the task 'ManiFeel-PegInsertion-v1' is registered twice, by manifeel_ms3" in ran.stderr
    assert "and by again.Other; give one of them another id" in ran.stderr


def test_two_packages_with_one_name_are_refused(tmp_path):
    for name in ("first", "second"):
        code = {f"{name}.py": "from manifeel_ms3.plugins import Command\nCOMMAND = Command('json', 'About')"}
        install(tmp_path, name=name, files=code, entry_points=f"[manifeel.commands]\nsing = {name}:COMMAND\n")
    said = refusal(tmp_path, "sing")
    assert "manifeel.commands: 'sing' is registered twice" in said
    assert "first:COMMAND (first)" in said
    assert "second:COMMAND (second)" in said


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("Command('json', 'About')", "the plug-in command 'record' (json) has the name of one of manifeel's own; rename it"),
        ("3", "the plug-in command 'record' is 3; it must be a manifeel_ms3.plugins.Command"),
    ],
)
def test_a_command_with_a_name_that_is_taken_or_of_another_kind_is_refused(tmp_path, command, said):
    code = {"mine.py": f"from manifeel_ms3.plugins import Command\nCOMMAND = {command}"}
    install(tmp_path, files=code, entry_points="[manifeel.commands]\nrecord = mine:COMMAND\n")
    assert said in refusal(tmp_path, "--help")
    assert manifeel(tmp_path, "record", "--help").stdout.startswith("usage: manifeel record")


def test_a_checkpoint_of_a_policy_that_is_not_registered_is_refused(tmp_path):
    config = dict(policy_name="knitting", env_id=PEG, obs_mode="tacff", cameras=[], tactile_sensors=["right"])
    (tmp_path / "config.json").write_text(json.dumps(config))
    out = ("--out", tmp_path / "evaluation.json")
    said = refusal(tmp_path, "eval", "--checkpoint", tmp_path, "--episodes", 1, "--env-kwargs", NO_RENDERER, *out)
    assert "is unknown: 'knitting' is not registered in manifeel.policies; registered are" in said
    assert "['diffusion_policy', 'equivariant_diffusion_policy', 'flow_matching']" in said


@pytest.mark.parametrize(
    ("env_id", "about", "said"),
    [
        ("MyLab-Press", {}, "must end in a version; give one such as 'MyLab-Press-v1'"),
        ("MyLab-Press-v1", dict(revison=2), r"is registered with \['revison'\]; the fields of a task are .*'revision'"),
        ("MyLab-Press-v1", dict(paper_demos=-3), "has paper_demos=-3; give a whole number of at least 1"),
        ("MyLab-Press-v1", dict(max_episode_steps="40"), "has max_episode_steps='40'; give a whole number"),
    ],
)
def test_a_task_with_fields_that_cannot_be_is_refused(env_id, about, said):
    with pytest.raises(PluginError, match=said):
        register_task(env_id, **dict(category="insertion", paper_demos=10, max_episode_steps=40) | about)


def test_a_task_without_a_field_that_it_needs_is_refused_before_it_is_known():
    with pytest.raises(PluginError, match=r"is registered without \['paper_demos'\]"):
        register_task("MyLab-Press-v1", category="insertion", max_episode_steps=40)(object)
    assert "MyLab-Press-v1" not in gym.registry
