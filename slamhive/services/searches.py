"""Searching runs with filters, and saved searches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.settings import Settings
from slamhive.domain.accounts import Viewer
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import check_name, plural
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.side_by_side import MixedProtocols, ProtocolUse
from slamhive.filters.binding import Search, read_search
from slamhive.filters.datasets import attributes_of
from slamhive.filters.fields import FieldKind, ParameterKind, Vocabulary, vocabulary_of
from slamhive.services.datasets import Catalogue, check_writable, imported_algorithms
from slamhive.store import Store, Transaction
from slamhive.store.records import Count, GroupPage, GroupRecord, Repeats, RunSort, SavedSearchRecord
from slamhive.store.run_listing import COUNTED

_KINDS = {
    ParameterType.INT: FieldKind.NUMBER,
    ParameterType.FLOAT: FieldKind.NUMBER,
    ParameterType.BOOL: FieldKind.FLAG,
    ParameterType.STRING: FieldKind.TEXT,
    ParameterType.ENUM: FieldKind.CHOICE,
    ParameterType.MATRIX: FieldKind.TEXT,
}


KEPT_FROM = 50_000
"""With more runs than this, counts of omitted runs are cached for some seconds."""

KEPT_S = 10.0
_Key = tuple[tuple[str, ...], str | None, Viewer | None]
_Having = tuple[int, dict[str, int]]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Runs that a search omits: of ``total`` runs, those without a metric that the search compares."""

    total: int
    without: dict[str, int]


class Searches:
    """Searches for pages, command line, API and analysis files, all in one filter language.

    Args:
        settings: In force.
        store: The database.
        catalogue: Algorithms, with their parameters and sensors.
        clock: Monotonic seconds.
    """

    def __init__(
        self, settings: Settings, store: Store, catalogue: Catalogue, clock: Callable[[], float] = monotonic_s
    ) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._clock = clock
        self._counts: dict[_Key, tuple[float, _Having]] = {}

    def metrics(self) -> list[str]:
        """The metrics for which any run has a value."""
        return self._store.read(lambda t: t.searches.metrics())

    def unevaluated(self) -> int:
        """Number of successful runs with no evaluation, neither done nor queued."""
        return self._store.read(lambda t: t.searches.unevaluated())

    def names(self) -> tuple[list[str], list[str]]:
        """The names of all stored algorithms and datasets; their folders may no longer exist."""
        return self._store.read(lambda t: t.searches.names())

    def vocabulary(self) -> Vocabulary:
        """The names that a filter may use: those of the catalogue and those of stored runs."""
        algorithms = self._catalogue.algorithms()
        sensors: dict[str, tuple[str, ...]] = {}
        for algorithm in (*algorithms, *imported_algorithms(self._store)):
            sensors[algorithm.setup.value] = (*sensors.get(algorithm.setup.value, ()), algorithm.name)
        packages = {algorithm.package.name: algorithm.parameters for algorithm in algorithms}
        defined = [kind for parameters in packages.values() for entry in parameters for kind in _kinds(entry)]
        stored, protocols = self._store.read(lambda t: (t.searches.parameters(), t.searches.protocols()))
        own_keys: dict[str, tuple[str, ...]] = {}
        for entry in (entry for parameters in packages.values() for entry in parameters if entry.general):
            name = str(entry.general)
            own_keys[name] = tuple(dict.fromkeys((*own_keys.get(name, ()), entry.key)))
        return vocabulary_of(
            [*defined, *stored],
            sensors=sensors,
            protocols=protocols,
            own_keys=own_keys,
            attributes=attributes_of(self._catalogue.datasets()),
            me=self._store.account,
        )

    def parameters(self) -> list[str]:
        """The parameters that configurations have, by key and by general name, and their variant options."""
        return [kind.name for kind in self._store.read(lambda t: t.searches.parameters())]

    def read(self, text: str) -> Search:
        """Parse a filter; raises FilterError with the position of the error."""
        return read_search(text, self.vocabulary())

    def find(self, text: str) -> list[int]:
        """The ids of all runs that match the filter ``text``, in order."""
        return self.run_ids(self.read(text))

    def run_ids(self, search: Search) -> list[int]:
        """The ids of all matching runs, in order."""
        return self._store.read(lambda t: t.searches.run_ids(search))

    def count(self, search: Search) -> Count:
        """The number of matching runs, exact as far as that is cheap."""
        return self._store.read(lambda t: t.searches.count(search))

    def exact_count(self, search: Search) -> int:
        """The exact number of matching runs, however long counting takes."""
        return self._store.read(lambda t: t.searches.exact_count(search))

    def left_out(self, search: Search, found: Count) -> LeftOut:
        """The number of runs, and how many have no value for each metric that ``search`` compares.

        ``found`` is the number of matching runs; without a filter it is the number of all runs.
        """
        if search.tree is None:
            return LeftOut(found.number, {})
        names = tuple(field.name for field in search.metrics)
        total, having = self._kept(
            (names, search.protocol, self._store.viewer),
            lambda: self._store.read(lambda t: (t.searches.total(), t.searches.with_metrics(search))),
        )
        return LeftOut(total, {key: total - number for key, number in having.items() if number < total})

    def _kept(self, key: _Key, count: Callable[[], _Having]) -> _Having:
        """The result of ``count``; with very many runs, one of the last few seconds is reused."""
        until_s, kept = self._counts.get(key, (0.0, (0, {})))
        if self._clock() < until_s:
            return kept
        found = count()
        if found[0] >= KEPT_FROM:
            now_s = self._clock()
            self._counts = {k: entry for k, entry in self._counts.items() if entry[0] > now_s}
            self._counts[key] = (now_s + KEPT_S, found)
        return found

    def groups(self, search: Search, sort: RunSort, after: str | None, limit: int, metrics: Sequence[str]) -> GroupPage:
        """The configurations of the matching runs, with mean and spread of ``metrics`` over the repeats."""
        return self._store.read(lambda t: t.searches.groups(search, sort, after, limit, metrics))

    def mixed(self, search: Search, shown: Iterable[ProtocolUse] | None, count: Count) -> MixedProtocols | None:
        """The protocols of the runs that match, if their errors are not comparable.

        Of very many runs, those that are ``shown`` decide, as they do if the search names a protocol. No more than
        :data:`COUNTED` ids are read. ``shown`` is None where all runs go into a file.
        """
        uses = None if shown is None else list(shown)
        few = search.protocol is None and count.exact and count.number <= COUNTED

        def work(t: Transaction) -> MixedProtocols | None:
            found = None if uses is None else t.evaluations.mixed(uses)
            if not few or (found is None and uses is not None):
                return found
            return t.evaluations.mixed_of(t.searches.run_ids(search)) or found

        return self._store.read(work)

    def repeats(self, search: Search, groups: Sequence[GroupRecord], metrics: Sequence[str]) -> Repeats:
        """The values behind the means of ``groups``, in order of the runs."""
        ids = [group.configuration_id for group in groups]
        return self._store.read(lambda t: t.searches.repeats(search, ids, metrics))

    def save(self, record: SavedSearchRecord) -> bool:
        """Save a search, replacing one of the same name; returns whether it is new. The filter must be valid."""
        check_writable(self._settings)
        check_name("saved search", record.name)
        self.read(record.filter_text)
        now = utc_now()
        return self._store.write(lambda t: t.searches.save(record, now))

    def saved(self) -> list[SavedSearchRecord]:
        """All saved searches, sorted by name."""
        return self._store.read(lambda t: t.searches.saved())

    def saved_named(self, name: str) -> SavedSearchRecord:
        """One saved search; raises NotFound."""
        return self._store.read(lambda t: t.searches.saved_named(name))

    def delete(self, name: str) -> None:
        """Delete a saved search; raises NotFound."""
        check_writable(self._settings)
        self._store.write(lambda t: t.searches.delete_saved(name))


