"""Where a result comes from: the code that made the task, and the machine."""

import ast
import hashlib
import os
import platform
from functools import cache
from importlib import import_module
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any

import torch
from mani_skill.utils.registration import REGISTERED_ENVS

OURS = ("manifeel_ms3.", "baselines.")


def machine() -> dict[str, Any]:
    """What computes here."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return dict(cpu=_cpu_name(), cores=os.cpu_count(), gpu=gpu, system=platform.system())


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def task_hash(env_id: str) -> str:
    """Hash of the code that makes a task.

    Raises:
        KeyError: there is no such task.
    """
    import_module("manifeel_ms3.tasks")
    return code_hash(REGISTERED_ENVS[env_id].cls.__module__)


@cache
def code_hash(module: str) -> str:
    """Hash of a module of ours and of whatever of ours that imports.

    Comments, docstrings and layout do not count; all that could change what it does counts.
    """
    waiting, seen = [module], set()
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += _imported(name)
    content = "".join(f"{name}\n{_meaning(_tree(name))}\n" for name in sorted(seen))
    return hashlib.sha256(content.encode()).hexdigest()[:16]


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(Path(find_spec(module).origin).read_text())


def _imported(module: str) -> list[str]:
    """Modules of ours that a module imports."""
    package = module if Path(find_spec(module).origin).name == "__init__.py" else module.rpartition(".")[0]
    names = []
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), package)
            names += [source, *(f"{source}.{alias.name}" for alias in node.names)]
    return [name for name in names if name.startswith(OURS) and _is_module(name)]


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:  # a name within a module
        return False


def _meaning(node: Any) -> str:
    """A syntax tree as text, the same in all versions of Python, without docstrings."""
    if isinstance(node, ast.AST):
        fields = ((name, value) for name, value in ast.iter_fields(node) if value not in (None, []))
        return f"{type(node).__name__}({','.join(f'{name}={_meaning(value)}' for name, value in fields)})"
    if isinstance(node, list):
        return "[" + ",".join(_meaning(item) for item in node if not _is_text(item)) + "]"
    return repr(node)


def _is_text(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
