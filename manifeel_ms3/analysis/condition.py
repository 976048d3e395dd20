"""Conditions: what is evaluated, told apart by everything that makes another policy.

A `Condition` is a task, its observations, a policy, and the settings that the policy was trained and run with: two results are
of the same condition only if they differ in nothing but the training seed, the checkpoint, and where they were computed.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from manifeel_ms3.arguments import names_in
from manifeel_ms3.evaluation.checkpoint_config import IMPLIED
from manifeel_ms3.evaluation.variant import SENSING, variant_of
from manifeel_ms3.tasks.obs_modes import in_usual_order
from manifeel_ms3.tasks.registry import short_name

NO_SETTINGS = frozenset(
    {
        *("policy_name", "env_id", *SENSING, "num_demos", "env_kwargs"),  # these have fields of their own
        *("seed", "step"),  # a condition has several of these
        *("action_dim", "taxel_shape", "num_samples"),  # these follow from the task and its demonstrations
        *("demos", "run_dir", "resume", "overwrite", "device", "compile", "trained_on", "training_seconds"),  # where and how
        *("epochs", "min_steps"),  # these are in the entry `steps`
        *("total_steps", "save_freq", "keep", "log_freq"),
        *("num_eval_episodes", "num_eval_envs", "eval_env_kwargs", "eval_freq", "capture_video"),
        *("exp_name", "track", "wandb_project_name", "wandb_entity"),
    }
)
"""Entries of a policy's configuration that do not make it another policy. Every other entry does."""
OF_MODALITIES = {
    "image_size": ("rgb",),
    "camera_view": ("rgb",),
    "policy.encoder.crop": ("rgb",),
    "policy.encoder.image": ("rgb",),
    "policy.encoder.image_features": ("rgb",),
    "tactile_image_size": ("tacrgb",),
    "tacrgb_weights": ("tacrgb",),
    "policy.tacrgb_scale": ("tacrgb",),
    "policy.encoder.tactile_crop": ("tacrgb",),
    "policy.encoder.tacrgb": ("tacrgb",),
    "policy.encoder.tacrgb_sensor": ("tacrgb",),
    "policy.encoder.freeze_tacrgb": ("tacrgb",),
    "policy.encoder.force_field": ("tacff",),
    "policy.encoder.tactile_features": ("tacrgb", "tacff"),
    "policy.touch_noise": ("tacrgb", "tacff"),
}
"""Settings that only have an effect on a policy that observes one of the given modalities."""
ENCODER, NETWORK = "policy.encoder.tacrgb", "policy.encoder.image"
"""Settings that name the networks of TacRGB and of the cameras."""
LEARNT_ON = "trained on"
"""Setting of a policy whose demonstrations were recorded with other arguments of the task than its evaluation has."""
KEY_LENGTH = 8
"""Number of hexadecimal digits of a condition's hash that are shown."""
Settings = tuple[tuple[str, str], ...]
"""Names and values, in the order of the names. Names of nested entries are joined by dots, values are json."""


@dataclass(frozen=True)
class Condition:
    """A task, its observations and a policy with all its settings: everything but the training seed."""

    env_id: str
    """Id of the task."""
    obs_mode: str
    """Observation mode, such as "rgb+tacff"."""
    policy: str
    """Registered name of the policy, or the name of its class."""
    encoder: str = ""
    """Encoder of TacRGB images; empty without them."""
    cameras: tuple[str, ...] = ()
    """Cameras that the policy observes."""
    pads: tuple[str, ...] = ()
    """Sides of the tactile sensors that the policy observes."""
    num_demos: int | None = None
    """Number of training episodes."""
    variant: str = ""
    """Arguments of the task other than its defaults, such as its fit, light or units of touch, as json."""
    revision: int = 1
    """Revision of the task."""
    settings: Settings = ()
    """All other settings that make another policy."""

    @property
    def task(self) -> str:
        """Short name of the task."""
        return short_name(self.env_id)

    @property
    def sensing(self) -> str:
        """Observation mode, cameras, and tactile sensors other than the right one alone, as a page shows them."""
        return " ".join((self.obs_mode, *self.cameras, *(self.pads if self.pads != ("right",) else ())))

    @property
    def network(self) -> str:
        """Encoder of camera images; empty for a policy that is no baseline."""
        return str(json.loads(dict(self.settings).get(NETWORK, '""')))

    @property
    def key(self) -> str:
        """Hash that names the condition: two conditions with the same key agree in everything."""
        content = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:KEY_LENGTH]

    def __str__(self) -> str:
        demos = f"{self.num_demos} demonstrations" if self.num_demos else ""
        return f"{listed(self.task, self.variant, self.sensing, self.policy, self.encoder, demos)} ({self.key})"


