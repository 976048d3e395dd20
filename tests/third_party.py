"""Installs a package of a third party."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs/sensor.md"


def install(site: Path, *, name: str = "my_package", files: dict[str, str] | None = None, entry_points: str = "") -> None:
    """Write what `pip install` would: the package's modules, and a dist-info folder with its entry points."""
    for path, code in (files or {}).items():
        (site / path).parent.mkdir(parents=True, exist_ok=True)
        (site / path).write_text(code)
    about = site / f"{name}-0.1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(entry_points)


def own_sensor() -> tuple[str, str]:
    """Entry points and module of the sensor that docs/sensor.md shows."""
    text = PAGE.read_text()
    (toml,) = re.findall(r"```toml\n# pyproject.toml\n(.*?)```", text, flags=re.DOTALL)
    (module,) = re.findall(r"```python\n# my_sensors.py\n(.*?)```", text, flags=re.DOTALL)
    return entry_points_of(toml), module


def entry_points_of(toml: str) -> str:
    """The entry points in a pyproject.toml, in the form of entry_points.txt."""
    return re.sub(r'\[project\.entry-points\."(.*?)"\]', r"[\1]", toml).replace('"', "")
