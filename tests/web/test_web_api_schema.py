"""Schemathesis sends requests that the description allows, and others: every answer is one that it promises."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from slamhive.documents.imports import UploadRequest
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store.records import RunSort, SavedSearchRecord
from slamhive.web.api import TABLE
from slamhive.web.api.operation import ApiOperation, Section
from slamhive.web.security import API_HEADER
from tests.services.challenge_world import rooms, write_challenge
from tests.services.mariadb import DatabaseServer
from tests.web import web_world as world
from tests.web.request_fuzz import ANALYSIS, EXPERIMENT
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration

EXAMPLES = 4
NOTHING_THERE = {
    "dataset_check",
    "analysis_report",
    "dataset_frame",
    "dataset_sweep",
    "experiment_decision",
    "experiment_search",
    "dataset_trial",
    "search_protocols",
}
"""Nobody has checked the dataset or tried its ground truth, no worker has computed the analysis, the recording holds no
images or points, the experiment has no question, and the run no trajectory that a protocol could be searched for."""
LOOKING_FIRST = sorted(TABLE.operations, key=attrgetter("method"))
"""Changes come last: they remove what others look at."""


@pytest.fixture(scope="module")
def sqlite_hive(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Hive:
    """A filled installation on SQLite."""
    folder = tmp_path_factory.mktemp("schema")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    return world.make_hive(folder)


@pytest.fixture(scope="module")
def mysql_hive(database_server: DatabaseServer, tmp_path_factory: pytest.TempPathFactory) -> Hive:
    """A filled installation on a database server."""
    url = database_server.create_database("slamhive_api_schema")
    hive = world.make_hive(tmp_path_factory.mktemp("schema"), database_url=url)
    world.fill(hive)
    return hive


@pytest.fixture(scope="module", params=["sqlite", pytest.param("mysql", marks=pytest.mark.mysql)])
def target(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Web]:
    """An installation that the requests may change, on each kind of database."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
        web = make_web(request.getfixturevalue(f"{request.param}_hive"))
        web.hive.experiments.start(ExperimentSource(EXPERIMENT.replace("NAME", "trial")))
        web.hive.searches.save(SavedSearchRecord("slow-ones", "duration > 1", (), RunSort(), grouped=False))
        path = write_challenge(tmp_path_factory.mktemp("challenge"), rooms(1, phases=[{"name": "public"}]))
        web.hive.challenges.create(path)
        yield web
        web.hive.close()


@dataclass(frozen=True)
class Fuzz:
    """The description as Schemathesis read it, and what an answer has to fulfil.

    Whether data that breaks the schema is refused is not part of it: our own rules are stricter in some places (not
    every text is a cursor) and laxer in others (unknown arguments are ignored).
    """

    schema: Any
    checks: list[Any]
    modes: tuple[Any, Any]


@pytest.fixture(scope="module")
def token(target: Web) -> str:
    """The token of an analysis that waits."""
    return target.hive.stored_analyses.create(ANALYSIS).token


@pytest.fixture(scope="module")
def upload(target: Web) -> str:
    """The token of an upload that waits for its first byte."""
    return target.hive.uploads.create(UploadRequest(name="walk.bag", size_bytes=1000, sha256="0" * 64), "").token


@pytest.fixture(scope="module")
def fuzz(target: Web) -> Fuzz:
    import schemathesis  # noqa: PLC0415 - takes a second, which other tiers should not pay when they collect
    from schemathesis.specs.openapi import checks  # noqa: PLC0415

    return Fuzz(
        schemathesis.openapi.from_wsgi("/api/openapi.json", whole(target)),
        [
            schemathesis.checks.not_a_server_error,
            checks.status_code_conformance,
            checks.content_type_conformance,
            checks.response_schema_conformance,
        ],
        (schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE),
    )


def places_of(operation: ApiOperation, token: str, upload: str) -> dict[str, Any]:
    """Values for the places in its path, which something has."""
    names = {
        Section.CATALOGUE: "eye-slam-mono",
        Section.CHALLENGES: "rooms",
        Section.EXPERIMENTS: "trial",
        Section.SEARCHES: "slow-ones",
    }
    values = {"run_id": 1, "configuration_id": 1, "key": "traj.txt", "format": "ndjson", "action": "pause"}
    values |= {"submission": "20260101-0123456789ab", "upload": upload, "plot": "error", "sensor": "cam0"}
    known = {**values, "name": names.get(operation.section, "room"), "token": token}
    if operation.section is Section.ANALYSES:
        known["key"] = "analysis.yaml"
    return {name: known[name] for name in operation.places}


def whole(target: Web) -> Any:
    """The application, whose answers are read to their end and closed, as a server does; Schemathesis does not."""

    def application(environ: Any, start: Any) -> list[bytes]:
        answer = target.app.wsgi_app(environ, start)
        try:
            return [b"".join(answer)]
        finally:
            close = getattr(answer, "close", None)
            if close is not None:
                close()

    return application


@pytest.mark.parametrize("operation", LOOKING_FIRST, ids=attrgetter("name"))
def test_every_answer_is_one_that_the_description_promises(
    fuzz: Fuzz, token: str, upload: str, operation: ApiOperation
) -> None:
    described = fuzz.schema.find_operation_by_id(operation.name)
    valid, broken = fuzz.modes
    query = {"comparison": {"runs": "1,2"}, "run_moment": {"timestamp": 1.5}}.get(operation.name)
    found = described.as_strategy(valid, path_parameters=places_of(operation, token, upload), query=query)
    statuses = set()

    @given(case=found | described.as_strategy(valid) | described.as_strategy(broken))
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def send(case: Any) -> None:
        sent = {API_HEADER: "1", "Accept-Encoding": "identity"}
        statuses.add(case.call_and_validate(headers=sent, checks=fuzz.checks).status_code)

    send()
    assert operation.method != "GET" or 200 in statuses or operation.name in NOTHING_THERE
