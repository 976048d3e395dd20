"""The site builds without a warning, and every command that it shows is one, with flags that exist."""

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

from manifeel_ms3 import cli

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "baselines").rglob("README.md")]
MODULES = {module.removesuffix(".__main__"): name for name, (module, _) in cli.COMMANDS.items()}


def commands(page: Path) -> list[str]:
    """Lines of the page's shell blocks, continued ones joined, without comments and prompts."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if shlex.split(line, comments=True)]


SHOWN = [pytest.param(line, id=f"{page.stem}: {line[:60]}") for page in PAGES for line in commands(page)]


@pytest.mark.parametrize("line", SHOWN)
def test_a_command_that_is_shown_is_one(line, capsys):
    words = shlex.split(line, comments=True)
    if words[:2] == ["python", "-m"] and words[2] in MODULES:
        words = ["manifeel", MODULES[words[2]], *words[3:]]
    if words[0] == "python" and (training := re.fullmatch(r"baselines/(\w+)/train\.py", words[1])):
        words = ["manifeel", "train", training[1], *words[2:]]
    if words[0] == "manifeel" and words[1] in cli.COMMANDS:
        tyro.cli(cli.form(words[1]), args=words[2:])  # leaves the process where a flag is not known
    elif words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]), line
    elif words[0] == "python":
        assert (REPOSITORY / words[1]).is_file(), line
    elif words[0] == "make":
        assert f"\n{words[1]}:" in (REPOSITORY / "Makefile").read_text(), line
    else:
        assert words[0] in ("pip", "torchrun", "pytest", "wandb") or words[:2] == ["manifeel", "--help"], line


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site/api/sensors/index.html").read_text()
    assert "TactileSensor" in page
