"""What is private is nowhere: every address, asked by those who may see it and by those who may not."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import unified_diff
from pathlib import Path
from typing import Any

import pytest
from flask.testing import FlaskClient
from sqlalchemy import text
from werkzeug.test import TestResponse

from slamhive.base.settings import Auth, Mode
from slamhive.domain.accounts import Role, Scope, Sharing, Visibility
from slamhive.domain.claim import ClaimState
from slamhive.domain.run import NotesChange, RunState
from slamhive.services.accounts import TokenRequest
from slamhive.services.experiments import ExperimentFolder, StoredExperiment
from slamhive.services.hive import Hive
from slamhive.services.sharing import SharingChange
from slamhive.store import RunRequest
from slamhive.store.records import AnalysisRecord, AnalysisState, ExperimentState
from slamhive.web.security import API_HEADER
from tests.web import web_world as world
from tests.web.account_world import NAMES, PASSWORD, AccountWeb, account_web
from tests.web.test_web_claims import keep_claims, one_of
from tests.web.test_web_security import VALUES

pytestmark = pytest.mark.integration

NUMBER, NOWHERE = 734_912, 734_999
"""The private run, and one that does not exist."""
UID = "ab5ec7e7" * 4
EXPERIMENT, NO_EXPERIMENT = "hidden-trial", "absent-trial"
TOKEN, NO_TOKEN = "ab5ec7e8" * 4, "ab5ec7e9" * 4
NOTE, TAG, LOG, DETAIL = "hidden note", "hidden-tag", "hidden log", "hidden analysis"
CPU, ATE = 739.173, 0.0731337
SECRETS = (str(NUMBER), UID, EXPERIMENT, TOKEN, NOTE, TAG, LOG, DETAIL, "739.1", "0.07313", "734,912")
ASKED = {
    "runs.index": ("where=state+%3D+succeeded", "sort=experiment", "sort=ate.rmse", "group=configuration", "owner=max"),
    "api.runs": (
        "where=owner+%3D+max",
        f"where=experiment+%3D+{EXPERIMENT}",
        f"where=id+%3D+{NUMBER}",
        "sort=cpu.mean",
    ),
    "api.export_runs": ("columns=note&columns=tags", "where=ate.rmse+%3E+0"),
    "compare.show": (f"runs={NUMBER}&runs=1", f"run={NUMBER}&run=1"),
    "compare.figures": (f"runs={NUMBER}&runs=1", f"run={NUMBER}&run=1"),
    "scenes.comparison": (f"runs={NUMBER}&runs=1", f"run={NUMBER}&run=1"),
    "api.comparison": (f"runs={NUMBER}&runs=1", f"run={NUMBER}&run=1"),
    "selected_runs.confirm": (f"run={NUMBER}",),
    "selected_runs.export": (f"run={NUMBER}",),
    "api.find": ("q=hidden", f"q={NUMBER}", f"q={UID}"),
    "finding.index": ("q=hidden", f"q={NUMBER}", f"q={UID}"),
    "analyses.select": (f"runs={NUMBER}", f"where=id+%3D+{NUMBER}", f"experiment={EXPERIMENT}"),
    "api.configurations": ("where=runs+%3E+0",),
}
"""What else addresses are asked. They may repeat what they were asked, so they are compared with other answers."""


NO_RUNS = (
    "accounts.",
    "api.import_",
    "api.check_dataset",
    "api.judge_dataset",
    "api.make_variant",
    "configurations.",
    "dashboard.demo",
    "datasets.",
    "searches.",
)
"""Changes of other things, which answer a repetition in another way."""


@dataclass
class Shared:
    """The application with private things of ``max``."""

    accounts: AccountWeb

    @property
    def hive(self) -> Hive:
        """Its services."""
        return self.accounts.web.hive

    def client(self, name: str) -> FlaskClient:
        """A browser of somebody; of nobody for an empty name."""
        if not name:
            return self.accounts.web.app.test_client()
        client, answer = self.accounts.sign_in(name)
        assert answer.status_code == 303
        return client


def fill(hive: Hive) -> None:
    """A private experiment with a run that has everything, and a private analysis, all of ``max``."""
    values: dict[str, Any] = {"state": ExperimentState.ACTIVE, "executor": "process", "created_at": world.NOW}
    stored = StoredExperiment(uid="e" * 32, name=EXPERIMENT, content_hash="0" * 64, repeats=1, owner="max", **values)
    source = f"name: {EXPERIMENT}\nalgorithms: eye-slam-stereo\ndatasets: room\n"
    ExperimentFolder(hive.settings.experiments_folder / EXPERIMENT).root.mkdir(parents=True)
    ExperimentFolder(hive.settings.experiments_folder / EXPERIMENT).write(stored, source)
    more = dict.fromkeys(("priority", "repeats", "cells", "runs"), 1)
    texts = {"description": NOTE, "content_hash": "0" * 64, "source": source}
    whole = {**values, **more, **texts, "complete": True}
    record = hive.store.write(lambda t: t.experiments.get_or_create(stored.uid, EXPERIMENT, owner="max", **whole))
    configuration = hive.runs.get(1).configuration_id
    request = RunRequest(UID, configuration, "process", experiment_id=record.id, cell=1)
    hive.store.write(lambda t: t.database.execute(text(f"UPDATE sqlite_sequence SET seq={NUMBER - 1}")))
    assert hive.store.write(lambda t: t.runs.add_runs([request], world.NOW)) == [NUMBER]
    world.finish_run(hive, NUMBER, {"cpu.mean": CPU, "ram.max": 1e9, "duration": 41.5})
    world.evaluate_run(hive, NUMBER, ATE)
    hive.runs.folder(NUMBER).log.write_text(f"{LOG}\n")
    hive.notes.change([NUMBER], NotesChange(NOTE, (TAG,)))
    hive.sharings.experiment(EXPERIMENT, SharingChange(Visibility.PRIVATE))
    analysis = AnalysisRecord(
        TOKEN, DETAIL, AnalysisState.FAILED, listed=True, visitor=False, created_at=world.NOW, owner="max",
        visibility=Visibility.PRIVATE,
    )  # fmt: skip
    folder = hive.stored_analyses.folder(TOKEN)
    folder.root.parent.mkdir(exist_ok=True)
    folder.create(f"name: {DETAIL}\n", analysis)
    hive.store.write(lambda t: t.analyses.put(analysis))
    claim = one_of(ClaimState.DIFFERS, value=ATE, words=DETAIL, runs=(NUMBER,))
    hive.claims.keep(keep_claims(hive).model_copy(update={"name": VALUES["name"], "claims": (claim,)}))


@contextmanager
def shared_web(filled: Path, folder: Path) -> Iterator[Shared]:
    """The filled installation with accounts and private things."""
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    with account_web(folder) as made:
        made.web.hive.accounts.add("ben", Role.MEMBER, PASSWORD)
        fill(made.web.hive)
        yield Shared(made)


@pytest.fixture(scope="module")
def shared(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    with shared_web(filled, tmp_path_factory.mktemp("shared")) as made:
        yield made


def addresses(shared: Shared, method: str, **values: Any) -> list[tuple[str, str, str]]:
    """(endpoint, method, address) of all that looks (``GET``) or changes (``POST``)."""
    app, found = shared.accounts.web.app, []
    with app.test_request_context():
        adapter = app.url_map.bind("localhost")
        for rule in app.url_map.iter_rules():
            if method not in (rule.methods or ()) or rule.endpoint == "dashboard.events":
                continue
            own = {name: values.get(name, VALUES.get(name, 1)) for name in rule.arguments}
            if rule.endpoint.rpartition(".")[0] == "experiments" or "experiment" in rule.endpoint:
                own = {name: values.get("experiment", "x") if name == "name" else own[name] for name in own}
            found.append((rule.endpoint, method, adapter.build(rule.endpoint, own, method=method)))
    return found


def told(answer: TestResponse) -> str:
    """Everything that an answer says."""
    said: str = answer.data.decode(errors="replace") + str(answer.headers)
    answer.close()
    return said


def said_of(answer: TestResponse, *asked: str) -> tuple[int, str]:
    """Status and text, without what was asked for and what differs with each answer."""
    said = told(answer)
    for part in asked:
        said = said.replace(part, "ASKED")
    varying = ("csrf", "ETag", "Set-Cookie", "Content-Length", "Date: ")
    lines = [line for line in said.splitlines() if not any(word in line for word in varying)]
    return answer.status_code, "\n".join(lines)


def different(one: tuple[int, str], other: tuple[int, str]) -> list[str]:
    """The lines in which two answers differ."""
    return list(unified_diff([str(one[0]), *one[1].splitlines()], [str(other[0]), *other[1].splitlines()], n=0))


@pytest.mark.parametrize("name", ["ben", "rita", ""])
def test_nobody_else_sees_anything_anywhere(shared: Shared, name: str) -> None:
    client = shared.client(name)
    found, seen = [], 0
    for _, _, address in addresses(shared, "GET"):
        answer = client.get(address)
        seen += answer.status_code == 200
        assert answer.status_code < 500, address
        said = told(answer)
        found += [(address, secret) for secret in SECRETS if secret in said]
    assert found == []
    assert seen >= (60 if name else 3)


@pytest.mark.parametrize("name", ["ben", "rita", ""])
def test_asking_for_it_is_asking_for_nothing(shared: Shared, name: str) -> None:
    client = shared.client(name)
    there = addresses(shared, "GET", run_id=NUMBER, token=TOKEN, experiment=EXPERIMENT)
    nowhere = addresses(shared, "GET", run_id=NOWHERE, token=NO_TOKEN, experiment=NO_EXPERIMENT)
    for (endpoint, _, hidden), (_, _, absent) in zip(there, nowhere, strict=True):
        if endpoint.startswith("accounts."):
            continue  # times of one's own session
        for query in ASKED.get(endpoint, ("",)):
            client.get("/help/")  # shows what an earlier page had to say
            other = query.replace(str(NUMBER), str(NOWHERE)).replace(EXPERIMENT, NO_EXPERIMENT).replace(UID, "9" * 32)
            answers = [
                said_of(client.get(f"{path}?{asked}" if asked else path), *parts)
                for path, asked, parts in (
                    (hidden, query, (str(NUMBER), EXPERIMENT, TOKEN, UID)),
                    (absent, other, (str(NOWHERE), NO_EXPERIMENT, NO_TOKEN, "9" * 32)),
                )
            ]
            assert "\n".join(different(*answers)) == "", (endpoint, query)


def test_the_owner_and_admins_see_all_of_it(shared: Shared) -> None:
    for name in ("max", NAMES[Role.ADMIN]):
        client = shared.client(name)
        everything = "".join(told(client.get(address)) for _, _, address in addresses(shared, "GET"))
        everything += "".join(
            told(client.get(address))
            for _, _, address in addresses(shared, "GET", run_id=NUMBER, token=TOKEN, experiment=EXPERIMENT)
        )
        assert [secret for secret in SECRETS[:-1] if secret not in everything] == []


def test_nobody_else_changes_it(shared: Shared) -> None:
    client = shared.client("ben")
    token = client.get("/runs/1").text.partition('name="csrf_token" value="')[2].partition('"')[0]
    _, key = shared.hive.accounts.create_token("ben", TokenRequest("all", [Scope.CHANGE]))
    before = shared.hive.runs.in_full(NUMBER).content
    there = addresses(shared, "POST", run_id=NUMBER, token=TOKEN, experiment=EXPERIMENT)
    nowhere = addresses(shared, "POST", run_id=NOWHERE, token=NO_TOKEN, experiment=NO_EXPERIMENT)
    for (endpoint, _, hidden), (_, _, absent) in zip(there, nowhere, strict=True):
        if endpoint.startswith(NO_RUNS):
            continue
        answers = []
        for address, number, named in ((hidden, NUMBER, EXPERIMENT), (absent, NOWHERE, NO_EXPERIMENT)):
            form = {"csrf_token": token, "run": str(number), "tags": "x", "count": "1", "visibility": "private"}
            if endpoint.startswith("api."):
                body = {"runs": [number], "tags": ["x"], "add": ["x"], "count": 1, "visibility": "private"}
                headers = {"Authorization": f"Bearer {key}", API_HEADER: "1"}
                answer = client.post(address, json=body, headers=headers)
            else:
                answer = client.post(address, data=form)
            assert answer.status_code < 500, address
            answers.append(said_of(answer, str(number), named, TOKEN, NO_TOKEN))
        assert "\n".join(different(*answers)) == "", endpoint
    assert shared.hive.runs.in_full(NUMBER).content == before
    assert shared.hive.stored_analyses.get(TOKEN).state is AnalysisState.FAILED


def _text(piece: Any) -> str:
    return bytes(piece).decode()


def test_live_updates_count_what_the_reader_sees(shared: Shared) -> None:
    counts = {}
    for name in ("max", "ben"):
        with shared.client(name).get("/events", buffered=False) as stream:
            event = next(piece for piece in map(_text, stream.response) if "data: " in piece)
        counts[name] = json.loads(event.partition("data: ")[2])["counts"][RunState.SUCCEEDED]
    assert counts["max"] == counts["ben"] + 1


def test_a_view_only_server_shows_what_is_public(filled: Path, tmp_path: Path) -> None:
    with shared_web(filled, tmp_path) as shared:
        hive = shared.hive
        hive.sharings.runs([1], SharingChange(Visibility.PUBLIC))
        hive.settings = hive.settings.with_values({"mode": Mode.VIEW_ONLY, "auth": Auth.AUTO})
        web = world.make_web(hive)
        listed = web.client.get("/api/v1/runs").get_json()
        assert [run["id"] for run in listed["runs"]] == [1]
        assert web.client.get("/runs/2").status_code == 404
        for _, _, address in addresses(Shared(AccountWeb(web)), "GET"):
            answer = told(web.client.get(address))
            assert [secret for secret in SECRETS if secret in answer] == [], address


def test_view_only_without_accounts_hides_what_is_private(filled: Path, tmp_path: Path) -> None:
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(tmp_path, Mode.VIEW_ONLY)
    hive.store.write(lambda t: t.sharing.share_runs({1: Sharing(None, Visibility.PRIVATE)}))
    web = world.make_web(hive)
    listed = [run["id"] for run in web.client.get("/api/v1/runs").get_json()["runs"]]
    assert len(listed) == len(world.RUNS) - 1
    assert 1 not in listed
    assert web.client.get("/runs/1").status_code == 404
    hive.close()
