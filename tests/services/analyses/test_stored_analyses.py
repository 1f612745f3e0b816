"""Stored analyses: computed in a process with limits, found again, removed; whatever is killed meanwhile."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

import slamhive
from slamhive.base.errors import Forbidden, InvalidInput, NotFound
from slamhive.base.settings import Mode
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.services.stored_analyses import computing
from slamhive.services.stored_analyses.computing import AnalysisJobs
from slamhive.services.stored_analyses.stored import FIGURES, PAGE, REPORT, SOURCE, STATE, StoredAnalyses
from slamhive.store import AnalysisRecord, AnalysisState, Lease, open_store
from tests.web import web_world as world

pytestmark = pytest.mark.integration

OWNER = "test:1:2:3:4"
KILLED = Path(__file__).with_name("killed_computer.py")
TEXT = """name: Two runs
text: "**bold** <script>alert(1)</script> [x](javascript:alert(1))"
select:
  good: {runs: [1, 2]}
forms:
  - {form: distributions, metrics: [ate.rmse]}
  - {form: scatter, x: cpu.mean, y: ram.max}
"""


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Path:
    """The folder of an installation that has runs with figures."""
    folder = tmp_path_factory.mktemp("filled")
    opened = world.make_hive(folder, template=sqlite_template)
    world.fill(opened)
    world.evaluate_run(opened, 2, 0.1)
    opened.close()
    return folder


@pytest.fixture(scope="module")
def refusing(filled: Path) -> Iterator[Hive]:
    """That installation, in which no test stores anything."""
    opened = world.make_hive(filled)
    yield opened
    opened.close()


@pytest.fixture
def hive(filled: Path, tmp_path: Path) -> Iterator[Hive]:
    """An installation of the test's own."""
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    opened = world.make_hive(tmp_path)
    yield opened
    opened.close()


def work(hive: Hive, **limits: float) -> bool:
    settings = hive.settings.with_values(limits)
    return AnalysisJobs(settings, hive.store, hive.catalogue.project_root).work_once(OWNER, threading.Event())


def visiting(hive: Hive, **settings: object) -> StoredAnalyses:
    changed = hive.settings.with_values({"mode": Mode.VIEW_ONLY, **settings})
    return StoredAnalyses(changed, hive.store, lambda text: hive.analyses.read(text).name)


def test_from_text_to_report_and_the_same_again_is_not_computed_twice(hive: Hive):
    made = hive.stored_analyses.create(TEXT)
    assert made.state is AnalysisState.QUEUED
    assert work(hive)
    assert not work(hive)
    found = hive.stored_analyses.get(made.token)
    assert (found.state, found.name, found.listed, found.visitor) == (AnalysisState.DONE, "Two runs", True, False)
    folder = hive.stored_analyses.folder(made.token)
    assert folder.source == TEXT
    assert found.size_bytes == folder.size_bytes
    report, page = folder.read_result(REPORT), folder.read_result(PAGE)
    assert report["runs"] == page["runs"] == 2
    assert [form["error"] for form in report["forms"]] == [None, None]
    assert "01_distributions_raw.csv" in page["files"]
    assert sorted(json.loads(gzip.decompress(folder.result_bytes(FIGURES)))) == sorted(
        f"{form['place']}-{chart['key']}" for form in report["forms"] for chart in form["result"]["charts"]
    )

    again = hive.stored_analyses.create(TEXT, listed=False)
    assert work(hive)
    assert hive.stored_analyses.get(again.token).content_hash == found.content_hash
    assert (hive.stored_analyses.folder(again.token).root / REPORT).samefile(folder.root / REPORT)
    assert [record.token for record in hive.stored_analyses.listed()] == [made.token]

    shutil.rmtree(hive.runs.folder(2).root / "evaluations")
    world.evaluate_run(hive, 2, 0.2)
    hive.stored_analyses.recompute(again.token)
    assert work(hive)
    newer = hive.stored_analyses.get(again.token)
    assert newer.content_hash != found.content_hash
    assert hive.stored_analyses.folder(made.token).read_result(REPORT) == report


