"""Sharing through pages and the web API: who is offered it, what it does, and what the audit log says of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.settings import Auth
from slamhive.domain.accounts import Role, Scope, Visibility
from slamhive.services.accounts import TokenRequest
from slamhive.services.sharing import SharingChange
from slamhive.web.security import API_HEADER
from tests.web.account_world import NAMES
from tests.web.test_web_visibility import EXPERIMENT, NUMBER, TOKEN, Shared, shared_web
from tests.web.web_world import make_web

pytestmark = pytest.mark.integration


@pytest.fixture
def shared(filled: Path, tmp_path: Path) -> Iterator[Shared]:
    with shared_web(filled, tmp_path) as made:
        yield made


def token_in(page: str) -> str:
    return page.partition('name="csrf_token" value="')[2].partition('"')[0]


@pytest.mark.parametrize(
    ("page", "action", "field"),
    [
        (f"/experiments/{EXPERIMENT}?tab=setup", f"/experiments/{EXPERIMENT}/share", {}),
        (f"/analyses/{TOKEN}", f"/analyses/{TOKEN}/share", {}),
        (f"/runs/{NUMBER}", "/runs/share", {"run": str(NUMBER), "back": "1"}),
    ],
)
def test_the_owner_and_admins_share_on_the_page(shared: Shared, page: str, action: str, field: dict[str, str]) -> None:
    owner, other = shared.client("max"), shared.client("ben")
    if "run" in field:
        shared.hive.sharings.experiment(EXPERIMENT, SharingChange(Visibility.TEAM))
        owner.post(action, data={**field, "visibility": "private", "csrf_token": token_in(owner.get("/runs/1").text)})
    shown = owner.get(page).text
    assert f'action="{action}"' in shown
    assert ">private</span>" in shown
    assert other.get(page).status_code == 404
    answer = owner.post(action, data={**field, "visibility": "team", "csrf_token": token_in(shown)})
    assert (answer.status_code, answer.location) == (303, page.partition("?")[0])
    seen = other.get(page)
    assert seen.status_code == 200
    assert f'action="{action}"' not in seen.text
    assert ">private</span>" not in seen.text
    refused = other.post(action, data={**field, "visibility": "private", "csrf_token": token_in(seen.text)})
    assert refused.status_code == 403
    assert "belongs to max" in refused.text
    admin = shared.client(NAMES[Role.ADMIN])
    assert f'action="{action}"' in admin.get(page).text
    log = admin.get("/audit").text
    assert "visibility team" in log
    assert "visibility private" not in log or "run" in field


def test_selected_runs_are_shared_together_or_not_at_all(shared: Shared) -> None:
    shared.hive.sharings.experiment(EXPERIMENT, SharingChange(Visibility.TEAM))
    client = shared.client("max")
    form = client.get(f"/runs/share?run={NUMBER}").text
    assert f"Run {NUMBER}" in form
    data = {"csrf_token": token_in(form), "visibility": "private", "run": [str(NUMBER), "1"]}
    assert client.post("/runs/share", data=data).status_code == 403  # run 1 has no owner
    assert shared.hive.runs.get(NUMBER).seen_by is Visibility.TEAM
    assert client.post("/runs/share", data={**data, "run": [str(NUMBER)]}).status_code == 303
    assert shared.hive.runs.get(NUMBER).seen_by is Visibility.PRIVATE
    unknown = client.post("/runs/share", data={**data, "run": [str(NUMBER)], "visibility": "all"})
    assert unknown.status_code == 404
    assert "private" in unknown.text


def test_the_api_shares_and_filters(shared: Shared) -> None:
    _, key = shared.hive.accounts.create_token("max", TokenRequest("all", [Scope.CHANGE]))
    client = shared.accounts.web.app.test_client()
    headers = {"Authorization": f"Bearer {key}", API_HEADER: "1"}
    changed = client.post(f"/api/v1/experiments/{EXPERIMENT}/share", json={"visibility": "team"}, headers=headers)
    assert (changed.status_code, changed.get_json()["visibility"], changed.get_json()["owner"]) == (200, "team", "max")
    (run,) = client.post(
        "/api/v1/runs/share", json={"runs": [NUMBER], "visibility": "private"}, headers=headers
    ).get_json()["runs"]
    assert (run["owner"], run["visibility"]) == ("max", "private")
    for where, found in (
        ("visibility = private", [NUMBER]),
        ("owner = me", [NUMBER]),
        ("owner = max and visibility != team", [NUMBER]),
        ("visibility in (team, public) and owner = me", []),
    ):
        answer = client.get("/api/v1/runs", query_string={"where": where}, headers=headers).get_json()
        assert [entry["id"] for entry in answer["runs"]] == found
    wrong = client.post("/api/v1/runs/share", json={"runs": [NUMBER], "visibility": "all"}, headers=headers)
    assert wrong.status_code == 400


START = {"algorithm": "eye-slam-stereo", "dataset": "room"}


def test_a_run_is_private_from_the_moment_it_is_asked_for(shared: Shared) -> None:
    owner, other = shared.client("max"), shared.client("ben")
    form = owner.get("/runs/new").text
    assert 'name="visibility"' in form
    assert "Owner and admins" in form
    known = {run.id for run in shared.hive.runs.page(limit=100).records}
    data = {**START, "executor": "process", "visibility": "private", "csrf_token": token_in(form)}
    assert owner.post("/runs/new", data={**data, "visibility": "all"}).status_code == 400
    assert owner.post("/runs/new", data=data).status_code == 303
    _, key = shared.hive.accounts.create_token("max", TokenRequest("all", [Scope.CHANGE]))
    headers = {"Authorization": f"Bearer {key}", API_HEADER: "1"}
    program = shared.accounts.web.app.test_client()
    body = {**START, "executor": "process", "visibility": "private"}
    (sent,) = program.post("/api/v1/runs", json=body, headers=headers).get_json()["runs"]
    assert sent["visibility"] == "private"
    made = {run.id for run in shared.hive.runs.page(limit=100).records} - known
    assert len(made) == 2
    for run in made:
        assert other.get(f"/runs/{run}").status_code == 404
        page = owner.get(f"/runs/{run}").text
        assert 'action="/runs/share"' in page
        change = {"run": str(run), "back": "1", "csrf_token": token_in(page)}
        assert owner.post("/runs/share", data={**change, "visibility": "team"}).status_code == 303
        assert other.get(f"/runs/{run}").status_code == 200
        assert owner.post("/runs/share", data={**change, "visibility": "private"}).status_code == 303
        assert other.get(f"/runs/{run}").status_code == 404


def test_an_experiment_is_private_from_its_start(shared: Shared) -> None:
    owner, other = shared.client("max"), shared.client("ben")
    page = owner.get("/new-experiment").text
    text = "name: hidden\nexecutor: process\nalgorithms: eye-slam-stereo\ndatasets: room\n"
    data = {"yaml": text, "from": "text", "do": "start", "visibility": "private", "csrf_token": token_in(page)}
    assert owner.post("/new-experiment", data=data).status_code == 303
    _, key = shared.hive.accounts.create_token("max", TokenRequest("all", [Scope.CHANGE]))
    headers = {"Authorization": f"Bearer {key}", API_HEADER: "1"}
    body = {"yaml": text.replace("hidden", "unseen"), "visibility": "private"}
    answer = shared.accounts.web.app.test_client().post("/api/v1/experiments", json=body, headers=headers)
    assert (answer.status_code, answer.get_json()["visibility"]) == (201, "private")
    for name in ("hidden", "unseen"):
        assert owner.get(f"/experiments/{name}").status_code == 200
        assert other.get(f"/experiments/{name}").status_code == 404


def test_without_accounts_nothing_is_offered(shared: Shared) -> None:
    hive = shared.hive
    hive.settings = hive.settings.with_values({"auth": Auth.NONE})
    client = make_web(hive).client
    page = client.get(f"/runs/{NUMBER}")
    assert page.status_code == 200
    assert "/runs/share" not in page.text
    assert "/runs/share" not in client.get("/runs").text
    assert 'name="visibility"' not in client.get("/runs/new").text
    assert 'name="visibility"' not in client.get("/new-experiment").text
    assert client.get("/api/v1/runs?where=owner+%3D+me").status_code == 400
