"""``slamhive runs --where`` as tables and files, and ``slamhive search``: saved searches."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say, write_out
from slamhive.domain.finding import MOST_PINNED
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import mean_and_std
from slamhive.domain.side_by_side import ProtocolUse
from slamhive.filters.binding import Search, bind, means_of, read_search
from slamhive.filters.parser import parse_filter
from slamhive.filters.syntax import FilterComparison, Sign, Word, filter_text, join
from slamhive.filters.words import in_words
from slamhive.services.exports import RUNS_AT_ONCE, GroupExport, Record, RunExport, TableExport, by_protocol
from slamhive.services.searches import order_in_words, runs_text, summary
from slamhive.store import Count, RunSort
from slamhive.store.records import GroupRecord, SavedSearchRecord, group_uses
from slamhive.store.run_cells import RunCells

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

Fetch: TypeAlias = Callable[[str | None, int], tuple[Sequence[Record], str | None]]
"""At most so many records after a key, and the key of the next page."""

PAGE = 1000
GROUP_HEAD = ("configuration", "algorithm", "dataset", "runs", "failed", "disturbed", "protocol")
GROUP_METRICS = ("ate.rmse", "rpe.rmse", "tracked_fraction", "cpu.mean", "ram.max")
FILE_COLUMNS = ("id", "algorithm", "dataset", "configuration", "state", "reason", *GROUP_METRICS)
WORDS = ("algorithm", "dataset", "experiment", "executor", "state", "reason")
"""What is sorted from A to Z."""


def search_of(hive: Hive, where: str, lists: dict[str, Sequence[str]]) -> Search:
    """The filter and the restrictions of other options, joined by "and"."""
    if not where.strip() and not any(lists.values()):
        return Search()
    vocabulary = hive.searches.vocabulary()
    typed = parse_filter(where)
    bind(typed, where, vocabulary)  # so that a message points into the text that was typed
    chosen = [
        FilterComparison(Word(name), Sign.IN, tuple(map(Word, values))) for name, values in lists.items() if values
    ]
    parts = [*([] if typed is None else [typed]), *chosen]
    return read_search(filter_text(join("and", parts)), vocabulary) if parts else Search()


class Pages(Generic[Record]):
    """The pages of a list, for an export; at most ``limit`` records, ``at_once`` in a page."""

    def __init__(self, fetch: Fetch[Record], limit: int | None, at_once: int = PAGE) -> None:
        self._fetch = fetch
        self._left = limit
        self._at_once = at_once

    def __call__(self, after: str | None) -> tuple[Sequence[Record], str | None]:
        """The page after a key, and the key of the next."""
        size = self._at_once if self._left is None else min(self._at_once, self._left)
        records, next_key = self._fetch(after, size)
        if self._left is not None:
            self._left -= len(records)
        return records, None if self._left == 0 else next_key


@dataclass(frozen=True)
class Listing:
    """A request to ``slamhive runs``; ``limit`` None means the default of the form of showing."""

    hive: Hive
    search: Search
    sort: RunSort
    columns: tuple[str, ...]
    limit: int | None

    @property
    def size(self) -> int:
        """The number of rows of a table."""
        return min(self.limit or 50, PAGE)

    @property
    def metrics(self) -> list[str]:
        """The metrics that groups show."""
        return [key for key in self.columns if key in CATALOGUE] or list(GROUP_METRICS)

    def runs(self) -> tuple[RunExport, Pages[RunCells]]:
        """All runs, for a file."""
        export = RunExport(self.columns or FILE_COLUMNS, self.hive.searches.vocabulary())
        fetch = self.hive.stored_runs.cells(self.search, self.sort, export.wanted)
        return export, Pages(fetch, self.limit, RUNS_AT_ONCE)

    def groups(self) -> tuple[GroupExport, Pages[GroupRecord]]:
        """Their configurations, for a file."""

        def fetch(after: str | None, size: int) -> tuple[Sequence[GroupRecord], str | None]:
            page = self.hive.searches.groups(self.search, self.sort, after, size, self.metrics)
            return page.records, page.next_key

        return GroupExport(self.metrics), Pages(fetch, self.limit)

    def in_words(self, *, grouped: bool = False) -> str:
        """Search and order as the end of a sentence."""
        key = self.sort.key
        title = CATALOGUE[key].label if key in CATALOGUE else key
        order = order_in_words(self.sort, title, numeric=key not in WORDS)
        search = means_of(self.search) if grouped else self.search
        return ", ".join(part for part in (in_words(search), order) if part)

    def tell_mixed(self, shown: Iterable[ProtocolUse] | None, count: Count) -> None:
        """Say on stderr if the errors of the runs are not comparable, and what makes them so."""
        mixed = self.hive.searches.mixed(self.search, shown, count)
        if mixed is not None:
            tell(mixed.sentences, style="yellow")

    def summary(self, shown: int, count: Count, *, grouped: bool = False) -> str:
        """Say what is shown, how many, and what is left out."""
        left_out = self.hive.searches.left_out(self.search, count)
        return summary(shown, count, self.in_words(grouped=grouped), left_out, grouped=grouped)


def print_export(content: TableExport[Record], pages: Pages[Record], *, kind: str) -> None:
    """The rows on stdout as ``csv`` or ``json``."""
    for piece in content.csv(pages) if kind == "csv" else content.json(pages):
        write_out(piece)


def write_parquet(content: TableExport[Record], pages: Pages[Record], path: Path) -> int:
    """The rows as a Parquet file, which appears when it is whole; how many they are."""
    if not path.parent.is_dir():
        raise InvalidInput(f"the folder {path.parent} does not exist", "make it, or name another file")
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        written = content.parquet(pages, aside)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
    return written


def print_groups(listing: Listing) -> None:
    """Configurations with mean and spread over their repeats, and a sentence on what is shown."""
    metrics = listing.metrics
    page = listing.hive.searches.groups(listing.search, listing.sort, None, listing.size, metrics)
    rows = [
        (
            *(group.configuration_id, group.algorithm, group.dataset, runs_text(group), group.failed, group.disturbed),
            None if label is None else label.fingerprint,
            *(None if (found := figures.get(key)) is None else mean_and_std(found.mean, found.std) for key in metrics),
        )
        for group in page.records
        for label, figures in by_protocol(group)
    ]
    if rows:
        print_table((*GROUP_HEAD, *metrics), rows, right=("configuration", "runs", "failed", "disturbed", *metrics))
    listing.tell_mixed(group_uses(page.records), page.runs)
    tell(listing.summary(len(page.records), page.runs, grouped=True))


@click.group("search")
def search_group() -> None:
    """Save a filter with columns and an order under a name."""


@search_group.command("save")
@click.argument("name")
@click.argument("where", default="")
@click.option("--columns", default="", help="Keys of columns, metrics and parameters, with commas.")
@click.option("--sort", default="id", show_default=True, help="Column, metric or parameter.")
@click.option("--ascending", is_flag=True, help="Smallest first.")
@click.option("--group", is_flag=True, help="Group by configuration, with mean and spread.")
@click.option("--pinned", type=click.IntRange(0, MOST_PINNED), default=0, help="On pages, columns that stay in view.")
@click.option("--colours", is_flag=True, help="On pages, colour metrics by their value.")
@click.option("--sparks", is_flag=True, help="On pages, draw the error of each run over time.")
@pass_cli
def save(cli: CliContext, /, name: str, where: str, **options: Any) -> None:
    """Save the filter WHERE as NAME, replacing a search of that name."""
    hive = cli.hive()
    chosen = tuple(split_columns(options["columns"]))
    RunExport(chosen, hive.searches.vocabulary())
    record = SavedSearchRecord(
        name,
        where,
        chosen,
        RunSort(options["sort"], not options["ascending"]),
        options["group"],
        options["pinned"],
        options["colours"],
        options["sparks"],
    )
    say(f"search {name} {'saved' if hive.searches.save(record) else 'replaced'}")


@search_group.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List saved searches."""
    saved = cli.hive().searches.saved()
    if as_json:
        from slamhive.documents.api import (  # noqa: PLC0415 - lists of runs need none of these models
            SavedSearchDocument,
        )

        print_json([SavedSearchDocument.of(entry).content for entry in saved])
        return
    rows = [(entry.name, entry.filter_text or "all runs", entry.sort.key, ", ".join(entry.columns)) for entry in saved]
    print_table(("name", "where", "sort", "columns"), rows)


