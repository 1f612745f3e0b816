"""From an address to a dataset, on a server of this machine, with the catalogue's own entry of KITTI."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.settings import Mode, Settings
from slamhive.domain.dataset import Dataset
from slamhive.downloads.download import Pace
from slamhive.downloads.web import Timeouts
from slamhive.recordings.importers.registry import IMPORTERS
from slamhive.recordings.reader import open_bag
from slamhive.services.datasets import Catalogue
from slamhive.services.fetching import Collections, Fetching, FetchRequest
from tests.downloads.file_server import FileServer, serving
from tests.recordings.test_kitti_odometry import sequence

pytestmark = pytest.mark.integration

__all__ = ["sequence"]

CATALOGUE = Path(__file__).parents[2] / "datasets" / "catalogue"
SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
BITSTREAMS = "https://www.research-collection.ethz.ch/server/api/core/bitstreams"
VICON_ROOM1 = "/02ecda9a-298f-498b-970c-b7c44334d880/content"
QUICK = Pace(connections=2, span_bytes=50_000, attempts=2, first_pause_s=0.001)
ARCHIVES = ("data_odometry_gray.zip", "data_odometry_calib.zip", "data_odometry_poses.zip")


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving() as files:
        yield files


@pytest.fixture
def kitti(server: FileServer, sequence: Path, tmp_path: Path) -> FileServer:
    """KITTI's archives with two sequences, and a part of the catalogue with their addresses."""
    packed = {name: zipfile.ZipFile(tmp_path / name, "w") for name in ARCHIVES}
    for name in ("06", "07"):
        for camera in ("image_0", "image_1"):
            for image in sorted((sequence / camera).iterdir()):
                packed[ARCHIVES[0]].write(image, f"dataset/sequences/{name}/{camera}/{image.name}")
        for text in ("times.txt", "calib.txt"):
            packed[ARCHIVES[0]].write(sequence / text, f"dataset/sequences/{name}/{text}")
            packed[ARCHIVES[1]].write(sequence / text, f"dataset/sequences/{name}/{text}")
        packed[ARCHIVES[2]].write(sequence / "poses.txt", f"dataset/poses/{name}.txt")
    for name, archive in packed.items():
        archive.close()
        server.add(f"/{name}", (tmp_path / name).read_bytes())
    catalogue = tmp_path / "project" / "datasets" / "catalogue"
    catalogue.mkdir(parents=True)
    for name in ("kitti", "euroc", "newer-college", "openloris"):
        shutil.copy(CATALOGUE / f"{name}.yaml", catalogue)
    text = (catalogue / "kitti.yaml").read_text().replace('"07": {', '"07": {uncertainty_m: 0.05, ')
    (catalogue / "kitti.yaml").write_text(
        text.replace("https://s3.eu-central-1.amazonaws.com/avg-kitti", server.address).replace("about_bytes", "#")
    )
    return server


def fetching(tmp_path: Path, mode: Mode = Mode.WORKSTATION, **environment: str) -> Fetching:
    settings = Settings(data=tmp_path / "data", mode=mode)
    project = tmp_path / "project"
    return Fetching(settings, Catalogue(settings, project), Collections(project), environment, QUICK)


def run(tmp_path: Path, *names: str, **options: object) -> list[Dataset]:
    service, request = fetching(tmp_path), FetchRequest(names, **options)  # type: ignore[arg-type]
    return list(service.perform(service.plan(request), request, lambda _fraction, _text: None))


def left(tmp_path: Path) -> list[str]:
    """What lies in the data root besides datasets."""
    folder = tmp_path / "data" / "downloads"
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_several_archives_become_a_dataset(kitti: FileServer, tmp_path: Path) -> None:
    (dataset,) = run(tmp_path, "kitti/07")
    assert dataset.name == "kitti_07"
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam1"]
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.uncertainty_m == 0.05
    assert {"outdoor", "car", "loops", "kitti"} <= set(dataset.attributes)
    assert dataset.licence == "CC BY-NC-SA 3.0"
    assert "Geiger" in dataset.citation
    with open_bag(dataset.bag_path) as bag:
        assert bag.message_count == 16  # with the camera infos
    assert left(tmp_path) == []
    assert not (tmp_path / "data" / "downloads" / "kitti").exists()


