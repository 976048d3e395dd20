"""The site builds without a warning, and every shown command exists, has flags that exist, and runs."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import cv2
import gymnasium as gym
import h5py
import pytest
import torch
import tyro

from baselines.diffusion_policy import train as diffusion
from baselines.tactile_representations.t3 import T3
from docs import make_readme_results
from manifeel_ms3 import cli
from manifeel_ms3.analysis.paper_claims import comparisons
from manifeel_ms3.demonstrations import render_observations
from manifeel_ms3.leaderboard import __main__ as leaderboard
from manifeel_ms3.tasks.registry import all_tasks
from tests.links import dead_links, missing_targets
from tests.sample import states_sample
from tests.tasks_and_marks import PEG, needs_renderer
from tests.third_party import install, own_sensor
from tests.tiny_study import TINY

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "baselines").rglob("README.md")]
WEIGHTS = shutil.ignore_patterns("*.safetensors")
MODULES = {command.module.removesuffix(".__main__"): name for name, command in cli.all_commands().items()}


def commands(page: Path) -> list[str]:
    """Lines of the page's shell blocks, continued ones joined, without comments and prompts."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if shlex.split(line, comments=True)]


SHOWN = [pytest.param(line, id=f"{page.stem}: {line[:60]}") for page in PAGES for line in commands(page)]


def command_of(words: list[str]) -> list[str]:
    """A command by its name under `manifeel`, where it has one, and its arguments."""
    if words[:2] == ["python", "-m"] and words[2] in MODULES:
        return [MODULES[words[2]], *words[3:]]
    for k, word in enumerate(words):
        if training := re.fullmatch(r"baselines/(\w+)/train\.py", word):
            return ["train", training[1], *words[k + 1 :]]
    return words[1:] if words[0] == "manifeel" and words[1] in cli.all_commands() else words


@pytest.mark.parametrize("spec", all_tasks().values(), ids=lambda spec: spec.name)
def test_every_entry_of_info_and_of_the_state_is_explained(spec):
    page = (REPOSITORY / "docs" / "observations.md").read_text()
    with closing(gym.make(spec.env_id, obs_mode="state_dict", render_backend="none")) as env:
        obs, info = env.reset(seed=0)
    assert [name for name in info if f"`{name}`" not in page] == ["reconfigure"]  # ManiSkill's own
    assert [name for name in obs["extra"] if not name.endswith("_pose")] == []


def test_what_the_bowls_add_to_info_is_explained():
    page = (REPOSITORY / "docs" / "observations.md").read_text()
    with closing(gym.make("ManiFeel-BallSorting-v1", obs_mode="state", render_backend="none", goal="bowls")) as env:
        _, info = env.reset(seed=0)
    assert [name for name in info if f"`{name}`" not in page] == ["reconfigure"]


@pytest.mark.parametrize("line", SHOWN)
def test_a_shown_command_and_its_flags_exist(line, capsys):
    words = shlex.split(line, comments=True)
    name, *arguments = command_of(words)
    if name in cli.all_commands():
        tyro.cli(cli.command_module(name).Args, args=arguments)  # leaves the process where a flag is not known
    elif words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]), line
    elif name == "make":
        assert f"\n{words[1]}:" in (REPOSITORY / "Makefile").read_text(), line
    elif name == "source":  # the environment that the set-up makes
        assert words[1:] == [".venv/bin/activate"], line
    else:
        assert name == "pip" or words[:2] == ["manifeel", "--help"], line


SOURCES = [*PAGES, *(path for folder in ("manifeel_ms3", "baselines") for path in (REPOSITORY / folder).rglob("*.py"))]
OBSERVATIONS_IN = re.compile(
    r"(record .*--out|render.observations .*--out|--demo-path|--demos|--sim|view|export) \S*\btrajectory\.h5"
)


def test_no_command_that_is_shown_writes_or_seeks_observations_in_a_file_of_states():
    """A plain trajectory.h5 holds states and actions alone."""
    wrong = {path.name: found[0] for path in SOURCES if (found := OBSERVATIONS_IN.search(path.read_text()))}
    assert not wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_a_page_links_files_that_exist(page):
    assert not missing_targets(page)


