"""An archive goes out, comes back into an empty and into a filled installation, and equals itself."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import bagit
import pytest

from slamhive.base.errors import Conflict, Forbidden, InvalidInput
from slamhive.documents.archive import ArchiveManifest
from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.domain.verdict import FROM_REPEATS
from slamhive.services.archive.exporting import ExportReport, ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport, ArchiveReport
from slamhive.services.archive.layout import ArchivePart, bag_format
from slamhive.services.archive.writing import archive_writer
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.store import RunSort
from slamhive.store.metrics import VERDICT
from slamhive.store.records import SavedSearchRecord
from tests.services.archive_world import all_files, all_rows, make_runs
from tests.services.mariadb import DatabaseServer
from tests.services.tiny_project import environment, make_dataset

pytestmark = pytest.mark.integration

SOME = "name: some\nalgorithms: tiny\ndatasets: track\nparameters: {behaviour: good | crash, seconds: 0 | 0.01}\n"
ANALYSIS = "name: one\nselect: {all: {where: 'id >= 1'}}\nforms:\n- {form: distributions, metrics: [ate.rmse]}\n"


def of_itself(metrics: dict[str, float] | None) -> dict[str, float]:
    """Without what follows from the repeats that are there."""
    return {key: value for key, value in (metrics or {}).items() if key not in FROM_REPEATS}


def without_verdicts(figures: Iterable[tuple[Any, ...]]) -> set[tuple[Any, ...]]:
    """The rows without what follows from the repeats that are there."""
    return {row for row in figures if row[1] not in (VERDICT, *FROM_REPEATS)}


def export(hive: Hive, path: Path, **options: object) -> ExportReport:
    return export_archive(hive.settings, hive.store, ExportRequest(path, **options), lambda _done, _total: None)  # type: ignore[arg-type]


def import_archive(hive: Hive, path: Path) -> ArchiveReport:
    return ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(path, lambda _share, _text: None)


def content(path: Path) -> dict[str, bytes]:
    """Every member but the manifest, which tells when it was made."""
    with zipfile.ZipFile(path) as file:
        return {
            name.partition("/")[2]: file.read(name)
            for name in file.namelist()
            if name.partition("/")[2] not in bag_format(path.stem).tags
        }


@pytest.fixture(params=["sqlite", pytest.param("mysql", marks=pytest.mark.mysql)])
def use_database(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Gives the installation that is opened next a database of its own on a server; a file lies in its data root."""
    if request.param == "sqlite":
        yield lambda _name: None
        return
    server: DatabaseServer = request.getfixturevalue("database_server")
    names = []

    def use(name: str) -> None:
        names.append(f"slamhive_archive_{name}")
        monkeypatch.setenv("SLAMHIVE_DATABASE_URL", server.create_database(names[-1]))

    yield use
    for name in names:
        server.drop_database(name)


@pytest.fixture
def first(use_database: Callable[[str], None]) -> None:
    """Where the installation that exports has its rows."""
    use_database("first")


@pytest.fixture
def world(first: None, hive: Hive) -> Hive:
    """Runs that succeeded, failed and were repeated, one of them cancelled before it began, with all that is said."""
    make_runs(hive, 30)
    (run,) = hive.runs.submit(Submission("tiny", "track"))
    hive.runs.cancel(run.id)
    hive.store.write(lambda t: t.configuration_book.describe(1, "the first", "a <note>"))
    hive.store.write(lambda t: t.configuration_book.add_to_group("mine", [1, 2]))
    hive.searches.save(SavedSearchRecord("good", "ate.rmse < 1", ("id",), RunSort(), False))
    hive.experiments.start(ExperimentSource(SOME))
    hive.experiments.cancel("some")
    hive.stored_analyses.create(ANALYSIS)
    return hive


