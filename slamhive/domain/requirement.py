"""What an algorithm has to know of a sensor, and whether the dataset has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slamhive.domain.sensor_property import SensorProperty
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class Requirement:
    """An entry of ``requires`` in ``algorithm.yaml``: a property that must be known.

    ``allowed`` are its only values, empty for any.
    """

    source: SensorProperty
    allowed: tuple[str, ...] = ()

    def met_by(self, sensor: Sensor) -> bool:
        """Whether ``sensor`` has the property, with a value that is allowed."""
        found = self.source.value({self.source.role: sensor})
        return found is not None and (not self.allowed or str(found) in self.allowed)


def check_requirements(requirements: Sequence[Requirement], sensor: Sensor, algorithm: str, dataset: str) -> None:
    """Raise InvalidInput naming all that ``sensor`` of ``dataset`` lacks of what ``algorithm`` requires of its role."""
    unmet = [entry for entry in requirements if not entry.met_by(sensor)]
    missing = [entry.source.name for entry in unmet if entry.source.value({entry.source.role: sensor}) is None]
    if missing:
        raise InvalidInput(
            f"{algorithm} needs {', '.join(missing)} of its {unmet[0].source.role}; {sensor.name} of dataset {dataset} "
            f"does not state {'it' if len(missing) == 1 else 'them'}",
            f"add {', '.join(missing)} to the calibration of {sensor.name} in dataset.yaml",
        )
    for entry in unmet:
        raise InvalidInput(
            f"{algorithm} needs {entry.source} to be {' or '.join(entry.allowed)}; it is "
            f"{entry.source.value({entry.source.role: sensor})} for {sensor.name} of dataset {dataset}",
            "choose another sensor, dataset or algorithm",
        )
