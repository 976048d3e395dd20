"""What this machine can do, and how to repair what it cannot: `manifeel doctor`.

A check that could crash (because of a broken driver, say) runs in a process of its own, so that the crash is a finding, too.
"""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import tyro
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .command_line import PACKAGE, run
from .errors import MachineError
from .paths import CACHE_DIR, writable_cache
from .tasks.registry import all_tasks, task_spec

PYTHONS = ((3, 10), (3, 12))
"""First and last version of Python that the tests run on."""
TIMEOUT = 300
"""Time in s after which a check counts as failed; set once, not tuned."""
MAKE_WITHOUT_RENDERER = (
    "import gymnasium as gym, manifeel_ms3; env = gym.make('ManiFeel-PegInsertion-v1', obs_mode='tacff', render_backend='none')"
)
MAKE_WITH_IMAGES = "import gymnasium as gym, manifeel_ms3; env = gym.make('ManiFeel-PegInsertion-v1', obs_mode='rgb+tacrgb')"
STEP = "; env.reset(seed=0); env.step(env.action_space.sample()); env.close()"
RENDERER = "; from manifeel_ms3.rendering.backend import available_render_backend as found; print(found())"
CUDA = "import torch; print(torch.cuda.get_device_name() if torch.cuda.is_available() else 'none')"
"""Programs, and parts of programs, that the checks run in processes of their own."""
RENDERER_REMEDY = (
    "Without a GPU: install Mesa 24.3 or newer, libvulkan1, libegl1 and libgl1, as scripts/setup.sh does. With a GPU: install "
    "its driver and libvulkan1. Until then, use obs_mode='state' or 'tacff' with render_backend='none'."
)
CACHE_REMEDY = f"Set the environment variable {CACHE_DIR} to a folder that can be written."


@dataclass(frozen=True)
class Finding:
    """The outcome of one check."""

    what: str
    """What was checked."""
    ok: bool | None
    """Whether it is in order; None for a finding that is only information."""
    found: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty if nothing is wrong."""


def examine(on_check: Callable[[str], None]) -> list[Finding]:
    """The findings of all checks.

    Args:
        on_check: Function that is called before each check with the name of what is checked; some checks take ten seconds.
    """
    findings = []
    for what, check in _checks().items():
        on_check(what)
        found = check()
        findings += found if isinstance(found, list) else [found]
    return findings


def _checks() -> dict[str, Callable[[], Finding | list[Finding]]]:
    """The checks, by what they check."""
    return {
        "Python": _python,
        "packages": _packages,
        "GPU": _gpu,
        "a step with touch": _simulation,
        "a step with images": _images,
        "disk, here": _disk,
        "cache": _cache,
        "cores": _threads,
    }


def _python() -> Finding:
    good = PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]
    first, last = (".".join(map(str, one)) for one in PYTHONS)
    remedy = "" if good else f"Create an environment with Python {first} to {last}."
    return Finding("Python", good, platform.python_version(), remedy)


def _packages() -> list[Finding]:
    """The dependencies of this package that are missing or of another version, according to its metadata."""
    findings = []
    for requirement in map(Requirement, requires(PACKAGE) or []):
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            found = "missing"
        if found == "missing" or not requirement.specifier.contains(found, prereleases=True):
            findings.append(Finding(requirement.name, False, found, f"pip install '{requirement.name}{requirement.specifier}'"))
    return findings or [Finding("packages", True, f"{PACKAGE} {version(PACKAGE)} and all of its dependencies")]


def _gpu() -> Finding:
    name = _run(CUDA).out or "none"
    if name != "none":
        return Finding("GPU", True, name)
    if shutil.which("nvidia-smi") is None:
        return Finding("GPU", None, "none; everything runs on the CPU")
    return Finding("GPU", False, "torch does not find the GPU", "Install a torch for CUDA: https://pytorch.org")


def _simulation() -> Finding:
    ran = _run(MAKE_WITHOUT_RENDERER + STEP)
    if ran.worked:
        return Finding("a step with touch", True, "works")
    return Finding("a step with touch", False, ran.reason, _remedy(ran.reason, "Repair the packages that are listed above."))


def _images() -> Finding:
    ran = _run(MAKE_WITH_IMAGES + STEP + RENDERER)
    if ran.worked:
        return Finding("a step with images", True, f"works, with Vulkan on the {ran.out.upper()}")
    return Finding("a step with images", False, ran.reason.partition(". ")[0], _remedy(ran.reason, RENDERER_REMEDY))


def _remedy(reason: str, usual: str) -> str:
    """The usual remedy of a step that fails, or that of a cache that cannot be written, if that is the reason."""
    return CACHE_REMEDY if CACHE_DIR in reason else usual


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    needed = sum(spec.paper_demos * spec.demo_megabytes for spec in map(task_spec, all_tasks())) / 1e3
    remedy = f"The paper's demonstrations with observations take {needed:.0f} GB; use a folder on a larger disk."
    return Finding("disk, here", free > needed, f"{free:.0f} GB free", "" if free > needed else remedy)


def _cache() -> Finding:
    try:
        with writable_cache() as folder:
            probe = folder / ".probe"
            probe.write_text("")
            probe.unlink()
    except MachineError as error:
        return Finding("cache", False, str(error.__cause__ or error), CACHE_REMEDY)
    return Finding("cache", True, str(folder))


def _threads() -> Finding:
    return Finding("cores", None, f"{os.cpu_count() or 1}, OMP_NUM_THREADS {os.environ.get('OMP_NUM_THREADS') or 'not set'}")


@dataclass(frozen=True)
class _Ran:
    """How a program ended."""

    worked: bool
    out: str
    """Last line of its output."""
    reason: str
    """Why it did not work."""


def _run(code: str) -> _Ran:
    """Run a program in a process of its own, without importing from the current folder, whose files may be anybody's."""
    # the empty entry stands for the current folder; `python -P`, which leaves it out, needs Python 3.11
    alone = "import sys; sys.path[:] = [folder for folder in sys.path if folder]"
    program = f"{alone}\ntry: {code}\nexcept Exception as error: raise SystemExit(f'{{type(error).__name__}}: {{error}}')"
    try:
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return _Ran(False, "", f"no answer within {TIMEOUT} s")
    out = (done.stdout.strip().splitlines() or [""])[-1]
    error = (done.stderr.strip().splitlines() or [""])[-1]
    reason = f"crashed (signal {-done.returncode})" if done.returncode < 0 else error
    return _Ran(done.returncode == 0, out if done.returncode == 0 else "", reason)


def table(findings: list[Finding]) -> Table:
    """The findings as a table."""
    marks = {True: "[green]ok[/]", False: "[red]wrong[/]", None: ""}
    out = Table("", "what", "found", "how to repair it")
    for finding in findings:
        out.add_row(marks[finding.ok], finding.what, Text(finding.found), Text(finding.remedy))
    return out


@dataclass
class Args:
    """`manifeel doctor` takes no arguments."""


def main(_args: Args) -> int:
    """Print all findings, and return the number of those that are wrong."""
    console = Console()
    with console.status("") as status:
        findings = examine(lambda what: status.update(f"checking: {what}"))
    console.print(table(findings))
    return sum(finding.ok is False for finding in findings)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
