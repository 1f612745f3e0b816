"""The query in the address of the runs page: search, sort order, columns and page position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput, unknown
from slamhive.documents.submission import MAX_REPEATS
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.parameters import Value
from slamhive.experiments.experiment import Experiment
from slamhive.filters.binding import Search, bind, means_of, read_search
from slamhive.filters.fields import BUILT_IN, Vocabulary
from slamhive.filters.parser import parse_filter
from slamhive.filters.syntax import (
    Filter,
    FilterComparison,
    FilterError,
    Junction,
    Sign,
    Tree,
    Word,
    filter_text,
    join,
)
from slamhive.filters.words import in_words
from slamhive.services.configurations import parse_conditions
from slamhive.services.experiments import METRICS
from slamhive.services.searches import LeftOut, order_in_words
from slamhive.services.searches import summary as summary_in_words
from slamhive.store import ConfigurationFilter
from slamhive.store.records import Count, RunSort
from slamhive.web.columns import DEFAULT_COLUMNS, ListColumn, ListLook, all_columns, column
from slamhive.web.formatting import plural, thousands, value_text
from slamhive.web.presenters.experiments import default_axes

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
class RunListQuery:
    """The query of the runs page. Equal queries have equal addresses.

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
    look: ListLook = field(default_factory=ListLook)

    @classmethod
    def from_args(
        cls, args: MultiDict[str, str], vocabulary: Vocabulary, largest_limit: int = LARGEST_LIMIT
    ) -> RunListQuery:
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
            look=ListLook.from_args(args),
        )

    @classmethod
    def unread(cls, args: MultiDict[str, str]) -> RunListQuery:
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

    def sorted_by(self, chosen: ListColumn) -> RunListQuery:
        """The first page sorted by this column; in reverse order if it is the current one."""
        return self.sorted_by_key(chosen.sort or "id")

    def sorted_by_key(self, key: str) -> RunListQuery:
        """The first page sorted by this key."""
        default = GROUPED_SORT if self.grouped else RunSort()
        descending = not self.sort.descending if self.sort.key == key else key == default.key
        return replace(self, sort=RunSort(key, descending=descending), after=None)

    def at(self, after: str | None) -> RunListQuery:
        """The same query after this key; None is the first page."""
        return replace(self, after=after)

    def standard(self) -> RunListQuery:
        """The same runs, with the columns and the look of an address that names none."""
        return replace(self, columns=DEFAULT_COLUMNS, look=ListLook(), after=None)

    @property
    def conditions(self) -> tuple[Filter, ...]:
        """The parts of the search that all have to hold."""
        tree = parse_filter(self.search.text)
        if tree is None:
            return ()
        return tree.parts if isinstance(tree, Junction) and tree.word == "and" else (tree,)

    def without(self, place: int) -> RunListQuery:
        """The same search without one of its conditions, written entirely as a filter."""
        left = [part for at, part in enumerate(self.conditions) if at != place]
        return replace(self, where=filter_text(join("and", left)) if left else "", fields={}, after=None)

    def with_look(self, **changes: bool) -> RunListQuery:
        """The same runs, drawn in another way."""
        return replace(self, look=replace(self.look, **changes))

    def args_without(self, name: str) -> dict[str, Any]:
        """The arguments of :meth:`args` but one."""
        return {key: values for key, values in self.args().items() if key != name}

    def as_text(self) -> RunListQuery:
        """The same search, written entirely as a filter."""
        return replace(self, where=self.search.text, fields={}, after=None)

    def narrowed(self, name: str, value: str) -> RunListQuery:
        """The same search with one more condition, written entirely as a filter."""
        typed = parse_filter(self.search.text)
        more = FilterComparison(Word(name), Sign.EQUAL, (Word(value),))
        where = filter_text(more if typed is None else join("and", [typed, more]))
        return replace(self, where=where, fields={}, after=None)

    def grouped_or_not(self, *, grouped: bool) -> RunListQuery:
        """The same runs one by one, or grouped by configuration."""
        return replace(self, grouped=grouped, sort=GROUPED_SORT if grouped else RunSort(), after=None)

    @property
    def restricted(self) -> bool:
        """True if any filter is set."""
        return self.search.tree is not None

    def in_words(self) -> str:
        """Search and order as a phrase: ``state failed, sorted by ATE RMSE, smallest first``."""
        chosen = all_columns().get(self.sort.key)
        title = self.sort.key if chosen is None else chosen.title
        order = order_in_words(self.sort, title, numeric=chosen is None or chosen.numeric)
        search = means_of(self.search) if self.grouped else self.search
        return ", ".join(part for part in (in_words(search), order) if part)


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


