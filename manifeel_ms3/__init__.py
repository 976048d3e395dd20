"""ManiFeel for ManiSkill3: importing registers the robot and every task (`gym.make("ManiFeel-PegInsertion-v1")`)."""

import gc
import os
import sys
from pathlib import Path

if "OMP_WAIT_POLICY" not in os.environ:
    # torch's threads wait for each other in a loop before they sleep: by default so long that a training step takes hundreds of
    # times as long where other processes use the cores; a hundredth of that makes no difference where they are idle
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")

_collects = gc.isenabled()
gc.disable()  # imports make many objects and no garbage: to search them again and again takes a fifth of the time
try:
    from . import agents as agents
    from . import tasks as tasks
except ImportError as error:
    if Path(sys.argv[0]).stem != "manifeel" or os.environ.get("MANIFEEL_TRACEBACK"):
        raise
    sys.stderr.write(f"error: {error}; a dependency is missing or broken, and installing manifeel-ms3 again repairs it\n")
    sys.exit(1)
except KeyboardInterrupt:
    if Path(sys.argv[0]).stem != "manifeel":
        raise
    sys.stderr.write("stopped\n")  # these imports are the first seconds of a command; `command_line.run` says the same later
    sys.exit(130)
finally:
    if _collects:
        if not gc.get_freeze_count():
            gc.freeze()  # these two calls hand what was imported to the oldest generation, without a search of it
            gc.unfreeze()
        gc.enable()
