"""Where the project's folders are."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.project import about_data_root, project_root
from slamhive.base.settings_sources import load_settings

CHECKOUT = Path(__file__).resolve().parents[2]


def test_a_checkout_is_found_by_itself(monkeypatch):
    monkeypatch.delenv("SLAMHIVE_ROOT", raising=False)
    assert project_root() == CHECKOUT


def test_the_variable_wins(tmp_path, monkeypatch):
    for name in ("algorithms", "templates"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("SLAMHIVE_ROOT", str(tmp_path))
    assert project_root() == tmp_path


def test_a_wrong_value_is_refused_not_ignored(tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_ROOT", str(tmp_path))
    with pytest.raises(
        InvalidInput, match=r"SLAMHIVE_ROOT=.* is not a project folder: algorithms/.*; name the checkout"
    ):
        project_root()


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The project root of a wheel in the environment ``environment``, seen from the empty folder ``work``."""
    root = tmp_path / "environment" / "share" / "slamhive"
    root.mkdir(parents=True)
    (tmp_path / "work").mkdir()
    monkeypatch.setattr("sys.prefix", str(tmp_path / "environment"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.chdir(tmp_path / "work")
    return root


def data_root(root, **environment):
    return load_settings(root, environment).data


def test_an_installed_package_keeps_results_out_of_its_environment(installed, tmp_path, monkeypatch):
    home = tmp_path / "home" / ".local" / "share" / "slamhive"
    assert data_root(installed) == home
    assert about_data_root(installed, home).startswith("the place for an installed package")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert data_root(installed) == tmp_path / "xdg" / "slamhive"
    monkeypatch.setenv("XDG_DATA_HOME", "relative/is/ignored")
    assert data_root(installed) == home


def test_a_relative_data_root_starts_at_the_current_folder_without_a_checkout(installed, tmp_path):
    assert data_root(installed, SLAMHIVE_DATA="results") == tmp_path / "work" / "results"
    assert about_data_root(installed, tmp_path / "work" / "results") == ""
    assert data_root(tmp_path / "checkout", SLAMHIVE_DATA="results") == tmp_path / "checkout" / "results"


@pytest.mark.parametrize(("name", "environment"), [("data", {}), ("mine", {"SLAMHIVE_DATA": "mine"})])
def test_a_data_root_in_the_environment_goes_on_being_used_and_says_how_to_keep_it(
    installed, tmp_path, name, environment
):
    (installed / name).mkdir()
    (tmp_path / "home" / ".local" / "share" / "slamhive").mkdir(parents=True)
    assert data_root(installed, **environment) == installed / name
    remark = about_data_root(installed, installed / name)
    assert f"removing the environment {tmp_path / 'environment'} removes it too" in remark
    assert f"mv -T {installed / name} {tmp_path / 'home'}/.local/share/slamhive" in remark


def test_a_user_without_a_home_is_told_what_to_set(installed, monkeypatch):
    def homeless():
        raise RuntimeError

    monkeypatch.setattr(Path, "home", homeless)
    assert data_root(installed, SLAMHIVE_DATA="/srv/slamhive") == Path("/srv/slamhive")
    with pytest.raises(Unavailable, match="no home folder for the data root; set SLAMHIVE_DATA"):
        data_root(installed)


def test_the_file_of_settings_names_no_mode_that_does_not_start():
    assert "not available" not in (CHECKOUT / "configuration.py").read_text()