def added(args: MultiDict[str, str]) -> dict[str, list[str]]:
    """The address with the condition in ``add`` as part of the filter; an invalid one stays as it was typed."""
    kept = {name: values for name, values in args.lists() if name not in ("add", "where", "after")}
    parts = [text for text in (args.get("where", "").strip(), args.get("add", "").strip()) if text]
    try:
        trees = [tree for text in parts if (tree := parse_filter(text)) is not None]
        where = filter_text(join("and", trees))
    except FilterError:
        where = " and ".join(f"({part})" for part in parts) if len(parts) > 1 else parts[0]
    return {"where": [where], **kept}


def summary(query: RunListQuery, shown: int, count: Count, left_out: LeftOut) -> str:
    """A line about the page: its search, the number of runs, and those that are left out."""
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
        return FilterComparison(Word(single), sign, words)
    for bound, sign in _BOUNDS.items():
        if name.startswith(bound):
            return FilterComparison(Word(name.removeprefix(bound)), sign, words)
    return FilterComparison(Word(name), Sign.IN, words)


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


# -- the query in the address of the configurations page: filters and page position ------------------------------------

CONFIGURATION_ID = "<int(max=9007199254740991):configuration_id>"
"""Configuration numbers up to what JSON and every database can store."""
PAGE_LENGTH = 50
LARGEST_PAGE = 500
_USED = {"": None, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class ConfigurationQuery:
    """The query of the configurations page. Equal queries have equal addresses."""

    filter: ConfigurationFilter
    after: str | None
    limit: int

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> ConfigurationQuery:
        """Read an address; raises InvalidInput naming the invalid value."""
        used = args.get("used", "")
        if used not in _USED:
            raise InvalidInput(f"unknown value {used[:40]!r} for used", "use yes or no")
        conditions = [part for text in args.getlist("where") for part in text.replace(";", "\n").splitlines()]
        return cls(
            filter=ConfigurationFilter(
                algorithms=_named(args, "algorithm"),
                datasets=_named(args, "dataset"),
                group=args.get("group", "").strip(),
                text=args.get("text", "").strip(),
                used=_USED[used],
                conditions=parse_conditions(part for part in conditions if part.strip()),
            ),
            after=args.get("after") or None,
            limit=whole_number(args.get("limit") or str(PAGE_LENGTH), "limit", 1, LARGEST_PAGE),
        )

    def args(self) -> dict[str, Any]:
        """The query as arguments of an address, without defaults."""
        wanted = self.filter
        everything = {
            "algorithm": list(wanted.algorithms),
            "dataset": list(wanted.datasets),
            "group": wanted.group,
            "text": wanted.text,
            "used": {None: "", True: "yes", False: "no"}[wanted.used],
            "where": self.where,
            "limit": "" if self.limit == PAGE_LENGTH else str(self.limit),
            "after": self.after or "",
        }
        return {name: value for name, value in everything.items() if value}

    @property
    def where(self) -> str:
        """The conditions as typed."""
        return "; ".join(map(str, self.filter.conditions))

    @property
    def restricted(self) -> bool:
        """True if any filter is set."""
        return self.filter != ConfigurationFilter()

    def at(self, after: str | None) -> ConfigurationQuery:
        """The same query after this key; None is the first page."""
        return replace(self, after=after)

    def summary(self, shown: int, total: int) -> str:
        """The content of the page, as a sentence."""
        wanted = self.filter
        parts = [
            *(
                f"{kind} {' or '.join(names)}"
                for kind, names in (("algorithm", wanted.algorithms), ("dataset", wanted.datasets))
                if names
            ),
            *([f"in group {wanted.group}"] if wanted.group else []),
            *([f"“{wanted.text}” in name or note"] if wanted.text else []),
            *([] if wanted.used is None else ["with runs" if wanted.used else "without runs"]),
            *map(str, wanted.conditions),
            "newest first",
        ]
        following = "the next " if self.after else ""
        return f"Showing {following}{thousands(shown)} of {plural(total, 'configuration')}: {', '.join(parts)}."


def _named(args: MultiDict[str, str], name: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part.strip() for text in args.getlist(name) for part in text.split(",") if part.strip()))


# -- the queries in the addresses of experiment pages: axes of the grid, and position in the table ---------------------

