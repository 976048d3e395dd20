"""The tasks as a benchmark of AllenAI's vla-eval (tested with 0.8.0), which scores models for vision, language and action.

A model is served once (`vla-eval serve`), and any benchmark asks it. With this folder on PYTHONPATH, an evaluation is:

    # manifeel.yaml
    server: {url: "ws://localhost:8000"}
    benchmarks:
      - benchmark: vla_eval_benchmark:ManiFeelBenchmark
        name: manifeel
        episodes_per_task: 50
        params: {tasks: [ManiFeel-PegInsertion-v1, ManiFeel-BallSorting-v1], obs_mode: rgb+tacrgb+tacff}

    vla-eval run --config manifeel.yaml --render cpu
"""

from functools import partial
from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import configure_sapien_render
from vla_eval.specs import IMAGE_RGB, LANGUAGE, POSITION_DELTA, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

ROTATION = DimSpec("rotation", 3, "delta_about_base_axes", (-1, 1))
GRIPPER = DimSpec("gripper", 1, "distance_open_positive", (-1, 1))
STATE = DimSpec("state", 7, "eef_pos3_quat4_wxyz")


class ManiFeelBenchmark(StepBenchmark):
    """Every episode of a task has one of its evaluation seeds, from 100000 on.

    A model gets `images` (cameras, and pads as `tactile_right`), `task_description`, `state` (the tool's pose) and `touch`, the
    force fields in newtons by pad. It answers with `actions` in [-1, 1], as many as the task's controller takes. Where other
    tasks open and close the gripper, and this one does not, the last number is left out.
    """

    render_backends = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        return configure_sapien_render(mode, "MANIFEEL_LAVAPIPE_ICD")

    def __init__(self, tasks: list[str] | None = None, obs_mode: str = "rgb+tacrgb", env_kwargs: dict | None = None):
        # imported here, because SAPIEN takes the renderer that is set when it is imported first
        from manifeel_ms3.agents.panda_gelsight import FIXED_GRIPPER
        from manifeel_ms3.evaluation.lerobot_env import LeRobotEnv
        from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED, all_tasks, task_spec

        super().__init__()
        self.tasks = [task_spec(task) for task in tasks or all_tasks()]
        self.make = partial(LeRobotEnv, obs_mode=obs_mode, env_kwargs=env_kwargs)
        self.first_seed = FIRST_EVALUATION_SEED
        self.env_kwargs = env_kwargs or {}
        modes = {spec.control_mode(self.env_kwargs) for spec in self.tasks}
        self.has_gripper = any(not mode.endswith(FIXED_GRIPPER) for mode in modes)
        self.env, self.made = None, None

    def get_tasks(self) -> list[Task]:
        return [
            {"name": spec.env_id, "suite": spec.category, "instruction": spec.instruction_for(self.env_kwargs)}
            for spec in self.tasks
        ]

    def reset(self, task: Task) -> Any:
        if self.made != task["name"]:
            self.cleanup()
            self.env, self.made = self.make(task["name"]), task["name"]
        obs, _ = self.env.reset(seed=self.first_seed + task.get("episode_idx", 0))
        return obs

    def step(self, action: Action) -> StepResult:
        wanted = self.env.action_space.shape
        given = np.asarray(action["actions"], np.float32)
        if self.has_gripper and given.shape == (wanted[0] + 1,):
            given = given[:-1]  # this task's gripper is fixed, another one's is not
        if given.shape != wanted:
            raise ValueError(f"the model answered with actions of shape {given.shape}, the task takes {wanted}")
        obs, reward, terminated, truncated, info = self.env.step(np.clip(given, -1, 1))
        return StepResult(obs, reward, terminated or truncated, info)

    def make_obs(self, raw_obs: Any, task: Task) -> Observation:
        touch = {name.split(".")[1]: raw_obs[name] for name in raw_obs if name.startswith("tactile.")}
        seen = dict(images=raw_obs.get("pixels", {}), task_description=task["instruction"], state=raw_obs["agent_pos"])
        return seen | (dict(touch=touch) if touch else {})

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        return {"success": bool(step_result.info.get("is_success", False))}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": self.env_kwargs.get("max_episode_steps") or max(spec.max_episode_steps for spec in self.tasks)}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"position": POSITION_DELTA, "rotation": ROTATION} | ({"gripper": GRIPPER} if self.has_gripper else {})

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"image": IMAGE_RGB, "language": LANGUAGE, "state": STATE}

    def cleanup(self) -> None:
        if self.env is not None:
            self.env.close()
        self.env = self.made = None
