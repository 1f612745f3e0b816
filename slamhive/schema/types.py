"""The types that fields of documents are made of."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, StrictInt

from slamhive.domain.disturbance import Disturbance
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.schema.limits import StopWhen


def _moment(raw: object) -> object:
    at = datetime.fromisoformat(raw) if isinstance(raw, str) else raw
    if isinstance(at, datetime) and at.tzinfo is None:
        raise ValueError(f"{at} lacks its UTC offset")
    return at


def timestamp(at: datetime) -> str:
    """ISO 8601 with the UTC offset, to the millisecond."""
    return at.isoformat(timespec="milliseconds")


Moment = Annotated[
    datetime, BeforeValidator(_moment), PlainSerializer(datetime.isoformat, when_used="json-unless-none")
]
"""A time that a row is rebuilt from: ISO 8601 with its UTC offset, to the microsecond."""
Timestamp = Annotated[datetime, PlainSerializer(timestamp, when_used="json-unless-none")]
"""A time that is shown."""


def cut(length: int) -> Any:
    """Keeps as much of a text as its column holds."""
    return AfterValidator(lambda text: text if text is None else text[:length])


Values = dict[str, int | float | str | bool | tuple[int | float, ...]]
"""Values by name; a matrix is a list of numbers."""
RowNumber = Annotated[StrictInt, Field(ge=0, lt=2**31)]
Uid = Annotated[str, Field(pattern=r"\A[0-9a-f]{32}\z")]
ContentHash = Annotated[str, Field(pattern=r"\A[0-9a-f]{64}\z")]


def _rules(raw: Any) -> Any:
    return raw if isinstance(raw, StopWhen) else StopWhen.of(raw)


Rules = Annotated[StopWhen, BeforeValidator(_rules), PlainSerializer(lambda rules: rules.content)]
"""Only the rules that are set; None and unknown ones are no rules."""


def _disturbance(raw: Any) -> Any:
    try:
        return Disturbance.of(raw) if isinstance(raw, dict) else raw
    except (KeyError, TypeError) as error:
        raise ValueError(f"no disturbance: {error!r}") from None


FoundDisturbance = Annotated[Disturbance, BeforeValidator(_disturbance), PlainSerializer(lambda found: found.content)]


def _definitions(raw: Any) -> Any:
    """``[type, unit, general name]`` by key, from definitions or as read."""
    return {
        key: entry if isinstance(entry, list | tuple) else (entry.type, entry.unit, entry.general)
        for key, entry in raw.items()
    }


Definitions = Annotated[
    dict[str, tuple[ParameterType, str, str | None]],
    BeforeValidator(_definitions),
    Field(description="Type, unit and general name of each parameter."),
]


def defined(definitions: Definitions, values: Mapping[str, Value]) -> tuple[Parameter, ...]:
    """How the parameters with these values are defined."""
    return tuple(
        Parameter(key, kind, values[key], "", unit, general=general)
        for key, (kind, unit, general) in definitions.items()
        if key in values
    )