def test_the_folders_bring_the_table_back(hive: Hive):
    done, waiting = hive.stored_analyses.create(TEXT), hive.stored_analyses.create(TEXT, listed=False)
    work(hive)
    hive.store.write(lambda t: (t.analyses.delete(done.token), t.analyses.delete(waiting.token)))
    broken = hive.settings.analyses_folder / ("0" * 32)
    broken.mkdir()
    (broken / STATE).write_text('{"format": 1}')
    report = reindex(hive, lambda _done, _total: None)
    assert report.analyses == 2
    assert [path for path, _ in report.skipped if path == broken] == [broken]
    assert hive.stored_analyses.get(done.token).state is AnalysisState.DONE
    assert not hive.stored_analyses.get(waiting.token).listed
    assert work(hive)
    assert hive.stored_analyses.get(waiting.token).state is AnalysisState.DONE


@pytest.mark.parametrize(
    ("text", "limits", "reason"),
    [
        (TEXT.replace("[1, 2]", "[1, 99]"), {}, "unknown runs 99"),
        (TEXT, {"analysis_max_runs": 1}, "2 runs, 1 are allowed"),
        (TEXT, {"analysis_time_limit_s": 0.2}, "longer than 0.2 s"),
        (TEXT, {"analysis_memory_mb": 60}, "memory"),
    ],
)
def test_what_cannot_be_computed_says_why_and_harms_nobody(
    hive: Hive, text: str, limits: dict[str, float], reason: str
):
    token = hive.stored_analyses.create(text).token
    assert work(hive, **limits)
    found = hive.stored_analyses.get(token)
    assert found.state is AnalysisState.FAILED
    assert reason in str(found.reason)
    assert "Traceback" not in str(found.reason)
    assert hive.stored_analyses.folder(token).read_state().reason == found.reason
    assert not work(hive)
    hive.stored_analyses.recompute(token)
    assert hive.stored_analyses.get(token).state is AnalysisState.QUEUED


def test_deleting_ends_the_computation(hive: Hive, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(computing, "BEAT_S", 0.05)
    token = hive.stored_analyses.create(TEXT).token
    folder = hive.stored_analyses.folder(token).root
    thread = threading.Thread(target=work, args=(hive,))
    thread.start()
    while hive.stored_analyses.get(token).state is AnalysisState.QUEUED:
        time.sleep(0.01)
    hive.stored_analyses.delete(token)
    thread.join(20)
    assert not thread.is_alive()
    assert not folder.exists()
    with pytest.raises(NotFound):
        hive.stored_analyses.get(token)


def test_a_worker_that_ends_leaves_the_analysis_to_the_next(hive: Hive):
    token = hive.stored_analyses.create(TEXT).token
    stopping = threading.Event()
    stopping.set()
    for _ in range(5):
        assert hive.analysis_jobs.work_once(OWNER, stopping)
        assert hive.stored_analyses.get(token).state is AnalysisState.QUEUED
    assert work(hive)
    assert hive.stored_analyses.get(token).state is AnalysisState.DONE


def test_a_killed_worker_leaves_the_analysis_to_the_next_and_no_process(hive: Hive, tmp_path: Path):
    token = hive.stored_analyses.create(TEXT).token
    environment = {
        **os.environ,
        "SLAMHIVE_DATA": str(hive.settings.data),
        "SLAMHIVE_ROOT": str(tmp_path / "project"),
        "PYTHONPATH": str(Path(slamhive.__file__).parent.parent),
    }
    killed = subprocess.run([sys.executable, str(KILLED)], env=environment, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    child = int(killed.stdout)
    held = hive.stored_analyses.get(token)
    assert held.state is AnalysisState.RUNNING
    deadline_s = time.monotonic() + 30
    while (Path("/proc") / str(child) / "cmdline").exists() and time.monotonic() < deadline_s:
        if b"analyses.child" not in (Path("/proc") / str(child) / "cmdline").read_bytes():
            break  # a zombie, or another process of this number
        time.sleep(0.05)
    else:
        assert time.monotonic() < deadline_s, "the process goes on without its worker"
    assert not work(hive), "the lease still holds"
    hive.worker()._take_over_from_the_dead()
    assert work(hive)
    assert hive.stored_analyses.get(token).state is AnalysisState.DONE


def test_a_lease_that_ran_out_is_taken_over(hive: Hive):
    token = hive.stored_analyses.create(TEXT).token
    hive.store.write(lambda t: t.analyses.claim(Lease("dead", world.NOW, 0.0)))
    assert work(hive)
    found = hive.stored_analyses.get(token)
    assert (found.state, found.attempt) == (AnalysisState.DONE, 2)


def test_one_that_kills_every_worker_is_given_up(hive: Hive):
    token = hive.stored_analyses.create(TEXT).token
    for second in range(computing.MOST_ATTEMPTS):
        at = world.NOW + timedelta(seconds=second)
        assert hive.store.write(lambda t, at=at: t.analyses.claim(Lease("dead", at, 0.0)))  # type: ignore[misc]
    assert work(hive)
    assert "3 workers ended" in str(hive.stored_analyses.get(token).reason)


def test_visitors_get_analyses_of_their_own_and_the_oldest_go(hive: Hive):
    owned = hive.stored_analyses.create(TEXT).token
    stored = visiting(hive, analyses_max_stored=2)
    tokens = [stored.create(TEXT, listed=True).token for _ in range(3)]
    found = hive.store.read(lambda t: t.analyses.visitors())
    assert [record.token for record in found] == tokens[1:]
    assert not any(record.listed for record in found)
    assert not stored.folder(tokens[0]).root.exists()
    assert stored.folder(owned).root.exists()
    for change in (stored.delete, stored.recompute, lambda token: stored.list_or_not(token, listed=True)):
        with pytest.raises(Forbidden):
            change(tokens[2])
    with pytest.raises(Forbidden, match="takes no new analyses"):
        visiting(hive, no_new_analysis=True).create(TEXT)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("name: [", "line 1"),
        ("a: &a [1]\nb: *a\n", "anchors and aliases"),
        (TEXT.replace("form: scatter", "form: scater"), "line 7.*scatter"),
        (TEXT + "x" * 200_000, "larger than 100 kB"),
        ("- 1\n", "top level"),
    ],
)
def test_texts_that_cannot_be_used_store_nothing(refusing: Hive, text: str, problem: str):
    with pytest.raises(InvalidInput, match=problem):
        refusing.stored_analyses.create(text)
    assert not refusing.settings.analyses_folder.exists() or not list(refusing.settings.analyses_folder.iterdir())


