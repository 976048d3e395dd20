"""Demonstrations: recorded, replayed, rendered with other sensors, checked, exported and viewed."""

from .formats.maniskill_h5 import DemonstrationError as DemonstrationError
from .formats.maniskill_h5 import read_demonstrations as read_demonstrations
from .formats.maniskill_h5 import read_header as read_header
