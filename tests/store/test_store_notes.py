"""Filters by tag and note, on both kinds of database."""

from __future__ import annotations

import pytest

from slamhive.domain.run import RunNotes, RunState
from slamhive.filters.binding import read_search
from slamhive.filters.fields import FieldKind, ParameterKind, Source, Vocabulary, vocabulary_of
from slamhive.store import RunSort, Store
from tests.store.store_samples import Samples

pytestmark = pytest.mark.quick


@pytest.fixture
def noted(store: Store, samples: Samples) -> list[int]:
    """Runs 1 to 4: two tags and a note, one tag, a note, nothing."""
    runs = [samples.run_in(RunState.SUCCEEDED) for _ in range(4)]
    notes = [RunNotes("an Outlier", ("draft", "paper")), RunNotes("", ("paper",)), RunNotes("fine"), RunNotes()]
    store.write(lambda tx: tx.notes.put(dict(zip(runs, notes, strict=True))))
    found = store.read(lambda tx: tx.runs.get_many(runs))
    assert [run.notes for run in found] == notes
    return runs


@pytest.mark.parametrize(
    ("where", "places"),
    [
        ("tag = paper", {0, 1}),
        ("tag = Paper", set()),
        ("tag in (paper, draft)", {0, 1}),
        ("tag ~ d*", {0}),
        ("has tag", {0, 1}),
        ("missing tag", {2, 3}),
        ("tag != draft", {1, 2, 3}),
        ("tag not in (draft, x)", {1, 2, 3}),
        ("tag !~ p*", {2, 3}),
        ("tag = paper and tag != draft", {1}),
        ("not tag = paper and state = succeeded", {2, 3}),
        ("tag = draft or note = fine", {0, 2}),
        ("note ~ *Out*", {0}),
        ("has note", {0, 2}),
        ("note != fine", {0, 1, 3}),
    ],
)
def test_filters_find_what_people_wrote(store: Store, noted: list[int], where: str, places: set[int]) -> None:
    search = read_search(where, Vocabulary())
    page = store.read(lambda tx: tx.runs.page(search, RunSort(), limit=100))
    assert {run.id for run in page.records} == {noted[place] for place in places}
    assert store.read(lambda tx: tx.searches.exact_count(search)) == page.count.number == len(places)
    assert store.read(lambda tx: tx.searches.run_ids(search)) == sorted(noted[place] for place in places)


def test_notes_are_replaced_as_a_whole(store: Store, noted: list[int]) -> None:
    store.write(lambda tx: tx.notes.put({noted[0]: RunNotes("", ("paper",)), noted[1]: RunNotes()}))
    found = store.read(lambda tx: tx.notes.for_runs(noted))
    assert found == {noted[0]: RunNotes("", ("paper",)), noted[2]: RunNotes("fine")}
    assert store.read(lambda tx: tx.notes.tags()) == ["paper"]


def test_a_parameter_called_note_keeps_its_name() -> None:
    vocabulary = vocabulary_of([ParameterKind("note", FieldKind.TEXT)])
    assert [field.source for field in vocabulary.fields("note")] == [Source.PARAMETER, Source.NOTE]
