"""Signing in at a provider of OpenID Connect: who gets in, and whose word is not taken."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from flask.testing import FlaskClient
from werkzeug.test import TestResponse

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.settings import Auth, NewAccounts
from slamhive.domain.accounts import Identity, Role
from slamhive.web.app import create_app
from tests.web.account_world import AccountWeb, account_web
from tests.web.oidc_provider import CLIENT, SECRET, Provider, serving

pytestmark = pytest.mark.integration

BACK = "/login/provider/back"


@pytest.fixture(scope="module")
def provider() -> Iterator[Provider]:
    with serving() as found:
        yield found


@pytest.fixture(scope="module")
def kept(filled: Path, tmp_path_factory: pytest.TempPathFactory, provider: Provider) -> Iterator[AccountWeb]:
    folder = tmp_path_factory.mktemp("oidc")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    with account_web(folder) as made:
        use(made, provider)
        yield made


@pytest.fixture
def site(kept: AccountWeb, provider: Provider) -> AccountWeb:
    """An installation that all tests share; nobody is linked, and the provider tells the truth."""
    provider.lies, provider.algorithm = {}, "RS256"
    for account in kept.web.hive.accounts.list():
        kept.web.hive.accounts.unlink(account.name)
        kept.web.hive.accounts.enable(account.name)
    use(kept, provider)
    return kept


def use(site: AccountWeb, provider: Provider, **changes: Any) -> None:
    """Make the application again, with other settings."""
    hive = site.web.hive
    update = {
        "auth": Auth.ACCOUNTS,
        "oidc_issuer": provider.issuer,
        "oidc_client_id": CLIENT,
        "oidc_client_secret": SECRET,
        "oidc_new_accounts": NewAccounts.NONE,
    }
    hive.settings = hive.settings.with_values({**update, **changes})
    site.web.app = create_app(hive)


def sign_in(
    site: AccountWeb, provider: Provider, following: str = "", **claims: Any
) -> tuple[FlaskClient, TestResponse]:
    """A new browser that goes to the provider, agrees there, and comes back."""
    client = site.web.app.test_client()
    sent = client.get("/login/provider", query_string={"next": following})
    assert sent.status_code == 302, sent.text
    assert sent.location.startswith(f"{provider.issuer}/authorize?")
    return client, client.get(BACK, query_string=provider.approve(sent.location, **{"sub": "248", **claims}))


def test_a_linked_user_signs_in_and_comes_back(site: AccountWeb, provider: Provider) -> None:
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    assert "Sign in with your organisation" in site.web.app.test_client().get("/login").text
    client, answer = sign_in(site, provider, "/runs?state=failed", preferred_username="ada")
    assert (answer.status_code, answer.location) == (303, "/runs?state=failed")
    page = client.get("/account").text
    assert "Account max" in page  # what the provider calls somebody decides nothing
    line = site.web.hive.accounts.audit(1)[0]
    assert (line.action, line.account) == ("accounts.from_provider", "ada")


def test_other_sites_are_no_address_to_go_on_to(site: AccountWeb, provider: Provider) -> None:
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    _, answer = sign_in(site, provider, "https://evil.example/")
    assert answer.location == "/"


def test_whoever_is_not_linked_stays_out(site: AccountWeb, provider: Provider) -> None:
    client, answer = sign_in(site, provider, preferred_username="ada")
    assert answer.status_code == 401
    assert "No account here belongs to &#39;ada&#39;" in answer.text
    assert client.get("/runs").status_code == 302
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    site.web.hive.accounts.disable("max")
    assert sign_in(site, provider)[1].status_code == 401


def test_accounts_are_made_where_the_settings_say_so(site: AccountWeb, provider: Provider) -> None:
    use(site, provider, oidc_new_accounts=NewAccounts.READER)
    client, answer = sign_in(site, provider, sub="new", email="Grace.Hopper@navy.example")
    assert answer.status_code == 303, answer.text
    assert "Account grace.hopper" in client.get("/account").text
    accounts = site.web.hive.accounts
    assert accounts.named("grace.hopper").role is Role.READER
    again = sign_in(site, provider, sub="new", email="other@navy.example")[1]
    assert (again.status_code, len(accounts.list())) == (303, 4)
    taken = sign_in(site, provider, sub="another", preferred_username="ada")[1]
    assert (taken.status_code, "is taken here" in taken.text) == (409, True)


@pytest.mark.parametrize(
    "lies",
    [
        {"iss": "https://other.example"},
        {"aud": "somebody-else"},
        {"nonce": "replayed"},
        {"exp": int(time.time()) - 4000},
        {"sub": None},
    ],
)
def test_tokens_for_others_or_for_another_time_are_refused(
    site: AccountWeb, provider: Provider, lies: dict[str, Any]
) -> None:
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    provider.lies = lies
    client, answer = sign_in(site, provider)
    assert answer.status_code == 401
    assert client.get("/account").status_code == 302


def test_unsigned_tokens_are_refused(site: AccountWeb, provider: Provider) -> None:
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    provider.algorithm = "none"
    assert sign_in(site, provider)[1].status_code == 401


def test_an_answer_for_another_browser_is_refused(site: AccountWeb, provider: Provider) -> None:
    site.web.hive.accounts.link("max", Identity(provider.issuer, "248"))
    mine = site.web.app.test_client()
    answer = provider.approve(mine.get("/login/provider").location, sub="248")
    victim = site.web.app.test_client()
    assert victim.get(BACK, query_string=answer).status_code == 401
    victim.get("/login/provider")
    assert victim.get(BACK, query_string=answer).status_code == 401
    assert mine.get(BACK, query_string=answer).status_code == 303
    assert mine.get(BACK, query_string=answer).status_code == 401


def test_a_refusal_of_the_provider_is_said(site: AccountWeb) -> None:
    client = site.web.app.test_client()
    state = client.get("/login/provider").location.partition("state=")[2].partition("&")[0]
    answer = client.get(
        BACK, query_string={"error": "access_denied", "error_description": "No <b>thanks</b>", "state": state}
    )
    assert (answer.status_code, "No &lt;b&gt;thanks&lt;/b&gt;" in answer.text) == (401, True)


def test_a_provider_that_does_not_answer_is_said(site: AccountWeb, provider: Provider) -> None:
    use(site, provider, oidc_issuer="http://127.0.0.1:9")
    answer = site.web.app.test_client().get("/login/provider")
    assert (answer.status_code, "does not answer" in answer.text) == (503, True)


@pytest.mark.parametrize(
    ("changes", "said"), [({"oidc_issuer": "http://idp.example"}, "https"), ({"oidc_client_id": ""}, "OIDC_CLIENT_ID")]
)
def test_settings_that_cannot_be_used_are_refused(
    site: AccountWeb, provider: Provider, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(InvalidInput, match=said):
        use(site, provider, **changes)


def test_a_person_belongs_to_one_account(site: AccountWeb, provider: Provider) -> None:
    accounts, identity = site.web.hive.accounts, Identity(provider.issuer, "248")
    accounts.link("max", identity)
    accounts.link("max", identity)
    with pytest.raises(Conflict, match="belongs to the account max"):
        accounts.link("rita", identity)
    assert [found.subject for found in accounts.identities("max")] == ["248"]


def test_without_a_provider_nobody_goes_there(site: AccountWeb, provider: Provider) -> None:
    use(site, provider, oidc_issuer="")
    client = site.web.app.test_client()
    assert "Sign in with" not in client.get("/login").text
    assert client.get("/login/provider").status_code == 404
