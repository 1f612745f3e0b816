"""``slamhive runs --where`` as tables and files, and ``slamhive search``: saved searches."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table
from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import InvalidInput
from slamhive.search.binding import Search, bind, read_search
from slamhive.search.grammar import join
from slamhive.search.syntax import Comparison, Sign, Word, filter_text, parse_filter
from slamhive.services.hive import Hive
from slamhive.services.run_export import RunExport
from slamhive.store import Count, RunRecord, RunSort
from slamhive.store.records import ProtocolLabel, SavedSearchRecord, Spread

PAGE = 1000
GROUP_HEAD = ("configuration", "algorithm", "dataset", "runs", "failed", "protocol")
GROUP_METRICS = ("ate.rmse", "rpe.rmse", "tracked_fraction", "cpu.mean", "ram.max")


def search_of(hive: Hive, where: str, lists: dict[str, Sequence[str]]) -> Search:
    """The filter, and what further options restrict, joined by "and"."""
    vocabulary = hive.searches.vocabulary()
    typed = parse_filter(where)
    bind(typed, where, vocabulary)  # a mistake is told in the text that was typed
    chosen = [Comparison(Word(name), Sign.IN, tuple(map(Word, values))) for name, values in lists.items() if values]
    parts = [*([] if typed is None else [typed]), *chosen]
    return read_search(filter_text(join("and", parts)), vocabulary) if parts else Search()


def counted(count: Count) -> str:
    """``12 runs``, ``more than 2,000 runs``."""
    return f"{count.number:,} runs" if count.exact else f"more than {count.number:,} runs"


class Pages:
    """The pages of a search, for an export; at most ``limit`` runs."""

    def __init__(self, hive: Hive, search: Search, sort: RunSort, limit: int | None) -> None:
        self._hive = hive
        self._search = search
        self._sort = sort
        self._left = limit

    def __call__(self, after: str | None) -> tuple[Sequence[RunRecord], str | None]:
        """The page after a key, and the key of the next."""
        size = PAGE if self._left is None else min(PAGE, self._left)
        page = self._hive.runs(self._search, self._sort, after, size)
        if self._left is not None:
            self._left -= len(page.records)
        return page.records, None if self._left == 0 else page.next_key


def print_export(hive: Hive, columns: Sequence[str], pages: Pages, *, kind: str) -> None:
    """The runs on stdout as ``csv`` or ``json``."""
    content = RunExport(columns, hive.searches.vocabulary())
    for piece in content.csv(pages) if kind == "csv" else content.json(pages):
        click.echo(piece, nl=False)


def write_parquet(hive: Hive, columns: Sequence[str], pages: Pages, path: Path) -> None:
    """The runs as a Parquet file, which appears when it is whole."""
    if not path.parent.is_dir():
        raise InvalidInput(f"the folder {path.parent} does not exist", "make it, or name another file")
    content = RunExport(columns, hive.searches.vocabulary())
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        content.parquet(pages, aside)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def print_groups(
    hive: Hive, search: Search, sort: RunSort, limit: int, columns: Sequence[str], *, as_json: bool
) -> None:
    """Configurations with mean and spread over their repeats."""
    metrics = [key for key in columns if key in CATALOGUE] or list(GROUP_METRICS)
    page = hive.searches.groups(search, sort, None, limit, metrics)
    rows = []
    for group in page.records:
        measured = group.figures.get(None, {})
        labels: list[ProtocolLabel | None] = [*(label for label in group.figures if label is not None)]
        for label in labels or [None]:
            figures = {**measured, **({} if label is None else group.figures[label])}
            head = (group.configuration_id, group.algorithm, group.dataset, group.runs, group.failed)
            rows.append((*head, None if label is None else label.fingerprint, figures))
    if as_json:
        print_json(
            [
                {**dict(zip(GROUP_HEAD, row[:6], strict=True)), "figures": {k: _spread(v) for k, v in row[6].items()}}
                for row in rows
            ]
        )
        return
    cells = [(*row[:6], *(_spread_text(row[6].get(key)) for key in metrics)) for row in rows]
    print_table((*GROUP_HEAD, *metrics), cells, right=("configuration", "runs", "failed", *metrics))


def _spread(spread: Spread) -> dict[str, float | int | None]:
    return {"n": spread.n, "mean": spread.mean, "std": spread.std, "min": spread.minimum, "max": spread.maximum}


def _spread_text(spread: Spread | None) -> str | None:
    if spread is None:
        return None
    return f"{spread.mean:.4g}" if spread.std is None else f"{spread.mean:.4g} ± {spread.std:.2g}"


@click.group("search")
def search_group() -> None:
    """Saved searches: a filter, columns and an order under a name."""


@search_group.command("save")
@click.argument("name")
@click.argument("where", default="")
@click.option("--columns", default="", help="Keys of columns, metrics and parameters, with commas.")
@click.option("--sort", default="id", show_default=True, help="Column, metric or parameter.")
@click.option("--ascending", is_flag=True, help="Smallest first.")
@click.option("--group", is_flag=True, help="Show configurations with mean and spread.")
@pass_cli
def save(cli: CliContext, /, name: str, where: str, **options: Any) -> None:
    """Save the filter WHERE as NAME; what has the name is replaced."""
    hive = cli.hive()
    chosen = tuple(split_columns(options["columns"]))
    RunExport(chosen, hive.searches.vocabulary())
    record = SavedSearchRecord(
        name, where, chosen, RunSort(options["sort"], not options["ascending"]), options["group"]
    )
    click.echo(f"search {name} {'saved' if hive.searches.save(record) else 'replaced'}")


@search_group.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List saved searches."""
    saved = cli.hive().searches.saved()
    if as_json:
        print_json(
            [
                {"name": entry.name, "where": entry.filter_text, "columns": list(entry.columns), "sort": entry.sort.key,
                 "descending": entry.sort.descending, "group": entry.grouped}
                for entry in saved
            ]
        )  # fmt: skip
        return
    rows = [(entry.name, entry.filter_text or "all runs", entry.sort.key, ", ".join(entry.columns)) for entry in saved]
    print_table(("name", "where", "sort", "columns"), rows)


@search_group.command("delete")
@click.argument("name")
@pass_cli
def delete(cli: CliContext, name: str) -> None:
    """Delete the saved search NAME."""
    cli.hive().searches.delete(name)
    click.echo(f"search {name} deleted")


def split_columns(text: str) -> list[str]:
    """``a, b`` as keys."""
    return [part.strip() for part in text.split(",") if part.strip()]


COMMANDS = (search_group,)