@pytest.mark.parametrize("token", ["", "..", "../runs", "0" * 31, "G" * 32, "0" * 32, "0" * 31 + "\n"])
def test_addresses_that_are_none(refusing: Hive, token: str):
    with pytest.raises(NotFound):
        refusing.stored_analyses.get(token)


def test_a_damaged_report_is_told_and_computed_anew_after_reindex(hive: Hive):
    token = hive.stored_analyses.create(TEXT).token
    work(hive)
    folder = hive.stored_analyses.folder(token)
    (folder.root / PAGE).unlink()
    assert folder.read_state().state is AnalysisState.QUEUED
    assert (folder.root / SOURCE).read_text() == TEXT


@pytest.mark.mysql
def test_the_queue_works_on_mysql(database_server):
    url = database_server.create_database("slamhive_analyses")
    store = open_store(url)
    try:
        record = hive_record()
        store.write(lambda t: t.analyses.put(record))
        assert store.read(lambda t: t.analyses.waiting()) == 1
        claimed = store.write(lambda t: t.analyses.claim(Lease("a", world.NOW, 30.0)))
        assert claimed is not None
        assert claimed.attempt == 1
        assert store.write(lambda t: t.analyses.claim(Lease("b", world.NOW, 30.0))) is None
        assert store.write(lambda t: t.analyses.heartbeat([record.token], Lease("a", world.NOW, 30.0)))
        assert not store.write(lambda t: t.analyses.heartbeat([record.token], Lease("b", world.NOW, 30.0)))
        done = replace(record, state=AnalysisState.DONE, content_hash="1" * 64, size_bytes=3_000_000_000)
        store.write(lambda t: t.analyses.finish(done, "a"))
        assert store.read(lambda t: t.analyses.same("1" * 64)) == [record.token]
        assert store.read(lambda t: t.analyses.get(record.token)).size_bytes == 3_000_000_000
        assert len(store.read(lambda t: t.analyses.fingerprint([1, 2, 3]))) == 64
        assert store.write(lambda t: t.analyses.delete(record.token))
    finally:
        store.close()
        database_server.drop_database("slamhive_analyses")


def hive_record():
    return AnalysisRecord("f" * 32, "n", AnalysisState.QUEUED, True, False, world.NOW)
