"""Configurations as lists and pages show them: frozen values, never rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import Value


@dataclass(frozen=True, slots=True)
class StoredParameter:
    """How a parameter was defined when the configuration was stored; the definition may have been edited since.

    ``general`` is the name shared across algorithms, from the newest definition. It finds a value and is no part of its
    meaning.
    """

    type: str
    unit: str
    general: str | None


@dataclass(frozen=True, slots=True)
class ConfigurationRecord:
    """A configuration, what users say about it, and what depends on it.

    ``parameters``: {key: definition}. ``runs`` counts its runs, ``experiments`` names the experiments that contain it.
    """

    id: int
    configuration: Configuration
    created_at: datetime
    name: str | None = None
    note: str = ""
    groups: tuple[str, ...] = ()
    runs: int = 0
    experiments: tuple[str, ...] = ()
    parameters: dict[str, StoredParameter] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """``configuration 12`` or ``configuration 12 (half rate)``."""
        return f"configuration {self.id}" + (f" ({self.name})" if self.name else "")

    def value(self, name: str) -> Value | None:
        """The value of the parameter whose key or general name is ``name`` (the key wins), None if there is none."""
        values = self.configuration.parameters
        if name in values:
            return values[name]
        return next((values[key] for key, definition in self.parameters.items() if definition.general == name), None)


@dataclass(frozen=True, slots=True)
class ParameterCondition:
    """``name`` (own key or general name) compared by ``operator`` (``=``, ``<``, ``<=``, ``>``, ``>=``) with a text."""

    name: str
    operator: str
    value: str

    def __str__(self) -> str:
        return f"{self.name}{self.operator}{self.value}"


@dataclass(frozen=True, slots=True)
class ConfigurationFilter:
    """Which configurations to list; an empty tuple, an empty text or None does not restrict.

    ``text`` is searched in names and notes, whatever the case. ``used``: with or without runs.
    """

    algorithms: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    group: str = ""
    text: str = ""
    used: bool | None = None
    conditions: tuple[ParameterCondition, ...] = ()


@dataclass(frozen=True, slots=True)
class ConfigurationPage:
    """One page, newest first. ``total`` counts all matches; ``next_key`` asks for the next page; None at the end."""

    records: tuple[ConfigurationRecord, ...]
    total: int
    next_key: str | None
