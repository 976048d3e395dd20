"""Gel-based tactile sensors (GelSight, DIGIT) for ManiSkill scenes: depth, mechanics and optics of a pad."""

from .config import GelConfig as GelConfig
from .config import HousingConfig as HousingConfig
from .config import Light as Light
from .config import LightsConfig as LightsConfig
from .config import OpticsConfig as OpticsConfig
from .config import TactileSensorConfig as TactileSensorConfig
from .config import TouchRandomization as TouchRandomization
from .config_fields import with_options as with_options
from .imperfection_config import ImperfectionConfig as ImperfectionConfig
from .mounting import grids_for as grids_for
from .mounting import pad_pose as pad_pose
from .registry import digit as digit
from .registry import gelsight_mini as gelsight_mini
from .registry import gelsight_r15 as gelsight_r15
from .registry import sensor_config as sensor_config
from .registry import sensor_names as sensor_names
from .tactile_sensor import TactileSensor as TactileSensor
