"""The address of the runs page: filters, sort, columns and place, read from it and written back to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any, TypeVar

from werkzeug.datastructures import MultiDict

from slamhive.domain.run import FailureReason, RunState
from slamhive.errors import InvalidInput
from slamhive.store.records import RunFilter, RunSort
from slamhive.web.columns import DEFAULT_COLUMNS, Column, column
from slamhive.web.formatting import plural, thousands

DEFAULT_LIMIT = 50
LARGEST_LIMIT = 500
EXPORT_LIMIT = 1000
Choice = TypeVar("Choice", bound=StrEnum)


@dataclass(frozen=True, slots=True)
class RunQuery:
    """What the runs page shows. Equal queries have equal addresses."""

    filter: RunFilter
    sort: RunSort
    columns: tuple[str, ...]
    after: str | None
    limit: int

    @classmethod
    def from_args(cls, args: MultiDict[str, str], largest_limit: int = LARGEST_LIMIT) -> RunQuery:
        """Read an address; raises InvalidInput or NotFound naming the value that cannot be used."""
        keys = _many(args, "columns") or DEFAULT_COLUMNS
        sort_key = args.get("sort", "id")
        return cls(
            filter=RunFilter(
                states=_choices(args, "state", RunState),
                reasons=_choices(args, "reason", FailureReason),
                algorithms=_many(args, "algorithm"),
                datasets=_many(args, "dataset"),
                executors=_many(args, "executor"),
                configuration_id=_integer(args, "configuration", 1, 2**31),
                created_after=_day(args, "from"),
                created_before=_day_after(args, "to"),
                evaluated=_yes_no(args, "evaluated"),
            ),
            sort=RunSort(sort_key, descending=_order(args, default_descending=sort_key == "id")),
            columns=tuple(column(key).key for key in dict.fromkeys(keys)),
            after=args.get("after") or None,
            limit=_integer(args, "limit", 1, largest_limit) or min(DEFAULT_LIMIT, largest_limit),
        )

    def args(self) -> dict[str, Any]:
        """The address as arguments, defaults left out."""
        wanted = self.filter
        before = None if wanted.created_before is None else wanted.created_before - timedelta(days=1)
        all_args = {
            "state": [state.value for state in wanted.states],
            "reason": [reason.value for reason in wanted.reasons],
            "algorithm": list(wanted.algorithms),
            "dataset": list(wanted.datasets),
            "executor": list(wanted.executors),
            "configuration": [] if wanted.configuration_id is None else [str(wanted.configuration_id)],
            "from": [] if wanted.created_after is None else [wanted.created_after.date().isoformat()],
            "to": [] if before is None else [before.date().isoformat()],
            "evaluated": [] if wanted.evaluated is None else ["yes" if wanted.evaluated else "no"],
            "sort": [] if self.sort == RunSort() else [self.sort.key],
            "order": [] if self.sort == RunSort() else ["desc" if self.sort.descending else "asc"],
            "columns": [] if self.columns == DEFAULT_COLUMNS else [",".join(self.columns)],
            "limit": [] if self.limit == DEFAULT_LIMIT else [str(self.limit)],
            "after": [] if self.after is None else [self.after],
        }
        return {name: values for name, values in all_args.items() if values}

    def sorted_by(self, chosen: Column) -> RunQuery:
        """From the first page, by this column; the other way round if it is the one already."""
        key = chosen.sort or "id"
        descending = not self.sort.descending if self.sort.key == key else key == "id"
        return replace(self, sort=RunSort(key, descending=descending), after=None)

    def at(self, after: str | None) -> RunQuery:
        """The page after this key; None is the first."""
        return replace(self, after=after)

    @property
    def restricted(self) -> bool:
        """Whether any filter is in force."""
        return self.filter != RunFilter()

    def in_words(self) -> str:
        """The filter and the order as the end of a sentence: ``state failed, sorted by ATE RMSE, smallest first``."""
        wanted = self.filter
        parts = [
            f"{name} {' or '.join(values)}"
            for name, values in (
                ("state", [state.value for state in wanted.states]),
                ("reason", [reason.value.replace("_", " ") for reason in wanted.reasons]),
                ("algorithm", list(wanted.algorithms)),
                ("dataset", list(wanted.datasets)),
                ("executor", list(wanted.executors)),
            )
            if values
        ]
        if wanted.configuration_id is not None:
            parts.append(f"configuration {wanted.configuration_id}")
        if wanted.created_after is not None:
            parts.append(f"created since {wanted.created_after.date()}")
        if wanted.created_before is not None:
            parts.append(f"created until {(wanted.created_before - timedelta(days=1)).date()}")
        if wanted.evaluated is not None:
            parts.append("evaluated" if wanted.evaluated else "not evaluated")
        parts.append(self._order_in_words())
        return ", ".join(parts)

    def _order_in_words(self) -> str:
        if self.sort.key == "id":
            return "newest first" if self.sort.descending else "oldest first"
        chosen = column(self.sort.key)
        way = ("largest first", "smallest first") if chosen.numeric else ("Z to A", "A to Z")
        if self.sort.key.endswith("_at"):
            way = ("latest first", "earliest first")
        return f"sorted by {chosen.title}, {way[0] if self.sort.descending else way[1]}"


def summary(query: RunQuery, shown: int, matching: int, total: int) -> str:
    """What the page shows, how many, and what it leaves out, in words."""
    if total == 0:
        return "No runs yet."
    text = f"Showing {thousands(shown)} of {plural(matching, 'run')}: {query.in_words()}."
    if query.after is not None:
        text = f"Showing the next {thousands(shown)} of {plural(matching, 'run')}: {query.in_words()}."
    if matching < total:
        text += f" Left out: {plural(total - matching, 'run')} that the filter does not match."
    return text


def _many(args: MultiDict[str, str], name: str) -> tuple[str, ...]:
    """All values of an argument, given once or several times, commas between them or not."""
    parts = [part.strip() for value in args.getlist(name) for part in value.split(",")]
    return tuple(dict.fromkeys(part for part in parts if part))


def _choices(args: MultiDict[str, str], name: str, kind: type[Choice]) -> tuple[Choice, ...]:
    found = []
    for text in _many(args, name):
        try:
            found.append(kind(text))
        except ValueError:
            raise InvalidInput(f"{name} {text!r} is not known", f"use one of {', '.join(kind)}") from None
    return tuple(found)


def _integer(args: MultiDict[str, str], name: str, minimum: int, maximum: int) -> int | None:
    text = args.get(name, "").strip()
    if not text:
        return None
    if not text.isascii() or not text.isdigit() or not minimum <= int(text[:20]) <= maximum:
        raise InvalidInput(f"{name} {text[:40]!r} is not allowed", f"use {minimum} to {maximum}")
    return int(text)


def _day(args: MultiDict[str, str], name: str) -> datetime | None:
    text = args.get(name, "").strip()
    if not text:
        return None
    try:
        day = datetime.strptime(text, "%Y-%m-%d").replace(tzinfo=UTC)
    except ValueError:
        raise InvalidInput(f"{name} {text[:40]!r} is not a day", "write it as 2026-01-31") from None
    return day


def _day_after(args: MultiDict[str, str], name: str) -> datetime | None:
    day = _day(args, name)
    try:
        return None if day is None else day + timedelta(days=1)
    except OverflowError:
        raise InvalidInput(f"{name} {day:%Y-%m-%d} is too far away") from None


def _yes_no(args: MultiDict[str, str], name: str) -> bool | None:
    text = args.get(name, "")
    if text not in {"", "yes", "no"}:
        raise InvalidInput(f"{name} {text[:40]!r} is not known", "use yes or no")
    return None if not text else text == "yes"


def _order(args: MultiDict[str, str], *, default_descending: bool) -> bool:
    text = args.get("order", "")
    if text not in {"", "asc", "desc"}:
        raise InvalidInput(f"order {text[:40]!r} is not known", "use asc or desc")
    return default_descending if not text else text == "desc"
