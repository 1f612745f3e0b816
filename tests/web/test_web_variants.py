"""Variants on the page of a dataset: listed, made and removed."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict
from slamhive.base.project import project_root
from slamhive.services.executors import Executors
from slamhive.services.hive import open_hive
from slamhive.web.context import VARIANTS_EXTENSION
from slamhive.web.security import API_HEADER
from slamhive.web.views.start import read_steps
from tests.services.recorded_track import make_recorded_track
from tests.services.tiny_project import environment, make_project
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration


@pytest.fixture
def track(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path):
    """An installation whose dataset has a recording that can be treated."""
    root = make_project(tmp_path / "project")
    for name in ("templates", "static"):
        shutil.rmtree(root / name, ignore_errors=True)
        (root / name).symlink_to(project_root() / name)
    make_recorded_track(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(root, tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    hive = open_hive()
    yield make_web(hive)
    hive.close()


def send(web: Web, path: str, **fields: str):
    page = web.client.get("/runs/new").text
    token = page.partition('name="csrf_token" value="')[2].partition('"')[0]
    return web.client.post(path, data={"csrf_token": token, **fields})


def wait(name: str = "variant") -> None:
    for thread in threading.enumerate():
        if thread.name == name:
            thread.join(60)


def test_a_variant_is_made_listed_and_removed(track: Web):
    assert "The cache contains no variants of this dataset." in track.client.get("/datasets/track").text
    assert send(track, "/datasets/track/variants", steps="rate every=2").status_code == 303
    wait()
    (entry,) = track.hive.variants.entries("track")
    page = track.client.get("/datasets/track").text
    assert "1 variant in the cache" in page
    assert "rate of lidar (every 2)" in page
    assert f"{entry.size_bytes:,} bytes" in page
    other = send(track, f"/datasets/nowhere/variants/{entry.key}/drop")
    assert other.status_code == 404
    assert send(track, f"/datasets/track/variants/{entry.key}/drop").status_code == 303
    assert track.hive.variants.entries() == ()
    assert send(track, f"/datasets/track/variants/{entry.key}/drop").status_code == 404


@pytest.mark.parametrize(
    ("steps", "words"),
    [("", "change nothing"), ("rate hz=10", "change nothing"), ("rate hz=99", "above the 10 Hz"),
     ("resolution scale=0.5", "has no sensor for it"), ("<b>", "&lt;b&gt;")],
)  # fmt: skip
def test_steps_that_cannot_be_are_refused_at_once(track: Web, steps: str, words: str):
    answer = send(track, "/datasets/track/variants", steps=steps)
    assert answer.status_code in {400, 404}
    assert words in answer.text
    assert track.hive.variants.entries() == ()


def test_a_failed_build_says_why_on_the_page(track: Web):
    bag = track.hive.catalogue.dataset("track").bag_path
    bag.write_bytes(bag.read_bytes()[:2000])
    assert send(track, "/datasets/track/variants", steps="rate every=2").status_code == 303
    wait()
    assert "The variant could not be created: " in track.client.get("/datasets/track").text


def test_one_at_a_time(track: Web, monkeypatch: pytest.MonkeyPatch):
    maker, go_on = track.app.extensions[VARIANTS_EXTENSION], threading.Event()

    @contextmanager
    def hold(*_arguments: object) -> Iterator[None]:
        assert go_on.wait(60)
        yield

    monkeypatch.setattr(track.hive.variants, "hold", hold)
    steps = read_steps("rate every=2")
    thread = maker.start("track", steps)
    with pytest.raises(Conflict, match="a variant of track is being created; wait"):
        maker.start("track", steps)
    assert "Creating a variant, 0 % done" in track.client.get("/datasets/track").text
    go_on.set()
    thread.join()


def test_the_api_takes_steps(track: Web):
    body = {"algorithm": "tiny", "dataset": "track"}
    step = {"kind": "rate", "sensors": ["lidar"], "options": {"every": 2}}
    headers = {API_HEADER: "1"}
    (run,) = track.client.post("/api/v1/runs", json={**body, "variant": [step]}, headers=headers).get_json()["runs"]
    assert run["variant"] == [step]
    everywhere = {"kind": "rate", "options": {"every": 2}}
    (same,) = track.client.post("/api/v1/runs", json={**body, "variant": [everywhere]}, headers=headers).get_json()[
        "runs"
    ]
    assert same["configuration"] == run["configuration"]
    for wrong, words in (
        ({"kind": "rate", "options": {"every": [2]}}, "variant.0.options.every"),
        ({"kind": "blur"}, "unknown pre-processing step"),
        ({"kind": "rate", "speed": 2}, "variant.0.speed"),
        ({"kind": "rate", "options": {"every": "2; drop"}}, "step rate: every"),
    ):
        answer = track.client.post("/api/v1/runs", json={**body, "variant": [wrong]}, headers=headers)
        assert answer.status_code in {400, 404}
        assert words in answer.get_json()["error"]["message"]