@pytest.fixture
def other(
    world: Hive,
    use_database: Callable[[str], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sqlite_template: Path,
) -> Iterator[Hive]:
    """A second installation, empty."""
    use_database("second")
    (tmp_path / "other").mkdir()
    shutil.copy(sqlite_template, tmp_path / "other" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "other").items():
        monkeypatch.setenv(key, value)
    opened = open_hive()
    yield opened
    opened.close()


def test_an_archive_into_an_empty_installation_equals_itself(world: Hive, other: Hive, tmp_path: Path) -> None:
    report = export(world, tmp_path / "a.zip")
    assert report.counts["runs"] == 35
    assert not report.left_out
    result = import_archive(other, tmp_path / "a.zip")
    assert (result.imported, result.kept_numbers, result.notes) == (35, True, [])
    before, after = all_rows(world), all_rows(other)
    for name, rows in before.items():
        assert after[name] == rows, name
    assert dict(all_files(other)) == dict(all_files(world))
    (analysis,) = other.stored_analyses.listed()
    assert analysis == replace(world.stored_analyses.listed()[0], attempt=0)
    assert other.stored_analyses.folder(analysis.token).source == ANALYSIS
    truth = "datasets/track/groundtruth.txt"
    assert (other.settings.data / truth).read_bytes() == (world.settings.data / truth).read_bytes()
    assert not list((other.settings.data / "datasets" / "track").glob("*.bag"))
    export(other, tmp_path / "b.zip")
    assert content(tmp_path / "b.zip") == content(tmp_path / "a.zip")
    reindex(other, lambda _done, _total: None)
    assert all_rows(other) == after


def test_an_archive_into_a_filled_installation_is_merged(world: Hive, other: Hive, tmp_path: Path) -> None:
    make_dataset(other.settings.data)
    make_runs(other, 7, salt=9)
    other.experiments.start(ExperimentSource(SOME.replace("0.01", "0.02")))
    own = all_rows(other)
    export(world, tmp_path / "a.zip")
    result = import_archive(other, tmp_path / "a.zip")
    assert (result.imported, result.kept_numbers) == (35, False)
    assert any("some-2" in note for note in result.notes)
    assert any("analyses" in note for note in result.notes)
    after = all_rows(other)
    for name in ("runs", "events", "evaluations"):
        assert set(after[name]) == set(all_rows(world)[name]) | set(own[name]), name
    own_figures = [without_verdicts(rows["figures"]) for rows in (after, all_rows(world), own)]
    assert own_figures[0] == own_figures[1] | own_figures[2]
    assert without_verdicts(after["figures"]) != set(after["figures"]), "verdicts count the repeats of both"
    reindex(other, lambda _done, _total: None)
    assert all_rows(other) == after
    theirs = dict(all_files(world))
    assert theirs.items() <= dict(all_files(other)).items()
    reindex(other, lambda _done, _total: None)
    assert all_rows(other) == after
    again = import_archive(other, tmp_path / "a.zip")
    assert (again.imported, again.known) == (0, 35)
    assert all_rows(other) == after


KILLED = """
import os, signal, sys
from pathlib import Path
from typing import Any
from slamhive.run_folder.folder import RunFolder
from slamhive.services.archive import importing
from slamhive.services.hive import open_hive
from slamhive.store import Store
importing.BATCH = 10
left = [int(sys.argv[2])]
def dying(function):
    def wrapped(*arguments):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments)
    return wrapped
if sys.argv[3] == "unpacking":
    os.utime = dying(os.utime)
else:
    Store.write = dying(Store.write)
    Path.rename = dying(Path.rename)
hive = open_hive()
importing.ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(Path(sys.argv[1]), lambda *_: None)
"""


@pytest.mark.parametrize(("doing", "step"), [("unpacking", 70), ("filing", 2), ("filing", 9), ("filing", 40)])
def test_an_import_that_was_killed_is_completed_and_nothing_is_doubled(
    world: Hive, other: Hive, tmp_path: Path, doing: str, step: int
) -> None:
    export(world, tmp_path / "a.zip")
    command: list[str] = [sys.executable, "-c", KILLED, str(tmp_path / "a.zip"), str(step), doing]
    assert subprocess.run(command, env=os.environ, timeout=120, check=False).returncode == -signal.SIGKILL
    result = import_archive(other, tmp_path / "a.zip")
    assert result.imported + result.known + result.completed == 35
    assert all_rows(other) == all_rows(world)
    assert dict(all_files(other)) == dict(all_files(world))
    assert not list(other.settings.runs_folder.glob(".*"))


def test_a_part_goes_out_with_what_it_needs(world: Hive, other: Hive, tmp_path: Path) -> None:
    without = (ArchivePart.TRAJECTORIES, ArchivePart.LOGS)
    report = export(world, tmp_path / "a.zip", run_ids=[3, 11, 12], without=without)
    assert (report.counts["runs"], report.counts["saved_searches"]) == (3, 0)
    with zipfile.ZipFile(tmp_path / "a.zip") as file:
        names = file.namelist()
    assert not any(name.endswith(("traj.txt", ".tum", "log.txt")) for name in names)
    import_archive(other, tmp_path / "a.zip")
    assert [run.id for run in other.runs.page(sort=RunSort("id", False)).records] == [3, 11, 12]
    assert other.runs.get(12).retry_of == 11
    assert of_itself(other.runs.get(3).metrics) == of_itself(world.runs.get(3).metrics)


def test_a_part_of_an_experiment_queues_nothing(hive: Hive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hive.experiments.start(ExperimentSource(SOME))
    hive.runs.cancel(1)
    report = export(hive, tmp_path / "a.zip")
    assert (report.counts["runs"], dict(report.left_out)) == (1, {"had not ended": 3})
    for key, value in environment(tmp_path / "project", tmp_path / "other").items():
        monkeypatch.setenv(key, value)
    other = open_hive()
    result = import_archive(other, tmp_path / "a.zip")
    assert any("counts as cancelled" in note for note in result.notes)
    reindex(other, lambda _done, _total: None)
    assert other.store.read(lambda t: t.runs.counts_by_state())[RunState.QUEUED] == 0
    other.close()


def test_an_archive_is_a_valid_bag(world: Hive, other: Hive, tmp_path: Path) -> None:
    """The library of the Library of Congress finds nothing to complain about, and finds one changed byte."""
    export(world, tmp_path / "my runs.zip")
    with zipfile.ZipFile(tmp_path / "my runs.zip") as file:
        file.extractall(tmp_path)
    folder = tmp_path / "my runs"
    bag = bagit.Bag(str(folder))
    bag.validate()
    assert bag.has_oxum()
    assert bag.info["External-Description"] == "35 runs of SLAM Hive"
    command: list[str] = [sys.executable, str(bagit.__file__), "--validate", str(folder)]
    assert subprocess.run(command, check=False, capture_output=True).returncode == 0
    with (folder / "data" / "runs" / "1" / "log.txt").open("r+b") as log:
        log.write(b"X")
    assert subprocess.run(command, check=False, capture_output=True).returncode == 1


def test_percent_signs_in_names_are_quoted_as_bagit_demands(world: Hive, other: Hive, tmp_path: Path) -> None:
    (world.runs.folder(1).result / "100%25.txt").write_text("all of it")
    export(world, tmp_path / "a.zip", run_ids=[1])
    with zipfile.ZipFile(tmp_path / "a.zip") as file:
        assert "  data/runs/1/result/100%2525.txt\n" in file.read("a/manifest-sha256.txt").decode()
    import_archive(other, tmp_path / "a.zip")
    assert (other.runs.folder(1).result / "100%25.txt").read_text() == "all of it"


def test_large_and_small_members_are_packed_alike(tmp_path: Path) -> None:
    text = "".join(f"{1403636580 + step / 200:.9f} {step * 7 % 1013 / 997:.6f}\n" for step in range(60_000)).encode()
    (tmp_path / "traj.txt").write_bytes(text)
    with archive_writer(tmp_path / "a.zip") as archive:
        archive.add_file("large", tmp_path / "traj.txt")
        archive.add_bytes("small", text[:100_000])
        archive.finish(ArchiveManifest(made_at="", software="", counts={}))
    with zipfile.ZipFile(tmp_path / "a.zip") as file:
        for name in ("large", "small"):
            packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS)
            data = file.read(f"a/data/{name}")
            assert file.getinfo(f"a/data/{name}").compress_size == len(packer.compress(data) + packer.flush())


def test_an_export_that_fails_leaves_no_file(world: Hive, tmp_path: Path) -> None:
    def full(done: int, _total: int) -> None:
        if done == 20:
            raise OSError(28, "No space left on device")

    request = ExportRequest(tmp_path / "out" / "a.zip")
    (tmp_path / "out").mkdir()
    with pytest.raises(Exception, match="No space left"):
        export_archive(world.settings, world.store, request, full)
    assert list((tmp_path / "out").iterdir()) == []
    request.path.write_text("mine")
    with pytest.raises(Conflict, match="exists already"):
        export_archive(world.settings, world.store, request, full)


def test_what_cannot_be_exported_or_imported_is_said(
    world: Hive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidInput, match="no run to export"):
        export(world, tmp_path / "a.zip", run_ids=[])
    export(world, tmp_path / "a.zip")
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    readonly = open_hive()
    with pytest.raises(Forbidden, match="view-only"):
        import_archive(readonly, tmp_path / "a.zip")
    readonly.close()
