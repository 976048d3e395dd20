"""A hash of code changes with what it does, not with how it is told."""

import ast

from manifeel_ms3.evaluation.provenance import _imported, _meaning, code_hash, machine, task_hash
from tests.conftest import PEG


def meaning(code: str) -> str:
    return _meaning(ast.parse(code))


def test_only_what_code_does_counts():
    plain = meaning("def f(x):\n    return x + 1\n")
    assert meaning('"""Module."""\ndef f(x):\n    """Adds one."""  # it does\n\n    return (x + 1)\n') == plain
    assert meaning("def f(x):\n    return x + 2\n") != plain
    assert meaning("def f(x):\n    return x + True\n") != plain


def test_a_task_is_its_module_and_what_that_imports():
    imported = _imported("manifeel_ms3.tasks.peg_insertion")
    assert "manifeel_ms3.geometry.plugs" in imported or "manifeel_ms3.tasks.insertion" in imported
    assert all(name.startswith("manifeel_ms3.") for name in imported)
    assert task_hash(PEG) == code_hash("manifeel_ms3.tasks.peg_insertion")
    assert task_hash(PEG) != task_hash("ManiFeel-ObjectSearch-v1")
    assert task_hash("ManiFeel-BallSorting-v1") == task_hash("ManiFeel-BallSortingDim-v1")  # the same module


def test_the_machine_is_told():
    told = machine()
    assert told["cpu"]
    assert told["cores"] >= 1
