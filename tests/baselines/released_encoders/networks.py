"""Our modules of the released encoders in the sizes of the stand-ins, which are quick to compute."""

from transformers import CLIPVisionConfig

from baselines.tactile_representations.anytouch import AnyTouch
from baselines.tactile_representations.sparsh import Sparsh
from baselines.tactile_representations.t3 import T3
from baselines.tactile_representations.unit import UniT

from .stand_ins import HEADS, WIDTHS

SMALL_CLIP = CLIPVisionConfig(
    hidden_size=32,
    intermediate_size=64,
    num_hidden_layers=2,
    num_attention_heads=HEADS,
    patch_size=14,
    projection_dim=16,
    hidden_act="gelu",
)


def small_t3() -> T3:
    return T3(width=32, depth=(1, 2), heads=HEADS).eval()


def small_sparsh() -> Sparsh:
    return Sparsh(width=32, depth=2, heads=HEADS).eval()


def small_anytouch() -> AnyTouch:
    return AnyTouch(SMALL_CLIP).eval()


def small_unit(attention: bool = False) -> UniT:
    return UniT(WIDTHS, attention).eval()
