from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.settings import ExecutorOption, Mode
from slamhive.base.settings_sources import describe, load_settings, settings_in_force
from slamhive.executors.registry import declared_settings


def test_defaults_are_those_of_a_workstation(tmp_path):
    settings = load_settings(tmp_path, {})
    assert settings.mode is Mode.WORKSTATION
    assert settings.host == "127.0.0.1"
    assert settings.data == tmp_path / "data"
    assert settings.effective_database_url == f"sqlite:///{tmp_path / 'data' / 'slamhive.db'}"


def test_later_sources_win(tmp_path):
    (tmp_path / "configuration.py").write_text('PORT = 1\nHOST = "a"\nEXECUTOR = "docker"\n')
    settings = load_settings(tmp_path, {"SLAMHIVE_PORT": "2", "SLAMHIVE_HOST": "b"}, {"port": 3, "data": None})
    assert (settings.executor, settings.host, settings.port) == ("docker", "b", 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PROT = 1", "unknown setting in"),
        ("PORT = 'x'", "PORT='x' from configuration.py: expected int"),
        ("MODE = 'public'", "expected one of workstation, view-only, cluster, cloud"),
        ("WORKER_SLOTS = 0", "must be at least 1"),
        ("WORKER_SLOTS = None", "WORKER_SLOTS=None from configuration.py: expected int"),
        ("WORKER_SLOTS = 1.5", "WORKER_SLOTS=1.5 from configuration.py: expected int"),
        ("WORKER_SLOTS = True", "WORKER_SLOTS=True from configuration.py: expected int"),
        ("WORKER_SLOTS = 10**30", "WORKER_SLOTS from configuration.py: is a whole number of more than 64 bits"),
        ("WORKER_SLOTS = float('inf')", "WORKER_SLOTS from configuration.py: inf is not a finite number"),
        ("LEASE_S = 10**400", "LEASE_S from configuration.py: is a whole number of more than 64 bits"),
        ("PORT = 70000", "must be at most 65535"),
        ("DATA = 5", "DATA=5 from configuration.py: expected Path"),
        ("HOST = None", "HOST=None from configuration.py: expected str"),
        ("MODE = []", "expected one of workstation"),
        ("1 / 0", "ZeroDivisionError"),
        ("PORT = ", "SyntaxError"),
    ],
)
def test_mistakes_name_setting_value_and_source(tmp_path, text, message):
    (tmp_path / "configuration.py").write_text(text)
    with pytest.raises((InvalidInput, NotFound)) as caught:
        load_settings(tmp_path, {})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nan_is_below_every_minimum(tmp_path):
    with pytest.raises(InvalidInput, match="LEASE_S='nan'"):
        load_settings(tmp_path, {"SLAMHIVE_LEASE_S": "nan"})


@pytest.mark.parametrize("text", ["inf", "1e300", "-inf"])
def test_times_must_be_such_as_dates_can_be_reckoned_with(tmp_path, text):
    with pytest.raises(InvalidInput, match=f"LEASE_S='{text}' from environment variable SLAMHIVE_LEASE_S: must be"):
        load_settings(tmp_path, {"SLAMHIVE_LEASE_S": text})


def test_every_default_is_within_its_bounds(tmp_path):
    settings = {entry.environment: entry.default for entry in describe(declared_settings())}
    load_settings(tmp_path, settings, further=declared_settings)


def test_the_shipped_configuration_file_is_valid():
    root = Path(__file__).resolve().parents[2]
    assert load_settings(root, {}).mode is Mode.WORKSTATION