def test_readme_has_the_published_results():
    readme = make_readme_results.README.read_text()
    assert make_readme_results.block() in readme, "run `python -m docs.make_readme_results`"


def test_the_page_of_results_has_every_claim():
    page = (REPOSITORY / "docs/results.md").read_text()
    missing = [one for one in comparisons() if f"| {one.claim} | {one.first.task} |" not in page]
    assert not missing, "run `make results`"


def test_the_leaderboard_shows_its_entries(tmp_path):
    board = Path(shutil.copytree(REPOSITORY / "leaderboard", tmp_path / "leaderboard", ignore=WEIGHTS))
    shown = (board / "README.md").read_text()
    leaderboard.main(leaderboard.Build(board))
    assert (board / "README.md").read_text() == shown, "run `manifeel leaderboard build`"


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site/api/sensors/index.html").read_text()
    assert "TactileSensor" in page
    formulas = [(tmp_path / f"site/{name}/index.html").read_text() for name in ("sensor", "submitting")]
    assert all("<math" in html and "arithmatex" not in html for html in formulas)
    assert all('<div class="formula"><math' in html for html in formulas)  # it can be scrolled where it is wider than the page
    assert ".formula { overflow-x: auto; }" in (tmp_path / "site/site.css").read_text()
    assert not dead_links(tmp_path / "site")
    first = (tmp_path / "site/index.html").read_text()
    assert '<a href="leaderboard/index.html"' in first
    assert 'src="data:video/mp4;' in (tmp_path / "site/leaderboard/index.html").read_text()


# -------------------------------------------------------------------- run, page by page

SMALLER = {  # flags appended to a command, by its name or module, to make hours seconds; the last of a repeated flag counts
    "record": "-n 1 --cameras wrist --tactile-sensors right",
    "dataset": "--num 10 --tasks ManiFeel-BallSorting-v1 --cameras front --tactile-sensors right --image-size 64",
    "render-observations": "--num 1 --image-size 64",
    "replay": "--num 1",
    "teleop": "--port 8137",
    "view": "--save peg.rrd",
    "train": "--steps 2 --batch-size 2 --image-size 64 --policy.encoder.image small_cnn --policy.encoder.crop 0 "
    "--policy.down-dims 16 32 --device cpu --precision fp32 --no-compile",
    "eval": "--episodes 2 --workers 1 --env-kwargs '{\"max_episode_steps\": 5}'",
    "study": "--address local",
    "verify-sensor": "--loads 1 10",
    "similarity": "--features tests.analysis.test_sim_real_similarity:brightness --resamples 5",
    "baselines.tactile_representations.pretrain": "--steps 1 --batch-size 2 --image-size 64",
    "mani_skill.trajectory.replay_trajectory": "--count 1",
}
ENDLESS = ("teleop",)  # runs until it is interrupted


@pytest.fixture(scope="module")
def shelf(tmp_path_factory) -> Path:
    """What pages take for granted: recordings, weights, pictures of a real sensor, a policy and a sensor of a user's own."""
    shelf = tmp_path_factory.mktemp("shelf")
    for name, task in (("gear", "ManiFeel-GearAssembly-v1"), ("peg", PEG)):
        states = states_sample(task)
        seen = dict(cameras=("wrist",), tactile_sensors=("right",), image_size=64)
        render_observations.main(render_observations.Args(states, shelf / f"{name}.h5", **seen, num=1))
    for suffix in (".h5", ".json"):
        shutil.copy(states.with_suffix(suffix), shelf / f"states{suffix}")
    (shelf / "real_pictures").mkdir()
    with h5py.File(shelf / "peg.h5") as file:
        for k, picture in enumerate(file["traj_0/obs/sensor_data/tactile_right/rgb"][:20]):
            cv2.imwrite(str(shelf / f"real_pictures/{k}.png"), picture)
    module = re.search(r"```python\n(# my_module.*?)```", (REPOSITORY / "docs/evaluation.md").read_text(), flags=re.DOTALL)
    (shelf / "my_module.py").write_text(module[1])
    (shelf / "my_seeds.txt").write_text("734501\n220011\n")
    flags = f"--demo-path {shelf}/peg.h5 --run-dir {shelf}/runs/peg {SMALLER['train']}"
    evaluated = ["--num-eval-episodes", "2", "--eval-env-kwargs", json.dumps(dict(max_episode_steps=5))]
    diffusion.main(
        tyro.cli(cli.command_module("train").Args, args=["diffusion_policy", "cpu", *shlex.split(flags), *evaluated])
    )
    entry_points, sensor = own_sensor()
    install(shelf / "packages", files={"my_sensors.py": sensor}, entry_points=entry_points)
    network = T3()
    (shelf / "t3_medium/encoders").mkdir(parents=True)
    torch.save(network.encoder.state_dict(), shelf / "t3_medium/encoders/mini.pth")
    torch.save(network.trunk.state_dict(), shelf / "t3_medium/trunk.pth")
    return shelf


