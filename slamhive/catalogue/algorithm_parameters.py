"""The parameters of ``algorithm.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from pydantic import BaseModel, ConfigDict, Field, model_validator

from slamhive.domain.numbers import plain
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.sensor_property import SensorProperty
from slamhive.domain.sensors import SensorKind
from slamhive.errors import InvalidInput

PlainValue = bool | int | float | str | list[float]


class ParameterModel(BaseModel):
    """One parameter."""

    model_config = ConfigDict(extra="forbid")
    type: ParameterType
    default: PlainValue | None = None
    source: str | None = Field(default=None, alias="from")
    required: bool = False
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: list[str] = Field(default_factory=list)
    general: str | None = None

    @model_validator(mode="after")
    def _definition_makes_sense(self) -> ParameterModel:
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"minimum {plain(self.minimum)} is larger than maximum {plain(self.maximum)}")
        if not self.required and self.default is None and self.source is None:
            raise ValueError("give a default, the property of a sensor that it is taken from, or required: true")
        if self.required and not (self.default is None and self.source is None):
            raise ValueError("a required parameter has neither a default nor a property of a sensor")
        if self.type is ParameterType.ENUM and not self.choices:
            raise ValueError("an enum needs choices")
        return self


class Mode(Protocol):
    """What is asked of the mode that has a parameter."""

    @property
    def title(self) -> str:
        """For messages."""

    @property
    def inputs(self) -> Mapping[str, SensorKind]:
        """Its roles."""

    @property
    def defaults(self) -> Mapping[str, PlainValue]:
        """Its own defaults, by key."""


def check_general_names(path: Path, mode: str, parameters: dict[str, ParameterModel]) -> None:
    """A name leads to one parameter, whether it is a key or a general name; raises InvalidInput naming ``path``."""
    owners: dict[str, str] = {}
    for key, model in parameters.items():
        general = model.general
        if general is None:
            continue
        other = owners.get(general) or (general if general in parameters and general != key else None)
        if other is not None:
            raise InvalidInput(
                f"{path}: mode {mode}: the general name {general!r} of {key} is also that of {other}",
                "give each parameter of a mode a name of its own",
            )
        owners[general] = key


def read_parameter(path: Path, key: str, model: ParameterModel, mode: Mode) -> Parameter:
    """The parameter ``key`` of one mode; raises InvalidInput naming ``path``."""
    raw = mode.defaults.get(key, model.default)
    parameter = Parameter(
        key=key,
        type=model.type,
        default=None,
        help=model.help,
        unit=model.unit,
        minimum=model.minimum,
        maximum=model.maximum,
        choices=tuple(model.choices),
        general=model.general,
        source=_source(path, key, model, mode),
    )
    if raw is None:
        return parameter
    try:
        return replace(parameter, default=parameter.parse(raw))
    except InvalidInput as error:
        raise InvalidInput(f"{path}: default of {error.message}", error.remedy) from None


def _source(path: Path, key: str, model: ParameterModel, mode: Mode) -> SensorProperty | None:
    """The property of a sensor that the parameter is taken from; raises InvalidInput for a role that is no input."""
    if model.source is None:
        return None
    try:
        source = SensorProperty.parse(model.source)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: parameter {key}: {error.message}", error.remedy) from None
    missing = [role for role in source.roles if role not in mode.inputs]
    if missing and key not in mode.defaults and model.default is None:
        raise InvalidInput(
            f"{path}: {mode.title}: parameter {key} is taken from {source}, but there is no input {missing[0]}",
            "name the parameters of the mode, or give the parameter a default",
        )
    return None if missing else source
