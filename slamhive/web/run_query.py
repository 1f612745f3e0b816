"""The query in the address of the runs page: search, sort order, columns and page position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.search.binding import Search, bind, read_search
from slamhive.search.fields import Vocabulary
from slamhive.search.grammar import join
from slamhive.search.parser import parse_filter
from slamhive.search.reader import FilterError
from slamhive.search.syntax import Comparison, Filter, Sign, Word, filter_text
from slamhive.search.words import in_words
from slamhive.services.searches import LeftOut, order_in_words
from slamhive.services.searches import summary as summary_in_words
from slamhive.store.records import Count, RunSort
from slamhive.web.columns import DEFAULT_COLUMNS, Column, all_columns, column
from slamhive.web.look import Look

DEFAULT_LIMIT = 50
LARGEST_LIMIT = 500
EXPORT_LIMIT = 1000
LISTS = ("state", "reason", "verdict", "trust", "algorithm", "dataset", "sensor", "executor", "experiment")
"""Fields with lists of names; several values mean "or"."""

GROUPED_SORT = RunSort("configuration")
_SINGLE = {
    "configuration": ("configuration", Sign.EQUAL),
    "from": ("created_at", Sign.AT_LEAST),
    "to": ("created_at", Sign.AT_MOST),
    "evaluated": ("evaluated", Sign.EQUAL),
    "disturbed": ("disturbed", Sign.EQUAL),
}
_BOUNDS = {"min.": Sign.AT_LEAST, "max.": Sign.AT_MOST}


@dataclass(frozen=True, slots=True)
class RunQuery:
    """What the runs page shows. Equal queries have equal addresses.

    ``where`` is the typed filter, ``fields`` the values of the search fields: {name: values}. ``search`` combines both.
    ``look`` is how the list is drawn.
    """

    where: str
    fields: Mapping[str, tuple[str, ...]]
    search: Search
    sort: RunSort
    columns: tuple[str, ...]
    grouped: bool
    after: str | None
    limit: int
    look: Look = field(default_factory=Look)

    @classmethod
    def from_args(
        cls, args: MultiDict[str, str], vocabulary: Vocabulary, largest_limit: int = LARGEST_LIMIT
    ) -> RunQuery:
        """Read an address; raises InvalidInput or NotFound naming the invalid value."""
        keys = _many(args, "columns") or DEFAULT_COLUMNS
        grouped = _grouped(args)
        default = GROUPED_SORT if grouped else RunSort()
        sort_key = args.get("sort", default.key)
        where, fields = args.get("where", "").strip(), form_fields(args)
        return cls(
            where=where,
            fields=fields,
            search=_search(where, fields, vocabulary),
            sort=RunSort(sort_key, descending=_order(args, default_descending=sort_key == default.key)),
            columns=tuple(column(key, vocabulary).key for key in dict.fromkeys(keys)),
            grouped=grouped,
            after=args.get("after") or None,
            limit=_integer(args, "limit", 1, largest_limit) or min(DEFAULT_LIMIT, largest_limit),
            look=Look.from_args(args),
        )

    @classmethod
    def unread(cls, args: MultiDict[str, str]) -> RunQuery:
        """The typed text alone, for a page that shows why it is invalid."""
        columns = _many(args, "columns") or DEFAULT_COLUMNS
        where = args.get("where", "").strip()
        return cls(
            where, form_fields(args), Search(), RunSort(), columns, grouped=False, after=None, limit=DEFAULT_LIMIT
        )

    def args(self) -> dict[str, Any]:
        """The query as arguments of an address, without defaults."""
        default = GROUPED_SORT if self.grouped else RunSort()
        all_args = {
            "where": [self.where] if self.where else [],
            **{name: list(values) for name, values in self.fields.items()},
            "group": ["configuration"] if self.grouped else [],
            "sort": [] if self.sort == default else [self.sort.key],
            "order": [] if self.sort == default else ["desc" if self.sort.descending else "asc"],
            "columns": [] if self.columns == DEFAULT_COLUMNS else [",".join(self.columns)],
            "limit": [] if self.limit == DEFAULT_LIMIT else [str(self.limit)],
            "after": [] if self.after is None else [self.after],
            **self.look.args(),
        }
        return {name: values for name, values in all_args.items() if values}

    def sorted_by(self, chosen: Column) -> RunQuery:
        """The first page sorted by this column; in reverse order if it is the current one."""
        return self.sorted_by_key(chosen.sort or "id")

    def sorted_by_key(self, key: str) -> RunQuery:
        """The first page sorted by this key."""
        default = GROUPED_SORT if self.grouped else RunSort()
        descending = not self.sort.descending if self.sort.key == key else key == default.key
        return replace(self, sort=RunSort(key, descending=descending), after=None)

    def at(self, after: str | None) -> RunQuery:
        """The same query after this key; None is the first page."""
        return replace(self, after=after)

    def standard(self) -> RunQuery:
        """The same runs, with the columns and the look of an address that names none."""
        return replace(self, columns=DEFAULT_COLUMNS, look=Look(), after=None)

    def as_text(self) -> RunQuery:
        """The same search, written entirely as a filter."""
        return replace(self, where=self.search.text, fields={}, after=None)

    def narrowed(self, name: str, value: str) -> RunQuery:
        """The same search with one more condition, written entirely as a filter."""
        typed = parse_filter(self.search.text)
        more = Comparison(Word(name), Sign.EQUAL, (Word(value),))
        where = filter_text(more if typed is None else join("and", [typed, more]))
        return replace(self, where=where, fields={}, after=None)

    def grouped_or_not(self, *, grouped: bool) -> RunQuery:
        """The same runs one by one, or grouped by configuration."""
        return replace(self, grouped=grouped, sort=GROUPED_SORT if grouped else RunSort(), after=None)

    @property
    def restricted(self) -> bool:
        """Whether any filter is set."""
        return self.search.tree is not None

    def in_words(self) -> str:
        """Search and order as a phrase: ``state failed, sorted by ATE RMSE, smallest first``."""
        return ", ".join(part for part in (in_words(self.search), self._order_in_words()) if part)

    def _order_in_words(self) -> str:
        chosen = all_columns().get(self.sort.key)
        title = self.sort.key if chosen is None else chosen.title
        return order_in_words(self.sort, title, numeric=chosen is None or chosen.numeric)


def filled(args: MultiDict[str, str]) -> dict[str, list[str]]:
    """The arguments of an address without empty ones, which a web form sends for every field."""
    kept = {name: [value for value in values if value.strip()] for name, values in args.lists()}
    return {name: values for name, values in kept.items() if values}


def form_fields(args: MultiDict[str, str]) -> dict[str, tuple[str, ...]]:
    """The search fields in an address besides the filter, without empty ones, in a fixed order."""
    found = {name: _many(args, name) for name in LISTS}
    for name in (*_SINGLE, *(f"{bound}{key}" for key in CATALOGUE for bound in _BOUNDS)):
        text = args.get(name, "").strip()
        found[name] = (text,) if text else ()
    return {name: values for name, values in found.items() if values}


def summary(query: RunQuery, shown: int, count: Count, left_out: LeftOut) -> str:
    """What the page shows, how many runs, and what is left out, as text."""
    return summary_in_words(
        shown, count, query.in_words(), left_out, grouped=query.grouped, further=query.after is not None
    )


def _search(where: str, fields: Mapping[str, tuple[str, ...]], vocabulary: Vocabulary) -> Search:
    """The filter and the fields joined by "and". Errors quote the text that contains them."""
    typed = parse_filter(where)
    bind(typed, where, vocabulary)
    parts = [] if typed is None else [typed]
    for name, values in fields.items():
        part = _comparison(name, values)
        try:
            read_search(filter_text(part), vocabulary)
        except FilterError as error:
            message = error.message.rsplit(" (at character", 1)[0]
            raise InvalidInput(f"{name} {', '.join(values)[:80]!r}: {message}", error.remedy) from None
        parts.append(part)
    return read_search(filter_text(join("and", parts)), vocabulary) if parts else Search()


def _comparison(name: str, values: tuple[str, ...]) -> Filter:
    words = tuple(Word(value) for value in values)
    if name in _SINGLE:
        single, sign = _SINGLE[name]
        return Comparison(Word(single), sign, words)
    for bound, sign in _BOUNDS.items():
        if name.startswith(bound):
            return Comparison(Word(name.removeprefix(bound)), sign, words)
    return Comparison(Word(name), Sign.IN, words)


def _many(args: MultiDict[str, str], name: str) -> tuple[str, ...]:
    """All values of an argument, repeated or separated by commas."""
    parts = [part.strip() for value in args.getlist(name) for part in value.split(",")]
    return tuple(dict.fromkeys(part for part in parts if part))


def _integer(args: MultiDict[str, str], name: str, minimum: int, maximum: int) -> int | None:
    text = args.get(name, "")
    return whole_number(text, name, minimum, maximum) if text.strip() else None


def _grouped(args: MultiDict[str, str]) -> bool:
    text = args.get("group", "")
    if text not in {"", "configuration"}:
        raise InvalidInput(f"unknown group {text[:40]!r}", "use configuration")
    return bool(text)


def _order(args: MultiDict[str, str], *, default_descending: bool) -> bool:
    text = args.get("order", "")
    if text not in {"", "asc", "desc"}:
        raise InvalidInput(f"unknown order {text[:40]!r}", "use asc or desc")
    return default_descending if not text else text == "desc"
