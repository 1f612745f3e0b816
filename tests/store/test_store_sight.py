"""What a viewer may see: every answer is that of a database without the hidden runs."""

from __future__ import annotations

import re
from typing import Any

import pytest
from sqlalchemy import event

from slamhive.base.errors import NotFound
from slamhive.domain.accounts import ANYBODY, Sharing, Viewer, Visibility
from slamhive.domain.run import RunNotes, RunState
from slamhive.filters.binding import EVERYTHING, Search, read_search
from slamhive.store import Store, Transaction, run_listing
from slamhive.store.records import Count, RunRecord, RunSort
from slamhive.store.sight import OF_EXPERIMENTS, OF_RUNS, SEEN
from slamhive.store.tables import TableBase
from tests.store.search_world import VOCABULARY, fill
from tests.store.store_samples import Samples

pytestmark = pytest.mark.integration

ANNA, BEN, READER = (Viewer(name, signed_in=True) for name in ("anna", "ben", "rita"))
SHARINGS = (
    Sharing("anna", Visibility.PRIVATE),
    Sharing("ben", Visibility.PRIVATE),
    Sharing("anna", Visibility.TEAM),
    Sharing("anna", Visibility.PUBLIC),
    Sharing(None, Visibility.PRIVATE),
    Sharing(None, None),
)
FILTERS = (
    "",
    "ate.rmse < 0.2",
    "cpu.mean > 1 and state = succeeded",
    "not (state = failed)",
    "has tag",
    "nFeatures >= 2000",
)
ORDERS = (
    ("id", True),
    ("owner", False),
    ("experiment", True),
    ("algorithm", False),
    ("ate.rmse", True),
    ("nFeatures", False),
)
"""One of each way to sort."""
OF_NO_RUN = {
    *("algorithms", "algorithm_versions", "datasets", "parameters", "configurations", "configuration_values"),
    *("configuration_labels", "configuration_groups", "variant_options", "hosts", "protocols", "metrics"),
    *("saved_searches", "accounts", "account_keys", "account_identities", "audit_lines", "audit_log"),
    "deleted_runs",  # uids, which nobody can guess; pages list the folders of the trash
}


@pytest.fixture
def shared(store: Store) -> dict[int, Sharing]:
    """Runs that differ in everything, of several owners; {run: owner and visibility}."""
    runs = [known.id for known in fill(store, 30)]
    found = {run: SHARINGS[place % len(SHARINGS)] for place, run in enumerate(runs)}
    store.write(lambda t: t.sharing.share_runs(found))
    store.write(lambda t: t.notes.put({run: RunNotes("secret", (f"tag{run}",)) for run in runs}))
    return found


def expected(shared: dict[int, Sharing], viewer: Viewer | None) -> set[int]:
    """The runs that a viewer sees, said in another way than the code does."""

    def sees(sharing: Sharing) -> bool:
        if viewer is None or sharing.visibility is Visibility.PUBLIC:
            return True
        if sharing.visibility is Visibility.PRIVATE:
            return viewer.account != "" and sharing.owner == viewer.account
        return viewer.signed_in

    return {run for run, sharing in shared.items() if sees(sharing)}


def search(text: str) -> Search:
    return read_search(text, VOCABULARY) if text else EVERYTHING


def all_pages(store: Store, wanted: Search, sort: RunSort) -> tuple[list[RunRecord], list[Count]]:
    """All runs of a list, and the totals of its pages."""
    records: list[RunRecord] = []
    totals, after = [], None
    while True:
        page = store.read(lambda t: t.runs.page(wanted, sort, after, 20, with_metrics=True))  # noqa: B023
        records += page.records
        totals.append(page.count)
        if page.next_key is None:
            return records, totals
        after = page.next_key


