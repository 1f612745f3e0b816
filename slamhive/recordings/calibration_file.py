"""Reads YAML calibration of other tools (EuRoC's ``sensor.yaml``, OpenCV's files); mistakes name file and key."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Matrix4, is_rigid
from slamhive.recordings.geometry import Array
from slamhive.recordings.text_lists import read_lines


@dataclass(frozen=True)
class CalibrationFile:
    """A mapping of a calibration file, or a part of one.

    Attributes:
        name: What messages call it: the path, and the place inside it.
        content: Its keys.
    """

    name: str
    content: dict[str, Any]

    def part(self, key: str) -> CalibrationFile:
        """The mapping under ``key``; raises InvalidInput."""
        value = self._value(key)
        if not isinstance(value, dict):
            raise InvalidInput(f"{self.name}: {key} is no mapping", "correct the file")
        return CalibrationFile(f"{self.name}: {key}", value)

    def parts(self, key: str) -> list[CalibrationFile]:
        """The mappings in the list under ``key``, none without the key; raises InvalidInput."""
        value = self.content.get(key) or []
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise InvalidInput(f"{self.name}: {key} is no list of mappings", "correct the file")
        return [CalibrationFile(f"{self.name}: {key} {index}", entry) for index, entry in enumerate(value)]

    def number(self, key: str) -> float:
        """A finite number; raises InvalidInput."""
        return self.numbers(key, 1)[0]

    def positive(self, key: str) -> float:
        """A finite number above 0; raises InvalidInput."""
        value = self.number(key)
        if value <= 0:
            raise InvalidInput(f"{self.name}: {key} is {value:g}", "expected a number above 0")
        return value

    def optional(self, key: str) -> float | None:
        """A finite number, None without the key; raises InvalidInput."""
        return self.number(key) if key in self.content else None

    def numbers(self, key: str, *counts: int) -> tuple[float, ...]:
        """Read as many finite numbers as one of ``counts`` says, from a list, an OpenCV matrix or a single number.

        Raises InvalidInput.
        """
        value = self._value(key)
        if isinstance(value, dict):
            value = value.get("data")
        try:
            found = np.array(value, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError):
            raise InvalidInput(f"{self.name}: {key} is {str(value)[:60]!r}, no numbers", "correct the file") from None
        allowed = " or ".join(str(count) for count in counts)
        if (counts and len(found) not in counts) or not np.isfinite(found).all():
            raise InvalidInput(f"{self.name}: {key} has {len(found)} numbers", f"expected {allowed} finite numbers")
        return tuple(float(number) for number in found)

    def size(self, *keys: str) -> tuple[int, int]:
        """Width and height in pixels, under one key as a list or under two; raises InvalidInput."""
        found = [number for key in keys for number in self.numbers(key, 1, 2)]
        if len(found) != 2 or not all(number == int(number) and 0 < number < 100_000 for number in found):
            raise InvalidInput(f"{self.name}: {' and '.join(keys)} is no width and height: {found}", "correct the file")
        return int(found[0]), int(found[1])

    def word(self, key: str, default: str | None = None) -> str:
        """A text; raises InvalidInput without the key, unless there is a default."""
        return str(self._value(key) if default is None else self.content.get(key, default))

    def rigid(self, key: str) -> Array:
        """A rigid transform (4, 4); raises InvalidInput."""
        numbers: Matrix4 = self.numbers(key, 16)
        if not is_rigid(numbers):
            raise InvalidInput(
                f"{self.name}: {key} is no rigid transform", "expected a rotation and a translation in m"
            )
        return np.array(numbers).reshape(4, 4)

    def _value(self, key: str) -> Any:
        if self.content.get(key) is None:
            raise InvalidInput(f"{self.name} lacks {key}", "add it from the calibration of the dataset")
        return self.content[key]


def read_calibration_file(path: Path) -> CalibrationFile:
    """Read a YAML file, also one with OpenCV's ``%YAML:1.0`` and ``!!opencv-matrix``, which YAML does not allow.

    Raises InvalidInput.
    """
    lines = [line.replace("!!opencv-matrix", "") for line in read_lines(path) if not line.startswith("%YAML:")]
    return CalibrationFile(str(path), strict_yaml.parse("\n".join(lines), str(path)))
