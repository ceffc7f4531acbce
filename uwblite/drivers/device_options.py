"""Options that a user writes behind a port, and further input of a driver."""

from dataclasses import dataclass, field

from ..errors import ConfigError
from .events import Pose

BAUD = 1200, 4_000_000
"""bit/s, least and most, that a serial port is opened with."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What a driver gets besides its options."""

    start: Pose = (0.0, 0.0, 0.0)
    """Pose of the base with which odometry goes on."""
    stream: bool = True
    """Measure; False: only find out who answers."""


@dataclass(slots=True)
class Options:
    """What a user wrote behind the port, ``?name=value&...``; every name must be asked for."""

    device: str
    values: dict[str, str]
    known: list[str] = field(default_factory=list)

    def text(self, name: str, default: str = "") -> str:
        """Return an option as it was written."""
        self.known.append(name)
        return self.values.get(name, default)

    def number(self, name: str, default: float, least: float, most: float) -> float:
        """Return a number within bounds."""
        text = self.text(name, str(default))
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise ConfigError(f"{self.device}: {name}={text} is not a number from {least:g} to {most:g}")
        return value

    def whole(self, name: str, default: int, least: int, most: int) -> int:
        """Return a whole number within bounds."""
        value = self.number(name, default, least, most)
        if value != int(value):
            raise ConfigError(f"{self.device}: {name}={self.values[name]} is not a whole number")
        return int(value)

    def finish(self) -> None:
        """Refuse unknown options."""
        unknown = [name for name in self.values if name not in self.known]
        if unknown:
            known = f"known are {', '.join(self.known)}" if self.known else "it has none"
            raise ConfigError(f"{self.device}: unknown option {unknown[0]!r}; {known}")
