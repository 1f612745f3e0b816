"""The frame of all imports: detection, options, plans, streams in order of time, kept recordings."""

from dataclasses import replace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry
from slamhive.domain.calibration import CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers import registry as importers
from slamhive.recordings.importers.registry import detect_format, plan_import
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    KeptRecording,
    PlannedStream,
    PlannedTruth,
    perform,
    rate_hz,
)
from slamhive.recordings.reader import messages, open_bag
from slamhive.recordings.staging import checksum

pytestmark = pytest.mark.quick


def silent(_fraction, _text):
    pass


def imu_stream(name, times_ns, received_ns=None):
    sensor = Sensor(name, SensorKind.IMU, f"/{name}", 100.0)

    def write(bag, index):
        bag.imu(sensor, int(times_ns[index]), np.full(3, index), np.zeros(3))

    return PlannedStream(sensor, np.array(times_ns), write, 400, received_ns)


def a_plan(*streams, **changes):
    times_s = np.array([1.0, 2.0])
    truth = PlannedTruth(times_s, np.zeros((2, 3)), None, gravity_aligned=True, source="total station")
    return replace(ImportPlan(streams, truth, DatasetText("Two IMUs", citation="Somebody 2020")), **changes)


def importer(found=(), missing=(), options=(), refines=()):
    class Some:
        title = "some format"

        def __init__(self):
            self.options, self.refines = frozenset(options), frozenset(refines)

        def detect(self, path):
            return Detection(tuple(found), tuple(missing))

        def plan(self, source, options):
            return a_plan(notes=(str(source), str(options.sequence)))

    return Some()


@pytest.fixture
def registry(monkeypatch):
    made: Registry[importers.Importer] = Registry("dataset importer")
    monkeypatch.setattr(importers, "IMPORTERS", made)
    return made


def test_messages_stand_in_the_order_in_which_they_were_received(tmp_path):
    late = imu_stream("late", [10, 20, 30], received_ns=np.array([15, 25, 35]))
    plan = a_plan(imu_stream("early", [10, 20, 30]), late)
    dataset = perform(plan, tmp_path / "two", silent)
    with open_bag(dataset.bag_path) as reader:
        order = [connection.topic for connection, _, _ in messages(reader, dataset.bag_path)]
    assert order == ["/early", "/late"] * 3
    assert load_dataset(dataset.folder) == dataset
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.positions_only
    assert dataset.groundtruth.source == "total station"
    assert dataset.citation == "Somebody 2020"
    assert dataset.duration_s == pytest.approx(25e-9)


@pytest.mark.parametrize("folder", [False, True])
def test_a_kept_recording_is_copied_byte_for_byte(tmp_path, folder):
    source = tmp_path / "take.1"
    files = {"metadata.yaml": b"x", "take_0.db3": b"y" * 5_000_000} if folder else {"": b"z" * 9_000_001}
    if folder:
        source.mkdir()
        for name, content in files.items():
            (source / name).write_bytes(content)
    else:
        source = source.with_suffix(".mcap")
        source.write_bytes(files[""])
    sensor = Sensor("imu0", SensorKind.IMU, "/imu", 100.0)
    plan = a_plan(recording=KeptRecording(source, (sensor,), {"imu0": 3}, 5, 2_000_000_005))
    seen = []
    dataset = perform(plan, tmp_path / "kept", lambda fraction, text: seen.append(fraction))
    assert dataset.bag == ("kept" if folder else "kept.mcap")
    for name, content in files.items():
        assert (dataset.bag_path / name if folder else dataset.bag_path).read_bytes() == content
    assert dataset.checksum == checksum(source) == checksum(dataset.bag_path)
    assert dataset.duration_s == 2.0
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_the_one_format_that_fits_is_chosen(registry, tmp_path):
    registry.register("a", importer(["a.txt"], ["b.txt"]))
    registry.register("b", importer(["a.txt", "c.txt"]))
    assert detect_format(tmp_path) == "b"


def test_a_special_format_wins_over_the_general_one(registry, tmp_path):
    registry.register("general", importer(["mav0"]))
    registry.register("special", importer(["mav0"], refines=["general"]))
    assert detect_format(tmp_path) == "special"


def test_several_formats_are_named_with_their_evidence(registry, tmp_path):
    registry.register("a", importer(["a.txt"]))
    registry.register("b", importer(["b.txt"]))
    with pytest.raises(InvalidInput, match=r"fits several formats: a \(a.txt\); b \(b.txt\).*--format"):
        detect_format(tmp_path)


def test_an_option_that_the_format_does_not_take_is_refused(registry, tmp_path):
    registry.register("a", importer(["a.txt"], options=["sequence"]))
    name, plan = plan_import(tmp_path, ImportOptions(sequence="one"))
    stated = "the ground truth has positions only: runs get no rotation errors"
    assert (name, *plan.notes) == ("a", str(tmp_path), "one", stated)
    with pytest.raises(InvalidInput, match="importer a takes no option typestore; leave it out; it takes sequence"):
        plan_import(tmp_path, ImportOptions(typestore="ros2_humble"))


@pytest.mark.parametrize("times_ns", [[], [5], [5, 5]])
def test_a_rate_needs_two_different_times(times_ns):
    with pytest.raises(InvalidInput, match="make no recording"):
        rate_hz(np.array(times_ns))


@pytest.mark.parametrize(
    ("model", "distortion", "problem"),
    [
        ("pinhole", (), None),
        ("pinhole", (0.1, 0.2, 0.0, 0.0), None),
        ("pinhole-radtan", (0.1, 0.2, 0.0, 0.0, 0.3), None),
        ("pinhole-radtan", (), "takes 4 or 5 or 8 distortion coefficients, not 0"),
        ("fisheye-kb", (0.1, 0.2, 0.3, 0.4), None),
        ("double-sphere", (0.1,), "takes 2 distortion coefficients, not 1"),
        ("omni", (), "camera model 'omni' is unknown"),
    ],
)
def test_a_camera_model_takes_its_number_of_coefficients(model, distortion, problem):
    values = {"width": 4, "height": 3, "fx": 1.0, "fy": 1, "cx": 1.5, "cy": 1.0, "model": model}
    sensor = Sensor("cam0", SensorKind.CAMERA, "/cam0", 20.0, calibration={**values, "distortion": distortion})
    if problem is None:
        found = CameraIntrinsics.of(sensor)
        assert (found.model, found.distortion, found.rectified) == (CameraModel(model), distortion, False)
        again = replace(sensor, calibration=found.calibration("mono8"))
        assert CameraIntrinsics.of(again) == found
    else:
        with pytest.raises(InvalidInput, match=problem):
            CameraIntrinsics.of(sensor)


def test_unknown_noise_is_none_and_not_written():
    sensor = Sensor("imu0", SensorKind.IMU, "/imu", 100.0, calibration={"gyroscope_noise_density": 1e-3})
    noise = ImuNoise.of(sensor)
    assert noise == ImuNoise(gyroscope_noise_density=1e-3)
    assert noise.accelerometer_random_walk is None
    assert noise.calibration() == sensor.calibration
