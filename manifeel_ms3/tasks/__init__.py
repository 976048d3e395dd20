from .peg_insertion import PegInsertionEnv as PegInsertionEnv
from .visuotactile_env import VisuotactileEnv as VisuotactileEnv