CELLS_LENGTH = 50
MOST_CELLS = 200
MOST_NUMBER = 2**31 - 1
PROGRESS = "progress"
"""The metric of a grid that counts runs by phase."""


@dataclass(frozen=True, slots=True)
class GridQuery:
    """The axes of the grid, and the metric that it shows; None shows the progress."""

    rows: str
    columns: str
    metric: str | None = None

    @classmethod
    def from_args(cls, args: MultiDict[str, str], axes: Mapping[str, int]) -> GridQuery | None:
        """The requested axes, or the most informative ones; None without axes. Raises NotFound for unknown names.

        ``axes``: {name: number of values}.
        """
        if not axes:
            return None
        rows, columns = default_axes(axes)
        metric = args.get("metric") or None
        if metric is not None and metric not in (*METRICS, PROGRESS):
            raise unknown("metric of the grid", metric, [PROGRESS, *METRICS])
        return cls(
            _axis(args.get("rows"), axes, rows),
            _axis(args.get("columns"), axes, columns),
            None if metric == PROGRESS else metric,
        )

    def args(self) -> dict[str, str]:
        """The query as arguments of an address."""
        return {"rows": self.rows, "columns": self.columns} | ({"metric": self.metric} if self.metric else {})


@dataclass(frozen=True, slots=True)
class CellsQuery:
    """A page of the table of configurations: those after number ``after``."""

    after: int = 0
    limit: int = CELLS_LENGTH

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> CellsQuery:
        """Read an address; raises InvalidInput naming the argument."""
        after = whole_number(args.get("after", "0"), "after", 0, MOST_NUMBER)
        return cls(after, whole_number(args.get("limit", str(CELLS_LENGTH)), "limit", 1, MOST_CELLS))

    def args(self) -> dict[str, str]:
        """The query as arguments of an address, without the position."""
        return {} if self.limit == CELLS_LENGTH else {"limit": str(self.limit)}


def page_number(args: MultiDict[str, str], pages: int) -> int:
    """The requested page; raises InvalidInput if it does not exist."""
    return whole_number(args.get("page", "1"), "page", 1, pages)


def repeats_count(form: MultiDict[str, str]) -> int:
    """The number of repeats to add; raises InvalidInput."""
    return whole_number(form.get("count", ""), "repeats", 1, MAX_REPEATS)


def stated_values(experiment: Experiment) -> dict[str, tuple[Value, ...]]:
    """{axis: its values} from the experiment file, without reading the cells."""
    options = (option for step in experiment.steps for option in step.options)
    named = (experiment.algorithms, experiment.datasets, *options, *experiment.parameters, *experiment.limit_axes)
    return {axis.name: axis.values for axis in named}


def stated_axes(experiment: Experiment) -> dict[str, int]:
    """{axis: number of values} from the experiment file, without reading the cells."""
    return {name: len(values) for name, values in stated_values(experiment).items()}


def search_of(
    experiment: Experiment, values: Mapping[str, Value | None], configurations: Sequence[int]
) -> dict[str, str] | None:
    """Arguments of the runs page that find the runs with these values; None if no filter can express them.

    Algorithms, datasets and parameters have names to search for. Options of steps do not: a step that changes nothing
    is not stored, and which steps change nothing depends on the recording. In that case ``configurations`` are listed.
    """
    parameters = {axis.name for axis in experiment.parameters if axis.algorithm is None}
    parameters |= {axis.name for axis in experiment.limit_axes if axis.name in BUILT_IN}
    chosen = {"experiment": experiment.name}
    conditions: list[Tree[FilterComparison]] = []
    for axis, value in values.items():
        if axis in ("algorithm", "dataset"):
            chosen[axis] = str(value)
        elif axis not in parameters or value is None or isinstance(value, tuple):
            return _listed(chosen["experiment"], configurations)
        else:
            conditions.append(FilterComparison(Word(axis), Sign.EQUAL, (Word(value_text(value)),)))
    return {**chosen, "where": filter_text(join("and", conditions))} if conditions else chosen


def _listed(experiment: str, configurations: Sequence[int]) -> dict[str, str] | None:
    if not configurations:
        return None
    numbers = tuple(Word(str(number)) for number in configurations)
    return {"experiment": experiment, "where": filter_text(FilterComparison(Word("configuration"), Sign.IN, numbers))}


def _axis(name: str | None, axes: Mapping[str, int], default: str) -> str:
    if not name:
        return default
    if name not in axes:
        raise unknown("axis", name, list(axes))
    return name
