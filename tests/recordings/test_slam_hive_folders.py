"""Dataset folders of SLAM Hive come in as they are, and those of the published one with what is known of them."""

import random
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.packages.dataset_file import dataset_to_yaml
from slamhive.recordings.exporters import export_dataset, plan_export
from slamhive.recordings.importers.registry import detect_format, plan_import
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.trajectory.pose_file import read_times, read_uncertainties
from tests.fuzzing import mutated
from tests.recordings.format_world import silent

pytestmark = pytest.mark.integration
MUTATIONS = 40


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("datasets") / "room"
    return render_room(folder, RoomOptions(duration_s=0.3, width=64, height=48, workers=1), silent)


@pytest.fixture
def folder(room, tmp_path):
    return shutil.copytree(room.folder, tmp_path / "given")


@pytest.fixture
def published(room, tmp_path):
    target = tmp_path / "hall"
    target.mkdir()
    shutil.copyfile(room.bag_path, target / "hall.bag")
    for name in ("groundtruth.txt", "rosbag_play.py"):
        shutil.copyfile(room.folder / name, target / name)
    return target


def imported(source, target, options=ImportOptions()):  # noqa: B008 - it is frozen
    return perform(plan_import(source, options)[1], target, silent)


def test_a_dataset_comes_in_unchanged(room, folder, tmp_path):
    assert detect_format(folder) == "slam-hive"
    made = imported(folder, tmp_path / "copy")
    assert made == replace(room, name="copy", folder=tmp_path / "copy", bag="copy.bag", duration_s=made.duration_s)
    assert made.duration_s == pytest.approx(room.duration_s, abs=0.1)
    for file in (room.groundtruth.file, room.reference_map):
        assert (made.folder / file).read_bytes() == (room.folder / file).read_bytes()


def test_everything_known_of_a_ground_truth_comes_along(room, folder, tmp_path):
    truth = replace(
        room.groundtruth,
        positions_only=True,
        lever_arm_m=(0.1, 0.0, 1.2),
        uncertainty_m=0.02,
        uncertainties="uncertainties.txt",
        image_times="image_times.txt",
    )
    times = [line.split()[0] for line in (folder / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    (folder / "uncertainties.txt").write_text("".join(f"{time} 0.01 0.02 0.03\n" for time in times))
    (folder / "image_times.txt").write_text("".join(f"{time}\n" for time in times[::2]))
    (folder / "dataset.yaml").write_text(dataset_to_yaml(replace(room, name="given", groundtruth=truth)))
    made = imported(folder, tmp_path / "copy")
    assert made.groundtruth == truth
    assert read_times(made.folder / "image_times.txt").tolist() == [float(time) for time in times[::2]]
    sigmas_m = read_uncertainties(made.folder / "uncertainties.txt", np.array([float(times[0])]))
    assert sigmas_m.tolist() == [[0.01, 0.02, 0.03]]
    export_dataset(plan_export(made, "mcap", partial=False), tmp_path / "exported", silent)
    assert {"uncertainties.txt", "image_times.txt"} <= {path.name for path in (tmp_path / "exported").iterdir()}


def test_an_export_comes_in_without_options(room, tmp_path):
    export_dataset(plan_export(room, "mcap", partial=False), tmp_path / "exported", silent)
    assert imported(tmp_path / "exported", tmp_path / "back").sensors == room.sensors


def test_a_published_folder_has_its_ground_truth(room, published, tmp_path):
    assert detect_format(published) == "slam-hive-published"
    options = ImportOptions(calibration=(room.folder / "dataset.yaml",))
    made = imported(published, tmp_path / "made", options)
    assert [sensor.name for sensor in made.sensors] == [sensor.name for sensor in room.sensors]
    assert made.groundtruth is not None
    assert made.checksum == room.checksum


def remove_recording(folder):
    (folder / "room.bag").rename(folder / "other.bag")


def remove_truth(folder):
    (folder / "groundtruth.txt").unlink()


def link_outside(folder):
    truth = folder.parent / "truth.txt"
    (folder / "groundtruth.txt").rename(truth)
    (folder / "groundtruth.txt").symlink_to(truth)


def change_checksum(folder):
    path = folder / "dataset.yaml"
    path.write_text(re.sub(r"sha256:\w+", "sha256:" + "0" * 64, path.read_text()))


def change_topic(folder):
    path = folder / "dataset.yaml"
    path.write_text(path.read_text().replace("topic: /imu0", "topic: /imu7"))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (remove_recording, r"dataset\.yaml names room\.bag; add the missing file"),
        (remove_truth, r"dataset\.yaml names groundtruth\.txt; add the missing file"),
        (link_outside, r"groundtruth\.txt is a link that leaves its folder"),
        (change_checksum, r"has checksum sha256:\w+, but its dataset\.yaml says sha256:0+; .* copy it again"),
        (change_topic, r"no topic '/imu7' for sensor imu0 of dataset\.yaml; did you mean"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_folder_that_does_not_fit_its_description_is_refused(folder, tmp_path, damage, problem):
    damage(folder)
    with pytest.raises(InvalidInput, match=problem):
        imported(folder, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_what_a_folder_lacks_is_named(folder):
    (folder / "room.bag").unlink()
    with pytest.raises(InvalidInput, match=r"looks like slam-hive .* lacks a \.bag or \.mcap file"):
        detect_format(folder)


@pytest.mark.parametrize("name", ["slam-hive", "slam-hive-published"])
def test_damaged_folders_are_read_or_refused_in_one_line(folder, published, tmp_path, name):
    source = folder if name == "slam-hive" else published
    files = sorted(path for path in source.iterdir() if path.suffix in {".bag", ".yaml", ".txt"})
    draw = random.Random(f"{name} 1")
    refusals = []
    for number in range(MUTATIONS):
        path = files[number % len(files)]
        content = path.read_bytes()
        path.write_bytes(mutated(content, draw))
        try:
            perform(plan_import(source, ImportOptions(), name)[1], tmp_path / f"made{number}", silent)
        except SlamHiveError as error:
            refusals.append(str(error))
            assert not (tmp_path / f"made{number}").exists()
        path.write_bytes(content)
    assert len(refusals) > MUTATIONS // 10
    assert not any("\n" in refusal for refusal in refusals)