def test_every_setting_is_documented():
    documentation = (Path(__file__).resolve().parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")
    for entry in describe(declared_settings()):
        assert entry.help
        assert entry.name in documentation
        assert entry.environment in documentation


def test_each_value_in_force_tells_where_it_comes_from_and_no_secret(tmp_path):
    (tmp_path / "configuration.py").write_text("PORT = 1\nWORKER_SLOTS = 2\n")
    environment = {
        "SLAMHIVE_PORT": "2",
        "SLAMHIVE_SECRET_KEY": "hunter2",
        "SLAMHIVE_DATABASE_URL": "mysql://u:hunter2@lab/x",
    }
    found = {
        entry.info.name: (entry.value, entry.source)
        for entry in settings_in_force(tmp_path, environment, {"data": "here", "database_url": None})
    }
    assert found["PORT"] == ("2", "environment variable SLAMHIVE_PORT")
    assert found["WORKER_SLOTS"] == ("2", "configuration.py")
    assert found["DATA"] == (str(tmp_path / "here"), "option --data")
    assert found["HOST"] == ("127.0.0.1", "default")
    assert found["DATABASE_URL"][0] == "mysql://***@lab/x"
    assert "hunter2" not in str(found)


def declared():
    return [ExecutorOption("plain_shell", "/bin/sh", "A shell"), ExecutorOption("plain_token", "", "A token", True)]


def test_settings_that_executors_declare_come_from_the_same_sources(tmp_path):
    (tmp_path / "configuration.py").write_text("PLAIN_SHELL = '/bin/dash'\nPLAIN_TOKEN = 'hunter2'\n")
    assert load_settings(tmp_path, {}, further=declared).further == {
        "plain_shell": "/bin/dash",
        "plain_token": "hunter2",
    }
    environment = {"SLAMHIVE_PLAIN_SHELL": "/bin/bash", "SLAMHIVE_PLAIN_OTHER": "x"}
    assert load_settings(tmp_path, environment, further=declared).further["plain_shell"] == "/bin/bash"
    found = {
        entry.info.name: (entry.value, entry.source)
        for entry in settings_in_force(tmp_path, environment, further=declared())
    }
    assert found["PLAIN_SHELL"] == ("/bin/bash", "environment variable SLAMHIVE_PLAIN_SHELL")
    assert found["PLAIN_TOKEN"] == ("(not shown)", "configuration.py")
    assert load_settings(tmp_path, environment, {"plain_shell": "/x"}, declared).further["plain_shell"] == "/x"


def test_a_setting_that_nobody_declares_is_refused(tmp_path):
    (tmp_path / "configuration.py").write_text("PLAIN_SHEL = '/bin/dash'\n")
    with pytest.raises(NotFound, match="did you mean 'PLAIN_SHELL'"):
        load_settings(tmp_path, {}, further=declared)
    (tmp_path / "configuration.py").write_text("PLAIN_SHELL = 3\n")
    with pytest.raises(InvalidInput, match=r"PLAIN_SHELL=3 from configuration.py: expected str"):
        load_settings(tmp_path, {}, further=declared)


def test_executors_are_asked_for_their_settings_only_if_there_is_a_strange_name(tmp_path):
    def fail():
        raise AssertionError

    assert load_settings(tmp_path, {"SLAMHIVE_PORT": "2", "SLAMHIVE_ROOT": "/x"}, further=fail).further == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PORT = 16**4000", "PORT from configuration.py: is a whole number of more than 64 bits"),
        ("LEASE_S = float('inf')", "LEASE_S from configuration.py: inf is not a finite number"),
        ("HOST = 'a\\x00b'", "HOST from configuration.py: holds the character U+0000"),
        ("HOST = '\\ud800'", "HOST from configuration.py: holds the character U+D800"),
        ("raise SystemExit", "cannot be run: SystemExit"),
        ("def f(): f()\nf()", "cannot be run: RecursionError"),
        ("\x00", "cannot be run"),
        ("PORT = [[[", "cannot be run: SyntaxError"),
        ("PORT = {}", "expected int"),
    ],
)
def test_odd_values_of_a_configuration_file_are_explained_in_one_line(tmp_path, text, message):
    (tmp_path / "configuration.py").write_text(text)
    with pytest.raises(InvalidInput) as caught:
        load_settings(tmp_path, {})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_of_the_environment_that_are_no_text_are_named(tmp_path):
    with pytest.raises(
        InvalidInput, match="DATA from environment variable SLAMHIVE_DATA: holds the character U\\+DCFF"
    ):
        load_settings(tmp_path, {"SLAMHIVE_DATA": "/tmp/\udcff"})
