"""The errors that the workbench raises on purpose, as a tree.

::

    WorkbenchError
    ├── InputError              something that the user gave cannot be used
    │   ├── SceneError          a scene or mesh file: names the file and the line or key
    │   └── OptionError         an option or argument out of its range
    ├── MemoryForecastError     the work would need more memory than is free
    └── MissingLibraryError     an optional library or a system library is absent

Each message is one line: where, what was found, what was wanted, what to do next.  The
command line prints it and ends with exit code 2.
"""

from __future__ import annotations

__all__ = [
    "InputError",
    "MemoryForecastError",
    "MissingLibraryError",
    "OptionError",
    "SceneError",
    "WorkbenchError",
]


class WorkbenchError(Exception):
    """Base of every error that the workbench raises on purpose."""


class InputError(WorkbenchError):
    """Input that cannot be used; the message says where, what came and what was wanted."""


class SceneError(InputError):
    """A scene that cannot be read.

    Parameters
    ----------
    message : str
        What was found, what was wanted and the next step.
    path : str or Path, optional
        The file.
    line : int, optional
        Line number, from 1.
    key : str, optional
        Dotted key of a TOML file, such as ``surface[3].polygon``.
    """

    def __init__(self, message, *, path=None, line=None, key=None):
        self.path, self.line, self.key = path, line, key
        where = [str(path)] if path is not None else []
        if line is not None:
            where.append(f"line {line}")
        if key is not None:
            where.append(key)
        super().__init__(": ".join([", ".join(where), message]) if where else message)


class OptionError(InputError):
    """An option or argument out of its range."""


class MemoryForecastError(WorkbenchError):
    """The forecast of memory exceeds what is free; nothing was allocated."""


class MissingLibraryError(WorkbenchError):
    """An optional or system library is absent; the message says what to install."""
