"""Gel-based tactile sensor (GelSight) for ManiSkill scenes: depth, mechanics and optics of a pad."""

from .config import GelConfig as GelConfig
from .config import OpticsConfig as OpticsConfig
from .config import TactileSensorConfig as TactileSensorConfig
from .config import TouchRandomization as TouchRandomization
from .config import gelsight_mini as gelsight_mini
from .config import gelsight_r15 as gelsight_r15
from .config import with_options as with_options
from .mounting import grids_for as grids_for
from .mounting import pad_pose as pad_pose
from .tactile_sensor import TactileSensor as TactileSensor
