"""The types that fields of documents are made of."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer, StrictInt

from slamhive.domain.disturbance import Disturbance
from slamhive.schema.submission import StopWhen


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
