"""Search over everything that has a name, and requests to change all runs that a search finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.api import FoundEvaluation, FoundRuns, FoundSharing, FoundTags
from slamhive.domain.finding import MOST_OF_A_KIND, Found, FoundAction, FoundKind, best
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import plural
from slamhive.domain.run import NotesChange
from slamhive.filters.binding import read_search
from slamhive.services.sharing import SharingChange
from slamhive.store import ConfigurationFilter

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.services.search_actions import Acted

LONGEST_TEXT = 200


def find(hive: Hive, text: str) -> Mapping[FoundKind, tuple[Found, ...]]:
    """List the possible meanings of ``text`` by kind, without empty kinds. Only the first 200 characters count."""
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


# Requests to change all runs of a search, of the web API and of the Python client.

if TYPE_CHECKING:
    Carry = Callable[[Hive, Sequence[int], Any], Acted]


def _evaluate(hive: Hive, run_ids: Sequence[int], body: FoundEvaluation) -> Acted:
    protocol = None if body.protocol is None else hive.protocols.named(body.protocol)
    return hive.search_actions.evaluate(run_ids, protocol)


def _retry(hive: Hive, run_ids: Sequence[int], _body: FoundRuns) -> Acted:
    return hive.search_actions.retry(run_ids)


def _tag(hive: Hive, run_ids: Sequence[int], body: FoundTags) -> Acted:
    if not body.add and not body.remove:
        raise InvalidInput("no tag is named", "name tags to add, or to remove")
    return hive.search_actions.tag(run_ids, NotesChange(add=body.add, remove=body.remove))


def _share(hive: Hive, run_ids: Sequence[int], body: FoundSharing) -> Acted:
    return hive.search_actions.share(run_ids, SharingChange(body.visibility))


def _delete(hive: Hive, run_ids: Sequence[int], _body: FoundRuns) -> Acted:
    return hive.search_actions.delete(run_ids)


ACTIONS: Mapping[FoundAction, tuple[type[FoundRuns], Carry]] = MappingProxyType(
    {
        FoundAction.EVALUATE: (FoundEvaluation, _evaluate),
        FoundAction.RETRY: (FoundRuns, _retry),
        FoundAction.TAGS: (FoundTags, _tag),
        FoundAction.SHARE: (FoundSharing, _share),
        FoundAction.DELETE: (FoundRuns, _delete),
    }
)
"""What a request says, and what carries it out."""


def change_found(hive: Hive, action: FoundAction, run_ids: Sequence[int], body: FoundRuns) -> Acted:
    """Carry out the action for these runs. Raises InvalidInput or NotFound naming the value, Forbidden."""
    hive.check_writable()
    _, carry = ACTIONS[action]
    return carry(hive, run_ids, body)
