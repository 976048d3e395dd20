"""The robot of the ManiFeel tasks and its controllers."""

from .panda_gelsight import PandaGelSight as PandaGelSight
