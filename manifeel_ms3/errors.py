"""The errors that this package raises because of what it was given.

`ManifeelError` is their common base. A command prints such an error as one line; every other exception is a fault of the
program and keeps its traceback. Each kind is also the built-in exception that a Python programmer expects, so that
`except ValueError` works on a bad argument.
"""


class ManifeelError(Exception):
    """Something that was given cannot be used. The message says what was given, what was expected, and how to fix it."""


class InvalidArgumentError(ManifeelError, ValueError):
    """An argument has a value that is not allowed."""


class UnknownNameError(InvalidArgumentError):
    """A name is not registered; the message lists the names that are."""


class InvalidFileError(ManifeelError, ValueError):
    """A file or folder is missing, broken, of another kind or of another version."""


class FileExistsAlreadyError(ManifeelError, FileExistsError):
    """A file or folder that would have been written exists already."""


class InUseError(ManifeelError, RuntimeError):
    """Another process works on a file or folder; the message names the process."""


class MissingExtraError(ManifeelError, ModuleNotFoundError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class PluginError(ManifeelError, ImportError):
    """A plug-in of another package cannot be loaded, or claims a name that is taken."""


class MachineError(ManifeelError, RuntimeError):
    """This machine lacks what is asked for, such as a renderer, a GPU or room on the disk."""


class ServerError(ManifeelError, ConnectionError):
    """A server cannot be reached, or answers with an error."""


class WorkFailedError(ManifeelError, RuntimeError):
    """A recording, a training run, an evaluation or a study could not be finished."""
