"""ManiFeel for ManiSkill3: importing registers the robot and every task (`gym.make("ManiFeel-PegInsertion-v1")`)."""

import gc

_collects = gc.isenabled()
gc.disable()  # imports make many objects and no garbage: to search them again and again takes a fifth of the time
try:
    from . import agents as agents
    from . import tasks as tasks
finally:
    if _collects:
        if not gc.get_freeze_count():
            gc.freeze()  # these two calls hand what was imported to the oldest generation, without a search of it
            gc.unfreeze()
        gc.enable()
