"""The pages docs/tasks/*.md, one for each task, made anew: `python -m docs.make_task_cards` in the repository's root.

What the code knows is read from it: the task's class and its entry in the registry. The demonstrators' figures are those of
docs/tasks.md, the audit's those of docs/audit.md, results those of docs/results.md. A test fails where a page is not what this
makes. The videos of docs/videos, which the pages show, are made by `python -m docs.make_task_videos`.
"""

import ast
import dataclasses
import inspect
import re
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.analysis.markdown import markdown_table, markdown_tables
from manifeel_ms3.analysis.paper import training_demos
from manifeel_ms3.files import write_text
from manifeel_ms3.tasks.registry import TaskSpec, all_tasks, description_of
from manifeel_ms3.tasks.scenery import LIGHTING
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, CONTROL_FREQ, VisuotactileEnv

DOCS = Path(__file__).parent
CARDS, VIDEOS, PICTURES = DOCS / "tasks", DOCS / "videos", DOCS / "images" / "tasks"
RESULT_COLUMNS = 18
"""Number of columns of the table of docs/results.md that says what was run."""
NOT_ON_CARDS = ("std", "id", "on", "row in the study")
"""Columns of that table that a card leaves out."""
MADE = "*Made by `python -m docs.make_task_cards` from the class of the task, the registry and what was measured.*\n"
CAPTION = "The scene, the front, side and wrist cameras, and the left and right pads, after four fifths of a demonstration."


def main() -> None:
    """Write the pages, and the picture of each task, which is its row of docs/images/tasks.jpg."""
    CARDS.mkdir(exist_ok=True)
    PICTURES.mkdir(exist_ok=True)
    specs = own_tasks()
    gallery: Any = cv2.imread(str(DOCS / "images/tasks.jpg"))
    height = gallery.shape[0] // len(specs)
    for k, spec in enumerate(specs):
        row = gallery[k * height : (k + 1) * height]
        cv2.imwrite(str(PICTURES / f"{spec.name}.jpg"), row, [cv2.IMWRITE_JPEG_QUALITY, 88])
        write_text(card_path(spec), card(spec))


def own_tasks() -> list[TaskSpec]:
    """The tasks of this package, in the order of the gallery."""
    return [spec for spec in all_tasks().values() if spec.env_class.__module__.startswith("manifeel_ms3.")]


def card_path(spec: TaskSpec) -> Path:
    """Path of a task's page."""
    return CARDS / f"{spec.name}.md"


def card(spec: TaskSpec) -> str:
    """The Markdown page of a task."""
    sections = (_facts(spec), _randomization(spec), _arguments(spec), _measured(spec), _use(spec))
    return "\n".join((_head(spec), _description(spec), *sections, MADE))


def _head(spec: TaskSpec) -> str:
    shown = f"![{spec.name} from all cameras and on both pads](../images/tasks/{spec.name}.jpg)\n\n*{CAPTION}*\n"
    if (VIDEOS / f"{spec.name}.mp4").is_file():
        video = f"../../videos/{spec.name}.mp4"  # the site has each page in a folder of its own
        player = f'<video src="{video}" controls autoplay loop muted playsinline style="width: 100%"></video>'
        shown = f"{player}\n\n[The video](../videos/{spec.name}.mp4) of a demonstration.\n\n{shown}"
    return f"# {spec.name}\n\n{shown}"


def _description(spec: TaskSpec) -> str:
    """The description of the task, with an empty line before each of its lists, as Markdown wants it."""
    lines = description_of(spec.env_class).splitlines()
    spaced = [f"\n{line}" if line.startswith("- ") and lines[k - 1].startswith("**") else line for k, line in enumerate(lines)]
    return "\n".join(spaced) + "\n"


def _facts(spec: TaskSpec) -> str:
    env: Any = spec.env_class
    axes = ACTION_AXES[env.default_control_mode]
    modes = ", ".join(f"`{mode}`" for mode in env.SUPPORTED_REWARD_MODES)
    gentle = f"{spec.force_limit:g} N" if spec.force_limit else "not measured yet"
    rows = {
        "Id": f"`{spec.env_id}`",
        "Category": spec.category,
        "Instruction": spec.instruction,
        "Tables of the paper": ", ".join(spec.paper_tables) or "none",
        "Time limit": f"{spec.max_episode_steps} steps, {spec.max_episode_steps / CONTROL_FREQ:g} s",
        "Actions": f"{len(axes)} components (`{env.default_control_mode}`): {', '.join(axes)}",
        "Cameras": f"{spec.policy_camera} for policies; {', '.join(CAMERAS)} are available",
        "Reward": f"{modes}; the dense one is at most {env.max_reward:g}",
        "Gentle success": f"contact force of at most {gentle}",
        "Demonstrations": f"{spec.paper_demos} recorded in the paper, {training_demos(spec.name)} of them used for training",
        "Revision": spec.revision,
    }
    return f"## At a glance\n\n{markdown_table(('What', 'Value'), rows.items())}"


