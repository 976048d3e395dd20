"""Processes of this machine, by their numbers."""

import os


def process_exists(process: int) -> bool:
    """Whether a process with a given number (PID) runs on this machine.

    Args:
        process: Number of the process; no process has a number below 1 or beyond what the system can count.
    """
    if process < 1:  # the system takes it as the name of a group of processes
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # the process belongs to another user
        pass
    return True
