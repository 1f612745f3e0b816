"""Runs in the trash: gone from everything, back as they were, and never queued again behind somebody's back."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound
from slamhive.base.settings import Mode
from slamhive.documents.submission import Submission
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.run import NotesChange, RunState
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.services.runs import begin_record
from tests.services.database_dump import differences, dump
from tests.services.test_reindex import ALGORITHM, HOST

pytestmark = pytest.mark.integration

ENDED = datetime(2026, 5, 4, tzinfo=UTC).isoformat()
EXPERIMENT = "name: e\nalgorithms: tiny\ndatasets: track\nparameters: {seconds: 1 | 2}\nevaluate: false\n"


def end(hive: Hive, *run_ids: int) -> None:
    """As if a worker had executed these runs."""
    for run_id in run_ids:
        folder = hive.runs.folder(run_id)
        folder.create()
        ended = {"state": "succeeded", "ended_at": ENDED, "events": [], "metrics": {"duration": 1.5, "poses": 9.0}}
        record = {**begin_record(hive.runs.get(run_id)), **ended, "algorithm": ALGORITHM, "host": HOST}
        folder.write_record(record)
        folder.log.write_text(f"run {run_id}\n")
    reindex(hive, lambda _done, _total: None)


def submitted(hive: Hive, count: int = 1) -> list[int]:
    return [run.id for run in hive.runs.submit(Submission("tiny", "track", repeat=count))]


def all_runs(hive: Hive) -> dict[int, RunState]:
    return {run.id: run.state for run in hive.runs.page(limit=100).records}


def reborn(hive: Hive) -> Hive:
    """The installation after its database was lost."""
    hive.close()
    for path in hive.settings.data.glob("slamhive.db*"):
        path.unlink()
    again = open_hive()
    reindex(again, lambda _done, _total: None)
    return again


def test_a_deleted_run_is_gone_and_comes_back_as_it_was(hive: Hive) -> None:
    one, two = submitted(hive, 2)
    end(hive, one, two)
    hive.notes.change([one], NotesChange("kept", add=("paper",)))
    before = dump(hive.store)
    hive.trash.delete([one])
    assert set(all_runs(hive)) == {two}
    assert not hive.runs.folder(one).root.exists()
    assert [run.deleted.run_id for run in hive.trash.listed()] == [one]
    assert hive.searches.find("tag = paper") == []
    assert hive.trash.restore([one]) == [one]
    assert differences(before, dump(hive.store)) == []
    assert hive.runs.folder(one).log.read_text() == f"run {one}\n"
    assert hive.trash.listed() == []
    assert not any(hive.settings.trash_folder.iterdir())


def test_a_lost_database_does_not_bring_deleted_runs_back(hive: Hive) -> None:
    one, two = submitted(hive, 2)
    end(hive, one, two)
    hive.trash.delete([one])
    without = dump(hive.store)
    again = reborn(hive)
    assert differences(without, dump(again.store)) == []
    again.trash.restore([one])
    assert set(all_runs(again)) == {one, two}
    again.close()


def test_an_experiment_does_not_queue_a_deleted_run_again(hive: Hive) -> None:
    hive.experiments.start(ExperimentSource(EXPERIMENT))
    one, two = hive.experiments.run_ids("e")
    end(hive, one, two)
    hive.trash.delete([one])
    hive.experiments.start(ExperimentSource(EXPERIMENT))
    assert list(hive.experiments.run_ids("e")) == [two]
    again = reborn(hive)
    assert list(again.experiments.run_ids("e")) == [two]
    again.experiments.add_repeats("e", 1)
    assert one not in again.experiments.run_ids("e")
    assert len(again.experiments.run_ids("e")) == 3
    again.trash.restore([one])
    assert one in again.experiments.run_ids("e")
    again.close()


def test_a_run_that_repeats_a_deleted_one_stays_and_finds_it_again(hive: Hive) -> None:
    (one,) = submitted(hive)
    end(hive, one)
    repeat = hive.runs.retry(one).id
    hive.trash.delete([one])
    assert hive.runs.get(repeat).retry_of is None
    hive.trash.restore([one])
    assert hive.runs.get(repeat).retry_of == one


def test_a_run_that_was_cancelled_before_it_started_comes_back_too(hive: Hive) -> None:
    one, two = submitted(hive, 2)
    hive.runs.cancel(one)
    hive.trash.delete([one])
    assert all_runs(hive) == {two: RunState.QUEUED}
    hive.trash.restore([one])
    assert all_runs(hive) == {one: RunState.CANCELLED, two: RunState.QUEUED}


def test_what_is_still_needed_is_not_deleted(hive: Hive) -> None:
    one, queued = submitted(hive, 2)
    end(hive, one)
    hive.store.write(lambda t: t.evaluations.queue([one], Protocol(Alignment.SE3), datetime.now(UTC)))
    for run_id, words in ((queued, "has not ended"), (one, "is being evaluated")):
        with pytest.raises(Conflict, match=words):
            hive.trash.delete([run_id])
    with pytest.raises(NotFound):
        hive.trash.delete([99])
    assert set(all_runs(hive)) == {one, queued}
    assert hive.trash.listed() == []


def test_an_emptied_trash_gives_nothing_back(hive: Hive) -> None:
    (one,) = submitted(hive)
    end(hive, one)
    hive.trash.delete([one])
    assert (hive.trash.empty(), hive.trash.empty()) == (1, 0)
    assert not list(hive.settings.trash_folder.rglob("run.json"))
    with pytest.raises(NotFound, match="is not in the trash"):
        hive.trash.restore([one])
    again = reborn(hive)
    assert all_runs(again) == {}
    again.close()


def test_a_number_that_is_in_use_again_is_not_overwritten(hive: Hive) -> None:
    (one,) = submitted(hive)
    end(hive, one)
    hive.trash.delete([one])
    hive.runs.folder(one).create()
    with pytest.raises(Conflict, match="belongs to another run now"):
        hive.trash.restore([one])


def test_a_deletion_that_was_interrupted_is_completed_by_the_next(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = submitted(hive)
    end(hive, one)

    def killed(_work: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(hive.store, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            hive.trash.delete([one])
    assert set(all_runs(hive)) == {one}
    hive.trash.delete([one])
    assert all_runs(hive) == {}
    hive.trash.restore([one])
    assert hive.runs.folder(one).log.read_text() == f"run {one}\n"


def test_a_run_that_cannot_be_read_stays_in_the_trash(hive: Hive) -> None:
    (one,) = submitted(hive)
    end(hive, one)
    record = hive.settings.trash_folder / hive.runs.get(one).uid / "run" / "run.json"
    hive.trash.delete([one])
    record.write_text(f'{{"id": {one}}}')
    with pytest.raises(InvalidInput, match="is not complete"):
        hive.trash.restore([one])
    assert record.exists()
    assert not hive.runs.folder(one).root.exists()
    assert [run.deleted.run_id for run in hive.trash.listed()] == [one]


def test_a_damaged_description_costs_that_run_alone(hive: Hive) -> None:
    one, two = submitted(hive, 2)
    end(hive, one, two)
    uid = hive.runs.get(one).uid
    hive.trash.delete([one, two])
    (hive.settings.trash_folder / uid / "deleted.json").write_text('{"id": "1"}')
    (hive.settings.trash_folder / "stray").mkdir()
    assert [run.deleted.run_id for run in hive.trash.listed()] == [two]


def test_a_view_only_installation_deletes_nothing(hive: Hive, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (one,) = submitted(hive)
    end(hive, one)
    hive.trash.delete([one])
    monkeypatch.setenv("SLAMHIVE_MODE", Mode.VIEW_ONLY.value)
    public = open_hive()
    for work in (lambda: public.trash.delete([one]), lambda: public.trash.restore([one]), public.trash.empty):
        with pytest.raises(Forbidden):
            work()
    public.close()
