from .ball_sorting import BallSortingDimEnv as BallSortingDimEnv
from .ball_sorting import BallSortingEnv as BallSortingEnv
from .object_search import ObjectSearchEnv as ObjectSearchEnv
from .peg_insertion import PegInsertionEnv as PegInsertionEnv
from .power_plug_insertion import PowerPlugInsertionEnv as PowerPlugInsertionEnv
from .usb_insertion import USBInsertionEnv as USBInsertionEnv
from .visuotactile_env import VisuotactileEnv as VisuotactileEnv