@pytest.mark.slow
@needs_renderer
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_the_commands_of_a_page_run_one_after_the_other(page, shelf, tmp_path):
    files = subprocess.check_output(["git", "ls-files"], cwd=REPOSITORY, text=True).splitlines()
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / file, tmp_path / file)
    for study in (tmp_path / "configs").glob("*.yaml"):
        study.write_text(TINY)  # the real ones are hours; tests/baselines/test_study_planning.py plans them
    (tmp_path / ".venv").symlink_to(sys.prefix)
    shown = commands(page)
    for thing in shelf.iterdir():
        makes_it = r"--run-dir runs/peg(\s|$)" if thing.name == "runs" else rf"--out {thing.stem}\."
        if not any(re.search(makes_it, line) for line in shown):
            (shutil.copytree if thing.is_dir() else shutil.copy)(thing, tmp_path / thing.name)
    for line in shown:
        for command in _spelled_out(line, tmp_path):
            _run(command, tmp_path)


def _spelled_out(line: str, place: Path) -> list[str]:
    """The line itself, or the commands that a make target would run."""
    if not line.startswith("make"):
        return [re.sub(r"\s+#.*", "", line)]
    said = subprocess.check_output(["make", "--dry-run", line.split()[1]], cwd=place, text=True)
    return [part for part in said.replace("\\\n", " ").splitlines() if part.startswith(".venv/bin/python")]


def _run(command: str, place: Path) -> None:
    name, *arguments = command_of(shlex.split(command.replace(".venv/bin/python", "python")))
    if name == "pip":  # tests/test_packaging.py
        return
    name = arguments[1] if name == "python" and arguments[0] == "-m" else name
    if name == "leaderboard" and arguments[0] == "hash":
        _prepare_submission(place)
    if name == "study":  # the tiny one has other rows
        command = re.sub(r'--only ".*?"', "", command)
    shown = f"{command} {SMALLER.get(name, '')}"
    if name == "record" and "data/dim" in command:  # for the audit
        shown += " -n 10"
    if name in ENDLESS:
        shown = f"env --default-signal=INT timeout --preserve-status --signal INT 90 {shown}"
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    packages = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(place / "packages")]))
    environment = os.environ | dict(PATH=path, PYTHONPATH=packages)
    done = subprocess.run(["bash", "-c", shown], cwd=place, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shown}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def _prepare_submission(place: Path) -> None:
    """Train a policy for two steps, and evaluate it on 50 initial states with a few steps each."""
    flags = "--demo-path peg.h5 --obs-mode tacff --run-dir runs/x --overwrite"
    _run(f"python baselines/diffusion_policy/train.py cpu {flags}", place)
    (place / "my_submission").mkdir()
    about = dict(name="Nothing learnt", authors="A page")
    (place / "my_submission/submission.json").write_text(json.dumps(about))
    few = json.dumps(dict(max_episode_steps=3, render_backend="none"))
    arguments = ["--checkpoint", "runs/x/checkpoints/last", "--out", "my_submission/00000002.json", "--env-kwargs", few]
    subprocess.run([sys.executable, "-m", "manifeel_ms3.evaluation.evaluate", *arguments], cwd=place, check=True)