def _randomization(spec: TaskSpec) -> str:
    ranges, reward = spec.env_class.Randomization, type(spec.env_class.reward_config)
    parts = []
    for title, config in (("Randomization: half ranges", ranges), ("Constants of the dense reward", reward)):
        documented = field_documentation(config)
        rows = [(f"`{name}`", f"{value:.4g}", documented[name]) for name, value in _defaults(config).items()]
        parts.append(f"## {title}\n\n{markdown_table(('Field', 'Default', 'Meaning'), rows)}")
    return "\n".join(parts)


def _defaults(config: type) -> dict[str, float]:
    return {field.name: getattr(config(), field.name) for field in dataclasses.fields(config)}


def field_documentation(config: type) -> dict[str, str]:
    """The strings below the fields of a dataclass, by the fields' names."""
    found = {}
    for base in reversed(config.__mro__[:-1]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = getattr(definition, "body", [])
        for line, below in pairwise(body):
            if isinstance(line, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[ast.unparse(line.target)] = " ".join(str(below.value.value).split())
    return found


def _arguments(spec: TaskSpec) -> str:
    """The arguments that make variants of a task: its own ones, and those of all tasks; none that is unset by default."""
    env: Any = spec.env_class
    own: dict[str, Any] = {}
    for base in reversed(env.__mro__[: env.__mro__.index(VisuotactileEnv)]):
        if "__init__" in vars(base):
            own |= {p.name: p.default for p in inspect.signature(base).parameters.values() if p.default is not p.empty}
    of_all_tasks = {"lighting": "normal"} | ({"occlusion": True} if env.has_occluder else {})
    given = own | of_all_tasks | own  # a task's own default is the one that holds
    rows = [(f"`{name}`", f"`{default!r}`", _values(env, name)) for name, default in given.items() if default is not None]
    return f"## Variants\n\n{markdown_table(('Argument', 'Default', 'Values'), rows)}"


def _values(env: Any, name: str) -> str:
    """The allowed values of an argument: those of all tasks, a class attribute, or a constant of the task's module."""
    module: Any = inspect.getmodule(env)
    of_all_tasks = {"lighting": tuple(LIGHTING), "occlusion": (True, False)}
    values = of_all_tasks.get(name) or getattr(env, f"{name}s", None) or getattr(module, f"{name.upper()}S", ())
    return ", ".join(f"`{value!r}`" for value in values)


def _measured(spec: TaskSpec) -> str:
    parts = []
    for page, title, columns in (("tasks.md", "The demonstrator", 4), ("audit.md", "What camera and touch reveal", 6)):
        link = f"[{page.removesuffix('.md')}](../{page})"
        if found := rows_of(DOCS / page, spec.name, columns):
            names, rows = found
            source = f"From {link}, which says how it was measured.\n"
            parts.append(f"## {title}\n\n{source}\n{markdown_table(names[1:], (row[1:] for row in rows))}")
        else:
            parts.append(f"## {title}\n\nNot measured for this task; {link} has other tasks.\n")
    return "\n".join([*parts, _results(spec)])


def _results(spec: TaskSpec) -> str:
    """What was run on this revision of the task, without the columns that are empty and those of `NOT_ON_CARDS`."""
    found = rows_of(DOCS / "results.md", f"{spec.name} revision {spec.revision}", RESULT_COLUMNS)
    if not found:
        return f"## Results\n\nNo policy has been evaluated on revision {spec.revision} of this task yet.\n"
    names, rows = found
    filled = [k for k in range(1, len(names)) if names[k] not in NOT_ON_CARDS and any(row[k] for row in rows)]
    table = markdown_table([names[k] for k in filled], ([row[k].replace("](", "](../") for k in filled] for row in rows))
    source = "From [results](../results.md), which says what the columns mean and how episodes fail.\n"
    return f"## Results\n\n{source}\n{table}"


def rows_of(page: Path, task: str, columns: int) -> tuple[list[str], list[list[str]]] | None:
    """The head and the rows of a task in the table of a page that has so many columns; None if it has none."""
    head: list[str] = []
    for table in markdown_tables(page.read_text(encoding="utf-8")):
        head, *rows = table
        mine = [row for row in rows if task in re.split(r",\s*", row[0])]
        if len(head) == columns and mine:
            return head, mine
    return None


def _use(spec: TaskSpec) -> str:
    return f"""## Use it

```python
import gymnasium as gym
import manifeel_ms3

env = gym.make("{spec.env_id}", obs_mode="rgb+tacrgb+tacff")
```

```bash
manifeel record {spec.env_id} -n 2 --out {spec.name}.h5
manifeel film {spec.name}.h5 --out {spec.name}.mp4
```
"""


if __name__ == "__main__":
    main()
