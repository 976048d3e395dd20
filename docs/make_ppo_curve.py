"""Draws the curve of docs/from_maniskill.md, or that of another run of `examples/ppo.py`: `python -m docs.make_ppo_curve
runs/ppo/log.jsonl`."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import tyro

from manifeel_ms3.files import read_json_lines

IMAGES = Path(__file__).parent / "images"


def main(log: tyro.conf.Positional[Path] = IMAGES / "ppo.jsonl") -> Path:
    """Draw return and success over steps into a picture beside the log, and return its path.

    Args:
        log: Log of a run of the example.
    """
    entries = [entry for entry in read_json_lines(log) if "eval/return" in entry]
    steps, length = [entry["step"] for entry in entries], entries[0]["eval/episode_len"]
    fig, (top, bottom) = plt.subplots(2, 1, figsize=(6.4, 4.4), sharex=True, height_ratios=(3, 1), layout="constrained")
    top.plot(steps, [entry["eval/return"] for entry in entries], marker="o", markersize=3)
    top.set(ylabel=f"return of {length:g} steps", ylim=(0, None), title="PPO on state and touch, easy PegInsertion")
    bottom.plot(steps, [100 * entry["eval/success_once"] for entry in entries], marker="o", markersize=3, color="C1")
    bottom.set(ylabel="success, %", ylim=(-5, 105), xlabel="environment steps")
    for ax in (top, bottom):
        ax.grid(alpha=0.3)
    out = log.with_name("ppo.png")
    fig.savefig(out, dpi=100)
    return out


if __name__ == "__main__":
    print(tyro.cli(main))  # noqa: T201