@search_group.command("delete")
@click.argument("name", shell_complete=completion.SEARCH)
@pass_cli
def delete(cli: CliContext, name: str) -> None:
    """Delete the saved search NAME."""
    cli.hive().searches.delete(name)
    say(f"search {name} deleted")


def split_columns(text: str) -> list[str]:
    """``a, b`` as keys."""
    return [part.strip() for part in text.split(",") if part.strip()]


# ``slamhive find``: one search over everything that has a name.


@click.command()
@click.argument("words", nargs=-1, required=True)
@json_option
@pass_cli
def find(cli: CliContext, words: tuple[str, ...], as_json: bool) -> None:
    """Find WORDS in names and descriptions of algorithms, datasets, experiments, analyses, searches and metrics.

    A number is also a run; a tag or a filter also finds the runs that it fits. Of each kind the best 8 are shown.
    """
    # Lists of runs import this module, and need nothing of what a search over everything reads.
    from slamhive.documents.catalogue import FoundThing  # noqa: PLC0415
    from slamhive.services.finding import find as find_everything  # noqa: PLC0415

    groups = find_everything(cli.hive(), " ".join(words))
    found = [entry for entries in groups.values() for entry in entries]
    if as_json:
        print_json([FoundThing.of(entry).content for entry in found])
    elif found:
        print_table(("what", "name", "description"), [(entry.kind.value, entry.name, entry.words) for entry in found])
    else:
        tell(f"nothing found for {' '.join(words)!r}")


COMMANDS = (
    search_group,
    find,
)