def _kinds(parameter: Parameter) -> list[ParameterKind]:
    """The parameter under its key and under its general name."""
    names = dict.fromkeys((parameter.key, parameter.general or parameter.key))
    kind = _KINDS[parameter.type]
    return [ParameterKind(name, kind, parameter.unit, parameter.choices) for name in names]


# Sentences about a list of runs.


def summary(
    shown: int, count: Count, words: str, left_out: LeftOut, *, grouped: bool = False, further: bool = False
) -> str:
    """``Showing 2 of 12 runs: state failed, newest first. Left out: ...``.

    Args:
        shown: Number of runs on the page, or of configurations if ``grouped``.
        count: Number of matching runs.
        words: Search and order as the end of a sentence.
        left_out: The runs that do not match.
        grouped: Whether configurations are shown.
        further: Whether the page is not the first.
    """
    if left_out.total == 0:
        return "No runs yet."
    what = f"{plural(shown, 'configuration')} with" if grouped else f"{shown:,} of"
    text = f"Showing {'the next ' if further else ''}{what} {counted(count)}: {words}."
    if count.exact and count.number == 0:
        text = f"No run matches: {words}."
    if count.number < left_out.total:
        rest = left_out.total - count.number
        most = "" if count.exact else "at most "
        text += f" Left out: {most}{plural(rest, 'run')} that the filter does not match."
    for key, number in left_out.without.items():
        text += f" {plural(number, 'run')} {'has' if number == 1 else 'have'} no {CATALOGUE[key].label}."
    return text


def counted(count: Count) -> str:
    """``12 runs``, ``more than 10,000 runs``."""
    return plural(count.number, "run") if count.exact else f"more than {plural(count.number, 'run')}"


def runs_text(group: GroupRecord) -> str:
    """``5``, or ``1 of 5`` where the search omits runs of the configuration."""
    shown = f"{group.runs:,}"
    return shown if group.runs == group.all_runs else f"{shown} of {group.all_runs:,}"


def order_in_words(sort: RunSort, title: str, *, numeric: bool) -> str:
    """``newest first``, ``sorted by ATE RMSE, smallest first``; ``title`` is the title of the sort column."""
    if sort.key in {"id", "configuration"}:
        return "newest first" if sort.descending else "oldest first"
    way = ("largest first", "smallest first") if numeric else ("Z to A", "A to Z")
    if sort.key.endswith("_at"):
        way = ("latest first", "earliest first")
    return f"sorted by {title}, {way[0] if sort.descending else way[1]}"
