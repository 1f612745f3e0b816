"""One search over everything that has a name: algorithms, datasets, experiments, runs, analyses, metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from slamhive.domain.finding import MOST_OF_A_KIND, Found, FoundKind, best
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.numbers import plural
from slamhive.errors import SlamHiveError
from slamhive.search.binding import read_search
from slamhive.store import ConfigurationFilter

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

LONGEST_TEXT = 200


def find(hive: Hive, text: str) -> Mapping[FoundKind, tuple[Found, ...]]:
    """What ``text`` may mean, by kind; kinds without anything are left out. Only the first 200 characters count."""
    text = text.strip()[:LONGEST_TEXT]
    if not text:
        return {}
    named = {FoundKind.RUN: tuple(_numbered(hive, text)), FoundKind.RUNS: tuple(_matching(hive, text))}
    named |= {
        FoundKind.EXPERIMENT: best(text, _experiments(hive)),
        FoundKind.ALGORITHM: best(text, _algorithms(hive)),
        FoundKind.DATASET: best(text, _datasets(hive)),
        FoundKind.CONFIGURATION: tuple(_configurations(hive, text)),
        FoundKind.ANALYSIS: best(text, _analyses(hive)),
        FoundKind.SEARCH: best(text, _searches(hive)),
        FoundKind.METRIC: best(text, _metrics()),
    }
    return {kind: entries for kind, entries in named.items() if entries}


def _numbered(hive: Hive, text: str) -> Iterator[Found]:
    """The run with this number."""
    number = text.removeprefix("run").strip()
    if not (number.isascii() and number.isdigit() and len(number) < 16):
        return
    try:
        run = hive.stored_runs.get(int(number))
    except SlamHiveError:
        return
    yield Found(FoundKind.RUN, str(run.id), f"Run {run.id}", f"{run.algorithm} on {run.dataset}, {run.state.value}")


def _matching(hive: Hive, text: str) -> Iterator[Found]:
    """The text as a filter of runs, and as a tag."""
    vocabulary = hive.searches.vocabulary()
    for filter_text in (text, f"tag = {text}"):
        try:
            wanted = read_search(filter_text, vocabulary)
        except SlamHiveError:
            continue
        count = hive.stored_runs.page(wanted, limit=1).count.number
        if wanted.tree is not None and count:
            yield Found(FoundKind.RUNS, filter_text, filter_text, plural(count, "run"))


def _experiments(hive: Hive) -> Iterator[Found]:
    for entry in hive.experiments.list():
        yield Found(FoundKind.EXPERIMENT, entry.name, entry.name, entry.description)


def _algorithms(hive: Hive) -> Iterator[Found]:
    for entry in hive.catalogue.algorithms():
        yield Found(FoundKind.ALGORITHM, entry.name, entry.name, entry.title)


def _datasets(hive: Hive) -> Iterator[Found]:
    for entry in hive.catalogue.datasets():
        words = (entry.title, *entry.attributes)
        yield Found(FoundKind.DATASET, entry.name, entry.name, ", ".join(word for word in words if word))


def _configurations(hive: Hive, text: str) -> Iterator[Found]:
    for entry in hive.configurations.page(ConfigurationFilter(text=text), limit=MOST_OF_A_KIND).records:
        name = entry.name or f"Configuration {entry.id}"
        words = f"{entry.configuration.algorithm} on {entry.configuration.dataset}"
        yield Found(FoundKind.CONFIGURATION, str(entry.id), name, words)


def _analyses(hive: Hive) -> Iterator[Found]:
    for entry in hive.stored_analyses.listed():
        yield Found(FoundKind.ANALYSIS, entry.token, entry.name, entry.state.value)


def _searches(hive: Hive) -> Iterator[Found]:
    for entry in hive.searches.saved():
        yield Found(FoundKind.SEARCH, entry.name, entry.name, entry.filter_text)


def _metrics() -> Iterator[Found]:
    for key, metric in CATALOGUE.items():
        yield Found(FoundKind.METRIC, key, key, f"{metric.label}: {metric.definition}")
