"""The page docs/perturbation.md, made anew: `python -m docs.make_perturbation` in the repository's root.

It compares results of one checkpoint of the leaderboard under changed appearances, in docs/perturbation, with its result under
the usual one, `none.json`. `COMMAND` makes such a result. A test fails where the page is not what this makes.
"""

import json
from pathlib import Path
from typing import Any

from manifeel_ms3.analysis.estimates import difference, holm, mean_success, p_text
from manifeel_ms3.analysis.markdown import markdown_table
from manifeel_ms3.analysis.paper_tables import linked
from manifeel_ms3.analysis.protocol import ConditionResults, collect
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.files import write_text

PAGE = Path(__file__).with_name("perturbation.md")
FOLDER = Path(__file__).with_name("perturbation")
ENTRY = "cpu/PegInsertion/rgb+tacff"
"""The entry of the leaderboard whose checkpoint was evaluated."""
USUAL = FOLDER / "none.json"
"""The checkpoint's result under the usual appearance, on the processor of the others."""
COMMAND = """manifeel eval --checkpoint leaderboard/{entry}/seed0/checkpoints/00007000 --num-eval-episodes 50 \\
    --env-kwargs '{{"visual_randomization": {changed}}}' --out docs/perturbation/NAME.json"""
HEAD = """# Robustness to appearance

How much success does a policy lose when the scene looks different from what it was trained on? The small policy of the
leaderboard entry `{entry}` was trained under the usual appearance and evaluated on the same {episodes} initial states under
changes of the [appearance](rendering.md#visual-randomization), which are drawn anew for each initial state. It observes the
wrist camera and TacFF; touch itself is not changed. All rows were evaluated on the same processor. Each difference, in
percentage points, has a 95 % interval from a bootstrap over initial states; p is that of McNemar's exact test, and "p, Holm"
is corrected for all rows (Holm 1979). One policy was tested: nothing here tells how other training seeds, observations or
tasks behave. The study `configs/perturbation.yaml` trains and evaluates policies of three tasks, with vision alone, TacRGB
and TacFF.

"""


def page() -> str:
    """The Markdown page."""
    usual = _of(read_result(USUAL))
    rows: list[tuple[str, ...]] = []
    p_values: list[float] = []
    changed: dict[str, float] = {}
    for path in sorted(set(FOLDER.glob("*.json")) - {USUAL}):
        result = read_result(path)
        changed, here = result["env_kwargs"]["visual_randomization"], _of(result)
        change, p_value = difference(here, usual)
        ranges = ", ".join(f"`{name}` {value:g}" for name, value in changed.items())
        success = linked(mean_success(here), f"{FOLDER.name}/{path.name}")
        rows.append((path.stem.replace("_", " "), ranges, success, change.signed))
        p_values.append(p_value)
    command = COMMAND.format(entry=ENTRY, changed=json.dumps(changed))
    tested = [(*row, p_text(p), p_text(p_holm)) for row, p, p_holm in zip(rows, p_values, holm(p_values), strict=True)]
    unchanged = ("none", None, linked(mean_success(usual), f"{FOLDER.name}/{USUAL.name}"), None, None, None)
    names = ("change", "half ranges", "success", "against the usual appearance", "p", "p, Holm")
    table = markdown_table(names, [unchanged, *tested])
    head = HEAD.format(entry=ENTRY, episodes=len(usual.episode_seeds))
    return f"{head}{table}\nA row is made by\n\n```bash\n{command}\n```\n"


def _of(result: dict[str, Any]) -> ConditionResults:
    (results,) = collect([result]).values()
    return results


if __name__ == "__main__":
    write_text(PAGE, page())
