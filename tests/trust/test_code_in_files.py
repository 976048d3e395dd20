"""A file that names code has none of it imported or run."""

import json
import shutil
import sys
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from manifeel_ms3.demonstrations import render_observations, replay, view
from manifeel_ms3.demonstrations.export import Args
from manifeel_ms3.demonstrations.export import main as export
from manifeel_ms3.demonstrations.summary import summary
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.policy import PolicySource, load_policy
from tests.command_process import run_module
from tests.sample import states_sample
from tests.tasks_and_marks import PEG

from .files_of_strangers import EXECUTED, SAMPLE, rewrite_json
from .tiny_checkpoint import save_tiny_checkpoint

# ------------------------------------------------------------------ checkpoints name policies, never code


GADGETS = [
    *(
        {"policy_name": name}
        for name in ("site:addsitedir", "os:system", "gadget", "gadget:Policy", "../gadget", "this", 5, [])
    ),
    {"policy_name": "baselines.diffusion_policy.train:SPEC"},
    {"policy": {"encoder": "gadget:Policy"}},
]
"""Entries of a checkpoint's config that name code where something else is expected."""
IGNORED = [
    {"kind": "site:addsitedir"},
    {"kind": "os:system"},
    {"kind": "shutil:rmtree"},
    {"kind": "baselines.common.agent:PolicyAgent", "policy_class": "gadget:Policy"},
]
"""Entries that no version reads."""


@pytest.mark.parametrize("config", [*GADGETS, *IGNORED], ids=str)
def test_a11_a_checkpoint_runs_nothing_that_its_config_names(config, tmp_path, monkeypatch):
    folder = tmp_path / "touch executed"  # the command that `os:system` would run
    folder.mkdir()
    save_tiny_checkpoint(folder)
    rewrite_json(folder / "config.json", lambda own: own.update(config))
    (folder / "gadget.pth").write_text(EXECUTED)  # the file that `site:addsitedir` would run
    (tmp_path / "gadget.py").write_text(EXECUTED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for load in (lambda: load_policy(folder), PolicySource(checkpoint=folder).make):
        with nullcontext() if config in IGNORED else pytest.raises(CheckpointError, match="policy"):
            load()
    assert (folder / "config.json").is_file()
    assert not (tmp_path / "executed").exists()
    assert "gadget" not in sys.modules


@pytest.mark.parametrize(
    "huge",
    [dict(action_network="mlp", mlp_blocks=10**6), dict(down_dims=[8] * 10**5), dict(down_dims=[8, 10**7])],
    ids=["many layers", "a long list", "a wide layer"],
)
def test_a_checkpoint_whose_config_asks_for_a_huge_network_is_refused_before_it_is_made(huge, tmp_path):
    save_tiny_checkpoint(tmp_path)
    rewrite_json(tmp_path / "config.json", lambda own: own["policy"].update(huge))
    with pytest.raises(CheckpointError, match=r"(larger|longer) than 1000"):
        load_policy(tmp_path)


# ------------------------------------------------------------------ environment ids of files


@pytest.fixture
def gadget(tmp_path, monkeypatch) -> Path:
    """A folder that is on the path of modules, as the current one is with `python -m`; its module leaves a marker."""
    (tmp_path / "gadget.py").write_text(EXECUTED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def naming(env_id: str, name: str, folder: Path) -> Path:
    """A trajectory file of a set whose json has this id."""
    source = SAMPLE if name == "observed" else states_sample(PEG)
    for suffix in (".h5", ".json"):
        shutil.copy(source.with_suffix(suffix), folder / f"{name}{suffix}")
    rewrite_json(folder / f"{name}.json", lambda header: header["env_info"].update(env_id=env_id))
    about = {"schema": "manifeel-demonstrations-1", "files": {f"{name}.h5": {"success": 2}}}
    (folder / "manifest.json").write_text(json.dumps(about))
    return folder / f"{name}.h5"


def test_a12_replay_from_the_command_line_imports_no_module_of_the_file(gadget):
    path = naming("gadget:ManiFeel-PegInsertion-v1", "states", gadget)
    done = run_module("manifeel_ms3.demonstrations.replay", path, "--num", 1, folder=gadget)
    assert "of 1 episodes succeed, and" in done.stdout + done.stderr
    assert not (gadget / "executed").exists()


READ_ENV_ID = {
    "replay": lambda path: replay.replay(path, 1),
    "validate": lambda path: validate(path.parent, 1),
    "render_observations": lambda path: render_observations.main(
        render_observations.Args(path, path.with_name("out.h5"), "tacff", (), ("right",), num=1)
    ),
    "summary": summary,
    "view": lambda path: view.read_streams(path, 0),
    "export": lambda path: export(Args(path, "npz", path.with_name("out"))),
}


@pytest.mark.parametrize("env_id", ["gadget:Other-v1", "gadget:ManiFeel-PegInsertion-v1"])
@pytest.mark.parametrize("command", READ_ENV_ID)
def test_a12_no_module_that_a_file_names_is_imported(command, env_id, gadget):
    if command == "render_observations" and "Peg" in env_id:
        pytest.skip("it renders in worker processes, which the test of the command line stands for")
    path = naming(env_id, "observed" if command in ("view", "export") else "states", gadget)
    with suppress(ManifeelError):
        READ_ENV_ID[command](path)
    assert not (gadget / "executed").exists()
    assert "gadget" not in sys.modules
