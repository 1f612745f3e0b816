"""Every address and every role: who is let in, who is sent away, and that no address was forgotten."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from flask.testing import FlaskClient

from slamhive.domain.accounts import Role, Scope
from slamhive.services.accounts import TokenRequest
from slamhive.web.access import OPEN, RULES, SAFE_METHODS
from slamhive.web.security import API_HEADER
from tests.web.account_world import NAMES, AccountWeb, account_web
from tests.web.test_web_security import VALUES

pytestmark = pytest.mark.integration

FOR_EVERYBODY = {
    *("accounts.to_provider", "accounts.from_provider"),
    *("static", "bootstrap.static", "assets.plotly_js", "dashboard.health"),
    *("accounts.form", "accounts.sign_in"),
}
FOR_ADMINS = {
    *("administration.accounts", "administration.audit", "administration.add_account", "administration.change_role"),
    *("administration.replace_password", "administration.disable_account", "administration.enable_account"),
    "administration.revoke_any_token",
    *("server_imports.look_at_dataset_here", "server_imports.look_at_algorithm"),
    *("server_imports.look_at_algorithm_here", "server_imports.show", "server_imports.store"),
    *("server_imports.cancel", "server_imports.discard"),
}
CHANGED_BY_ADMINS = {
    "trash.empty",
    "api.empty_trash",
    "nodes.drain",
    "nodes.undrain",
    *("api.drain_node", "api.undrain_node", "api.import_algorithm"),
}
SUBMITTED_BY_ALL = {
    *("challenges.submit", "challenges.submit_package", "challenges.cancel"),
    *("api.submit_to_challenge", "api.submit_image_to_challenge", "api.cancel_challenge_submission"),
    *("api.create_upload", "api.send_part", "api.delete_upload"),
}
"""What readers may change: images for challenges are uploaded first."""
ONES_OWN = {
    *("accounts.sign_out", "accounts.show", "accounts.change_password", "accounts.create_token"),
    "accounts.revoke_token",
}
"""Stated again here, so that a change of the rules has to be made twice."""
PASSED = {200, 400, 405}
"""What stubs answer, and the checks of web forms behind the rules."""


@pytest.fixture(scope="module")
def guarded(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[AccountWeb]:
    """The application with its rules, and with stubs in place of its pages."""
    folder = tmp_path_factory.mktemp("guarded")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    with account_web(folder) as made:
        yield made


@pytest.fixture(scope="module")
def callers(guarded: AccountWeb) -> dict[str, tuple[FlaskClient, dict[str, str]]]:
    """{caller: browser and headers}: nobody, each role, and tokens of the admin."""
    accounts, app = guarded.web.hive.accounts, guarded.web.app
    found: dict[str, tuple[FlaskClient, dict[str, str]]] = {role.value: (guarded.of(role), {}) for role in Role}
    found["nobody"] = app.test_client(), {}
    for scope in Scope:
        _, text = accounts.create_token(NAMES[Role.ADMIN], TokenRequest(f"of-{scope}", [scope]))
        found[f"token {scope}"] = app.test_client(), {"Authorization": f"Bearer {text}"}
    for endpoint in app.view_functions:
        app.view_functions[endpoint] = lambda **_: "stub"
    return found


def requests_of(guarded: AccountWeb) -> Iterator[tuple[str, str, str]]:
    """(endpoint, method, address) of the whole map."""
    with guarded.web.app.test_request_context():
        adapter = guarded.web.app.url_map.bind("localhost")
        for rule in guarded.web.app.url_map.iter_rules():
            arguments = {name: VALUES.get(name, 1) for name in rule.arguments}
            for method in sorted(rule.methods or ()):
                yield rule.endpoint, method, adapter.build(rule.endpoint, arguments, method=method)


def may(caller: str, endpoint: str, method: str) -> bool:
    """What the documentation promises."""
    looks = method in SAFE_METHODS
    if endpoint in FOR_EVERYBODY:
        return not (caller.startswith("token") and endpoint.startswith("accounts."))
    if caller == "nobody":
        return False
    if endpoint in ONES_OWN:
        return not caller.startswith("token")
    if endpoint in FOR_ADMINS or (endpoint in CHANGED_BY_ADMINS and not looks):
        return caller in {"admin", "token administer"}
    if endpoint in SUBMITTED_BY_ALL and caller == "reader":
        return True
    return looks or caller in {"member", "admin", "token change"}


@pytest.mark.parametrize("caller", ["nobody", *Role, *(f"token {scope}" for scope in Scope)])
def test_every_address_lets_in_whom_it_should(
    guarded: AccountWeb, callers: dict[str, tuple[FlaskClient, dict[str, str]]], caller: str
) -> None:
    client, headers = callers[caller]
    wrong, seen = [], 0
    for endpoint, method, address in requests_of(guarded):
        answer = client.open(address, method=method, headers={API_HEADER: "1", **headers})
        passed = answer.status_code in PASSED
        sent_away = answer.status_code in ({302, 401} if caller == "nobody" else {403})
        seen += 1
        if passed != may(caller, endpoint, method) or not (passed or sent_away):
            wrong.append((answer.status_code, method, endpoint))
    assert wrong == []
    assert seen > 150


@pytest.mark.parametrize("method", ["GET", "POST", "DELETE"])
def test_an_unknown_address_tells_strangers_nothing(
    callers: dict[str, tuple[FlaskClient, dict[str, str]]], method: str
) -> None:
    client, _ = callers["nobody"]
    answers = [client.open(path, method=method).status_code for path in ("/nowhere", "/runs/999", "/runs")]
    assert set(answers) == ({302} if method == "GET" else {401})


def test_every_own_address_has_a_rule(guarded: AccountWeb) -> None:
    forgotten = [
        endpoint
        for endpoint, _, _ in requests_of(guarded)
        if not {endpoint, endpoint.rpartition(".")[0]} & (OPEN | RULES.keys())
    ]
    assert forgotten == []


def test_an_address_without_a_rule_is_for_admins(
    callers: dict[str, tuple[FlaskClient, dict[str, str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(RULES, "runs")
    answers = {name: client.get("/runs", headers=headers).status_code for name, (client, headers) in callers.items()}
    assert {name for name, status in answers.items() if status == 200} == {"admin", "token administer"}
