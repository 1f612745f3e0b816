"""Signing in and out, API tokens, throttling, and what the audit log says of requests."""

from __future__ import annotations

import shutil
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from flask.testing import FlaskClient
from werkzeug.test import TestResponse

from slamhive.base.errors import TooManyRequests, Unauthenticated
from slamhive.base.settings import Auth, Mode
from slamhive.cli.serving import who_may_use
from slamhive.domain.accounts import Role, Scope
from slamhive.domain.run import RunState
from slamhive.services.accounts import TokenRequest
from slamhive.web import limits as web_limits
from slamhive.web import live
from slamhive.web.app import create_app
from slamhive.web.limits import MOST_OF_ADDRESS, MOST_OF_BOTH, SignInLimits, network_of
from slamhive.web.live import LiveHub
from slamhive.web.serve import WebServer
from slamhive.web.views.accounts import in_words, is_own_address
from tests.web.account_world import NAMES, PASSWORD, AccountWeb, account_web, token_of
from tests.web.web_world import HOSTILE, RUNS, Web

pytestmark = pytest.mark.quick

NEW = "another long password"


@pytest.fixture(scope="module")
def kept(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[AccountWeb]:
    folder = tmp_path_factory.mktemp("accounts")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    with account_web(folder) as made:
        yield made


@pytest.fixture
def site(kept: AccountWeb) -> AccountWeb:
    """An installation that all tests share; each begins with the accounts as they were."""
    accounts = kept.web.hive.accounts
    kept.forget_failures()
    for role, name in NAMES.items():
        accounts.enable(name)
        accounts.set_role(name, role)
        accounts.set_password(name, PASSWORD)
        for token in accounts.tokens(name):
            accounts.revoke(token.id)
    return kept


def bearer(site: AccountWeb, role: Role, *scopes: Scope) -> dict[str, str]:
    _, text = site.web.hive.accounts.create_token(NAMES[role], TokenRequest("-".join(scopes), scopes))
    return {"Authorization": f"Bearer {text}"}


def last_lines(site: AccountWeb, count: int) -> list[tuple[str, str, str]]:
    lines = site.web.hive.accounts.audit(count)
    return [(line.account, line.action, line.subject) for line in lines]


@pytest.mark.integration
def test_whoever_is_unknown_is_sent_to_sign_in_and_comes_back(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    answer = client.get("/runs?state=failed")
    assert (answer.status_code, answer.location) == (302, "/login?next=/runs?state%3Dfailed")
    page = client.get(answer.location)
    assert page.status_code == 200
    assert 'name="next" value="/runs?state=failed"' in page.text
    assert "failed" not in page.text.replace("state=failed", "")
    _, done = site.sign_in("rita", next="/runs?state=failed")
    assert (done.status_code, done.location) == (303, "/runs?state=failed")


def test_scripts_and_programs_are_refused_in_words_instead(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    of_script, of_program = {"Sec-Fetch-Mode": "cors"}, {"Accept": "application/json"}
    for path, headers in (("/api/v1/runs", {}), ("/live.json", of_script), ("/runs", of_program)):
        answer = client.get(path, headers=headers)
        assert answer.status_code == 401
        assert answer.headers["WWW-Authenticate"] == "Bearer"
        assert "send an API token" in answer.text


def test_the_page_to_sign_in_works_without_scripts_and_says_nothing_else(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    page = client.get("/login").text
    assert 'autocomplete="current-password"' in page
    assert 'href="/runs/new"' not in page
    assert client.get("/healthz").status_code == 200
    with client.get("/static/theme.js") as script:
        assert script.status_code == 200


@pytest.mark.parametrize(("name", "password"), [("max", "wrong"), ("nobody", "wrong"), ("", "")])
def test_wrong_names_and_passwords_get_the_same_answer(site: AccountWeb, name: str, password: str) -> None:
    client, answer = site.sign_in(name, password)
    assert answer.status_code == 401
    assert "Name or password is wrong." in answer.text
    assert f'required value="{name}"' in answer.text
    assert client.get("/runs").status_code == 302


def test_a_session_begins_with_a_new_token_and_a_closed_cookie(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    before = token_of(client, "/login")
    fields = {"csrf_token": before, "name": "max", "password": PASSWORD}
    cookie = client.post("/login", data=fields).headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Lax" in cookie
    assert "Secure" not in cookie
    assert "Expires" not in cookie
    assert token_of(client, "/account") != before
    assert client.post("/logout", data={"csrf_token": before}).status_code == 400
    secure = site.web.app.test_client()
    page = secure.get("/login", base_url="https://localhost")
    assert "Secure" in page.headers["Set-Cookie"]


def test_signing_in_as_somebody_else_ends_the_session_before(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    before = client.get_cookie("slamhive")
    assert before is not None
    fields = {"csrf_token": token_of(client, "/account"), "name": "ada", "password": PASSWORD}
    assert client.post("/login", data=fields).status_code == 303
    assert "Account ada" in client.get("/account").text
    client.set_cookie("slamhive", before.value)
    assert client.get("/account").status_code == 302


def test_signing_in_needs_the_token_of_the_page(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    assert client.post("/login", data={"name": "max", "password": PASSWORD}).status_code == 400
    assert client.get("/runs").status_code == 302


@pytest.mark.integration
def test_the_header_names_the_caller(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    page = client.get("/").text
    assert 'title="Signed in as max, member">max</summary>' in page
    assert 'href="/runs/new"' in page
    assert 'href="/accounts"' not in client.get("/account").text
    assert 'href="/nodes"' in client.get("/").text
    assert 'href="/accounts"' in site.of(Role.ADMIN).get("/account").text


@pytest.mark.integration
def test_readers_see_no_buttons(site: AccountWeb) -> None:
    client = site.of(Role.READER)
    for path in ("/", "/runs", "/runs/1", "/algorithms", "/datasets", "/configurations/1", "/trash"):
        page = client.get(path)
        assert page.status_code == 200
        assert page.text.count('method="post"') == 1, path
        assert 'action="/logout"' in page.text
        assert "private" in page.headers["Cache-Control"]


def test_signing_out_ends_the_session_and_every_copy_of_its_cookie(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    cookie = client.get_cookie("slamhive")
    assert cookie is not None
    answer = client.post("/logout", data={"csrf_token": token_of(client, "/account")})
    assert (answer.status_code, answer.location) == (303, "/login")
    thief = site.web.app.test_client()
    thief.set_cookie("slamhive", cookie.value)
    assert thief.get("/runs").status_code == 302


def test_a_new_password_ends_other_sessions(site: AccountWeb) -> None:
    client, other = site.of(Role.MEMBER), site.of(Role.MEMBER)
    fields = {"csrf_token": token_of(client, "/account"), "old": PASSWORD, "new": NEW, "again": NEW}
    assert client.post("/account/password", data=fields).status_code == 303
    assert "Other sessions of this account have ended." in client.get("/account").text
    assert other.get("/runs").status_code == 302
    assert site.sign_in("max")[1].status_code == 401
    assert site.sign_in("max", NEW)[1].status_code == 303
    assert ("max", "accounts.change_password", "") in last_lines(site, 3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"old": "wrong"}, "The present password is wrong."),
        ({"again": "something else"}, "The two new passwords differ."),
        ({"new": "short", "again": "short"}, "The password has 5 characters."),
        ({"new": "", "again": ""}, "The password has 0 characters."),
    ],
)
def test_a_password_is_changed_by_its_owner_only_and_to_a_good_one(
    site: AccountWeb, change: dict[str, str], said: str
) -> None:
    client, other = site.of(Role.MEMBER), site.of(Role.MEMBER)
    fields = {"csrf_token": token_of(client, "/account"), "old": PASSWORD, "new": NEW, "again": NEW, **change}
    answer = client.post("/account/password", data=fields)
    assert answer.status_code == 400
    assert said in answer.text
    assert other.get("/runs").status_code == 200


def test_a_disabled_account_is_out_at_once(site: AccountWeb) -> None:
    client, headers = site.of(Role.MEMBER), bearer(site, Role.MEMBER, Scope.READ)
    program = site.web.app.test_client()
    assert (client.get("/runs").status_code, program.get("/api/v1/runs", headers=headers).status_code) == (200, 200)
    site.web.hive.accounts.disable("max")
    assert (client.get("/runs").status_code, program.get("/api/v1/runs", headers=headers).status_code) == (302, 401)
    assert site.sign_in("max")[1].status_code == 401


def test_a_token_does_what_its_scopes_say(site: AccountWeb) -> None:
    program = site.web.app.test_client()
    reads, changes = bearer(site, Role.MEMBER, Scope.READ), bearer(site, Role.MEMBER, Scope.CHANGE)
    note = {"runs": [RUNS["done"]], "protocol": "sim3"}
    refused = program.post("/api/v1/evaluations", json=note, headers=reads)
    assert refused.status_code == 403
    assert "token 'read' does not allow this: change" in refused.text
    assert program.post("/api/v1/evaluations", json=note, headers=changes).status_code == 202
    assert program.get("/account", headers=changes).status_code == 403
    (line,) = site.web.hive.accounts.audit(1)
    assert (line.account, line.via, line.action) == ("max", "token change", "api.evaluate")
    assert line.subject == f"run {RUNS['done']}"
    assert program.post("/api/v1/evaluations", data=b"[" * 100_000, headers=changes).status_code == 400
    nested = {**changes, "Content-Type": "application/json"}
    assert program.post("/api/v1/evaluations", data=b'{"runs":' + b"[" * 100_000, headers=nested).status_code == 400
    used = {token.name: token.used_at is not None for token in site.web.hive.accounts.tokens("max")}
    assert used == {"read": True, "change": True}


def test_a_wrong_token_is_refused_even_with_a_session(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    for text in ("wrong", "", "slamhive_x"):
        assert client.get("/api/v1/runs", headers={"Authorization": f"Bearer {text}"}).status_code == 401
    assert client.get("/api/v1/runs", headers={"Authorization": "Basic YTpi"}).status_code == 200


def test_cookies_that_this_server_never_makes_are_ignored(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    for cookie in ("remember_token=1|é", "remember_token=ada|" + "0" * 128, "slamhive=x.y.z", "slamhive="):
        answer = client.get("/runs", headers={"Cookie": cookie.encode().decode("latin-1")})
        assert answer.status_code == 302


def test_the_api_still_wants_its_header_from_a_session(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    answer = client.post("/api/v1/evaluations", json={"runs": [1]})
    assert answer.status_code == 403
    assert "need the header X-SLAM-Hive" in answer.text


def test_a_token_is_shown_once(site: AccountWeb) -> None:
    client = site.of(Role.READER)
    csrf = token_of(client, "/account")
    fields = {"csrf_token": csrf, "name": "ci", "scope": ["read"], "days": "30"}
    made = client.post("/account/tokens", data=fields)
    text = made.text.partition('<code class="break">')[2].partition("<")[0]
    assert made.headers["Cache-Control"] == "no-store"
    assert (
        site.web.app.test_client().get("/api/v1/runs", headers={"Authorization": f"Bearer {text}"}).status_code == 200
    )
    page = client.get("/account").text
    assert text not in page
    assert "<td>ci</td>" in page
    assert "there is a token" not in page
    assert "has a token" in client.post("/account/tokens", data=fields).text
    (token,) = site.web.hive.accounts.tokens("rita")
    assert client.post(f"/account/tokens/{token.id}/revoke", data={"csrf_token": csrf}).status_code == 303
    assert site.web.hive.accounts.tokens("rita") == []


def test_nobody_revokes_tokens_of_others_on_the_account_page(site: AccountWeb) -> None:
    bearer(site, Role.MEMBER, Scope.READ)
    (token,) = site.web.hive.accounts.tokens("max")
    client = site.of(Role.ADMIN)
    fields = {"csrf_token": token_of(client, "/account")}
    assert client.post(f"/account/tokens/{token.id}/revoke", data=fields).status_code == 404
    assert site.web.hive.accounts.tokens("max") == [token]


def test_passwords_cannot_be_tried_out(site: AccountWeb) -> None:
    for _ in range(MOST_OF_BOTH):
        assert site.sign_in("max", "wrong")[1].status_code == 401
    _, answer = site.sign_in("max")
    assert answer.status_code == 429
    assert "wrong passwords in 15 min" in answer.text
    assert site.sign_in("ada")[1].status_code == 303
    client = site.web.app.test_client()
    fields = {"csrf_token": token_of(client, "/login"), "name": "max", "password": PASSWORD}
    elsewhere = client.post("/login", data=fields, environ_overrides={"REMOTE_ADDR": "192.0.2.7"})
    assert elsewhere.status_code == 303


def fail(limits: SignInLimits, name: str, address: str) -> None:
    with pytest.raises(Unauthenticated), limits.attempt(name, address):
        raise Unauthenticated("wrong")


def test_failures_count_by_name_and_network_and_successes_do_not() -> None:
    now = [0.0]
    limits = SignInLimits(lambda: now[0])
    for _ in range(3 * MOST_OF_ADDRESS):
        with limits.attempt("max", "2001:db8::1"):
            pass
    for number in range(MOST_OF_ADDRESS):
        fail(limits, f"name{number}", f"2001:db8::{number:x}")
    with pytest.raises(TooManyRequests), limits.attempt("max", "2001:db8::ffff"):
        pytest.fail("one network tries as many names as it likes")
    with limits.attempt("max", "2001:db8:0:1::1"):
        pass
    now[0] = 901.0
    with limits.attempt("max", "2001:db8::1"):
        pass
    for number in range(100):
        fail(limits, "ada", f"192.0.2.{number}")
    with pytest.raises(TooManyRequests), limits.attempt("ada", "198.51.100.1"):
        pytest.fail("many networks try one name as often as they like")


def test_failures_are_kept_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_limits, "MOST_ADDRESSES", 50)
    limits = SignInLimits(lambda: 0.0)
    for number in range(60):
        fail(limits, f"n{number}", f"10.0.0.{number}")
    assert {len(limit._calls) for limit in (limits._both, limits._address, limits._name)} == {50}


@pytest.mark.parametrize(
    ("address", "network"),
    [("192.0.2.1", "192.0.2.1"), ("2001:db8::5", "2001:db8::/64"), ("::ffff:192.0.2.1", "192.0.2.1"), ("", "")],
)
def test_networks(address: str, network: str) -> None:
    assert network_of(address) == network


@pytest.mark.parametrize("target", ["/", "/runs", "/runs?sort=ate.rmse&x=//a", "/a#b"])
def test_addresses_to_come_back_to(target: str) -> None:
    assert is_own_address(target)


@pytest.mark.parametrize(
    "target",
    ["", "runs", "//evil.example", "/\\evil.example", "https://evil.example", "/\t/evil.example", "javascript:alert(1)",
     "/a\\b", "\\\\evil.example", "/x" * 2000, " /runs", "/\r\nSet-Cookie: a=b"],
)  # fmt: skip
def test_addresses_of_other_servers_are_not_followed(site: AccountWeb, target: str) -> None:
    assert not is_own_address(target)
    _, answer = site.sign_in("rita", next=target)
    assert answer.status_code == 400 or (answer.status_code, answer.location) == (303, "/")


@pytest.mark.integration
def test_changes_are_in_the_audit_log_with_what_they_stored(site: AccountWeb) -> None:
    client = site.of(Role.MEMBER)
    csrf = {"csrf_token": token_of(client, "/account")}
    assert client.post(f"/runs/{RUNS['failed']}/retry", data=csrf).status_code == 303
    newest = max(run.id for run in site.web.hive.runs.page(limit=100).records)
    assert client.post(f"/runs/{newest}/cancel", data=csrf).status_code == 303
    assert site.web.hive.runs.get(newest).state is RunState.CANCELLED
    assert client.post("/runs/tags", data={**csrf, "run": ["1", "2"], "add": "paper"}).status_code == 303
    assert site.web.hive.runs.get(newest).owner == "max"
    assert "asked for by" in client.get(f"/runs/{newest}").text
    listed = client.get("/runs?where=owner+%3D+max&columns=id,owner").text
    assert [f'href="/runs/{run_id}"' in listed for run_id in (newest, RUNS["failed"])] == [True, False]
    assert last_lines(site, 3) == [
        ("max", "selected_runs.tag", "runs 1 to 2"),
        ("max", "runs.cancel", f"run {newest}"),
        ("max", "runs.retry", f"run {RUNS['failed']}; queued run {newest}"),
    ]


def test_changes_through_the_api_are_in_the_audit_log_too(site: AccountWeb) -> None:
    client, headers = site.web.app.test_client(), bearer(site, Role.MEMBER, Scope.CHANGE)
    body = {"runs": [1, 2], "add": ["paper"]}
    assert client.post("/api/v1/runs/tags", json=body, headers=headers).status_code == 200
    assert last_lines(site, 1) == [("max", "api.tag", "runs 1 to 2")]
    body = {"where": "id <= 2", "count": 2, "add": ["paper"]}
    assert client.post("/api/v1/runs/search/tags", json=body, headers=headers).status_code == 200
    assert last_lines(site, 1) == [("max", "api.tag_found", "search id <= 2")]


def test_the_audit_log_says_in_words_what_was_done(site: AccountWeb) -> None:
    client = site.of(Role.ADMIN)
    csrf = {"csrf_token": token_of(client, "/account")}
    assert client.post("/runs/tags", data={**csrf, "run": ["1", "2"], "add": "paper"}).status_code == 303
    text = client.get("/audit").text
    assert 'data-label="Action" title="selected_runs.tag">Add and remove tags of the selected runs</td>' in text
    actions = {rule.endpoint for rule in site.web.app.url_map.iter_rules() if "POST" in (rule.methods or ())}
    with site.web.app.app_context():
        assert [action for action in sorted(actions) if in_words(action) in {"", action}] == []


def test_callers_do_not_share_the_keys_of_their_requests(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    of_max, of_ada = bearer(site, Role.MEMBER, Scope.CHANGE), bearer(site, Role.ADMIN, Scope.CHANGE)
    answers = [
        client.post("/api/v1/runs/3/retry", headers={**headers, "Idempotency-Key": "a"})
        for headers in (of_max, of_ada, of_max)
    ]
    first, other, again = [answer.get_json()["id"] for answer in answers]
    assert first == again != other


def test_what_is_refused_or_fails_leaves_no_line(site: AccountWeb) -> None:
    reader, member = site.of(Role.READER), site.of(Role.MEMBER)
    before = last_lines(site, 1)
    assert reader.post("/runs/1/retry", data={"csrf_token": token_of(reader, "/account")}).status_code == 403
    csrf = {"csrf_token": token_of(member, "/account")}
    assert member.post("/runs/1/retry").status_code == 400
    assert member.post(f"/runs/{RUNS['queued']}/retry", data=csrf).status_code == 409
    assert member.post("/runs/999/cancel", data=csrf).status_code == 404
    assert member.post("/trash/empty", data=csrf).status_code == 403
    assert last_lines(site, 1) == before


def test_emptying_the_trash_is_in_the_log_although_only_files_change(site: AccountWeb) -> None:
    client = site.of(Role.ADMIN)
    assert client.post("/trash/empty", data={"csrf_token": token_of(client, "/account")}).status_code == 303
    assert last_lines(site, 1) == [("ada", "trash.empty", "")]


def test_admins_see_accounts_and_the_log(site: AccountWeb) -> None:
    client = site.of(Role.ADMIN)
    assert "rita" in client.get("/accounts").text
    csrf = {"csrf_token": token_of(client, "/account")}
    client.post("/configurations/1/describe", data={**csrf, "name": "plain", "note": HOSTILE})
    page = client.get("/audit?account=ada").text
    assert 'title="configurations.describe">' in page
    assert "configuration 1; name plain" in page
    assert HOSTILE not in page
    newest = site.web.hive.accounts.audit(1)[0].id
    assert "configuration 1; name plain" not in client.get(f"/audit?before={newest}").text
    assert "There are no lines of zoe" in client.get("/audit?account=zoe").text
    assert client.get("/audit?before=x").status_code == 400


def test_a_stream_ends_when_its_reader_is_out(site: AccountWeb, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "KEEPALIVE_S", 0.0)
    hub = LiveHub(site.web.hive, interval_s=0.01)
    stream = hub.open()
    answers = iter([True, True, False])
    assert len(list(stream.events(lambda: next(answers)))) == 3
    stream.close()
    hub.close()
    with site.web.app.test_request_context(headers=bearer(site, Role.READER, Scope.READ)):
        welcome = site.web.app.extensions["slamhive-callers"].watch()
    assert welcome()
    site.web.hive.accounts.disable("rita")
    assert not welcome()


def test_no_name_of_the_host_is_wrong_where_callers_sign_in(site: AccountWeb) -> None:
    assert site.web.app.test_client().get("/login", headers={"Host": "lab.example"}).status_code == 200


@pytest.mark.integration
@pytest.mark.parametrize(("trusted", "secure"), [("", False), ("127.0.0.1", True), ("192.0.2.1", False)])
def test_only_a_trusted_proxy_is_believed(site: AccountWeb, trusted: str, secure: bool) -> None:
    hive = site.web.hive
    before, hive.settings = hive.settings, hive.settings.with_values({"trusted_proxy": trusted})
    server = WebServer(hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        asked = urllib.request.Request(f"{server.url}/login", headers={"X-Forwarded-Proto": "https"})
        with urllib.request.urlopen(asked, timeout=20) as answer:
            assert ("Secure" in answer.headers["Set-Cookie"]) is secure
    finally:
        server.close()
        thread.join(20)
        hive.settings = before


@pytest.mark.integration
def test_the_server_says_who_may_use_it(site: AccountWeb, empty: Web) -> None:
    def said(**settings: object) -> str:
        hive = empty.hive
        hive.settings = hive.settings.with_values(settings)
        return who_may_use(hive)

    assert said(host="127.0.0.1") == "users of this machine may do everything, without signing in"
    assert "slamhive account add NAME --role admin adds the first" in said(host="0.0.0.0")
    assert said(auth=Auth.NONE).startswith("AUTH = none: everybody")
    assert said(mode=Mode.VIEW_ONLY).startswith("view-only: everybody")
    assert who_may_use(site.web.hive) == "callers sign in, see docs/accounts.md"
    page = create_app(empty.hive, host="0.0.0.0")
    assert page.test_client().get("/").status_code == 200


@pytest.mark.integration
def test_the_first_page_says_how_the_first_account_is_made(empty: Web) -> None:
    client = create_app(empty.hive, host="0.0.0.0").test_client()
    assert client.get("/").location == "/login"
    assert "slamhive account add NAME --role admin" in client.get("/login").text


def posted(client: FlaskClient, path: str, **fields: str) -> TestResponse:
    """Post a form of the page of accounts."""
    return client.post(path, data={"csrf_token": token_of(client, "/accounts"), **fields})


def password_in(page: str) -> str:
    return page.partition("The password of <b>")[2].partition("<code")[2].partition(">")[2].partition("</code>")[0]


@pytest.mark.integration
def test_an_admin_adds_an_account_whose_password_is_shown_once(site: AccountWeb) -> None:
    admin = site.of(Role.ADMIN)
    answer = posted(admin, "/accounts", name="nora", role="reader")
    assert answer.headers["Cache-Control"] == "no-store"
    password = password_in(answer.text)
    assert len(password) >= 20
    assert site.sign_in("nora", password)[1].status_code == 303
    assert password not in admin.get("/accounts").text
    assert posted(admin, "/accounts", name="nora", role="reader").status_code == 409
    refused = posted(admin, "/accounts", name="Nora Key", role="reader")
    assert refused.status_code == 400
    assert "is not allowed" in refused.text
    assert posted(admin, "/accounts", name="nils", role="owner").status_code in {400, 404}


@pytest.mark.integration
def test_an_admin_changes_roles_and_passwords_and_disables_accounts(site: AccountWeb) -> None:
    admin = site.of(Role.ADMIN)
    first = password_in(posted(admin, "/accounts", name="olga", role="reader").text)
    olga, _ = site.sign_in("olga", first)
    posted(admin, "/accounts/olga/role", role="member")
    assert olga.get("/runs/new").status_code == 200
    second = password_in(posted(admin, "/accounts/olga/password").text)
    assert olga.get("/runs").status_code == 302, "her sessions have ended"
    assert site.sign_in("olga", first)[1].status_code == 401
    olga, _ = site.sign_in("olga", second)
    posted(admin, "/accounts/olga/disable")
    assert olga.get("/runs").status_code == 302
    assert "disabled" in admin.get("/accounts").text
    posted(admin, "/accounts/olga/enable")
    site.forget_failures()
    assert site.sign_in("olga", second)[1].status_code == 303


@pytest.mark.integration
@pytest.mark.parametrize("change", ["role", "password", "disable"])
def test_nobody_locks_themselves_out(site: AccountWeb, change: str) -> None:
    answer = posted(site.of(Role.ADMIN), f"/accounts/{NAMES[Role.ADMIN]}/{change}", role="reader")
    assert answer.status_code == 409
    assert "your own account" in answer.text.lower()


@pytest.mark.integration
def test_an_admin_revokes_a_token_of_somebody_else(site: AccountWeb) -> None:
    hive = site.web.hive
    key, _ = hive.accounts.create_token(NAMES[Role.MEMBER], TokenRequest("nightly", [Scope.READ], 30))
    assert posted(site.of(Role.MEMBER), f"/accounts/tokens/{key.id}/revoke").status_code == 403
    assert posted(site.of(Role.ADMIN), f"/accounts/tokens/{key.id}/revoke").status_code == 303
    assert key.id not in {token.id for token in hive.accounts.tokens()}
