"""A package of somebody else, installed."""

from pathlib import Path


def install(site: Path, *, name: str = "my_package", files: dict[str, str] | None = None, entry_points: str = "") -> None:
    """What `pip install` leaves behind: the package's modules and a dist-info folder with its entry points."""
    for path, code in (files or {}).items():
        (site / path).parent.mkdir(parents=True, exist_ok=True)
        (site / path).write_text(code)
    about = site / f"{name}-0.1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(entry_points)
