"""The server process that worker processes are forked from imports this module, and with it the package; nobody else does."""

import atexit
import gc
import os

import manifeel_ms3  # noqa: F401

gc.freeze()  # the garbage collection of a worker process would write into memory that all of them share
atexit.register(os._exit, 0)  # the server ends at once, instead of taking seconds to clear the modules
