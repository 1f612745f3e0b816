"""The Python client submits runs and experiments, and waits for them; the examples in the documentation do."""

from __future__ import annotations

import ast
import asyncio
import inspect
import io
import json
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.client import Hive
from slamhive.client.http import send_file
from slamhive.client.requests import Request
from slamhive.documents.imports import UploadRequest
from slamhive.services.hive import Hive as ServedHive
from slamhive.services.hive import open_hive
from tests.recordings.format_world import make_euroc
from tests.services.imports.world import trajectory, write
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.serving import serving

pytestmark = pytest.mark.integration

NOTEBOOK = Path(__file__).parents[2] / "docs" / "examples" / "python.ipynb"
"""The examples of ``docs/python.md`` as a notebook, which ``tools/generate_docs.py`` writes."""
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


@pytest.mark.parametrize("over", ["files", "server"])
def test_all_runs_of_a_search_are_changed(data: Path, address: str, over: str) -> None:
    with Hive.open(data, writable=True) if over == "files" else Hive.connect(address) as hive:
        hive.runs.submit("tiny", "room", {"seconds": 0.0}, repeat=3)
        found = hive.runs.where("algorithm = tiny")
        assert found.tag(add=["one", "two"]).left_out == 3, "a run that is queued has no folder"
        hive.runs.get(1).cancel()
        changed = found.delete()
        assert (changed.done, changed.left_out, [run.id for run in found.sort("id")]) == (1, 2, [2, 3])
        assert "run 2 has not ended, it is queued" in changed.reasons
        assert changed.deleted_at is not None
        assert hive.runs.restore(changed.deleted_at) == (1,)
        changed = found.retry()
        assert (changed.done, changed.deleted_at, len(found)) == (1, None, 4)
        assert (found.evaluate().done, found.share("public").done) == (0, 4), "runs are shared while they wait, too"
        assert {run.visibility for run in found} == {"public"}
        for refused, words in (
            (hive.runs.delete, "all runs are meant"),
            (found.tag, "no tag is named"),
            (lambda: found.share("nobody"), "visibility"),
            (hive.runs.where("no_such = 1").retry, "no_such"),
        ):
            with pytest.raises(InvalidInput, match=words):
                refused()
        for unknown in (lambda: found.evaluate("no-protocol"), lambda: hive.runs.restore("2026-05-04T12:00:00+00:00")):
            with pytest.raises(NotFound):
                unknown()


ANALYSIS = """name: Errors
select: {tiny: {where: algorithm = tiny}}
forms:
  - {form: table, metrics: [ate.rmse], columns: algorithms}
"""


@pytest.mark.parametrize("over", ["files", "server"])
def test_notes_and_analyses(data: Path, address: str, over: str) -> None:
    with Hive.open(data, writable=True) as local:
        local.runs.submit("tiny", "room", {"seconds": 0.0}, playback_mode="sequential").wait(progress=False)
    with Hive.open(data, writable=True) if over == "files" else Hive.connect(address) as hive:
        run = hive.runs.get(1).annotate("drifts at the stairs", ["stairs", "paper"])
        assert (run.note, run.tags) == ("drifts at the stairs", ("paper", "stairs"))
        run = run.annotate(tags=["paper"])
        assert (run.note, run.tags) == ("drifts at the stairs", ("paper",))
        assert run.annotate("").refresh().note == ""
        with pytest.raises(InvalidInput, match="tag"):
            run.annotate(tags=["no tag"])
        with pytest.raises(InvalidInput, match="line 4"):
            hive.analyses.create(ANALYSIS.replace("table", "nope"))
        found = hive.analyses.create(ANALYSIS)
        assert (found.name, found.state, found.files) == ("Errors", "queued", ())
        with pytest.raises(NotFound):
            found.report()
        if over == "server":
            with Hive.open(data, writable=True) as local:
                assert local.analyses.get(found.token).wait(progress=False).state == "done"
        found = found.wait()
        assert (found.state, found.reason, found.yaml) == ("done", None, ANALYSIS)
        assert found.report()["name"] == "Errors"
        table = next(name for name in found.files if name.endswith(".csv"))
        assert b"tiny" in found.file(table)
        assert [entry.token for entry in hive.analyses] == [found.token]
        assert found.share("public").visibility == "public"
        assert found.recompute().state == "queued"
        found.delete()
        with pytest.raises(NotFound):
            found.refresh()