@pytest.mark.parametrize("counted", [2, 1000])
@pytest.mark.parametrize("viewer", [ANNA, BEN, READER, ANYBODY, None], ids=["anna", "ben", "reader", "anybody", "all"])
def test_lists_and_counts_hold_what_the_viewer_sees(
    store: Store, shared: dict[int, Sharing], viewer: Viewer | None, counted: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_listing, "COUNTED", counted)  # few matches are collected, many are walked along
    seen = expected(shared, viewer)
    everything = {text: set(store.read(lambda t: t.searches.run_ids(search(text)))) for text in FILTERS if text}  # noqa: B023
    assert seen
    assert any(everything.values())
    with store.seen_by(viewer):
        for text in FILTERS:
            wanted = everything[text] & seen if text else seen
            for key, descending in ORDERS:
                records, totals = all_pages(store, search(text), RunSort(key, descending))
                assert {record.id for record in records} == wanted, (text, key)
                assert len(records) == len(wanted)
                assert {total for total, exact in totals if exact} <= {len(wanted)}
            if text:
                assert set(store.read(lambda t: t.searches.run_ids(search(text)))) == wanted  # noqa: B023
                assert store.read(lambda t: t.searches.exact_count(search(text))) == len(wanted)  # noqa: B023
        assert sum(store.read(lambda t: t.runs.counts_by_state()).values()) == len(seen)
        assert store.read(lambda t: t.searches.total()) == len(seen)
        assert set(store.read(lambda t: t.notes.tags())) == {f"tag{run}" for run in seen}
        table = store.read(lambda t: t.run_table.facts(sorted(shared)))
        assert set(table["run_id"]) == seen
        every = store.read(lambda t: t.run_table.every_protocol(["ate.rmse"], sorted(shared)))
        assert {value.run_id for value in every} <= seen
        groups = store.read(lambda t: t.searches.groups(search("seed >= 0"), RunSort("runs"), None, 1000, ["ate.rmse"]))
        assert sum(group.runs for group in groups.records) == len(seen)


@pytest.mark.parametrize("viewer", [ANNA, READER, ANYBODY], ids=["anna", "reader", "anybody"])
def test_a_hidden_run_is_as_one_that_does_not_exist(store: Store, shared: dict[int, Sharing], viewer: Viewer) -> None:
    hidden = sorted(shared.keys() - expected(shared, viewer))
    nowhere = max(shared) + 1
    with store.seen_by(viewer):
        for run in hidden:
            for ask in (_get, _cancel):
                answers = []
                for number in (run, nowhere):
                    with pytest.raises(NotFound) as refused:
                        ask(store, number)
                    answers.append(str(refused.value).replace(str(number), "N"))
                assert answers[0] == answers[1]
            assert store.read(lambda t: t.runs.events(run)) == []  # noqa: B023
            assert not store.read(lambda t: t.evaluations.for_run(run))  # noqa: B023
            assert store.read(lambda t: t.metrics.for_runs([run])) in ({}, {run: {}})  # noqa: B023
            assert store.read(lambda t: t.notes.for_runs([run])) == {}  # noqa: B023


def _get(store: Store, run: int) -> None:
    store.read(lambda t: t.runs.get(run))


def _cancel(store: Store, run: int) -> None:
    store.write(lambda t: t.runs.request_cancel(run, t.lease("x", 1).now))


def test_viewers_share_statements_but_no_values(store: Store, shared: dict[int, Sharing]) -> None:
    def ids(viewer: Viewer | None) -> set[int]:
        with store.seen_by(viewer), store.snapshot():
            return {record.id for record in store.read(lambda t: t.runs.page(limit=1000)).records}

    for viewer in (ANNA, BEN, None, READER, ANYBODY, ANNA, None, BEN):
        assert ids(viewer) == expected(shared, viewer)


def test_where_nothing_is_hidden_nothing_is_added(store: Store) -> None:
    fill(store, 5)
    statements: list[str] = []

    def note(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        statements.append(statement)

    event.listen(store.engine, "before_cursor_execute", note)
    try:
        with store.seen_by(READER):
            assert len(store.read(lambda t: t.runs.page()).records) == 5
    finally:
        event.remove(store.engine, "before_cursor_execute", note)
    assert not any(re.search(r"coalesce\(\w+\.audience", text) for text in statements)
    assert any("audience" in text for text in statements)


def test_each_table_has_a_rule() -> None:
    """A new table either follows runs or experiments, or somebody has decided that it says nothing of them."""
    assert set(TableBase.metadata.tables) - {*SEEN, *OF_RUNS, *OF_EXPERIMENTS} <= OF_NO_RUN


def test_runs_follow_their_experiment(store: Store, samples: Samples, experiment: int) -> None:
    run, narrow = samples.queued(2, experiment_id=experiment)
    store.write(lambda t: t.sharing.share_runs({narrow: Sharing("anna", Visibility.PRIVATE)}))

    def audiences(sharing: Sharing) -> list[str]:
        def work(t: Transaction) -> list[str]:
            t.sharing.share_experiment(experiment, sharing)
            return [t.runs.get(number).audience for number in (run, narrow)]

        return store.write(work)

    assert audiences(Sharing("anna", Visibility.PUBLIC)) == ["public", "private:anna"]
    assert audiences(Sharing("anna", Visibility.PRIVATE)) == ["private:anna", "private:anna"]
    assert audiences(Sharing("anna", None)) == ["team", "private:anna"]
    assert store.read(lambda t: t.runs.get(run)).state is RunState.QUEUED
