"""The wheel carries everything that an installed copy needs, and nothing private."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("algorithms", "datasets", "docker", "docs", "evaluation", "static", "templates")
FILES = ("pyproject.toml", "setup.py", "README.md", "LICENSE")

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what is packaged, with a private certificate that must not be."""
    folder = tmp_path_factory.mktemp("source")
    without = shutil.ignore_patterns("__pycache__", ".venv", "*.egg-info")
    for name in ("slamhive", *FOLDERS):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=without)
    for name in FILES:
        shutil.copy(ROOT / name, folder)
    (folder / "docker" / "ca-certificates" / "private.crt").write_text("private\n")
    return folder


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    """The wheel, built by way of the source distribution."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source], check=True, capture_output=True
    )
    return next(out.glob("*.whl"))


def expected(source: Path, folder: str, where: str) -> set[str]:
    return {
        f"{where}{path.relative_to(source)}"
        for path in (source / folder).rglob("*")
        if path.is_file() and path.suffix not in {".crt", ".pyc"}
    }


def test_project_folders_lie_below_share(source, wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    prefix = f"{wheel.name.split('-py3')[0]}.data/data/share/slamhive/"
    for folder in FOLDERS:
        assert expected(source, folder, prefix) <= names
    assert not any(name.endswith(".crt") for name in names)


def test_package_is_whole_with_migrations(source, wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert expected(source, "slamhive", "") <= names
    assert "slamhive/store/migrations/script.py.mako" in names


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder of programs of an environment with the wheel. What it depends on is that of the tests."""
    environment = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-compile", wheel]
    subprocess.run(install, check=True, capture_output=True)
    (packages,) = environment.glob("lib/python*/site-packages")
    # A .pth file that this path leads to is not read, so that the checkout stays unknown.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return python.parent


@pytest.fixture
def call(installed, tmp_path):
    """Runs the installed program in an empty folder, and returns what it printed."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("SLAMHIVE_")}
    own |= {"XDG_DATA_HOME": str(tmp_path / "home"), "SLAMHIVE_EXECUTOR": "process"}
    own["PIP_NO_COMPILE"] = "no"  # pip takes it as "compile: no": each environment is used for a run or two
    (tmp_path / "empty").mkdir()

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [installed / "slamhive", *arguments]
        done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path / "empty", env=own)
        assert done.returncode == 0, done.stderr
        return done

    return call


def test_installed_copy_finds_its_folders(installed, tmp_path):
    code = "from slamhive.base.project import project_root; print(project_root())"
    found = subprocess.run([installed / "python", "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path)
    assert Path(found.stdout.strip()) == installed.parent / "share" / "slamhive"


@pytest.mark.timeout(900)
def test_the_demo_of_an_installed_copy_leaves_its_results_in_the_home_of_the_user(call, installed, tmp_path):
    before = {path for path in (installed.parent / "share").rglob("*") if "__pycache__" not in path.parts}
    done = call("demo", "--no-serve", "--seconds", "3")
    data = tmp_path / "home" / "slamhive"
    first, *_, last = done.stderr.splitlines()
    assert first.startswith(f"data root {data} (the place for an installed package")
    assert last.endswith(f"data in {data}")
    assert "kiss-icp" in done.stdout
    assert (data / "slamhive.db").is_file()
    assert list((tmp_path / "empty").iterdir()) == []
    assert {path for path in (installed.parent / "share").rglob("*") if "__pycache__" not in path.parts} == before


def test_a_data_root_of_an_earlier_version_is_found_and_said_to_be_in_danger(call, installed):
    old = installed.parent / "share" / "slamhive" / "data"
    old.mkdir()
    try:
        call("dataset", "room", "--name", "r", "--seconds", "0.5")
        assert "r" in call("dataset", "list").stdout
        (check,) = [check for check in json.loads(call("doctor", "--json").stdout) if check["name"] == "data root"]
        assert check["verdict"] == "warning"
        assert f"mv -T {old} " in check["remedy"]
    finally:
        shutil.rmtree(old)
