"""Replays: a bundle of one machine runs again in an empty data root; what is missing or another one is refused."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.cli import main
from slamhive.cli.archive import EXIT_CODES
from slamhive.documents.gate import ReplayAnswer
from slamhive.documents.submission import Submission
from slamhive.domain.gate import Agreement
from slamhive.executors.base import ImageMissing, PackageNeed
from slamhive.recordings.staging import checksum
from slamhive.services.archive.exporting import ExportRequest, Extra, export_archive
from slamhive.services.archive.layout import version_member
from slamhive.services.archive.reading import open_archive
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.replay.needs import Packages, ReplayRequest
from slamhive.store.records import AlgorithmVersion
from tests.services.archive_world import rewritten, sealed
from tests.services.docker_base import run_docker
from tests.services.installation import TINY_IMAGE
from tests.services.test_archive_hostile import members_of
from tests.services.test_versions import Engine
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration


EXPERIMENT = """
name: paper
algorithms: tiny
datasets: track
parameters: {seconds: 0}
seeds: 7 | 8 | 9
"""


@dataclass(frozen=True)
class World:
    """A project, the data root that ran, and its bundles: with and without what a replay needs."""

    root: Path
    bare: Path
    whole: Path

    @property
    def data(self) -> Path:
        """The data root that ran."""
        return self.root / "data"


def seal(data: Path) -> None:
    """Give the dataset the checksum of its recording."""
    folder = data / "datasets" / "track"
    text = (folder / "dataset.yaml").read_text()
    (folder / "dataset.yaml").write_text(text.replace("sha256:" + "0" * 64, checksum(folder / "track.bag")))


def export(hive: Hive, path: Path, *extra: Extra) -> Path:
    request = ExportRequest(path, extra=extra)
    export_archive(hive.settings, hive.store, request, lambda _done, _total: None, hive.versions)
    return path


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """An experiment with three runs of one configuration, evaluated."""
    root = tmp_path_factory.mktemp("replay")
    make_project(root / "project")
    make_dataset(root / "data")
    seal(root / "data")
    with pytest.MonkeyPatch.context() as patch:
        for key, value in environment(root / "project", root / "data").items():
            patch.setenv(key, value)
        hive = open_hive()
        hive.experiments.start(ExperimentSource(EXPERIMENT))
        hive.worker().run(until_idle=True)
        bare = export(hive, root / "bare.zip")
        yield World(root, bare, export(hive, root / "whole.zip", Extra.PACKAGES, Extra.RECORDINGS))
        hive.close()


def replay(bundle: Path, data: Path, *options: str) -> Result:
    data.mkdir(exist_ok=True)
    environment(data.parent, data)  # shares environments
    return CliRunner().invoke(main, ["replay", str(bundle), "--into", str(data), *options])


def test_a_bundle_replays_in_an_empty_data_root(world: World, tmp_path: Path) -> None:
    markdown = tmp_path / "replay.md"
    options = ("--load-image", "--json", "--markdown", str(markdown))
    shutil.move(world.root / "project" / "algorithms" / "tiny", tmp_path / "tiny")
    try:
        refused = replay(world.whole, tmp_path / "data")
        assert refused.exit_code == 2
        assert "package tiny, as the recorded runs used it, is not here; give --load-image" in refused.stderr
        done = replay(world.whole, tmp_path / "data", *options)
    finally:
        shutil.move(tmp_path / "tiny", world.root / "project" / "algorithms" / "tiny")
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    answer = ReplayAnswer.read(content)
    assert answer.content == content
    assert answer.answer == "agree"
    (configuration,) = answer.configurations
    assert len(configuration.recorded_runs) == 3
    assert (len(configuration.runs), configuration.failed, configuration.identical) == (5, (), 5)
    assert configuration.version.identity == configuration.recorded_version.identity
    assert not configuration.rebuilt
    assert {entry.key: entry.answer for entry in answer.metrics}["ate.rmse"] == "agree"
    assert "replay of whole.zip: agree" in markdown.read_text()
    again = open_hive({"data": tmp_path / "data"})
    repeats = again.store.read(lambda t: t.runs.get_many(configuration.runs))
    again.close()
    assert [run.seed for run in repeats] == [7, 8, 9, 7, 8]
    assert len({run.protocol.fingerprint for run in repeats if run.protocol is not None}) == 1


def test_a_record_that_was_made_up_differs(world: World, tmp_path: Path) -> None:
    """Its checksums fit, and its errors are half of what they were. The recording is here under another name."""
    data = tmp_path / "data"
    shutil.copytree(world.data / "datasets" / "track", data / "datasets" / "mine")
    text = (data / "datasets" / "mine" / "dataset.yaml").read_text()
    (data / "datasets" / "mine" / "dataset.yaml").write_text(text.replace("name: track", "name: mine", 1))
    bundle = made_up(world, tmp_path / "a.zip")
    margins = ("--margin", "failures=off", "--margin", "tracked.path=off", "--margin", "tracked_fraction=off")
    done = replay(bundle, data, *margins)
    assert done.exit_code == 1, done.output
    assert "replay of a.zip, 5 repeats: differs. The repeats differ from the record by more than" in done.stderr
    assert "ATE RMSE" in done.stdout
    assert "+100.0 %" in done.stdout
    assert (data / "datasets" / "track" / "track.bag").samefile(data / "datasets" / "mine" / "track.bag")
    hive = open_hive({"data": data})
    prepared = hive.replays.prepare(ReplayRequest(bundle), lambda _share, _text: None)
    few = hive.replays.answer(prepared, [[4]])
    hive.close()
    assert few.answer is Agreement.UNDECIDED
    assert EXIT_CODES[few.answer] == 3


def made_up(world: World, path: Path) -> Path:
    """The bare bundle with other errors."""
    members = members_of(world.bare)
    results = [name for name in members if name.endswith("/result.json")]
    assert len(results) == 3
    for name in results:
        result = json.loads(members[name])
        result["metrics"]["ate.rmse"] *= 0.5
        members[name] = json.dumps(result).encode()
    return rewritten(path, sealed(members))


def test_where_a_recording_can_be_got_is_said_before_anything_is_stored(world: World, tmp_path: Path) -> None:
    done = replay(world.bare, tmp_path / "data")
    assert done.exit_code == 2
    assert "the recording track.bag of dataset track (sha256:" in done.stderr
    assert "slamhive dataset fetch gets public sequences" in done.stderr
    assert "--with recordings" in done.stderr
    assert not any((tmp_path / "data" / "runs").iterdir())
    assert not (tmp_path / "data" / "datasets" / "track").exists()


def test_another_dataset_of_the_same_name_is_refused(world: World, tmp_path: Path) -> None:
    make_dataset(tmp_path / "data")
    done = replay(world.bare, tmp_path / "data")
    assert done.exit_code == 2
    assert "dataset track is another one here: its checksum is sha256:000000000000" in done.stderr


def test_a_recording_that_is_not_what_it_says_is_refused(world: World, tmp_path: Path) -> None:
    make_dataset(tmp_path / "data")
    seal(tmp_path / "data")
    (tmp_path / "data" / "datasets" / "track" / "track.bag").write_bytes(b"another recording")
    done = replay(world.bare, tmp_path / "data")
    assert done.exit_code == 2
    assert "the recording of track has checksum sha256:" in done.stderr
    lying = {**members_of(world.whole), "datasets/track/track.bag": b"harm"}
    done = replay(rewritten(tmp_path / "a.zip", sealed(lying)), tmp_path / "empty")
    assert done.exit_code == 2
    assert "the recording of track has checksum" in done.stderr
    assert not (tmp_path / "empty" / "datasets" / "track" / "track.bag").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("versions/tiny/harm.tar", "which no export writes"),
        ("versions/tiny/../0123456789abcdef.tar", "which no export writes"),
        ("versions/0123456789abcdef.tar", "which no export writes"),
        ("datasets/track/track.bag/../../harm", "which no export writes"),
        ("datasets/track/more/harm.bag", "belongs to nothing"),
        ("datasets/track/track.bag/a/b", "a file and a folder at once"),
    ],
)
def test_a_bundle_cannot_write_elsewhere(world: World, tmp_path: Path, name: str, message: str) -> None:
    done = replay(rewritten(tmp_path / "a.zip", sealed({**members_of(world.whole), name: b"harm"})), tmp_path / "data")
    assert (done.exit_code, message in done.stderr) == (2, True), done.output


def test_mistakes_end_in_one_line(world: World, tmp_path: Path) -> None:
    for arguments, message in (
        ((str(tmp_path / "none.zip"),), "none.zip does not exist"),
        ((str(world.whole), "--markdown", "/none/x.md"), "folder /none does not exist"),
        ((str(world.whole), "--repeats", "0"), "--repeats"),
        ((str(world.whole), "--executor", "nothing", "--into", str(tmp_path / "data")), "unknown executor 'nothing'"),
    ):
        done = CliRunner().invoke(main, ["replay", *arguments])
        assert (done.exit_code, done.stdout) == (2, ""), done.output
        assert message in done.stderr
        assert done.stderr.splitlines()[-1].startswith("error: ")


# -- versions: with an engine that holds images in memory ----------------------------------------------------------


@dataclass
class ImageEngine(Engine):
    """The engine of the tests of versions as one of containers."""

    capabilities = replace(Engine.capabilities, needs=PackageNeed.IMAGE)

    def save_image(self, identity) -> Iterator[bytes]:
        """As ``docker save`` writes it: with a manifest, which names the image."""
        saved = io.BytesIO()
        with tarfile.open(fileobj=saved, mode="w") as archive:
            named = json.dumps([{"RepoTags": ["slam-hive-algorithm:tiny"]}]).encode()
            for name, content in (("manifest.json", named), ("layer.tar", self.images[identity])):
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        yield saved.getvalue()

    def load_image(self, chunks) -> str:
        """Refuses names: they could take those of images that are here."""
        content = b"".join(chunks)
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            manifest = archive.extractfile("manifest.json")
            assert manifest is not None
            assert json.load(manifest) == [{"RepoTags": None}]
        return super().load_image([content])


@pytest.fixture
def images(hive: Hive, tmp_path: Path) -> tuple[Path, AlgorithmVersion, ImageEngine]:
    """A bundle with the image of tiny@1, what it is, and an engine without images."""
    engine = ImageEngine(on_start=lambda _spec: None)
    hive.executors.opened = {"process": engine, "docker": engine}
    (run,) = hive.runs.submit(Submission("tiny", "track", evaluate=False))
    hive.worker().run(until_idle=True)
    version = hive.runs.get(run.id).version
    assert version is not None
    bundle = export(hive, tmp_path / "a.zip", Extra.IMAGES)
    engine.images.clear()
    return bundle, version, engine


def get(hive: Hive, found: tuple[Path, AlgorithmVersion, ImageEngine], **allowed: bool) -> str:
    """The identity that would run."""
    bundle, version, engine = found
    request = ReplayRequest(bundle, **allowed)  # type: ignore[arg-type]
    with open_archive(bundle) as archive:
        packages = Packages(hive.versions, archive, request, hive.settings.versions_folder, lambda _line: None)
        return packages.get("tiny", version, engine).identity


def test_an_image_of_a_bundle_is_loaded_on_demand_only(
    hive: Hive, images: tuple[Path, AlgorithmVersion, ImageEngine]
) -> None:
    _, version, engine = images
    with pytest.raises(ImageMissing, match=r"is not here; give --load-image to take it from the bundle"):
        get(hive, images)
    assert engine.images == {}
    assert get(hive, images, load_image=True) == version.identity
    assert get(hive, images) == version.identity


def test_another_version_never_runs_silently(hive: Hive, images: tuple[Path, AlgorithmVersion, ImageEngine]) -> None:
    bundle, version, engine = images
    script = hive.catalogue.package("tiny").folder / "slamhive" / "mapping.py"
    script.write_text(script.read_text() + "# edited\n")
    shutil.rmtree(hive.settings.versions_folder)
    with pytest.raises(NotFound, match="package tiny, as the recorded runs used it, is not here"):
        get(hive, images, rebuild=True)
    member = version_member("tiny", version.identity, version.package_hash)
    tar = members_of(bundle)[member]
    hello = b"tiny says hello"
    place = tar.rindex(hello)
    forged = tar[:place] + b"T" + tar[place + 1 :]
    path = rewritten(bundle, sealed({**members_of(bundle), member: forged}))
    with pytest.raises(InvalidInput, match="is damaged"):
        get(hive, (path, version, engine), load_image=True)
    assert engine.images == {}


def test_a_package_is_built_again_only_if_that_is_said(
    hive: Hive, images: tuple[Path, AlgorithmVersion, ImageEngine], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ImageEngine, "build", lambda *_: "sha256:another")
    monkeypatch.setattr(ImageEngine, "has", lambda *_: False)
    with pytest.raises(ImageMissing, match="--rebuild builds it again"):
        get(hive, images)
    assert get(hive, images, rebuild=True) == "sha256:another"
    monkeypatch.setattr(ImageEngine, "capabilities", Engine.capabilities)
    with pytest.raises(Conflict, match=r"tiny ran as sha256:.* here it is built as sha256:another"):
        get(hive, images)


# -- in a real engine ------------------------------------------------------------------------------------------------


@pytest.fixture
def own_image(base_image: str, tmp_path: Path) -> Iterator[str]:
    """An image that is like no other, under the name that the package looks for; its digest."""
    (tmp_path / "Dockerfile").write_text(f"FROM {base_image}\nLABEL made-for={uuid.uuid4().hex}\n")
    built = run_docker("build", "--cpu-shares", "200", "--tag", TINY_IMAGE, str(tmp_path))
    assert built.returncode == 0, built.stderr
    digest = run_docker("image", "inspect", "--format", "{{.Id}}", TINY_IMAGE).stdout.strip()
    yield digest
    run_docker("rmi", "--force", digest)


@pytest.mark.docker
def test_a_replay_brings_the_image_of_its_bundle(
    own_image: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is gone from the engine, as on another machine, and comes back under its digest alone."""
    project = make_project(tmp_path / "project")
    (project / "algorithms" / "tiny" / "Dockerfile").unlink()  # the image is taken as it is
    make_dataset(tmp_path / "data")
    seal(tmp_path / "data")
    for key, value in environment(project, tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    hive = open_hive()
    hive.runs.submit(Submission("tiny", "track", {"seconds": 0}, repeat=2, executor="docker"))
    hive.worker().run(until_idle=True)
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "auto")  # the export asks all engines for the image
    bundle = export(hive, tmp_path / "a.zip", Extra.IMAGES, Extra.RECORDINGS)
    hive.close()
    assert run_docker("rmi", "--force", own_image).returncode == 0
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "process")  # for evaluations
    done = replay(bundle, tmp_path / "other", "--load-image", "--json")
    assert done.exit_code == 0, done.output
    (configuration,) = ReplayAnswer.read(json.loads(done.stdout)).configurations
    assert (configuration.version.identity, configuration.rebuilt) == (own_image, False)
    assert run_docker("image", "inspect", TINY_IMAGE).returncode != 0
