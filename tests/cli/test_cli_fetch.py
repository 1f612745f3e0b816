"""``slamhive dataset search``, ``links`` and ``fetch`` as a user calls them."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.base.project import project_root
from slamhive.cli import main
from tests.downloads.file_server import FileServer, serving
from tests.recordings.test_kitti_odometry import sequence
from tests.services.tiny_project import environment, make_project

pytestmark = pytest.mark.integration

__all__ = ["sequence"]

Command = Callable[..., Result]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving() as files:
        yield files


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, server: FileServer, sequence: Path) -> Command:
    """A project whose catalogue leads to one archive of this machine, and nowhere else."""
    make_project(tmp_path / "project")
    catalogue = tmp_path / "project" / "datasets" / "catalogue"
    shutil.copytree(project_root() / "datasets" / "catalogue", catalogue)
    path = catalogue / "bonn.yaml"
    text = path.read_text().replace("https://www.ipb.uni-bonn.de/html/projects/rgbd_dynamic2019", server.address)
    path.write_text(
        text.replace("importer: tum-rgbd", "importer: kitti-odometry").replace(", bytes: {archive: 243818512}", "")
    )
    with zipfile.ZipFile(tmp_path / "crowd.zip", "w") as packed:
        for file in sequence.rglob("*"):
            packed.write(file, f"rgbd_bonn_crowd/{file.relative_to(sequence)}")
    server.add("/rgbd_bonn_crowd.zip", (tmp_path / "crowd.zip").read_bytes())
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    return lambda *arguments: CliRunner().invoke(main, arguments)


def test_search(slamhive: Command) -> None:
    found = slamhive("dataset", "search", "indoor", "stereo-inertial", "dark")
    assert found.exit_code == 0
    assert "euroc/MH_04_difficult" in found.stdout
    assert "The addresses are unverified" in found.stderr
    content = json.loads(slamhive("dataset", "search", "openloris", "--json").stdout)
    assert content[0]["needs"][0]["variable"] == "HF_TOKEN"
    assert slamhive("dataset", "search", "indor").stderr.startswith(
        "error: no sequence fits 'indor'; did you mean 'indoor'?"
    )


def test_links_name_what_is_gone(slamhive: Command) -> None:
    found = slamhive("dataset", "links", "bonn")
    assert found.exit_code == 1
    assert "1 of 26 addresses give their file" in found.stderr
    reports = json.loads(slamhive("dataset", "links", "bonn", "--json").stdout)
    assert [report["address"].rsplit("_", 1)[1] for report in reports if report["problem"] is None] == ["crowd.zip"]
    assert "HTTP status 404" in reports[0]["problem"]


def test_fetch(slamhive: Command, tmp_path: Path, server: FileServer) -> None:
    preview = slamhive("dataset", "fetch", "bonn/crowd", "--preview")
    assert preview.exit_code == 0
    assert "bonn/crowd becomes dataset bonn_crowd: rgbd_bonn_crowd.zip, of unknown size" in preview.stderr
    assert "licence: not stated; please cite: E. Palazzolo" in preview.stderr
    assert not server.requests
    (made,) = json.loads(slamhive("dataset", "fetch", "bonn/crowd", "--name", "people", "--json").stdout)
    assert made["name"] == "people"
    assert "dynamic-scene" in made["attributes"]
    again = slamhive("dataset", "fetch", "bonn/crowd", "--name", "people")
    assert again.exit_code == 1
    assert again.stderr == "error: dataset 'people' exists already; choose another --name, or remove it first\n"
    gone = slamhive("dataset", "fetch", "bonn/balloon")
    assert gone.exit_code == 1
    assert (
        "rgbd_bonn_balloon.zip cannot be downloaded: 127.0.0.1 does not have the file (HTTP status 404)" in gone.stderr
    )
