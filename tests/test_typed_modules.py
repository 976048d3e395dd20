"""A task in a module of the working folder is found where its id is typed on a command line, and nowhere else."""

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from manifeel_ms3 import typed_modules
from manifeel_ms3.command_line import as_typed
from tests.command_process import run_module
from tests.tasks_and_marks import PEG

MODULE = '''
from manifeel_ms3.experts.object_search import ObjectSearchExpert
from manifeel_ms3.tasks.exploration.object_search import ObjectSearchEnv
from manifeel_ms3.tasks.registry import register_demonstrator, register_task


@register_task("MyLab-Press-v1", max_episode_steps=160, category="exploration", paper_demos=1)
class Press(ObjectSearchEnv):
    """Press the button of my laboratory."""


register_demonstrator("MyLab-Press-v1")(ObjectSearchExpert)
'''


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "my_task.py").write_text(MODULE)
    return tmp_path


def manifeel(folder: Path, *arguments: str, module: str = "manifeel_ms3.cli") -> subprocess.CompletedProcess:
    """The installed command, which has no working folder on its path."""
    return run_module(module, *arguments, folder=folder, on_path=False)


def test_a_task_is_shown_where_its_module_is_typed_with_it(folder):
    shown = manifeel(folder, "tasks", "my_task:MyLab-Press-v1")
    assert "Press the button of my laboratory" in shown.stdout, shown.stderr
    by_module = manifeel(folder, "my_task:MyLab-Press-v1", module="manifeel_ms3.tasks")
    assert "Press the button of my laboratory" in by_module.stdout, by_module.stderr
    without = manifeel(folder, "tasks", "MyLab-Press-v1")
    assert "'MyLab-Press-v1' is not registered" in without.stderr
    missing = manifeel(folder, "tasks", "no_task:MyLab-Press-v1")
    assert "the module 'no_task' of the task 'no_task:MyLab-Press-v1' is neither installed nor in the" in missing.stderr


def test_it_is_recorded_by_worker_processes_and_its_file_imports_nothing(folder):
    bare = ("--obs-mode", "tacff", "--env-kwargs", json.dumps(dict(render_backend="none")))
    recorded = manifeel(folder, "record", "my_task:MyLab-Press-v1", "-n", "1", "--out", "press.h5", *bare)
    assert recorded.returncode == 0, recorded.stderr
    assert "`MANIFEEL_TASKS=my_task manifeel train " in recorded.stderr  # the command that trains on it
    assert "--env-id MyLab-Press-v1 --obs-mode tacff" in recorded.stderr
    assert json.loads((folder / "press.json").read_text())["env_info"]["env_id"] == "my_task:MyLab-Press-v1"
    replayed = manifeel(folder, "replay", "press.h5")
    assert "'MyLab-Press-v1' is not registered" in replayed.stderr
    assert "MANIFEEL_TASKS=MODULE before a command names the module" in replayed.stderr


def test_the_variable_names_it_to_commands_that_read_the_task_from_a_file(folder, monkeypatch):
    monkeypatch.setenv("MANIFEEL_TASKS", "my_task")
    bare = ("--obs-mode", "tacff", "--env-kwargs", json.dumps(dict(render_backend="none")))
    recorded = manifeel(folder, "record", "MyLab-Press-v1", "-n", "1", "--out", "press.h5", *bare)
    assert recorded.returncode == 0, recorded.stderr
    for module in ("manifeel_ms3.cli", "manifeel_ms3.demonstrations.replay"):
        replayed = manifeel(folder, *(["replay"] if module.endswith("cli") else []), "press.h5", module=module)
        assert (replayed.returncode, "1 of 1 episodes succeed, and 1 did when recorded" in replayed.stderr) == (0, True), (
            replayed.stderr
        )
    monkeypatch.setenv("MANIFEEL_TASKS", "no_task")
    missing = manifeel(folder, "replay", "press.h5")
    assert "the module 'no_task' of the variable MANIFEEL_TASKS is neither installed nor in the working" in missing.stderr


def test_a_command_that_is_suggested_names_the_modules_of_the_users_tasks_alone(monkeypatch):
    monkeypatch.setattr(typed_modules, "_imported", [])
    typed_modules.import_typed_tasks(SimpleNamespace(env_id=f"manifeel_ms3:{PEG}"))
    assert as_typed("manifeel", "film", "my file.h5") == "`manifeel film 'my file.h5'`"
    typed_modules.import_typed_tasks(SimpleNamespace(env_id="json:MyLab-Press-v1"))
    assert as_typed("manifeel", "film", "peg.h5") == "`MANIFEEL_TASKS=json manifeel film peg.h5`"
