"""The benchmark's tasks. Importing this package registers them, in the paper's order; `registry` describes each."""

# ruff: noqa: I001  (the order of registration is the paper's)
from .visuotactile_env import VisuotactileEnv as VisuotactileEnv
from .insertion.peg_insertion import PegInsertionEnv as PegInsertionEnv
from .insertion.usb_insertion import USBInsertionEnv as USBInsertionEnv
from .insertion.power_plug_insertion import PowerPlugInsertionEnv as PowerPlugInsertionEnv
from .insertion.gear_assembly import GearAssemblyEnv as GearAssemblyEnv
from .screwing.nut_bolt_assembly import NutBoltAssemblyEnv as NutBoltAssemblyEnv
from .screwing.bulb_installation import BulbInstallationEnv as BulbInstallationEnv
from .exploration.peg_reorientation import PegReorientationEnv as PegReorientationEnv
from .exploration.object_search import ObjectSearchEnv as ObjectSearchEnv
from .exploration.ball_sorting import BallSortingEnv as BallSortingEnv
from .exploration.ball_sorting import BallSortingDimEnv as BallSortingDimEnv
