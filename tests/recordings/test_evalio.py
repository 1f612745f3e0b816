"""Datasets through evalio: a registered synthetic one, and damaged streams."""

import json
import random

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.domain.calibration import ImuNoise, LidarLayout, PointOrder
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.outside_lidar import EVALIO
from slamhive.recordings.importers.outside_reader import POINT, RECORD_HEADER
from slamhive.recordings.importers.registry import detect_format, plan_import
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.runtime.messages import to_points
from slamhive.trajectory.layout import read_tum
from tests.fuzzing import mutated
from tests.recordings.format_world import convert, recorded, silent

pytestmark = pytest.mark.integration
START_NS = 1_600_000_000_000_000_000
MUTATIONS = 60
SYNTHETIC = """
from enum import auto
import numpy as np
from evalio.datasets import Dataset, RawDataIter
from evalio.types import SE3, SO3, Duration, ImuMeasurement, ImuParams, LidarMeasurement, LidarParams, Point, Stamp
from evalio.types import Trajectory


def at(ns):
    return Stamp.from_nsec(1_600_000_000_000_000_000 + ns)


class Cellar(Dataset):
    stairs = auto()
    absent = auto()

    def data_iter(self):
        print("evalio talks on the standard output")
        imu = [ImuMeasurement(at(n * 10_000_000), np.array([0.1, 0.2, n]), np.array([0, 0, 9.81])) for n in range(30)]
        scans = []
        for n in range(3):
            points = [
                Point(x=n, y=row, z=column, intensity=7, t=Duration.from_nsec(column * 25_000_000), row=row, col=column)
                for row in range(2)
                for column in range(4)
            ]
            scans.append(LidarMeasurement(at(n * 100_000_000), points))
        return RawDataIter(iter(scans), iter(imu), len(scans))

    def ground_truth_raw(self):
        stamps = [at(n * 50_000_000) for n in range(6)]
        return Trajectory(stamps=stamps, poses=[SE3(SO3.identity(), np.array([n, 0.0, 0.0])) for n in range(6)])

    def imu_T_lidar(self):
        return SE3(SO3.identity(), np.array([0.1, 0.2, 0.3]))

    def imu_T_gt(self):
        return SE3(SO3.identity(), np.array([0.0, 0.0, 1.0]))

    def imu_params(self):
        return ImuParams(gyro=1e-3, accel=2e-3, gyro_bias=3e-5, accel_bias=4e-5, gravity=np.array([0, 0, -9.81]))

    def lidar_params(self):
        return LidarParams(num_rows=2, num_columns=4, min_range=0.1, max_range=80.0, rate=10.0)

    def files(self):
        return [] if self.value == "stairs" else ["scans.bag"]
"""


@pytest.fixture
def registered(tmp_path, monkeypatch, outside_python):
    monkeypatch.setenv(EVALIO.variable, str(outside_python))
    (tmp_path / "cellar_dataset.py").write_text(SYNTHETIC)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("EVALIO_CUSTOM", "cellar_dataset")
    (tmp_path / "data" / "cellar" / "stairs").mkdir(parents=True)
    return tmp_path / "data"