def listed(*parts: str) -> str:
    """The parts that are not empty, separated by commas."""
    return ", ".join(filter(None, parts))


def study_row(
    task: str, variant: str, policy: str, preset: str, obs_mode: str, encoder: str, camera: str, num_demos: int | None
) -> str:
    """Name of a row of a study: of the training runs, and their evaluations, that differ only in their seed.

    Args:
        task: Short name of the task.
        variant: Arguments of the task other than its defaults, as json; "" if there are none.
        policy: Registered name of the policy.
        preset: Name of the policy's preset.
        obs_mode: Observation mode.
        encoder: Encoder of TacRGB; "" for the preset's own.
        camera: The camera that the policy observes.
        num_demos: Number of demonstrations.
    """
    return listed(task, variant, policy, preset, obs_mode, encoder, camera, f"{num_demos} demonstrations")


def condition_of(result: dict[str, Any]) -> Condition:
    """The condition that a result belongs to.

    Entries of the policy's configuration that are of another type than the baselines' count as absent.
    """
    config, obs_mode = result["config"], in_usual_order(result["obs_mode"])
    modes = obs_mode.split("+")
    settings = settings_of(config, obs_mode)
    variant = variant_of(result["env_id"], result["env_kwargs"])
    recorded = config.get("env_kwargs")
    if isinstance(recorded, dict) and (learnt := variant_of(result["env_id"], recorded)) != variant:
        settings = tuple(sorted((*settings, (LEARNT_ON, learnt))))
    num_demos = config.get("num_demos")
    return Condition(
        result["env_id"],
        obs_mode,
        result["policy"].rpartition(":")[2],
        str(json.loads(dict(settings).get(ENCODER, '""'))),
        names_in(result["env_kwargs"].get("cameras")) if "rgb" in modes else (),
        (names_in(result["env_kwargs"].get("tactile_sensors")) or ("right",)) if {"tacrgb", "tacff"} & set(modes) else (),
        num_demos if isinstance(num_demos, int) else None,
        variant,
        result["revision"],
        tuple((name, value) for name, value in settings if name != ENCODER),
    )


def by_condition(results: Iterable[dict[str, Any]]) -> dict[Condition, list[dict[str, Any]]]:
    """The results of each condition, in the order in which they are given.

    Args:
        results: Contents of result files.
    """
    found: dict[Condition, list[dict[str, Any]]] = {}
    for result in results:
        found.setdefault(condition_of(result), []).append(result)
    return found


def settings_of(config: dict[str, Any], obs_mode: str) -> Settings:
    """The settings of a policy that tell it apart from other policies.

    Args:
        config: Configuration of the policy, with nested entries.
        obs_mode: Observation mode, without which some settings have no effect.
    """
    idle = {name for name, modes in OF_MODALITIES.items() if not set(modes) & set(obs_mode.split("+"))}
    no_settings = NO_SETTINGS | {"obs_mode"}
    named = {name: value for name, value in config.items() if name not in no_settings}
    if named.get("steps", 0) is None and (epochs := config.get("epochs")) is not None:
        named["steps"] = f"{epochs} epochs, at least {config.get('min_steps', 1)}"
    implied = {(name, json.dumps(value)) for name, value in IMPLIED.items()}
    return tuple(sorted(setting for setting in _flat(named) if setting[0] not in idle and setting not in implied))


def _flat(config: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Names joined by dots and values as json of a configuration's innermost entries."""
    places = [("", config)]
    while places:
        place, entries = places.pop()
        for name, value in entries.items():
            if isinstance(value, dict) and value:
                places.append((f"{place}{name}.", value))
            else:
                yield f"{place}{name}", json.dumps(value, sort_keys=True)
