"""ManiFeel for ManiSkill3: importing registers the robot and every task (`gym.make("ManiFeel-PegInsertion-v1")`)."""

from . import agents as agents
from . import tasks as tasks
