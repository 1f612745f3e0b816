"""The demo as a service: builds, a rendered room, and an experiment that waits for a worker; with a real executor."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.settings import Settings
from slamhive.executors.base import ImageMissing
from slamhive.services import demo
from slamhive.services.executors import Executors
from slamhive.services.hive import Hive
from slamhive.store import open_store
from tests.services import tiny_project
from tests.sharing import share_environments

pytestmark = pytest.mark.integration

PLAN = "name: room-demo\nalgorithms: tiny\ndatasets: room\n"


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hive:
    root = tiny_project.make_project(tmp_path / "project")
    (root / "docs" / "examples").mkdir(parents=True)
    (root / demo.FILE).write_text(PLAN)
    settings = Settings(data=tmp_path / "data", min_free_disk_mb=0)
    settings.runs_folder.mkdir(parents=True)
    share_environments(settings.data)
    monkeypatch.setattr(Executors, "default", lambda _executors: ("process", "the test says so"))
    monkeypatch.setattr(demo, "SECONDS", 1.0)
    return Hive(settings, open_store(settings.effective_database_url, upgrade=True), root)


def test_the_demo_renders_a_room_and_starts_an_experiment_that_a_worker_can_do(hive: Hive) -> None:
    told: list[tuple[float, str]] = []
    name = demo.start_demo(hive, lambda fraction, text: told.append((fraction, text)))
    assert hive.catalogue.dataset("room").duration_s == pytest.approx(1.0, abs=0.2)
    status = hive.experiments.status(name)
    assert status.runs == 1
    assert name.startswith("room-demo-")
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1
    assert any("building tiny" in text for _, text in told)
    assert any("rendering the room" in text for _, text in told)
    assert demo.start_demo(hive, lambda _fraction, _text: None) == name, "a second press adds nothing"
    hive.close()


def test_a_demo_whose_algorithms_cannot_be_built_says_why(hive: Hive) -> None:
    file = hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml"
    file.write_text(file.read_text() + "system_libraries: [libnobodyhasthis.so.9]\n")
    with pytest.raises(ImageMissing, match=r"none of the demo's algorithms .* libnobodyhasthis"):
        demo.start_demo(hive, lambda _fraction, _text: None)
    hive.close()
