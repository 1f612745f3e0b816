"""``slamhive account``: add, list, role, password, disable, enable, token, audit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.cheap_passwords import cheap_passwords

pytestmark = pytest.mark.integration

PASSWORD = "correct horse battery\n"


@pytest.fixture
def data(tmp_path: Path, sqlite_template: Path) -> Iterator[Path]:
    (tmp_path / "datasets").mkdir()
    shutil.copy(sqlite_template, tmp_path / "slamhive.db")
    with cheap_passwords():
        yield tmp_path


def call(data: Path, *arguments: str, typed: str | None = None) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "account", *arguments], input=typed)


def content(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_an_account_from_its_beginning_to_its_end(data: Path) -> None:
    assert call(data, "list").stderr.startswith("there are no accounts; slamhive account add NAME --role admin")
    assert call(data, "add", "anna", "--role", "admin", typed=PASSWORD).stdout == "anna: admin, active\n"
    assert "anna" in call(data, "list").stdout
    assert call(data, "role", "anna", "reader").stdout == "anna: reader, active\n"
    assert call(data, "password", "anna", typed="another long password\n").exit_code == 0
    assert "disabled" in call(data, "disable", "anna").stdout
    (listed,) = content(call(data, "list", "--json"))
    assert (listed["name"], listed["role"], listed["disabled_at"] is None) == ("anna", "reader", False)
    assert content(call(data, "enable", "anna", "--json"))["disabled_at"] is None


def test_everything_is_in_the_audit_log_and_no_secret_is(data: Path) -> None:
    call(data, "add", "anna", typed=PASSWORD)
    made = content(call(data, "token", "create", "anna", "ci", "--scope", "read", "--scope", "change", "--json"))
    assert isinstance(made, dict)
    call(data, "token", "revoke", str(made["id"]))
    call(data, "add", "anna", typed=PASSWORD)  # refused, so not in the log
    lines = content(call(data, "audit", "--json"))
    assert isinstance(lines, list)
    assert [(line["action"], line["subject"]) for line in lines] == [
        ("account token revoke", str(made["id"])),
        ("account token create", "anna: ci, read, change, 90 d"),
        ("account add", "anna as member"),
    ]
    assert {line["via"] for line in lines} == {"command line"}
    assert len(content(call(data, "audit", "--limit", "1", "--json"))) == 1
    assert content(call(data, "audit", "--account", "nobody", "--json")) == []
    assert "account add" in call(data, "audit").stdout
    assert made["text"] not in json.dumps(lines)
    assert PASSWORD.strip().encode() not in (data / "slamhive.db").read_bytes()


def test_tokens_are_made_listed_and_revoked(data: Path) -> None:
    call(data, "add", "anna", typed=PASSWORD)
    assert call(data, "token", "list").stderr == "there are no tokens\n"
    made = call(data, "token", "create", "anna", "ci", "--days", "7")
    assert made.stdout.startswith("slamhive_")
    assert "it is shown only now" in made.stderr
    (listed,) = content(call(data, "token", "list", "anna", "--json"))
    assert (listed["owner"], listed["name"], listed["scopes"], listed["used_at"]) == ("anna", "ci", ["read"], None)
    assert made.stdout.strip() not in call(data, "token", "list").stdout
    assert call(data, "token", "revoke", str(listed["id"])).stdout == "token 1 ci of anna is revoked\n"
    assert content(call(data, "token", "list", "--json")) == []


@pytest.mark.parametrize(
    ("arguments", "typed", "said"),
    [
        (("add", "Anna"), PASSWORD, "account name 'Anna' is not allowed"),
        (("add", "ben"), "short\n", "the password has 5 characters; use 12 to 200"),
        (("add", "ben"), "", "no password was given"),
        (("add", "ben", "--role", "king"), PASSWORD, "Invalid value for '--role'"),
        (("add", "anna"), PASSWORD, "there is an account 'anna' already"),
        (("password", "ana"), PASSWORD, "unknown account 'ana'; did you mean 'anna'?"),
        (("disable", "ana"), None, "unknown account 'ana'"),
        (("token", "create", "ana", "ci"), None, "unknown account 'ana'"),
        (("token", "create", "anna", "c i"), None, "token name 'c i' is not allowed"),
        (("token", "revoke", "7"), None, "unknown API token"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(
    data: Path, arguments: tuple[str, ...], typed: str | None, said: str
) -> None:
    call(data, "add", "anna", typed=PASSWORD)
    before = call(data, "list", "--json").stdout, call(data, "audit", "--json").stdout
    result = call(data, *arguments, typed=typed)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"error: {said}"), result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (call(data, "list", "--json").stdout, call(data, "audit", "--json").stdout) == before
