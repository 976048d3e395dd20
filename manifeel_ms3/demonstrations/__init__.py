from .trajectory_file import DemonstrationError as DemonstrationError
from .trajectory_file import read_demonstrations as read_demonstrations
from .trajectory_file import read_header as read_header
