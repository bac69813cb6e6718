"""Every error a caller may want to catch, each also a built-in type.

The command line turns a `LidarPainterError` into one line and exit code 2: its message says what
is wrong, where, and what was expected.
"""


class LidarPainterError(Exception):
    """Something given from outside cannot be used as it is.

    Messages quote names and values from outside: as text, what is not printable in them is written
    as an escape, so that one error is one line and a terminal obeys none of it.
    """

    def __str__(self) -> str:
        """The message on one line."""
        return "".join(
            character if character.isprintable() else character.encode("unicode_escape").decode()
            for character in super().__str__()
        )


class DataError(LidarPainterError, ValueError):
    """A dataset file, table or value is missing, damaged or makes no sense."""


class UnsafePickleError(DataError):
    """A pickle names a class outside the allow-list; nothing of it was run."""


class SceneError(LidarPainterError, ValueError):
    """A stored scene is incomplete, damaged, or lacks what was asked of it."""


class ShapeError(LidarPainterError, ValueError):
    """A tensor has another shape than the function can use."""


class ConfigError(LidarPainterError, ValueError):
    """A setting has a value that cannot be used."""


class WeightsError(LidarPainterError, ValueError):
    """A weights file is missing, damaged, or belongs to another network."""


class TrainingError(LidarPainterError, RuntimeError):
    """A training cannot go on: its loss is no longer a number."""


class BackendError(LidarPainterError, RuntimeError):
    """A kernel backend was asked for that cannot run here."""


class DeviceMemoryError(LidarPainterError, MemoryError):
    """A device has too little memory, for a smaller plan too."""


class MissingPackageError(LidarPainterError, ImportError):
    """A part of the package needs an extra that is not installed."""


class WriteError(LidarPainterError, OSError):
    """A file cannot be written or read (disk full, permissions)."""
