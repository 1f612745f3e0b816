"""A filled installation whose callers sign in, with one account of each role."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from flask.testing import FlaskClient
from werkzeug.test import TestResponse

from slamhive.base.settings import Auth
from slamhive.domain.accounts import Role
from slamhive.web.context import SIGN_IN_EXTENSION
from slamhive.web.limits import SignInLimits
from tests.cheap_passwords import cheap_passwords
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

PASSWORD = "correct horse battery"
NAMES = {Role.READER: "rita", Role.MEMBER: "max", Role.ADMIN: "ada"}


@dataclass
class AccountWeb:
    """The application, and what a browser does with it."""

    web: Web

    def sign_in(self, name: str, password: str = PASSWORD, **more: str) -> tuple[FlaskClient, TestResponse]:
        """A new browser that signs in, and the answer."""
        client = self.web.app.test_client()
        fields = {"csrf_token": token_of(client, "/login"), "name": name, "password": password, **more}
        return client, client.post("/login", data=fields)

    def of(self, role: Role) -> FlaskClient:
        """A browser in which the account with this role has signed in."""
        client, answer = self.sign_in(NAMES[role])
        assert answer.status_code == 303, answer.text
        return client

    def forget_failures(self) -> None:
        """Nobody has been wrong yet."""
        self.web.app.extensions[SIGN_IN_EXTENSION] = SignInLimits()


def token_of(client: FlaskClient, page: str) -> str:
    """The CSRF token of a page."""
    return client.get(page).text.partition('name="csrf_token" value="')[2].partition('"')[0]


@contextmanager
def account_web(folder: Path) -> Iterator[AccountWeb]:
    """The application on the filled installation in ``folder``, with cheap passwords."""
    hive = world.make_hive(folder)
    hive.settings = hive.settings.with_values({"auth": Auth.ACCOUNTS})
    with cheap_passwords():
        for role, name in NAMES.items():
            hive.accounts.add(name, role, PASSWORD)
        yield AccountWeb(make_web(hive))
    hive.close()
