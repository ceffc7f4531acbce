"""Silence of sensors: for how long each of them, and all together, have sent nothing."""

from dataclasses import dataclass, field

_PERIODS = 3.0
"""Missed periods of a sensor that show silence."""
_FIRST_PERIOD = 2.0
"""s, as long as a sensor's own is not known: that of a radio that measures at rest."""
_FORGETTING = 0.05
"""Share of the longest period that every message forgets."""


@dataclass(slots=True)
class Sensor:
    """What was heard from one sensor."""

    last: float
    """s, time of its last message."""
    longest: float = _FIRST_PERIOD
    """s, its longest period of late."""

    def limit(self, late: float) -> float:
        """Return the silence, s, from which on it is late, where `late` is the least one for any sensor."""
        return max(late, _PERIODS * self.longest)


@dataclass(slots=True)
class Silence:
    """Times of the last messages on the log's clock, which goes on while nothing comes.

    Sensors are expected from the beginning, or, optional ones, from their first message on.
    """

    late: float
    """s of silence, and _PERIODS periods of the sensor, from which on it is late."""
    expected: tuple[str, ...] = ()
    """Sensors that should be there."""
    sensors: dict[str, Sensor] = field(default_factory=dict)
    now: float = -float("inf")
    """s, time of the last message of all."""

    def hear(self, name: str, stamp: float) -> None:
        """Take the time, s, of a message; one that is late or broken does not set time back."""
        if not self.sensors:
            self.sensors = {each: Sensor(stamp) for each in self.expected}
        sensor = self.sensors.setdefault(name, Sensor(stamp))
        # A silence is no period: it counts as far as the next one is to be noticed soon.
        period = min(stamp - sensor.last, _PERIODS * self.late)
        sensor.longest = max(period, (1.0 - _FORGETTING) * sensor.longest)
        sensor.last, self.now = max(sensor.last, stamp), max(self.now, stamp)

    def silent(self, quiet: float = 0.0) -> dict[str, float]:
        """Return the sensors that are late, with their silence in s, where nothing at all came for `quiet` s."""
        ages = {name: self.now - sensor.last + quiet for name, sensor in self.sensors.items()}
        return {name: age for name, age in ages.items() if age > self.sensors[name].limit(self.late)}

    def all_late(self, quiet: float) -> bool:
        """Return whether all sensors should have sent something within `quiet` s."""
        return quiet > min((s.limit(self.late) for s in self.sensors.values()), default=self.late)
