"""Versions of packages: numbered at first use, asked for by number, kept, verified, removed, moved in one file."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.cli import main
from slamhive.documents.submission import Submission
from slamhive.executors.base import ImageMissing
from slamhive.filters.words import matching
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.services.versions import is_export
from tests.services.fake_executor import FakeExecutor, write_trajectory

pytestmark = pytest.mark.integration


@dataclass
class Engine(FakeExecutor):
    """Images by digest: each holds the package as it was when it was built."""

    images: dict[str, bytes] = field(default_factory=dict)
    kept: dict[str, tuple[str, int]] = field(default_factory=dict)
    used: list[str] = field(default_factory=list)
    named: dict[str, str] = field(default_factory=dict)

    def build(self, package, progress) -> str:
        content = (package.folder / "slamhive" / "mapping.py").read_bytes()
        digest = f"sha256:{sha256(content).hexdigest()}"
        self.images[digest] = content
        self.named[package.image] = digest
        return digest

    def start(self, spec):
        self.used.append(spec.identity)
        return super().start(spec)

    def has(self, package, identity) -> bool:
        return identity in self.images

    def keep(self, package, identity, number) -> None:
        self.kept[identity] = (package.name, number)

    def forget(self, package, identity, number) -> None:
        del self.images[identity]

    def save_image(self, identity) -> Iterator[bytes]:
        saved = io.BytesIO()
        with tarfile.open(fileobj=saved, mode="w") as archive:
            member = tarfile.TarInfo("layer.tar")
            member.size = len(self.images[identity])
            archive.addfile(member, io.BytesIO(self.images[identity]))
        yield saved.getvalue()

    def named_image(self, package) -> str | None:
        return self.named.get(package.image)

    def load_image(self, chunks: Iterable[bytes]) -> str:
        with tarfile.open(fileobj=io.BytesIO(b"".join(chunks))) as archive:
            stream = archive.extractfile("layer.tar")
            assert stream is not None
            content = stream.read()
        digest = f"sha256:{sha256(content).hexdigest()}"
        self.images[digest] = content
        return digest


@pytest.fixture
def engine(hive: Hive) -> Engine:
    found = Engine(on_start=write_trajectory())
    hive.executors.opened = {"process": found, "docker": found}
    return found


def run(hive: Hive, algorithm: str = "tiny", **changes) -> int:
    (submitted,) = hive.runs.submit(Submission(algorithm, "track", evaluate=False, **changes))
    hive.worker().run(until_idle=True)
    return submitted.id


def edit(hive: Hive, line: str = "# edited\n") -> Path:
    script = hive.catalogue.package("tiny").folder / "slamhive" / "mapping.py"
    script.write_text(script.read_text() + line)
    return script


def labels(hive: Hive) -> dict[int, str | None]:
    return {record.id: record.version_label for record in hive.runs.page(matching()).records}


def test_a_run_asks_for_a_version_and_gets_its_image_and_its_folder(hive: Hive, engine: Engine) -> None:
    first = run(hive)
    edit(hive)
    yaml = hive.catalogue.package("tiny").folder / "algorithm.yaml"
    yaml.write_text(yaml.read_text().replace("seconds:", "duration:"))
    second = run(hive)
    third = run(hive, "tiny@1", parameters={"seconds": 0.1})
    assert labels(hive) == {first: "tiny@1", second: "tiny@2", third: "tiny@1"}
    assert engine.used[0] == engine.used[2] != engine.used[1]
    assert list(engine.kept.values()) == [("tiny", 1), ("tiny", 2)]
    record = hive.runs.record(third)
    assert record["algorithm"]["number"] == 1
    assert record["request"]["version"] == 1
    assert hive.runs.get(third).configuration_id != hive.runs.get(first).configuration_id
    again = hive.runs.retry(third)
    hive.worker().run(until_idle=True)
    assert labels(hive)[again.id] == "tiny@1"


def test_what_cannot_be_had_is_refused_in_one_line(hive: Hive, engine: Engine) -> None:
    run(hive)
    with pytest.raises(NotFound, match=r"no folder of version tiny@7; kept are 1; tiny is the newest"):
        run(hive, "tiny@7")
    with pytest.raises(InvalidInput, match="'tiny@old' names no version"):
        run(hive, "tiny@old")
    engine.images.clear()
    with pytest.raises(ImageMissing, match="tiny@1 cannot run on process: sha256:"):
        run(hive, "tiny@1")


def test_an_experiment_compares_versions(hive: Hive, engine: Engine) -> None:
    run(hive)
    edit(hive)
    run(hive)
    text = "name: both\nalgorithms: tiny@1 | tiny@2 | tiny\ndatasets: track\nevaluate: false\n"
    hive.experiments.start(ExperimentSource(text + "parameters: {tiny: {seconds: 0}}\n", "both.yaml"))
    hive.worker().run(until_idle=True)
    found = hive.store.read(lambda t: t.runs.get_many(hive.experiments.run_ids("both")))
    assert [record.version_label for record in found] == ["tiny@1", "tiny@2", "tiny@2"]
    assert [record.asked_version for record in found] == [1, 2, None]
    assert len({record.configuration_id for record in found}) == 3
    axes = hive.store.read(lambda t: t.run_table.axes([record.id for record in found]))
    assert list(axes["algorithm"].values()) == ["tiny@1", "tiny@2", "tiny"]


@pytest.mark.parametrize("ledger", [True, False])
def test_numbers_survive_the_loss_of_the_database(hive: Hive, engine: Engine, ledger: bool) -> None:
    run(hive)
    edit(hive)
    run(hive)
    run(hive, "tiny@1")
    then = labels(hive)
    hive.close()
    data = hive.settings.data
    (data / "slamhive.db").unlink()
    if not ledger:
        shutil.rmtree(data / "ledger")
    again = open_hive()
    reindex(again, lambda done, total: None)
    assert labels(again) == then
    assert [record.number for record in again.versions.of("tiny")] == [1, 2]
    assert again.runs.get(3).asked_version == 1
    again.close()


def test_verify_finds_what_has_changed_or_vanished(hive: Hive, engine: Engine) -> None:
    run(hive)
    assert hive.versions.verify() == []
    edit(hive)
    assert [(finding.version, finding.kind) for finding in hive.versions.verify()] == [("tiny", "folder edited")]
    run(hive)
    assert hive.versions.verify("tiny") == []
    del engine.images[engine.used[0]]
    kept = hive.settings.versions_folder / "tiny" / "2" / "algorithm.yaml"
    kept.write_text(kept.read_text() + "\n")
    found = {(finding.version, finding.kind) for finding in hive.versions.verify()}
    assert found == {("tiny@1", "missing"), ("tiny@2", "edited")}


def test_verify_finds_an_image_whose_name_was_given_to_another(hive: Hive, engine: Engine) -> None:
    run(hive)
    image = hive.catalogue.package("tiny").image
    engine.named[image] = f"sha256:{'9' * 64}"
    found = hive.versions.verify("tiny")
    assert {(finding.version, finding.kind) for finding in found} == {("tiny", "tag moved")}
    assert f"{image} names sha256:999999999999 on" in found[0].words
    engine.named[image] = engine.used[0]
    assert hive.versions.verify("tiny") == []


def test_removing_asks_before_it_takes_what_runs_used(hive: Hive, engine: Engine) -> None:
    run(hive)
    edit(hive)
    hive.versions.register(engine, hive.catalogue.package("tiny"), engine.build(hive.catalogue.package("tiny"), print))
    edit(hive)
    run(hive)
    assert [record.label for record in hive.versions.unused()] == ["tiny@2"]
    with pytest.raises(Conflict, match="1 runs used tiny@1"):
        hive.versions.remove("tiny@1")
    hive.versions.remove("tiny@2")
    hive.versions.remove("tiny@1", with_runs=True)
    assert hive.versions.unused() == []
    assert len(engine.images) == 1
    assert hive.versions.verify() == []
    assert [report.kept for report in hive.versions.reports("tiny")] == [False, False, True]


def test_a_version_moves_to_another_installation(hive: Hive, engine: Engine, tmp_path: Path) -> None:
    run(hive)
    edit(hive)
    run(hive)
    path = tmp_path / "tiny.tar"
    assert hive.versions.export("tiny@2", path, engine).label == "tiny@2"
    with pytest.raises(Conflict, match="exists"):
        hive.versions.export("tiny", path, engine)
    assert is_export(path)
    with tarfile.open(path) as archive:
        assert "layer.tar" in archive.getnames()
    package = hive.catalogue.package("tiny").folder
    shutil.rmtree(package)
    other = Engine()
    imported, record = hive.versions.load(path, other)
    assert (imported.added, record.label) == (True, "tiny@2")
    assert imported.package.folder == hive.settings.algorithms_folder / "tiny"
    assert list(other.images.values()) == [(imported.package.folder / "slamhive" / "mapping.py").read_bytes()]
    edit(hive)
    with pytest.raises(Conflict, match="is another package"):
        hive.versions.load(path, other)


def test_a_damaged_archive_changes_nothing(hive: Hive, engine: Engine, tmp_path: Path) -> None:
    run(hive)
    path = tmp_path / "tiny.tar"
    hive.versions.export("tiny", path, engine)
    whole = path.read_bytes()
    hello = b"tiny says hello"
    places = (whole.index(hello), whole.rindex(hello))  # in the package, and in the image
    damaged = [whole[:place] + b"T" + whole[place + 1 :] for place in places]
    other = Engine()
    for content in (*damaged, whole[: whole.rindex(hello)], b"no archive"):
        path.write_bytes(content)
        with pytest.raises(InvalidInput, match=r"damaged|not complete|cannot be read"):
            hive.versions.load(path, other)
    assert other.images == {}


def test_the_commands_list_and_verify(hive: Hive) -> None:
    """With real environments: one of a process is a version too."""

    def call(*arguments: str, code: int = 0) -> str:
        done = CliRunner().invoke(main, ["algorithm", *arguments])
        assert done.exit_code == code, done.output
        return done.stdout

    assert "tiny@1: " in call("build", "tiny", "--executor", "process")
    hive.executors.opened.clear()
    run(hive)
    (listed,) = json.loads(call("versions", "tiny", "--json"))
    assert (listed["version"], listed["runs"], listed["kept"]) == ("tiny@1", 1, True)
    assert "process" in listed["runs_on"]
    edit(hive)
    assert "folder edited" in call("verify", code=1)
    (found,) = json.loads(call("verify", "tiny", "--json", code=1))
    assert found["kind"] == "folder edited"
    assert "no version is unused" in call("prune")
    done = CliRunner().invoke(main, ["algorithm", "export", "tiny", "x.tar", "--executor", "process"])
    assert "has no images to export" in done.output
