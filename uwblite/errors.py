"""Every exception that uwblite raises on purpose. The message contains the fault, its place, and how to fix it."""


class UwbliteError(Exception):
    """Base of all errors of this package; the command line shows its text as one line and exits with 1.

    Parameters
    ----------
    text : one line; the middle of a very long one, which quotes a broken file, is left out.
    """

    def __init__(self, text: str = "") -> None:
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 3 :]}")


_LONGEST = 1000
"""Characters of a message."""


class ConfigError(UwbliteError):
    """A setting is unknown, of the wrong type or out of its range."""


class UsageError(UwbliteError):
    """The command line, or a file of settings that it names, asks for what there is not; exit code 2."""


class FormatError(UwbliteError):
    """A file or stream is not what it should be."""

    def __init__(self, problem: str, path: str = "", line: int | None = None) -> None:
        self.problem, self.path, self.line = problem, path, line
        where = f"{path}:{line}: " if path and line else f"{path}: " if path else f"line {line}: " if line else ""
        super().__init__(where + problem)


class DataError(UwbliteError):
    """Measurements are well-formed but cannot be used: wrong shapes, no motion, a sensor without a reading."""


class ProtocolError(UwbliteError):
    """A device driver was asked for something its protocol does not allow."""


class DeviceError(UwbliteError):
    """A device could not be opened, answered with a fault, or fell silent."""


class SolverError(UwbliteError):
    """The least-squares problem is ill-posed: no free variable, not finite, or not connected."""


SINGULAR = "the normal equations are singular; add a prior or more measurements"
"""Text of a SolverError."""


class Cancelled(UwbliteError):
    """The caller's progress callback asked to stop."""