def test_a_shared_archive_is_downloaded_once(kitti: FileServer, tmp_path: Path) -> None:
    made = run(tmp_path, "kitti/06", "kitti/07", "kitti/06")
    assert [dataset.name for dataset in made] == ["kitti_06", "kitti_07"]
    truths = [dataset.groundtruth for dataset in made]
    assert [None if truth is None else truth.uncertainty_m for truth in truths] == [None, 0.05]
    assert sum(request.is_probe for request in kitti.asked(f"/{ARCHIVES[0]}")) == 1
    assert left(tmp_path) == []


def test_archives_can_be_kept(kitti: FileServer, tmp_path: Path) -> None:
    run(tmp_path, "kitti/07", name="first", keep_archive=True)
    assert left(tmp_path) == sorted(f"kitti/{name}" for name in ARCHIVES)
    kitti.requests.clear()
    assert [dataset.name for dataset in run(tmp_path, "kitti/07", name="second")] == ["second"]
    assert not kitti.requests


def test_files_that_were_downloaded_by_hand(kitti: FileServer, tmp_path: Path) -> None:
    (dataset,) = run(tmp_path, "kitti/07", archives=tuple(tmp_path / name for name in ARCHIVES))
    assert dataset.name == "kitti_07"
    assert not kitti.requests
    assert all((tmp_path / name).is_file() for name in ARCHIVES)


def test_files_of_a_collection_that_only_a_browser_can_get(kitti: FileServer, tmp_path: Path, sequence: Path) -> None:
    """With no parts in the catalogue, everything in the files is taken."""
    path = tmp_path / "project" / "datasets" / "catalogue" / "newer-college.yaml"
    path.write_text(path.read_text().replace("importer: newer-college", "importer: kitti-odometry"))
    with pytest.raises(InvalidInput, match=r"cannot be downloaded by a program \(form\).*download/; .*--archive FILE"):
        run(tmp_path, "newer-college/stairs")
    by_hand = Path(shutil.make_archive(str(tmp_path / "stairs"), "gztar", sequence))
    (dataset,) = run(tmp_path, "newer-college/stairs", archives=(by_hand,))
    assert len(dataset.sensors) == 5


def test_an_interrupted_fetch_continues(kitti: FileServer, tmp_path: Path) -> None:
    """Nothing is listed before everything is there."""
    kitti.behaviours[f"/{ARCHIVES[1]}"] = lambda request: request.answer(500)
    with pytest.raises(Unavailable, match=r"data_odometry_calib.zip cannot be downloaded"):
        run(tmp_path, "kitti/07")
    assert left(tmp_path) == [f"kitti/{ARCHIVES[0]}"]
    assert fetching(tmp_path).collections
    assert not (tmp_path / "data" / "datasets").exists()
    kitti.behaviours.clear()
    kitti.requests.clear()
    run(tmp_path, "kitti/07")
    assert not kitti.asked(f"/{ARCHIVES[0]}")


def test_an_archive_that_lacks_the_sequence(kitti: FileServer, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"data_odometry_gray.zip holds no dataset/sequences/05/image_0"):
        run(tmp_path, "kitti/05")
    assert left(tmp_path) == sorted(f"kitti/{name}" for name in ARCHIVES)


def test_ground_truth_that_is_not_published(kitti: FileServer, tmp_path: Path) -> None:
    """The archive of poses lacks the sequences of the benchmark; the catalogue says so by `optional`."""
    kitti.add(f"/{ARCHIVES[2]}", b"PK\x05\x06" + bytes(18))
    (dataset,) = run(tmp_path, "kitti/07")
    assert dataset.groundtruth is None