def test_the_examples_of_the_documentation_work(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    found: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            text = "".join(cell["source"])
            for name, replacement in {**NAMES, "http://127.0.0.1:5000": address}.items():
                text = text.replace(name, replacement)
            code = compile(text, NOTEBOOK.name, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
            waits = eval(code, found)
            if inspect.iscoroutine(waits):
                asyncio.run(waits)
    shown = capsys.readouterr()
    assert re.search(r"^succeeded \d", shown.out)
    assert "2 of 2" in shown.err
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


@pytest.mark.parametrize("through", ["files", "server"])
def test_recordings_and_trajectories_are_imported(data: Path, through: str, request: pytest.FixtureRequest) -> None:
    desk = make_euroc(data.parent / "desk")
    results, odd_results = data.parent / "results", data.parent / "odd_results"
    write(results / "mine" / "walk" / "1.txt", trajectory())
    write(results / "walk" / "groundtruth.txt", trajectory())
    files = through == "files"
    with Hive.open(data, writable=True) if files else Hive.connect(request.getfixturevalue("address")) as hive:
        assert hive.import_dataset(desk, name="desk2", progress=False).datasets == ("desk2",)
        report = hive.import_runs(results, sensors={"": "stereo"}, progress=False).runs
        assert report is not None
        assert (report.runs, report.problems) == ((1,), ())
        assert hive.runs.get(1).algorithm == "mine"
        lines = [line.split() for line in trajectory(3).splitlines()]
        odd = ["9 " + " ".join([*row[1:], row[0]]) + "\n" for row in lines]
        write(odd_results / "other" / "walk" / "1.txt", "".join(odd))
        named = hive.import_runs(odd_results, sensors={"": "stereo"}, columns="-,x,y,z,qx,qy,qz,qw,t", progress=False)
        assert named.runs is not None
        assert (named.runs.runs, named.runs.problems) == ((2,), ())
        with pytest.raises(InvalidInput, match="formt"):
            hive.import_dataset(desk, formt="tum", progress=False)
        with pytest.raises((NotFound, InvalidInput), match="nothing-here"):
            hive.import_dataset(data / "nothing-here", progress=False)


class Weak:
    """A connection that breaks in the middle of every second part, after some of it has arrived."""

    def __init__(self, hive: ServedHive) -> None:
        self.hive = hive
        self.parts = 0

    def send(self, request: Request[Any]) -> Any:
        uploads = self.hive.uploads
        if request.path == "/uploads":
            made = uploads.create(UploadRequest(**request.body), "")
            return made.model_copy(update={"part_bytes": 1000})
        token = request.path.split("/")[2]
        if request.data is not None:
            self.parts += 1
            broken = self.parts % 2 == 1
            data = request.data[:300] if broken else request.data
            uploads.folder(token, "").append(int(request.arguments["offset"]), io.BytesIO(data))
            if broken:
                raise Unavailable("the connection broke")
        return uploads.get(token, "").model_copy(update={"part_bytes": 1000})


def test_an_upload_survives_connections_that_break(data: Path, tmp_path: Path) -> None:
    file = tmp_path / "walk.bag"
    file.write_bytes(bytes(range(256)) * 20)
    with closing(open_hive({"data": str(data)})) as opened:
        weak = Weak(opened)
        sent = send_file(weak.send, file)
        with opened.uploads.folder(sent.token, "").complete(lambda _done, _text: None) as content:
            assert content.read_bytes() == file.read_bytes()
    assert weak.parts >= 6


def change(hive: Hive) -> None:
    """What both backends do alike: changes of runs and experiments, and refusals that name the value."""
    (run,) = hive.runs.submit("tiny", "room")
    assert run.cancel().state == "cancelled"
    assert (run.owner, run.visibility) == (None, "team")
    assert run.share("private").visibility == "private", "though it has no folder yet"
    with pytest.raises(NotFound, match="'all'"):
        run.share("all")
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
