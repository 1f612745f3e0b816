"""Options of steps: pydantic fields with their meaning, unit and range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field


def option(help_text: str, *, unit: str = "", default: Any = ..., **bounds: Any) -> Any:
    """A field of a step.

    Args:
        help_text: What it does, for forms and documentation.
        unit: The unit of the value, empty if it has none.
        default: Without one the option must be given.
        **bounds: pydantic's ``ge``, ``gt``, ``le``, ``lt``.
    """
    return Field(default, description=help_text, json_schema_extra={"unit": unit}, **bounds)


# A quantity that swings around its value over time, as an automatic exposure does that hunts.


@dataclass(frozen=True, slots=True)
class Swing:
    """``middle + amplitude * sin(2 pi t / period_s + phase)``; the phase comes from ``seed`` alone.

    Sensors with the same seed therefore swing together.
    """

    middle: float
    amplitude: float
    period_s: float
    seed: int

    def at(self, stamp_ns: int) -> float:
        """The value at one time."""
        if self.amplitude == 0:
            return self.middle
        phase = np.random.default_rng(self.seed).uniform(0.0, 2 * math.pi)
        turns = (stamp_ns % round(self.period_s * 1e9)) / (self.period_s * 1e9)
        return self.middle + self.amplitude * math.sin(2 * math.pi * turns + float(phase))
