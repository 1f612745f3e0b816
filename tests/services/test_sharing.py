"""Owner and visibility: who may change them, where they lie, and that nothing makes a private run seen by others."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import Connection
from sqlalchemy.engine.base import RootTransaction

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound
from slamhive.base.settings import NewRuns
from slamhive.documents.submission import Submission
from slamhive.domain.accounts import ANYBODY, Role, Sharing, Viewer, Visibility
from slamhive.domain.run import FailureReason, RunState
from slamhive.services.archive import ArchiveImport, ArchiveReport, ExportRequest, export_archive
from slamhive.services.archive.layout import PAYLOAD, RUNS
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.services.runs.record import begin_record
from slamhive.services.sharing import SharingChange
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import AuditAct, RunRecord, open_store
from slamhive.store.records import AnalysisState
from tests.cheap_passwords import cheap_passwords
from tests.services.archive_world import make_runs, rewritten, sealed
from tests.web.web_world import NOW

pytestmark = pytest.mark.integration

ANALYSIS = "name: one\nselect: {all: {where: 'id >= 1'}}\nforms:\n- {form: distributions, metrics: [ate.rmse]}\n"
PASSWORD = "correct horse battery"
ANNA, BEN = Viewer("anna", signed_in=True), Viewer("ben", signed_in=True)
PRIVATE, TEAM, PUBLIC = map(SharingChange, Visibility)


@pytest.fixture
def shared(hive: Hive) -> Hive:
    """An installation with the accounts anna and ben."""
    with cheap_passwords():
        for name in ("anna", "ben"):
            hive.accounts.add(name, Role.MEMBER, PASSWORD)
    return hive


def made_by(hive: Hive, name: str, visibility: Visibility | None = None) -> RunRecord:
    """A run that ``name`` has submitted and a worker has prepared."""
    with hive.store.acting(AuditAct(name + str(visibility), NOW, name, "pages", "", "start.submit", ""), visibility):
        (run,) = hive.runs.submit(Submission("tiny", "track"))
    folder = hive.runs.folder(run.id)
    folder.create()
    folder.write_record({**begin_record(run), "state": "cancelled", "ended_at": NOW.isoformat(), "events": []})
    hive.runs.cancel(run.id)
    return hive.runs.get(run.id)


def experiment(hive: Hive, name: str, account: str) -> None:
    """An experiment of ``account`` with two runs."""
    text = f"name: {name}\nalgorithms: [tiny]\ndatasets: [track]\nrepeats: 2\n"
    with hive.store.acting(AuditAct(name, NOW, account, "pages", "", "experiments.start", "")):
        hive.experiments.start(ExperimentSource(text, "trial.yaml"))


def rebuilt(hive: Hive) -> Hive:
    """The same installation on a database that was lost and made again."""
    hive.store.close()
    (hive.settings.data / "slamhive.db").unlink()
    again = Hive(hive.settings, open_store(hive.settings.effective_database_url), hive.project_root)
    reindex(again, lambda _done, _total: None)
    return again


def seen(hive: Hive) -> dict[int, tuple[str | None, Visibility]]:
    """{run: owner and visibility}."""
    return {run.id: (run.owner, run.seen_by) for run in hive.runs.page(limit=100).records}


def test_new_runs_belong_to_who_asks_and_are_seen_by_the_team_or_by_nobody(shared: Hive) -> None:
    assert made_by(shared, "anna").seen_by is Visibility.TEAM
    hidden = made_by(shared, "anna", Visibility.PRIVATE)
    assert (hidden.owner, hidden.seen_by) == ("anna", Visibility.PRIVATE)
    (own,) = shared.runs.submit(Submission("tiny", "track"))
    assert (own.owner, own.seen_by) == (None, Visibility.TEAM)
    assert [Visibility(kind) for kind in NewRuns] == [Visibility.PRIVATE, Visibility.TEAM]


def test_only_the_owner_and_the_command_line_share_a_run(shared: Hive) -> None:
    run = made_by(shared, "anna").id
    with shared.store.seen_by(BEN), pytest.raises(Forbidden, match="belongs to anna"):
        shared.sharings.runs([run], PRIVATE)
    with shared.store.seen_by(ANNA):
        assert shared.sharings.runs([run], PRIVATE)[0].seen_by is Visibility.PRIVATE
    with shared.store.seen_by(BEN), pytest.raises(NotFound, match=f"unknown run {run}"):
        shared.sharings.runs([run], PUBLIC)
    with shared.store.seen_by(ANNA), pytest.raises(Forbidden, match="only admins"):
        shared.sharings.runs([run], SharingChange(owner="ben"))
    assert shared.sharings.runs([run], SharingChange(owner="ben"))[0].owner == "ben"
    with shared.store.seen_by(ANNA), pytest.raises(NotFound):
        shared.runs.get(run)
    with pytest.raises(NotFound, match="'nobody'"):
        shared.sharings.runs([run], SharingChange(owner="nobody"))


def submitted_by(hive: Hive, name: str, visibility: Visibility | None = None) -> RunRecord:
    """A run that ``name`` has submitted, and no worker has touched."""
    with hive.store.acting(AuditAct(f"{name} submits", NOW, name, "pages", "", "start.submit", ""), Visibility.TEAM):
        (run,) = hive.runs.submit(Submission("tiny", "track", visibility=visibility))
    return run


def claimed(hive: Hive, run_id: int) -> RunInHand:
    """The run in the hand of a worker, as it was when the worker took it."""
    hive.store.write(lambda t: t.queue.claim(t.lease("worker", 60.0), [run_id]))
    context = SimpleNamespace(store=hive.store, settings=hive.settings, owner="worker", now=lambda: NOW)
    hand = RunInHand(context, hive.runs.get(run_id), None)  # type: ignore[arg-type]
    assert hand.run.state is RunState.PREPARING
    return hand


def prepared(hand: RunInHand) -> None:
    """The folder of the run, as a worker begins it."""
    hand.folder.create()
    hand.begin()


@pytest.mark.parametrize("visibility", list(Visibility))
def test_who_sees_a_run_is_said_when_it_is_asked_for(shared: Hive, visibility: Visibility) -> None:
    run = submitted_by(shared, "anna", visibility)
    assert seen(shared) == {run.id: ("anna", visibility)}
    again = rebuilt(shared)
    assert seen(again) == {run.id: ("anna", visibility)}
    prepared(claimed(again, run.id))
    assert json.loads(again.runs.folder(run.id).sharing.read_text())["visibility"] == visibility
    experiment_of = "name: own\nalgorithms: [tiny]\ndatasets: [track]\n"
    status = again.experiments.start(ExperimentSource(experiment_of, "own.yaml"), visibility=visibility)
    assert again.store.read(lambda t: t.experiments.get(status.name)).seen_by is visibility
    again.store.close()


def test_a_queued_run_is_hidden_at_once_and_for_good(shared: Hive) -> None:
    run = submitted_by(shared, "anna").id
    with shared.store.seen_by(ANNA):
        (hidden,) = shared.sharings.runs([run], PRIVATE)
    assert (hidden.state, hidden.seen_by) == (RunState.QUEUED, Visibility.PRIVATE)
    with shared.store.seen_by(BEN):
        assert seen(shared) == {}
    reindex(shared, lambda _done, _total: None)
    assert seen(shared) == {run: ("anna", Visibility.PRIVATE)}
    shared.sharings.runs([run], PUBLIC)
    shared.sharings.runs([run], SharingChange(Visibility.PRIVATE, "ben"))
    again = rebuilt(shared)
    assert seen(again) == {run: ("ben", Visibility.PRIVATE)}
    prepared(claimed(again, run))
    last = rebuilt(again)
    assert seen(last) == {run: ("ben", Visibility.PRIVATE)}
    last.store.close()


def test_a_run_is_hidden_while_a_worker_prepares_it(shared: Hive) -> None:
    """The worker took the run before it was hidden, and makes its folder after that."""
    run = submitted_by(shared, "anna").id
    hand = claimed(shared, run)
    shared.sharings.runs([run], PRIVATE)
    prepared(hand)
    assert seen(rebuilt(shared)) == {run: ("anna", Visibility.PRIVATE)}


@pytest.mark.parametrize("before", [Visibility.TEAM, Visibility.PRIVATE])
def test_what_a_killed_preparation_left_does_not_count(shared: Hive, before: Visibility) -> None:
    run = submitted_by(shared, "anna").id
    shared.runs.folder(run).create()
    shared.runs.folder(run).write_sharing(Sharing("anna", before))
    after = PRIVATE if before is Visibility.TEAM else TEAM
    shared.sharings.runs([run], after)
    prepared(claimed(shared, run))
    assert seen(rebuilt(shared)) == {run: ("anna", after.visibility)}


def test_a_run_that_fails_before_it_is_prepared_stays_private(shared: Hive) -> None:
    run = submitted_by(shared, "anna", Visibility.PRIVATE).id
    claimed(shared, run).fail(FailureReason.PREPROCESS_ERROR, "no such dataset")
    again = rebuilt(shared)
    assert seen(again) == {run: ("anna", Visibility.PRIVATE)}
    assert again.runs.get(run).state is RunState.FAILED


def test_a_run_of_an_experiment_is_hidden_while_it_waits(shared: Hive) -> None:
    experiment(shared, "trial", "anna")
    first, second = sorted(seen(shared))
    shared.sharings.runs([first], PRIVATE)
    shared.sharings.experiment("trial", SharingChange(owner="ben"))
    expected = {first: ("ben", Visibility.PRIVATE), second: ("ben", Visibility.TEAM)}
    assert seen(shared) == expected
    reindex(shared, lambda _done, _total: None)
    assert seen(shared) == expected
    assert seen(rebuilt(shared)) == expected


def test_a_damaged_line_of_the_ledger_hides_its_runs(shared: Hive) -> None:
    run = submitted_by(shared, "anna").id
    with (shared.settings.ledger_folder / "runs.jsonl").open("a") as book:
        book.write(json.dumps({"shared": [run], "owner": "A B", "visibility": "all"}) + "\n")
    assert seen(rebuilt(shared)) == {run: (None, Visibility.PRIVATE)}


def test_a_lost_folder_is_not_written_anew(shared: Hive) -> None:
    run = made_by(shared, "anna").id
    shutil.rmtree(shared.runs.folder(run).root)
    statement = f"UPDATE runs SET state = 'succeeded' WHERE id = {run}"
    shared.store.write(lambda t: t.database.exec_driver_sql(statement))
    with pytest.raises(Conflict, match=f"the folder of run {run} is lost"):
        shared.sharings.runs([run], PRIVATE)


STEPS = (os, "fsync"), (Path, "replace"), (os, "write"), (Connection, "execute"), (RootTransaction, "commit")


@pytest.mark.parametrize("waits", [True, False])
def test_a_kill_at_any_step_leaves_what_was_answered(shared: Hive, waits: bool) -> None:
    """After each kill, the run is seen by the team or its owner alone, and reindex and a worker agree on it."""
    shared.store.close()
    step, answered = 0, False
    while not answered:
        step += 1
        run = submitted_by(shared, "anna") if waits else made_by(shared, "anna")
        shared.store.close()
        answered = killed_at(step, partial(shared.sharings.runs, [run.id], PRIVATE))
        reindex(shared, lambda _done, _total: None)
        found = seen(shared)[run.id]
        if answered:
            assert found == ("anna", Visibility.PRIVATE)
        if waits:
            prepared(claimed(shared, run.id))
            reindex(shared, lambda _done, _total: None)
            assert seen(shared)[run.id] == found
            shared.runs.cancel(run.id)
            ended = {**shared.runs.record(run.id), "state": "cancelled", "ended_at": NOW.isoformat()}
            shared.runs.folder(run.id).write_record(ended)
            reindex(shared, lambda _done, _total: None)
    assert step > 5


ANSWERED = 77
"""Exit code of a child process that was not killed."""


def killed_at(step: int, work: Callable[[], object]) -> bool:
    """Whether ``work`` ended before a child process that does it was killed before its step of this number."""
    child = os.fork()
    if child == 0:
        code, left = 1, [step]

        def dying(function: Callable[..., Any]) -> Callable[..., Any]:
            def wrapped(*arguments: Any, **options: Any) -> Any:
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                return function(*arguments, **options)

            return wrapped

        try:
            for owner, name in STEPS:
                setattr(owner, name, dying(getattr(owner, name)))
            work()
            code = ANSWERED
        finally:
            os._exit(code)  # whatever happened: a child that went on would run the tests that follow
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert ended in {ANSWERED, -signal.SIGKILL}
    return ended == ANSWERED


def test_the_folder_is_the_truth(shared: Hive) -> None:
    """A lost database is rebuilt from the folders and the ledger, with owners and visibilities."""
    runs = [made_by(shared, "anna").id for _ in range(3)]
    shared.sharings.runs(runs[:1], PRIVATE)
    shared.sharings.runs(runs[1:2], PUBLIC)
    experiment(shared, "trial", "anna")
    shared.sharings.experiment("trial", PRIVATE)
    with shared.store.acting(AuditAct("w", NOW, "ben", "pages", "", "start.submit", ""), Visibility.PRIVATE):
        (waiting,) = shared.runs.submit(Submission("tiny", "track"))
    before = seen(shared)
    assert before[runs[0]] == ("anna", Visibility.PRIVATE)
    assert before[waiting.id] == ("ben", Visibility.PRIVATE)
    assert [kind for _, kind in before.values()].count(Visibility.PRIVATE) == 4
    again = rebuilt(shared)
    after = seen(again)
    assert after.pop(runs[2]) == (None, Visibility.TEAM)  # as it was made; a worker would have written its owner
    assert after == {run: said for run, said in before.items() if run != runs[2]}
    assert again.store.read(lambda t: t.experiments.get("trial")).sharing.audience() == "private:anna"
    again.store.close()


@pytest.mark.parametrize("content", ["{", "[]", '{"owner": 1}', '{"visibility": "all"}', '{"owner": "A B"}'])
def test_a_damaged_file_hides_the_run(shared: Hive, content: str) -> None:
    run = made_by(shared, "anna").id
    shared.runs.folder(run).sharing.write_text(content)
    again = rebuilt(shared)
    assert seen(again)[run] == (None, Visibility.PRIVATE)
    again.store.close()


def test_a_damaged_experiment_hides_its_runs(shared: Hive) -> None:
    experiment(shared, "trial", "anna")
    (first, _) = sorted(seen(shared))
    run = shared.runs.get(first)
    shared.runs.folder(first).create()
    ended = {"state": "cancelled", "ended_at": NOW.isoformat(), "events": []}
    shared.runs.folder(first).write_record({**begin_record(run), **ended})
    shared.sharings.experiment("trial", PRIVATE)
    (shared.settings.experiments_folder / "trial" / "experiment.json").write_text("{")
    again = rebuilt(shared)
    assert seen(again)[first] == (None, Visibility.PRIVATE)
    again.store.close()


def test_a_run_is_seen_by_no_more_people_than_its_experiment(shared: Hive) -> None:
    experiment(shared, "trial", "anna")
    first, second = sorted(seen(shared))
    for run in (first, second):
        shared.runs.folder(run).create()
        shared.runs.folder(run).write_record(begin_record(shared.runs.get(run)))
    with shared.store.seen_by(ANNA):
        shared.sharings.runs([first], PRIVATE)
        with pytest.raises(InvalidInput, match="its experiment trial is team"):
            shared.sharings.runs([second], PUBLIC)
        shared.sharings.experiment("trial", PUBLIC)
        assert seen(shared) == {first: ("anna", Visibility.PRIVATE), second: ("anna", Visibility.PUBLIC)}
        shared.sharings.runs([first], PUBLIC)
        assert shared.runs.get(first).visibility is None  # it follows the experiment again
        shared.sharings.experiment("trial", PRIVATE)
    assert {kind for _, kind in seen(shared).values()} == {Visibility.PRIVATE}
    with shared.store.seen_by(BEN):
        assert shared.experiments.list() == ()
        with pytest.raises(NotFound):
            shared.experiments.status("trial")
        with pytest.raises(Conflict, match="the name trial is taken"):
            experiment(shared, "trial", "ben")


def test_the_repetition_of_a_private_run_is_private(shared: Hive) -> None:
    run = made_by(shared, "anna", Visibility.PRIVATE)
    with shared.store.acting(AuditAct("r", NOW, "ada", "pages", "", "runs.retry", ""), Visibility.TEAM):
        again = shared.runs.retry(run.id)
    assert (again.owner, again.seen_by) == ("ada", Visibility.PRIVATE)


def test_the_trash_shows_what_its_viewer_saw(shared: Hive) -> None:
    run = made_by(shared, "anna", Visibility.PRIVATE).id
    shared.sharings.runs([run], PRIVATE)
    shared.trash.delete([run])
    with shared.store.seen_by(BEN):
        assert shared.trash.listed() == []
        with pytest.raises(NotFound, match="is not in the trash"):
            shared.trash.restore([run])
    with shared.store.seen_by(ANNA):
        shared.trash.restore([run])
    assert seen(shared)[run] == ("anna", Visibility.PRIVATE)


@pytest.fixture
def archived(shared: Hive, tmp_path: Path) -> Callable[..., dict[str, bytes]]:
    """Makes an archive, and gives its members."""
    make_runs(shared, 3)
    reindex(shared, lambda _done, _total: None)
    for run, kind in ((1, PRIVATE), (2, PUBLIC)):
        shared.sharings.runs([run], SharingChange(kind.visibility, "anna"))

    def make(*, unpublished: bool = False) -> dict[str, bytes]:
        path = tmp_path / "runs.zip"
        export_archive(
            shared.settings,
            shared.store,
            ExportRequest(path, replace=True, unpublished=unpublished),
            lambda _done, _total: None,
        )
        with zipfile.ZipFile(path) as content:
            return {name: content.read(name) for name in content.namelist()}

    return make


def test_an_archive_holds_what_is_public(archived: Callable[..., dict[str, bytes]]) -> None:
    members = archived()
    folders = set(re.findall(r"/data/runs/(\d+)/", " ".join(members)))
    assert folders == {"2"}
    assert not any(b"anna" in content for content in members.values())


def test_a_whole_archive_keeps_private_what_is_private(
    shared: Hive, archived: Callable[..., dict[str, bytes]], tmp_path: Path
) -> None:
    members = archived(unpublished=True)
    assert not any(b"anna" in content for content in members.values())
    shutil.rmtree(shared.settings.runs_folder)
    shared.settings.runs_folder.mkdir()
    again = rebuilt(shared)
    report = ArchiveImport(again.settings, again.store, again.catalogue).carry_out(
        tmp_path / "runs.zip", lambda *_: None
    )
    expected = {1: (None, Visibility.PRIVATE), 2: (None, Visibility.TEAM), 3: (None, Visibility.TEAM)}
    assert seen(again) == expected
    assert json.loads(again.runs.folder(1).sharing.read_text()) == {"owner": None, "visibility": "private"}
    with again.store.seen_by(ANYBODY):
        assert seen(again) == {}
    assert report.notes == [
        "1 run public where the archive comes from are seen here by those who sign in; share them to publish them"
    ]
    again.store.close()


FORGED_FILES = {
    "sharing.json": json.dumps({"owner": "ben", "visibility": "public"}).encode(),
    "work/exit": b"0",
    "token": b"abc",
    "evaluations/9ef7844a7e18/more.json": b"{}",
    "result/sharing.json": b"of the algorithm",
}
FORGED_DATASET_FILES = {"check.json": b"{}", "rosbag_play.py": b"import os"}


@pytest.fixture
def forged(archived: Callable[..., dict[str, bytes]], tmp_path: Path) -> Path:
    """An archive whose runs are public, and bring files that no export writes; all checksums are right."""
    members = members_of_bag(archived(unpublished=True))
    rows = [json.loads(line) for line in members[RUNS].splitlines()]
    lines = [json.dumps({**row, "visibility": "public"}).encode() + b"\n" for row in rows]
    members[RUNS] = b"".join(lines)
    for name, content in FORGED_FILES.items():
        members[f"runs/1/{name}"] = content
    for name, content in FORGED_DATASET_FILES.items():
        members[f"datasets/track/{name}"] = content
    record = json.loads(members["runs/1/run.json"])
    handle = {"executor": "docker", "data": {"container": "of somebody else"}}
    members["runs/1/run.json"] = json.dumps({**record, "handle": handle}).encode()
    return rewritten(tmp_path / "forged.zip", sealed(members))


def import_into_a_new_one(hive: Hive, path: Path) -> tuple[Hive, ArchiveReport]:
    """Import into the installation after it has lost its runs and datasets."""
    for folder in (hive.settings.runs_folder, hive.settings.datasets_folder):
        shutil.rmtree(folder)
        folder.mkdir()
    again = rebuilt(hive)
    with again.store.acting(AuditAct("import", NOW, "anna", "pages", "", "archive", "")):
        report = ArchiveImport(again.settings, again.store, again.catalogue).carry_out(path, lambda *_: None)
    return again, report


def members_of_bag(members: dict[str, bytes]) -> dict[str, bytes]:
    """The members by the names that the modules use."""
    return {name.partition("/")[2].removeprefix(PAYLOAD): content for name, content in members.items()}


def test_an_archive_does_not_decide_who_owns_and_sees_its_runs(shared: Hive, forged: Path) -> None:
    again, report = import_into_a_new_one(shared, forged)
    for _ in range(2):
        assert seen(again) == dict.fromkeys((1, 2, 3), ("anna", Visibility.TEAM))
        with again.store.seen_by(ANYBODY):
            assert seen(again) == {}
        assert again.runs.get(1).handle is None
        reindex(again, lambda _done, _total: None)
    folder = again.runs.folder(1)
    assert json.loads(folder.sharing.read_text()) == {"owner": "anna", "visibility": None}
    assert json.loads(folder.record.read_text())["handle"] is None
    there = {path.relative_to(folder.root).as_posix() for path in folder.root.rglob("*") if path.is_file()}
    assert there & FORGED_FILES.keys() == {"sharing.json", "result/sharing.json"}
    assert {path.name for path in (again.settings.datasets_folder / "track").iterdir()} == {
        "dataset.yaml",
        "groundtruth.txt",
    }
    (note, _) = report.notes
    assert note.startswith("6 files left out, which no export writes: ")
    assert "runs/1/sharing.json" in note or "and 1 more" in note
    again.store.close()


def test_an_archive_adds_nothing_public_to_a_public_experiment(shared: Hive, tmp_path: Path) -> None:
    """A forger knows the uid of an experiment that everybody sees."""
    experiment(shared, "trial", "anna")
    first, second = sorted(seen(shared))
    for run in (first, second):
        shared.runs.cancel(run)
    shared.sharings.experiment("trial", PUBLIC)
    export_archive(shared.settings, shared.store, ExportRequest(tmp_path / "a.zip"), lambda *_: None)
    with zipfile.ZipFile(tmp_path / "a.zip") as content:
        members = members_of_bag({name: content.read(name) for name in content.namelist()})
    rows = [json.loads(line) for line in members[RUNS].splitlines()]
    rows[1]["uid"] = rows[1]["record"]["uid"] = "f" * 32
    rows[1]["id"] = rows[1]["record"]["id"] = 99
    members[RUNS] = b"".join(json.dumps(row).encode() + b"\n" for row in rows)
    ArchiveImport(shared.settings, shared.store, shared.catalogue).carry_out(
        rewritten(tmp_path / "b.zip", sealed(members)), lambda *_: None
    )
    kinds = {run: kind for run, (_, kind) in seen(shared).items()}
    assert kinds.pop(max(kinds)) is Visibility.TEAM
    assert set(kinds.values()) == {Visibility.PUBLIC}


def test_an_archive_gives_no_folder_to_a_run_that_waits(shared: Hive, forged: Path) -> None:
    with shared.store.acting(AuditAct("w", NOW, "ben", "pages", "", "start.submit", ""), Visibility.PRIVATE):
        (waiting,) = shared.runs.submit(Submission("tiny", "track"))
    uid = f"{0:016x}{1:016x}"
    for run in (1, 2, 3):
        shared.trash.delete([run])
    statement = f"UPDATE runs SET uid = '{uid}' WHERE id = {waiting.id}"
    shared.store.write(lambda t: t.database.exec_driver_sql(statement))
    report = ArchiveImport(shared.settings, shared.store, shared.catalogue).carry_out(forged, lambda *_: None)
    assert (report.imported, report.known, report.completed) == (2, 1, 0)
    assert not shared.runs.folder(waiting.id).root.exists()
    assert seen(shared)[waiting.id] == ("ben", Visibility.PRIVATE)


def test_analyses_are_computed_again_when_a_run_is_hidden(shared: Hive) -> None:
    run = made_by(shared, "anna").id
    with shared.store.acting(AuditAct("a", NOW, "ben", "pages", "", "analyses.create", "")):
        analysis = shared.stored_analyses.create(ANALYSIS)
    folder = shared.stored_analyses.folder(analysis.token)
    for name in ("report.json.gz", "figures.json.gz", "page.json.gz"):
        folder.write_result(name, {})
    shared.store.write(lambda t: t.database.exec_driver_sql("UPDATE analyses SET state = 'done'"))
    shared.sharings.runs([run], PUBLIC)
    assert shared.stored_analyses.get(analysis.token).state is AnalysisState.DONE
    shared.sharings.runs([run], PRIVATE)
    assert shared.stored_analyses.get(analysis.token).state is AnalysisState.QUEUED
    assert not folder.whole
    assert (analysis.owner, analysis.seen_by) == ("ben", Visibility.TEAM)
