"""``slamhive runs share``: owner and visibility from the command line, which sees everything."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.domain.accounts import Role
from tests.cheap_passwords import cheap_passwords
from tests.services.test_trash import end
from tests.web import web_world as world

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with an account and three runs that have ended."""
    folder = tmp_path_factory.mktemp("sharing")
    hive = world.make_hive(folder)
    end(hive, *world.add_runs(hive, 3))
    with cheap_passwords():
        hive.accounts.add("anna", Role.MEMBER, "correct horse battery")
    hive.close()
    return folder / "data"


ANALYSIS = """\
name: Times
select: {all: {runs: [1, 2, 3]}}
forms:
- {form: table, metrics: [duration]}
"""


def call(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), *arguments])


def test_runs_are_shared_shown_found_and_exported(data: Path, tmp_path: Path) -> None:
    shared = call(data, "runs", "share", "1", "2", "--visibility", "private", "--owner", "anna")
    assert shared.stdout == "run 1: private, of anna\nrun 2: private, of anna\n"
    assert "private, of anna\n" in call(data, "runs", "show", "1").stdout
    public = call(data, "runs", "share", "3", "--visibility", "public", "--json")
    assert json.loads(public.stdout) == [{"id": 3, "owner": None, "visibility": "public"}]
    found = call(data, "runs", "--where", "visibility = private", "--columns", "id,owner,visibility", "--json")
    assert sorted(entry["id"] for entry in json.loads(found.stdout)) == [1, 2]
    exported = call(data, "archive", "export", str(tmp_path / "a.zip"), "--all")
    assert exported.stdout.startswith("1 runs exported")
    assert "left out: 2 runs that are not public" in exported.stderr
    whole = call(data, "archive", "export", str(tmp_path / "b.zip"), "--all", "--unpublished")
    assert whole.stdout.startswith("3 runs exported")
    site = call(data, "archive", "site", str(tmp_path / "site"))
    assert site.stdout.startswith("1 runs published")


def test_analyses_are_listed_shared_and_deleted(data: Path) -> None:
    assert call(data, "analyses", "list").stderr.startswith("there are no analyses")
    hive = world.make_hive(data.parent)
    made = hive.stored_analyses.create(
        "name: Times\nselect: {all: {runs: [1, 2, 3]}}\nforms:\n- {form: table, metrics: [duration]}\n"
    )
    hive.close()
    listed = json.loads(call(data, "analyses", "list", "--json").stdout)
    assert [(entry["token"], entry["name"], entry["state"]) for entry in listed] == [(made.token, "Times", "queued")]
    shared = call(data, "analyses", "share", made.token, "--visibility", "private", "--owner", "anna")
    assert shared.stdout == "analysis Times: private, of anna\n"
    table = call(data, "analyses", "list").stdout
    assert made.token in table
    assert "private" in table
    assert call(data, "analyses", "delete", made.token).stdout == "analysis Times deleted\n"
    assert json.loads(call(data, "analyses", "list", "--json").stdout) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("runs", "share", "1"), "nothing is to be changed"),
        (("runs", "share", "99", "--visibility", "team"), "unknown run 99"),
        (("analyses", "share", "none", "--visibility", "team"), "there is no analysis at this address"),
        (("analyses", "delete", "none"), "there is no analysis at this address"),
        (("runs", "share", "1", "--owner", "zoe"), "unknown account 'zoe'"),
        (("experiment", "share", "none", "--visibility", "team"), "unknown experiment 'none'"),
        (("runs", "--where", "owner = me"), "nobody has signed in here"),
    ],
)
def test_mistakes_are_one_line(data: Path, arguments: tuple[str, ...], said: str) -> None:
    result = call(data, *arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    assert said in result.stderr
    assert "Traceback" not in result.stderr
