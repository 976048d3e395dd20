"""Shapes of the tasks' parts; one description of each serves drawing, collision and touch."""

from .fits import FITS as FITS
from .fits import Fit as Fit
from .gears import gear_fit as gear_fit
from .part import Box as Box
from .part import Cylinder as Cylinder
from .part import Part as Part
from .part import block_with_holes as block_with_holes
from .plugs import peg_fit as peg_fit
from .plugs import reorientation_fit as reorientation_fit
from .power_plug import power_fit as power_fit
from .screws import Screw as Screw
from .screws import bulb_and_holder as bulb_and_holder
from .screws import nut_and_bolt as nut_and_bolt
from .usb import usb_fit as usb_fit
