"""What a condition's settings are in words: the preset of its policy that they come nearest to, and what differs from it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from manifeel_ms3 import plugins
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.nested_settings import as_json

from .condition import ENCODER, Condition, Settings, settings_of, study_row
from .markdown import shown

PAPER = "paper"
"""Name of the preset that has the paper's settings, in every policy that the paper reports."""
FULLEST = (PAPER, "cpu_targets", "cpu_noisy_pose", "cpu_long", "cpu")
"""Presets from the paper's own training to the shortest: an overview of Table I has the first in which a task was run."""
PAPER_PRECISION = {"precision": json.dumps("fp32")}
"""Number format of the paper's training. The presets' own depends on the machine."""
NOT_RECORDED = "not recorded"
"""Value of a setting that an older version of the policy did not have."""
NONE, A_FILE = json.dumps(None), json.dumps("a file of weights")
"""Values of the setting `tacrgb_weights` as json: no file, and any file."""
TACTILE_IMAGE_SIZE = {"t3": 224, "anytouch": 224}
"""Size of TacRGB images, in pixels, that the paper gives these encoders; the others have the preset's."""
PRETRAINED = ("unit", "t3", "anytouch")
"""Encoders that the paper fine-tunes from weights, whichever file they are in here."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a condition's training, without those that the paper gives to its encoder of TacRGB.

    Conditions with the same training settings can be compared: they differ only in their other fields.
    """

    preset: str
    """Name of the policy's preset that the settings come nearest to; "" where the policy has no presets here."""
    changes: Settings
    """Settings that differ from the preset's, or all of them where there is no preset."""

    @property
    def fullness(self) -> tuple[int, tuple[bool, int, str]]:
        """Key that puts the fullest training first (`FULLEST`), and settings of one preset in the order of `sort_key`."""
        return FULLEST.index(self.preset) if self.preset in FULLEST else len(FULLEST), self.sort_key

    @property
    def sort_key(self) -> tuple[bool, int, str]:
        """Key that puts the paper's preset first, and settings with fewer changes before those with more."""
        return self.preset != PAPER, len(self.changes), str(self)

    def __str__(self) -> str:
        """The settings in words, as Markdown."""
        changes = [shown(f"{name} {value.strip(chr(34))}") for name, value in self.changes]
        return ", ".join(filter(None, (self.preset, *changes))) or NOT_RECORDED


@cache
def training_settings_of(condition: Condition) -> TrainingSettings:
    """The training settings of a condition.

    Raises:
        PluginError: The condition's policy is registered, but cannot be imported.
    """
    settings = dict(condition.settings)
    known = _presets(condition.policy) if settings else {}
    changes = {name: _changes(condition, settings, args) for name, args in known.items()}
    if not changes:
        return TrainingSettings("", condition.settings)
    nearest = min(changes, key=lambda name: len(changes[name]))
    return TrainingSettings(nearest, changes[nearest])


def row_in_a_study(condition: Condition) -> str | None:
    """Name of the row of a study that makes results of a condition (`study_row`); None if its settings are not a preset's."""
    training = training_settings_of(condition)
    if not training.preset or training.changes:
        return None
    encoder = "" if has_presets_encoder(condition) else condition.encoder
    return study_row(
        condition.task,
        condition.variant,
        condition.policy,
        training.preset,
        condition.obs_mode,
        encoder,
        ", ".join(condition.cameras),
        condition.num_demos,
    )


def has_presets_encoder(condition: Condition) -> bool:
    """Whether the encoder of TacRGB is the preset's own, which is trained from scratch."""
    preset = _presets(condition.policy).get(training_settings_of(condition).preset)
    return preset is not None and condition.encoder == preset.policy.encoder.tacrgb


def _changes(condition: Condition, settings: Mapping[str, str], preset: Any) -> Settings:
    """What differs from a preset, given by the arguments of its training."""
    expected = dict(settings_of(as_json(_as_trained(preset, condition)), condition.obs_mode)) | PAPER_PRECISION
    expected.pop(ENCODER, None)
    if condition.encoder in TACTILE_IMAGE_SIZE:
        expected["tactile_image_size"] = json.dumps(TACTILE_IMAGE_SIZE[condition.encoder])
    if condition.encoder in PRETRAINED:
        given = settings.get("tacrgb_weights", NONE)
        expected["tacrgb_weights"] = given if given != NONE else A_FILE
    values = ((name, settings.get(name, NOT_RECORDED)) for name in sorted(set(expected) | set(settings)))
    return tuple((name, value) for name, value in values if value != expected.get(name))


def _as_trained(args: Any, condition: Condition) -> Any:
    """The arguments of a preset with the learning rate that a run chooses where they leave it open."""
    if getattr(args, "lr", 0) is not None:
        return args
    encoder = replace(args.policy.encoder, tacrgb=condition.encoder or args.policy.encoder.tacrgb)
    policy = replace(args.policy, encoder=encoder)
    return replace(args, lr=replace(args, obs_mode=condition.obs_mode, policy=policy).public_code_lr())


@cache
def _presets(policy: str) -> dict[str, Any]:
    """Arguments of the training of a policy's presets, by name; {} for a policy that is not registered, or has none."""
    try:
        spec = plugins.load(plugins.POLICIES, policy)
    except UnknownNameError:
        return {}
    return {name: preset.args for name, preset in getattr(spec, "presets", {}).items()}