def test_a_damaged_sequence_leaves_nothing_half_made(kitti: FileServer, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as packed:
        packed.writestr("dataset/sequences/07/calib.txt", "P0: 1 2 3")
        packed.writestr("dataset/sequences/07/times.txt", "0 1")
    kitti.add(f"/{ARCHIVES[1]}", (tmp_path / "bad.zip").read_bytes())
    with pytest.raises(InvalidInput, match=r"times\.txt"):
        run(tmp_path, "kitti/07")
    assert not any((tmp_path / "data").glob("datasets/*"))
    assert len(left(tmp_path)) == len(ARCHIVES)


def test_a_hostile_archive_is_not_unpacked(kitti: FileServer, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as packed:
        packed.writestr("dataset/sequences/07/../../../../../evil", "x")
    kitti.add(f"/{ARCHIVES[0]}", (tmp_path / "bad.zip").read_bytes())
    with pytest.raises(
        InvalidInput, match=r"data_odometry_gray.zip is not unpacked: the path .* leads out of the folder"
    ):
        run(tmp_path, "kitti/07")
    assert not list(tmp_path.rglob("evil"))


def test_archives_in_an_archive(kitti: FileServer, tmp_path: Path, sequence: Path) -> None:
    """As EuRoC has them: the archive of a room holds that of each sequence. Its importer is exchanged here."""
    path = tmp_path / "project" / "datasets" / "catalogue" / "euroc.yaml"
    text = path.read_text().replace(BITSTREAMS, kitti.address).replace("importer: euroc", "importer: kitti-odometry")
    path.write_text(text.replace("    bytes: 6042263426\n", ""))
    inner = shutil.make_archive(str(tmp_path / "inner"), "zip", sequence)
    with zipfile.ZipFile(tmp_path / "room.zip", "w") as room:
        room.write(inner, "vicon_room1/V1_01_easy/V1_01_easy.zip")
        room.writestr("vicon_room1/V1_01_easy/V1_01_easy.bag", b"not wanted")
    kitti.add(VICON_ROOM1, (tmp_path / "room.zip").read_bytes())
    (dataset,) = run(tmp_path, "euroc/V1_01_easy")
    assert len(dataset.sensors) == 5
    assert {"slow", "bright", "easy", "drone"} <= set(dataset.attributes)


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the recorded data in ../shared/data")
def test_euroc_as_it_is_published(server: FileServer, tmp_path: Path) -> None:
    """Real files of V1_01 in a room archive of today's layout, by the catalogue's own entry and importer."""
    catalogue = tmp_path / "project" / "datasets" / "catalogue"
    catalogue.mkdir(parents=True)
    text = (CATALOGUE / "euroc.yaml").read_text().replace(BITSTREAMS, server.address)
    (catalogue / "euroc.yaml").write_text(text.replace("    bytes: 6042263426\n", ""))
    inner = shutil.make_archive(str(tmp_path / "inner"), "zip", SHARED / "euroc_v101_static", "mav0")
    with zipfile.ZipFile(tmp_path / "room.zip", "w") as room:
        room.write(inner, "vicon_room1/V1_01_easy/V1_01_easy.zip")
    server.add(VICON_ROOM1, (tmp_path / "room.zip").read_bytes())
    (dataset,) = run(tmp_path, "euroc/V1_01_easy")
    assert [sensor.kind.value for sensor in dataset.sensors].count("camera") == 2
    assert "Burri" in dataset.citation
    assert {"indoor", "easy"} <= set(dataset.attributes)


@pytest.mark.parametrize(
    ("names", "options", "problem"),
    [
        (("kitti",), {}, "'kitti' names no sequence; write COLLECTION/SEQUENCE"),
        (("kiti/07",), {}, "unknown collection 'kiti'; did you mean 'kitti'"),
        (("kitti/7",), {}, "collection kitti has no sequence '7'; did you mean '17'"),
        (("kitti/x*",), {}, r"no sequence of kitti matches 'x\*'"),
        (("kitti/07",), {"source": "gray"}, "kitti/07 has no source 'gray'; did you mean 'grey'"),
        (("kitti/07",), {"name": "a/b"}, "dataset name 'a/b' is not allowed"),
        (("kitti/06", "kitti/07"), {"name": "x"}, "--name and --archive are for a single sequence"),
        (("kitti/07",), {"archives": (Path("/nowhere"),)}, "/nowhere is not a file"),
        (
            ("kitti/07",),
            {"archives": (Path(__file__),)},
            "kitti/07 has no file test_fetching.py; its files are data_odo",
        ),
        (("newer-college/park",), {"archives": (Path("/nowhere"),)}, "/nowhere is not a file"),
        (("openloris/cafe1-1",), {}, "OpenLORIS-Scene needs an access token.*then set HF_TOKEN=TOKEN"),
    ],
)
def test_mistakes(
    kitti: FileServer, tmp_path: Path, names: tuple[str, ...], options: dict[str, object], problem: str
) -> None:
    with pytest.raises(SlamHiveError, match=problem):
        run(tmp_path, *names, **options)
    assert not kitti.requests
    assert not (tmp_path / "data").exists()


def test_names_that_are_taken_are_noticed_before(kitti: FileServer, tmp_path: Path) -> None:
    (tmp_path / "data" / "datasets" / "kitti_07").mkdir(parents=True)
    with pytest.raises(Conflict, match="dataset 'kitti_07' exists already"):
        run(tmp_path, "kitti/07")
    assert not kitti.requests


def test_licences_to_accept(kitti: FileServer, tmp_path: Path) -> None:
    path = tmp_path / "project" / "datasets" / "catalogue" / "kitti.yaml"
    path.write_text(f"{path.read_text()}needs: [{{kind: licence, text: Read it., address: 'https://example.org/l'}}]\n")
    with pytest.raises(InvalidInput, match=r"licence to accept.*Read it. https://example.org/l; .*--accept-licence"):
        run(tmp_path, "kitti/07")
    assert run(tmp_path, "kitti/07", accept_licence=True)


def test_7z_has_to_be_unpacked_by_hand(kitti: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IMPORTERS, "get", lambda name: name)
    service = fetching(tmp_path, HF_TOKEN="secret")
    with pytest.raises(InvalidInput, match=r"packed with 7z.*7z x\), and run slamhive dataset import FOLDER"):
        service.plan(FetchRequest(("openloris/cafe1-1",)))


def test_view_only_installations_fetch_nothing(kitti: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Forbidden):
        fetching(tmp_path, Mode.VIEW_ONLY).plan(FetchRequest(("kitti/07",)))


def test_room_for_everything_is_needed_before(
    kitti: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "project" / "datasets" / "catalogue" / "kitti.yaml"
    path.write_text(path.read_text().replace("#: 22000000000", "about_bytes: 22000000000"))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=23_000_000_000))
    with pytest.raises(Unavailable, match=r"has 23,000 MB free, kitti/07 needs about 24,100 MB"):
        run(tmp_path, "kitti/07")
    assert not kitti.requests


def test_what_killed_commands_unpacked_is_removed(kitti: FileServer, tmp_path: Path) -> None:
    old = tmp_path / "data" / "downloads" / "kitti" / ".slamhive-abc"
    old.mkdir(parents=True)
    (old / "file").write_text("x")
    run(tmp_path, "kitti/07")
    assert not old.exists()


def test_the_download_is_reported(kitti: FileServer, tmp_path: Path) -> None:
    service, request, told = fetching(tmp_path), FetchRequest(("kitti/07",)), []
    list(service.perform(service.plan(request), request, lambda fraction, text: told.append((fraction, text))))
    assert [fraction for fraction, _ in told] == sorted(fraction for fraction, _ in told)
    assert told[0][1].startswith("kitti/07: data_odometry_gray.zip: 0.0")
    assert told[-1][0] == 1.0
    assert any("unpacking data_odometry_calib.zip" in text for _, text in told)


def test_search(tmp_path: Path) -> None:
    shutil.copytree(CATALOGUE, tmp_path / "project" / "datasets" / "catalogue")
    service = fetching(tmp_path)
    assert {entry.name.split("/")[0] for entry in service.search(["indoor", "stereo-inertial"])} >= {"euroc", "tum-vi"}
    assert [entry.name for entry in service.search(["euroc", "dark"])] == [
        "euroc/MH_04_difficult",
        "euroc/MH_05_difficult",
    ]
    assert [entry.name for entry in service.search(["MH_01"])] == ["euroc/MH_01_easy"]
    assert service.search(["stereo", "indoor", "car"]) == []
    assert len(service.search([])) == sum(len(entry.sequences) for entry in service.collections.all)
    with pytest.raises(NotFound, match="no sequence fits 'indor'; did you mean 'indoor'"):
        service.search(["indor"])
    (first,) = service.search(["euroc/V1_01"])
    assert (first.download_bytes, first.exact, first.shared) == (6042263426, True, True)


def test_links(kitti: FileServer, tmp_path: Path) -> None:
    path = tmp_path / "project" / "datasets" / "catalogue" / "kitti.yaml"
    path.write_text(path.read_text().replace("    #: 1000000", "    bytes: 5"))
    kitti.behaviours[f"/{ARCHIVES[2]}"] = lambda request: request.answer(403)
    asked: list[int] = []
    reports = fetching(tmp_path).check_links(["kitti"], Timeouts(5, 5), 3, asked.append)
    problems = {report.address.rsplit("/")[-1]: report.problem for report in reports}
    assert problems.pop(ARCHIVES[0]) is None
    assert "bytes, 5 are published" in str(problems.pop(ARCHIVES[1]))
    assert "refuses access (HTTP status 403)" in str(problems.pop(ARCHIVES[2]))
    assert all("404" in str(problem) for problem in problems.values())
    assert asked == [1, 2, 3, 4, 5]
    assert {report.ranges for report in reports if report.problem is None} == {True}
