"""What this machine can do, and how to mend what it cannot: `python -m manifeel_ms3.doctor`.

Each check runs in a process of its own, so that one that crashes (a broken driver, say) is a finding like any other.
"""

import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import tyro
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table

from .command_line import PACKAGE, run

PYTHONS = ((3, 10), (3, 12))  # tested: the first and the last
ROOM = 10.0  # GB: what the paper's demonstrations take, with observations
PATIENCE = 300  # s
STATE = (
    "import gymnasium as gym, manifeel_ms3; env = gym.make('ManiFeel-PegInsertion-v1', obs_mode='tacff', render_backend='none')"
)
PICTURE = "import gymnasium as gym, manifeel_ms3; env = gym.make('ManiFeel-PegInsertion-v1', obs_mode='rgb+tacrgb')"
STEP = "; env.reset(seed=0); env.step(env.action_space.sample()); env.close()"
RENDERER = "; from manifeel_ms3.tasks.rendering import available_render_backend as found; print(found())"
CUDA = "import torch; print(torch.cuda.get_device_name() if torch.cuda.is_available() else 'none')"


@dataclass(frozen=True)
class Finding:
    """What a check found. `ok` is None where it is worth knowing and nothing is wrong."""

    what: str
    ok: bool | None
    found: str
    remedy: str = ""


def examine() -> list[Finding]:
    """All checks."""
    return [_python(), *_packages(), _gpu(), _simulation(), _pictures(), _disk(), _cache(), _threads()]


def _python() -> Finding:
    here = sys.version_info[:2]
    good = PYTHONS[0] <= here <= PYTHONS[1]
    first, last = (".".join(map(str, one)) for one in PYTHONS)
    return Finding(
        "Python", good, platform.python_version(), "" if good else f"make an environment with Python {first} to {last}"
    )


def _packages() -> list[Finding]:
    """What this package needs, by its own metadata."""
    findings = []
    for requirement in map(Requirement, requires(PACKAGE) or []):
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            found = "missing"
        good = found != "missing" and requirement.specifier.contains(found, prereleases=True)
        if not good:
            findings.append(Finding(requirement.name, False, found, f"pip install '{requirement.name}{requirement.specifier}'"))
    return findings or [Finding("packages", True, f"{PACKAGE} {version(PACKAGE)}, and all that it needs")]


def _gpu() -> Finding:
    found = _run(CUDA)
    name = found.out or "none"
    if name != "none":
        return Finding("GPU", True, name)
    if shutil.which("nvidia-smi") is None:
        return Finding("GPU", None, "none: everything runs on the CPU")
    return Finding("GPU", False, "there is one, torch does not see it", "install a torch for CUDA: https://pytorch.org")


def _simulation() -> Finding:
    found = _run(STATE + STEP)
    return Finding(
        "a step with touch", found.worked, "works" if found.worked else found.reason, "" if found.worked else "see above"
    )


def _pictures() -> Finding:
    found = _run(PICTURE + STEP + RENDERER)
    if found.worked:
        return Finding("a step with pictures", True, f"works, with Vulkan on the {found.out.upper()}")
    remedy = (
        "without a GPU: Mesa 24.3 or newer, libvulkan1, libegl1, libgl1 (scripts/setup.sh installs them); with one: its driver "
        "and libvulkan1. Until then: obs_mode='state' or 'tacff' with render_backend='none'"
    )
    return Finding("a step with pictures", False, found.reason.partition(". ")[0], remedy)


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    remedy = (
        "" if free > ROOM else f"the paper's demonstrations with observations take {ROOM:.0f} GB: go to a folder with more room"
    )
    return Finding("disk, here", free > ROOM, f"{free:.0f} GB free", remedy)


def _cache() -> Finding:
    from .paths import cache_dir

    folder = cache_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.write_text("")
        probe.unlink()
    except OSError as error:
        return Finding("cache", False, f"{folder}: {error}", "set MANIFEEL_CACHE_DIR to a folder that can be written")
    return Finding("cache", True, str(folder))


def _threads() -> Finding:
    cores, asked = os.cpu_count() or 1, os.environ.get("OMP_NUM_THREADS")
    return Finding("cores", None, f"{cores}, OMP_NUM_THREADS {asked or 'not set'}")


@dataclass(frozen=True)
class _Ran:
    worked: bool
    out: str
    """last line"""
    reason: str


def _run(code: str) -> _Ran:
    told = f"try: {code}\nexcept Exception as error: raise SystemExit(f'{{type(error).__name__}}: {{error}}')"
    try:
        done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return _Ran(False, "", f"no answer within {PATIENCE} s")
    last = (done.stdout.strip().splitlines() or [""])[-1]
    said = (done.stderr.strip().splitlines() or [""])[-1]
    reason = f"crashed (signal {-done.returncode})" if done.returncode < 0 else said
    return _Ran(done.returncode == 0, last if done.returncode == 0 else "", reason)


def table(findings: list[Finding]) -> Table:
    marks = {True: "[green]ok[/]", False: "[red]wrong[/]", None: ""}
    out = Table("", "what", "found", "how to mend it")
    for finding in findings:
        out.add_row(marks[finding.ok], finding.what, finding.found, finding.remedy)
    return out


@dataclass
class Args:
    """It takes none."""


def main(_args: Args) -> int:
    """Print all findings; returns how many are wrong."""
    findings = examine()
    Console().print(table(findings))
    return sum(finding.ok is False for finding in findings)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
