from .fits import Fit as Fit
from .part import Box as Box
from .part import Cylinder as Cylinder
from .part import Part as Part
from .part import block_with_holes as block_with_holes
from .plugs import peg_fit as peg_fit
from .plugs import power_fit as power_fit
from .plugs import usb_fit as usb_fit
