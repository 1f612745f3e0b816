"""The Python client submits runs and experiments, and waits for them; the examples in the documentation do."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.client import Hive
from slamhive.errors import Conflict, InvalidInput, NotFound
from slamhive.services.hive import open_hive
from tests.client.conftest import serving
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
NAMES = {"kiss-icp": "tiny", "voxel_size": "seconds", "0.5 | 1.0": "0.0 | 0.05"}
"""Names and values in the documentation, and those of an algorithm that needs no packages."""


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The data root of the test algorithm, in the working folder."""
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data", "room")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data"


@pytest.fixture
def address(data: Path) -> Iterator[str]:
    """The address of a server of the data root."""
    opened = open_hive({"data": str(data)})
    with serving(opened) as found:
        yield found
    opened.close()


def test_the_examples_of_the_documentation_work(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name, replacement in {**NAMES, "http://127.0.0.1:5000": address}.items():
        text = text.replace(name, replacement)
    found: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        exec(compile(block, PAGE.name, "exec"), found)
    shown = capsys.readouterr()
    assert re.search(r"^succeeded \d", shown.out)
    assert "2/2" in shown.err
    assert "[1, 2]" in shown.out
    assert "'seconds': 0.05" in shown.out
    assert "unknown run 123456" in shown.out
    assert len(found["table"]) == len(found["few"]) == 2  # type: ignore[arg-type]
    assert len(found["errors_m"]) == 30  # type: ignore[arg-type]
    assert found["experiment"].state == "finished"  # type: ignore[attr-defined]
    assert "[(1, 1), (2, 2)]" in shown.out
    assert "[1, 2, 3, 4]" in shown.out


def test_a_server_takes_changes(address: str, data: Path) -> None:
    with Hive.connect(address) as hive:
        batch = hive.runs.submit("tiny", "room", {"seconds": 0.01}, playback_mode="sequential", evaluate=False)
        with Hive.open(data, writable=True) as local:
            assert local.runs.get(1).wait(progress=False).state == "succeeded"
        assert [run.state for run in batch.wait(progress=False)] == ["succeeded"]
        change(hive)


def test_a_data_root_takes_changes(data: Path) -> None:
    with Hive.open(data, writable=True) as hive:
        change(hive)


def change(hive: Hive) -> None:
    """What both backends do alike: changes of runs and experiments, and refusals that name the value."""
    (run,) = hive.runs.submit("tiny", "room")
    assert run.cancel().state == "cancelled"
    again = run.retry()
    assert (again.state, again.document.retry_of) == ("queued", run.id)
    experiment = hive.experiments.start("name: pair\nalgorithms: tiny\ndatasets: room\nseeds: [1, 2]\n")
    assert experiment.pause().wait(progress=False).state == "paused"
    assert [cell.counts["queued"] for cell in experiment.cells] == [2]
    assert experiment.resume().cancel().state == "cancelled"
    assert [entry.name for entry in hive.experiments] == ["pair"]
    assert {entry.state for entry in experiment.runs} == {"cancelled"}
    number = len(hive.runs)
    with pytest.raises(NotFound, match="secondss"):
        hive.runs.submit("tiny", "room", {"secondss": 1})
    with pytest.raises(InvalidInput, match="repeat"):
        hive.runs.submit("tiny", "room", repeat=0)
    with pytest.raises(Conflict):
        experiment.resume()
    assert len(hive.runs) == number
