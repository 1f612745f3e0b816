"""Runs on a disturbed machine: the verdict from measurement to record, row, search and JSON; and back from a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slamhive.documents.run import RunDocument
from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.domain.trust import DisturbanceKind
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.store.records import RunRecord
from tests.burning import busy_machine
from tests.services.disturbed_machine import beside
from tests.services.fake_executor import FakeExecutor, write_trajectory

pytestmark = pytest.mark.integration


def finish(hive: Hive, executor: FakeExecutor, **changes: Any) -> RunRecord:
    hive.executors.opened["process"] = executor
    (run,) = hive.runs.submit(Submission("tiny", "track", evaluate=False, **changes))
    hive.worker().run(until_idle=True)
    return hive.runs.get(run.id)


def found(hive: Hive, text: str) -> list[int]:
    return list(hive.store.read(lambda t: t.searches.run_ids(hive.searches.read(text))))


def test_a_disturbed_run_succeeds_and_says_so_everywhere(hive: Hive) -> None:
    run = finish(hive, beside(1.9, 1.8, 1.9, 0.1))
    assert run.state is RunState.SUCCEEDED
    assert run.disturbance is not None
    assert run.disturbance.disturbed
    words = "other processes used more than 0.5 of 2 cores for 75 % of the run (1.4 on average)"
    assert run.disturbance.words == words
    shown = RunDocument.of(run).content["disturbance"]
    assert shown == hive.runs.record(run.id)["disturbance"]
    assert shown == {
        "disturbed": True,
        "reasons": [{"kind": "others", "words": words}],
        "not_measured": ["CPU frequency: there is no such file"],
    }
    assert run.metrics is not None
    assert run.metrics["disturbance.others_cores"] == pytest.approx(1.425)


def test_filters_find_disturbed_quiet_and_unknown_runs(hive: Hive) -> None:
    disturbed, quiet = finish(hive, beside(1.9)), finish(hive, beside(0.1))
    unknown = finish(hive, FakeExecutor([Exited(0)], write_trajectory(3)))
    assert quiet.disturbance is not None
    assert quiet.disturbance.disturbed is False
    assert unknown.disturbance is not None
    assert unknown.disturbance.disturbed is None
    assert found(hive, "disturbed = yes") == [disturbed.id]
    assert found(hive, "disturbed = no") == [quiet.id]
    assert found(hive, "missing disturbed") == [unknown.id]
    assert found(hive, "disturbed_by = others") == [disturbed.id]
    assert found(hive, "disturbance.others_cores > 1") == [disturbed.id]


def test_a_run_on_another_machine_is_unknown_with_the_reason(hive: Hive) -> None:
    class Elsewhere(FakeExecutor):
        """As an engine on another machine: its runs use CPU time that this one does not see."""

        def usage_source(self, handle: RunHandle) -> Any:
            return OneReading()

    run = finish(hive, Elsewhere([Running(), Exited(0)], write_trajectory(3)))
    assert run.disturbance is not None
    assert run.disturbance.disturbed is None
    assert run.disturbance.not_measured == ("the run was on another machine than the worker",)


class OneReading:
    """Usage of a run, read once."""

    on_this_machine = False

    def __init__(self) -> None:
        self._left = [(1.0, 1000)]

    def read(self) -> tuple[float, int] | None:
        return self._left.pop() if self._left else None

    def totals(self) -> dict[str, float]:
        return {}

    def close(self) -> None:
        pass


def test_a_failed_run_may_be_disturbed_too(hive: Hive) -> None:
    run = finish(hive, beside(1.9, exit_code=3))
    assert run.state is RunState.FAILED
    assert run.disturbance is not None
    assert run.disturbance.disturbed


def test_limits_are_settings(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLAMHIVE_DISTURBED_OTHERS_FRACTION", "1")

    with_limit = open_hive()
    run = finish(with_limit, beside(1.9))
    with_limit.close()
    assert run.disturbance is not None
    assert run.disturbance.disturbed is False


def test_reindexing_restores_what_the_folder_says(hive: Hive, tmp_path: Path) -> None:
    before = [finish(hive, beside(1.9)), finish(hive, beside(0.1))]
    hive.close()
    (tmp_path / "data" / "slamhive.db").unlink()

    again = open_hive()
    reindex(again, lambda _done, _total: None)
    after = [again.runs.get(run.id) for run in before]
    assert [run.disturbance for run in after] == [run.disturbance for run in before]
    assert found(again, "disturbed = yes") == [before[0].id]
    again.close()


def test_a_record_without_it_is_unknown(hive: Hive, tmp_path: Path) -> None:
    run = finish(hive, beside(1.9))
    folder = hive.runs.folder(run.id)
    record = folder.read_record()
    del record["disturbance"], record["request"]["repeat_disturbed"]
    folder.write_record(record)
    reindex(hive, lambda _done, _total: None)
    assert hive.runs.get(run.id).disturbance is None
    assert found(hive, "missing disturbed") == [run.id]


def test_a_real_run_under_real_load_is_disturbed(hive: Hive) -> None:
    with busy_machine(per_core=0.5):
        (run,) = hive.runs.submit(Submission("tiny", "track", parameters={"seconds": 3.5}, evaluate=False))
        hive.worker().run(until_idle=True)
    ended = hive.runs.get(run.id)
    assert ended.state is RunState.SUCCEEDED
    assert ended.disturbance is not None
    assert DisturbanceKind.OTHERS in [reason.kind for reason in ended.disturbance.reasons]
    assert ended.metrics is not None
    assert ended.metrics["disturbance.others_cores"] > 0.5
