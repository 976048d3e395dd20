"""Result files with made-up outcomes, of runs with the settings of a policy's preset."""

import json
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from baselines.registry import policy_spec
from manifeel_ms3.analysis import results_page
from manifeel_ms3.analysis.protocol import collect
from manifeel_ms3.evaluation.result import provenance, result_of, results_in
from manifeel_ms3.nested_settings import as_json
from manifeel_ms3.tasks.registry import evaluation_seeds, full_id, task_spec
from tests.outcomes import made_up

TOTAL_STEPS = 50_000


def page_of(results: Path, page: Path | None = None) -> str:
    """The page of the results in a folder, which is written into the same folder unless another path is given."""
    return results_page.main(results_page.Args((results,), page or results / "results.md")).read_text()


def text_of(results: Path) -> str:
    """The page of the results in a folder without its figures, which take most of the time."""
    by_file = results_in(results)
    none = results_page.Figures(*[None] * len(fields(results_page.Figures)))
    links = results_page._links(by_file, results)
    return "".join(results_page.page(list(by_file.values()), collect(by_file), links, none, (), {}))


def config_of(policy: str, preset: str, task: str, mode: str, seed: int, encoder: str = "", **changes: Any) -> dict[str, Any]:
    """The configuration that training writes, from the preset itself; changes are by names joined by dots."""
    args = replace(policy_spec(policy).presets[preset].args, env_id=full_id(task), obs_mode=mode, seed=seed)
    if encoder:
        args = replace(args, policy=replace(args.policy, encoder=replace(args.policy.encoder, tacrgb=encoder)))
    if args.lr is None:
        args = replace(args, lr=args.public_code_lr())
    config = as_json(args) | dict(policy_name=policy, num_demos=50, num_samples=4200, total_steps=TOTAL_STEPS, precision="fp32")
    for name, value in changes.items():
        *places, last = name.split(".")
        entry = config
        for place in places:
            entry = entry[place]
        entry[last] = value
    return config


def write_run(
    folder: Path,
    mode: str,
    rate: float,
    seed: int = 0,
    task: str = "PegInsertion",
    policy: str = "diffusion_policy",
    preset: str = "paper",
    episodes: int = 50,
    checkpoints: int = 2,
    last_step: int = TOTAL_STEPS,
    env_kwargs: dict[str, Any] | None = None,
    **changes: Any,
) -> None:
    """Write the results of a run with this success rate; each condition and seed has outcomes of its own."""
    config = config_of(policy, preset, task, mode, seed, **changes)
    kwargs = dict(cameras=[task_spec(full_id(task)).policy_camera], tactile_sensors=["right"]) | (env_kwargs or {})
    name = json.dumps([config, kwargs], sort_keys=True, default=str)
    rng = np.random.default_rng(list(name.encode()))
    for step in np.linspace(last_step / checkpoints, last_step, checkpoints).astype(int).tolist():
        won = rng.permutation(episodes) < rate * episodes
        seeds = evaluation_seeds(episodes)
        outcomes = [made_up(one, bool(win)) for one, win in zip(seeds, won, strict=True)]
        path = folder / str(rng.integers(1 << 62)) / f"evaluations/{step:08d}.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(result_of(full_id(task), kwargs, config | dict(step=step), outcomes, origin=_origin(task))))


@cache
def _origin(task: str) -> dict[str, Any]:
    """Where the results come from; git is asked once for all of them."""
    return provenance(full_id(task))
