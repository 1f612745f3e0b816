"""The wheel carries everything that an installed copy needs, and nothing private."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("algorithms", "datasets", "docker", "evaluation", "static", "templates")
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


def test_installed_copy_finds_its_folders(wheel, tmp_path):
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-compile", wheel]
    subprocess.run(install, check=True, capture_output=True)
    code = "from slamhive.project import project_root; print(project_root())"
    found = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path)
    assert Path(found.stdout.strip()) == environment / "share" / "slamhive"