@pytest.mark.integration
def test_a_registered_dataset_comes_through_evalio(registered, tmp_path):
    source = registered / "cellar" / "stairs"
    dataset = convert(source, tmp_path / "made", "evalio")
    assert load_dataset(dataset.folder) == dataset
    lidar, imu = dataset.sensors
    layout = LidarLayout.of(lidar)
    assert (layout.beams, layout.maximum_range_m, layout.point_order) == (2, 80.0, PointOrder.ROWS)
    assert np.array(lidar.T_body_sensor).reshape(4, 4)[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert ImuNoise.of(imu) == ImuNoise(1e-3, 2e-3, 3e-5, 4e-5)
    seen = recorded(dataset)
    assert {topic: len(messages) for topic, messages in seen.items()} == {"/points": 3, "/imu": 30}
    cloud = to_points(seen["/points"][1])
    assert cloud.points_m[5].tolist() == [1, 1, 1]
    stamp_s = (START_NS + 100_000_000) * 1e-9
    assert layout.times.since_start_s(cloud, stamp_s)[:4] == pytest.approx([0, 0.025, 0.05, 0.075])
    assert cloud.field("ring").tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert seen["/imu"][4].angular_velocity.z == 4
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[2].tolist() == [2, 0, -1]
    again = convert(registered, tmp_path / "again" / "made", "evalio", sequence="cellar/stairs")
    assert again.checksum == dataset.checksum


@pytest.mark.integration
@pytest.mark.parametrize(
    ("sequence", "problem"),
    [
        ("cellar/roof", "evalio knows no sequence 'cellar/roof'; its datasets are boreas.*cellar"),
        ("cellar/absent", "absent lacks scans.bag; get it with: evalio dl cellar/absent"),
    ],
)
def test_what_evalio_lacks_is_named(registered, sequence, problem):
    with pytest.raises(InvalidInput, match=problem):
        plan_import(registered, ImportOptions(sequence=sequence), "evalio")


def test_the_folder_of_a_sequence_is_detected(tmp_path):
    source = tmp_path / "hilti_2022" / "basement_2"
    source.mkdir(parents=True)
    assert detect_format(source) == "evalio"


def test_without_evalio_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.delenv(EVALIO.variable, raising=False)
    with pytest.raises(Unavailable, match=f"pip install evalio.*{EVALIO.variable}"):
        plan_import(tmp_path, ImportOptions(sequence="hilti_2022/basement_2"), "evalio")
    monkeypatch.setenv(EVALIO.variable, str(tmp_path / "nowhere"))
    with pytest.raises(Unavailable, match="nowhere, which does not exist"):
        plan_import(tmp_path, ImportOptions(sequence="hilti_2022/basement_2"), "evalio")


def told(**changes) -> bytes:
    """What the reader writes for a small sequence."""
    arrays = {
        "scan_times_ns": START_NS + 100_000_000 * np.arange(2),
        "imu_times_ns": START_NS + 10_000_000 * np.arange(5),
        "imu": np.ones((5, 6)),
        "truth_times_ns": START_NS + 50_000_000 * np.arange(3),
        "truth": np.tile([1.0, 2, 3, 0, 0, 0, 1], (3, 1)),
        **changes,
    }
    about = {
        "name": "cellar/stairs",
        "url": "-",
        "environment": "cellar",
        "vehicle": "-",
        "T_imu_lidar": np.eye(4).reshape(-1).tolist(),
        "lidar": {"num_rows": 2, "num_columns": 4, "min_range": 0.1, "max_range": 80.0, "rate": 10.0},
        "imu": {"gyro": 1e-3, "accel": 2e-3, "gyro_bias": 3e-5, "accel_bias": 4e-5},
        "arrays": [[name, values.dtype.str, list(values.shape)] for name, values in arrays.items()],
    }
    return json.dumps(about).encode() + b"\n" + b"".join(values.tobytes() for values in arrays.values())


def sent() -> bytes:
    points = np.zeros(8, dtype=POINT)
    return b"".join(RECORD_HEADER.pack(START_NS + 100_000_000 * n, 8) + points.tobytes() for n in range(2))


@pytest.fixture
def replayed(tmp_path, monkeypatch):
    """A program that writes the files ``plan`` and ``records`` beside it, as the reader would."""
    program = tmp_path / "replay"
    program.write_text('#!/bin/sh\nexec cat "$(dirname "$0")/$4"\n')
    program.chmod(0o755)
    monkeypatch.setenv(EVALIO.variable, str(program))
    (tmp_path / "plan").write_bytes(told())
    (tmp_path / "records").write_bytes(sent())
    return tmp_path


def test_a_damaged_stream_is_refused_in_one_line(replayed):
    draw = random.Random("evalio 1")
    refusals = []
    options = ImportOptions(sequence="cellar/stairs")
    for number in range(MUTATIONS):
        part = replayed / draw.choice(["plan", "plan", "records"])
        whole = part.read_bytes()
        part.write_bytes(mutated(whole, draw))
        try:
            perform(plan_import(replayed, options, "evalio")[1], replayed / f"made{number}", silent)
        except SlamHiveError as error:
            refusals.append(str(error))
            assert not (replayed / f"made{number}").exists()
        part.write_bytes(whole)
    assert len(refusals) > MUTATIONS // 10
    assert not any("\n" in refusal for refusal in refusals)
    perform(plan_import(replayed, options, "evalio")[1], replayed / "whole", silent)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"scan_times_ns": np.array([START_NS, START_NS])}, "timestamps of the scans of cellar/stairs do not increase"),
        ({"imu": np.full((5, 6), np.nan)}, "an IMU sample of cellar/stairs is not finite"),
        ({"imu": np.ones((4, 6))}, "evalio stopped while it read cellar/stairs"),
        ({"truth": np.zeros((3, 7))}, "ground truth of cellar/stairs, pose 1: "),
        ({"scan_times_ns": np.array([START_NS], dtype="<i8")}, "make no recording"),
    ],
)
def test_a_mistake_in_a_sequence_is_one_clear_line(replayed, changes, problem):
    (replayed / "plan").write_bytes(told(**changes))
    with pytest.raises(InvalidInput, match=problem):
        plan_import(replayed, ImportOptions(sequence="cellar/stairs"), "evalio")


def test_a_sequence_that_changes_between_both_readings_is_refused(replayed):
    (replayed / "plan").write_bytes(told(scan_times_ns=START_NS + 90_000_000 * np.arange(2)))
    made = plan_import(replayed, ImportOptions(sequence="cellar/stairs"), "evalio")[1]
    with pytest.raises(InvalidInput, match="scan 1 of cellar/stairs is another when read again"):
        perform(made, replayed / "made", silent)
    assert not (replayed / "made").exists()


def test_the_last_words_of_evalio_are_the_reason(tmp_path, monkeypatch):
    program = tmp_path / "fails"
    program.write_text("#!/bin/sh\necho progress >&2\necho 'the disk is on fire' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv(EVALIO.variable, str(program))
    with pytest.raises(InvalidInput, match="evalio cannot read a/b: the disk is on fire"):
        plan_import(tmp_path, ImportOptions(sequence="a/b"), "evalio")
