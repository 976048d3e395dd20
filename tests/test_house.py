"""Imports keep to the layers of the packages, and functions and files stay small enough to be read."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("manifeel_ms3", "baselines")
MAX_FUNCTION_LINES, MAX_FILE_LINES = 60, 400
FORBIDDEN = [
    ("manifeel_ms3/tasks/registry.py", "import baselines.registry", "manifeel_ms3 never imports the baselines"),
    ("manifeel_ms3/sensors/config.py", "import manifeel_ms3.tasks.registry", "Layers of manifeel_ms3"),
    ("baselines/common/policy.py", "import baselines.flow_matching.policy", "Layers of the baselines"),
]
"""Files, lines that import what they must not, and the contracts that these break."""


def check_imports(folder: Path) -> subprocess.CompletedProcess:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path) -> Path:
    """A copy of the packages and of the contracts about their imports."""
    folder = tmp_path / "house"
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(REPOSITORY / "pyproject.toml", folder)
    return folder


def test_the_order_of_the_packages_is_kept(copy):
    done = check_imports(copy)
    assert done.returncode == 0, done.stdout


def test_forbidden_imports_are_found(copy):
    for file, line, _ in FORBIDDEN:
        with (copy / file).open("a") as code:
            code.write(f"\n{line}\n")
    done = check_imports(copy)
    assert done.returncode != 0
    for *_, contract in FORBIDDEN:
        verdicts = [
            said for said in done.stdout.splitlines() if said.startswith(contract) and said.endswith(("KEPT", "BROKEN"))
        ]
        assert [verdict.rpartition(" ")[2] for verdict in verdicts] == ["BROKEN"], done.stdout


def test_functions_and_files_can_be_read():
    long = []
    for path in (path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")):
        source = path.read_text()
        if (lines := source.count("\n")) > MAX_FILE_LINES:
            long.append(f"{path.name}: {lines} lines")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef) and (lines := node.end_lineno - node.lineno + 1) > MAX_FUNCTION_LINES:
                long.append(f"{path.name}: {node.name}: {lines} lines")
    assert not long
