"""No request at all makes the server fail: it is served, or refused in words, and a refusal changes nothing."""

from __future__ import annotations

import logging
import shutil
import sqlite3
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from werkzeug.test import TestResponse

from slamhive.base.settings import Mode
from slamhive.services.executors import Executors
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.stored_analyses.computing import AnalysisJobs
from tests.web import web_world as world
from tests.web.request_fuzz import ANALYSIS, EXPERIMENT, FuzzedRequest, Requests
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration

REQUESTS_PER_SEED = 250
STREAMS = {"dashboard.events"}
"""Answers that go on for as long as somebody listens."""


@pytest.fixture(scope="module")
def rich(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an installation that holds one of everything."""
    folder = tmp_path_factory.mktemp("rich")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(folder))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
        web.hive.experiments.start(ExperimentSource(EXPERIMENT.replace("NAME", "trial")))
    saved = {"csrf_token": web.token, "name": "slow-ones", "where": "duration > 1"}
    assert web.client.post("/searches", data=saved).status_code == 303
    web.hive.stored_analyses.create(ANALYSIS)
    jobs = AnalysisJobs(web.hive.settings, web.hive.store, web.hive.catalogue.project_root)
    assert jobs.work_once("fuzz", threading.Event())
    web.hive.close()
    return folder


@dataclass
class Target:
    """An installation of a test's own, and what a visitor of its pages has got."""

    web: Web
    token: str
    cookie: str


@pytest.fixture
def target(
    request: pytest.FixtureRequest, rich: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Target]:
    """An installation in the mode that the test asks for."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    shutil.copytree(rich, tmp_path, symlinks=True, dirs_exist_ok=True)
    owner = make_web(world.make_hive(tmp_path))
    token = owner.token
    cookie = owner.client.get_cookie("slamhive")
    assert token
    assert cookie is not None
    owner.hive.close()
    web = make_web(world.make_hive(tmp_path, request.param))
    yield Target(web, token, cookie.value)
    web.hive.close()


def values_of(web: Web) -> dict[str, list[str]]:
    tokens = [record.token for record in web.hive.stored_analyses.listed()]
    return {
        "run_id": ["1", "2", "3", "4", "5", "6", "999"],
        "configuration_id": ["1", "2", "3", "99"],
        "name": ["room", "hall", "trial", "eye-slam-mono", "slow-ones", "csv", "json", "runs", "report.html"],
        "token": tokens,
        "key": ["log.txt", "traj.txt", "frames.csv", "report.html", "0" * 16],
        "figure": ["path", "cpu", "latency"],
        "action": ["pause", "resume", "cancel", "retry-failed", "add-repeats"],
        "number": ["0", "1", "2"],
        "format": ["csv", "json", "ndjson", "parquet"],
        "filename": ["theme.js", "css/bootstrap.min.css"],
        "version": ["1"],
    }


def rows_of_the_owner(hive: Hive) -> dict[str, list[tuple[object, ...]]]:
    """All that the database holds but analyses, which visitors make and the server computes."""
    with closing(sqlite3.connect(hive.settings.data / "slamhive.db")) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: database.execute(f"SELECT * FROM {name}").fetchall() for name in tables if name != "analyses"}


def words_of(answer: TestResponse) -> str:
    """What an answer says to the one who asked."""
    if not answer.is_json:
        return answer.text
    content = answer.get_json()
    said = content.get("error", content)
    return str(said.get("message") if isinstance(said, dict) else said)


def problem_of(target: Target, request: FuzzedRequest, statuses: Counter[int]) -> str | None:
    """What is wrong with the answer to a request; None if nothing is."""
    answer = request.send(target.web.app, target.cookie)
    statuses[answer.status_code // 100] += 1
    try:
        if not 200 <= answer.status_code < 500:
            return f"{answer.status_code}"
        if answer.status_code < 400 or request.method == "HEAD" or request.endpoint in STREAMS:
            return None
        words = words_of(answer)
        if not words.strip() or "Traceback (most recent" in words:
            return f"{answer.status_code} without words: {words[:200]!r}"
        return None
    finally:
        answer.close()


def hammer(target: Target, seed: int, caplog: pytest.LogCaptureFixture, *, alone: bool = True) -> Counter[int]:
    """Send the requests of a seed; how many were answered with each class of status.

    ``alone``: nobody else writes, so that a refusal leaves the database file as it is.
    """
    requests = Requests(target.web.app.url_map, values_of(target.web), target.token, seed)
    statuses: Counter[int] = Counter()
    failures = []
    with closing(sqlite3.connect(target.web.hive.settings.data / "slamhive.db")) as watch:
        version = watch.execute("PRAGMA data_version").fetchone()
        caplog.set_level(logging.WARNING)
        for _ in range(REQUESTS_PER_SEED):
            request, refused = requests.next(), statuses[4]
            problem = problem_of(target, request, statuses)
            before, version = version, watch.execute("PRAGMA data_version").fetchone()
            errors = [entry.getMessage() for entry in caplog.records if entry.levelno >= logging.ERROR]
            if problem is None and errors:
                problem = f"logged {errors}"
            if problem is None and alone and statuses[4] > refused and version != before:
                problem = "refused, and still the database has changed"
            if problem is not None:
                failures.append(f"{problem}: {request}\n{caplog.text[-3000:]}")
            caplog.clear()
    assert not failures, f"{len(failures)} of {REQUESTS_PER_SEED}:\n" + "\n\n".join(failures[:30])
    return statuses


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("target", [Mode.WORKSTATION], indirect=True)
def test_no_request_breaks_the_server(target: Target, seed: int, caplog: pytest.LogCaptureFixture):
    statuses = hammer(target, seed, caplog)
    assert statuses[2] + statuses[3] > REQUESTS_PER_SEED // 5, "the requests no longer reach the code behind the checks"


@pytest.mark.parametrize("seed", range(100, 104))
@pytest.mark.parametrize("target", [Mode.VIEW_ONLY], indirect=True)
def test_no_request_breaks_a_server_that_only_shows(target: Target, seed: int, caplog: pytest.LogCaptureFixture):
    before = rows_of_the_owner(target.web.hive)
    statuses = hammer(target, seed, caplog, alone=False)
    assert statuses[4] > REQUESTS_PER_SEED // 5
    assert rows_of_the_owner(target.web.hive) == before
