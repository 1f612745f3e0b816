"""What people look at in a dataset: overview, frames, sweeps and motion, on its page and by command."""

from __future__ import annotations

import base64
import json
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamhive.base.errors import NotFound
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings import views
from slamhive.recordings.reader import open_bag
from slamhive.recordings.writers import BagWriter
from slamhive.services.datasets import DatasetViews, strip_times_s
from slamhive.services.datasets.views import THUMBNAILS
from slamhive.trajectory.model import Poses
from slamhive.trajectory.transforms import motion_of
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

CAMERA = Sensor("camera0", SensorKind.CAMERA, "/camera0", 10.0)
DEPTH = Sensor("depth0", SensorKind.DEPTH, "/depth0", 10.0)
LIDAR = Sensor("lidar0", SensorKind.LIDAR, "/lidar0", 10.0)
START_NS = 1_000_000_000_000
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def record(path: Path, frames: int = 40, points: int = 20_000) -> None:
    """One frame, depth image and sweep a second; each frame is as bright as its number."""
    sweep = np.zeros(points, POINT)
    sweep["x"] = np.arange(points)
    with BagWriter(path) as bag:
        for number in range(frames):
            stamp_ns = START_NS + number * 1_000_000_000
            bag.image(CAMERA, stamp_ns, np.full((48, 2000), 5 * number, np.uint8), "mono8")
            depth = np.tile(np.array([[0, 1000, 4000]], np.uint16), (30, 100))
            bag.image(DEPTH, stamp_ns, depth, "16UC1")
            bag.points(LIDAR, stamp_ns, stamp_ns, sweep)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "room.bag"
    record(path)
    return path


@pytest.fixture
def recorded(web: Web, bag: Path) -> Web:
    """The web of a dataset ``room`` whose recording has images and sweeps."""
    folder = web.hive.catalogue.dataset_folder("room")
    (folder / "room.bag").write_bytes(bag.read_bytes())
    text = (folder / "dataset.yaml").read_text()
    camera = "{width: 300, height: 30, fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0, units_per_m: 1000.0}"
    more = (
        f"  - {{name: depth0, kind: depth, topic: /depth0, rate_hz: 1.0, calibration: {camera}}}\n"
        "  - {name: lidar0, kind: lidar, topic: /lidar0, rate_hz: 1.0}\n"
    )
    (folder / "dataset.yaml").write_text(text.replace("groundtruth:", more + "groundtruth:"))
    return web


def pixels_of(data: bytes) -> np.ndarray:
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def test_a_frame_is_the_first_at_or_after_the_time(recorded: Web):
    answer = recorded.client.get("/datasets/room/frames/camera0.jpg?time=11.4")
    assert (answer.status_code, answer.mimetype) == (200, "image/jpeg")
    assert float(answer.headers["X-Frame-Time"]) == pytest.approx(12.0)
    pixels = pixels_of(answer.data)
    assert pixels.shape[:2] == (23, views.FRAME_WIDTH)
    assert abs(int(pixels.mean()) - 60) <= 1


@pytest.mark.parametrize("time", ["", "?time=abc", "?time=-1", "?time=1e9", "?time=nan"])
def test_a_time_that_makes_no_sense_is_the_middle(recorded: Web, time: str):
    answer = recorded.client.get(f"/datasets/room/frames/camera0.jpg{time}")
    assert float(answer.headers["X-Frame-Time"]) == pytest.approx(20.0)


def test_the_overview_spans_the_recording_and_is_read_once(recorded: Web, monkeypatch: pytest.MonkeyPatch):
    opened = []

    def counted(path: Path):
        opened.append(path)
        return open_bag(path)

    monkeypatch.setattr("slamhive.recordings.views.open_bag", counted)
    times_s = []
    for number in range(THUMBNAILS):
        answer = recorded.client.get(f"/datasets/room/frames/camera0.jpg?overview={number}")
        times_s.append(float(answer.headers["X-Frame-Time"]))
        assert pixels_of(answer.data).shape[1] == views.THUMBNAIL_WIDTH
    assert len(opened) == 1
    wanted = strip_times_s(recorded.hive.catalogue.dataset("room"))
    assert np.abs(np.subtract(times_s, wanted)).max() <= 1.0
    assert recorded.client.get("/datasets/room/frames/camera0.jpg?overview=12").status_code == 404


def test_depth_is_coloured_and_black_where_unknown(recorded: Web):
    pixels = pixels_of(recorded.client.get("/datasets/room/frames/depth0.jpg?time=0").data)
    assert pixels.ndim == 3
    coloured = views._coloured(np.array([[0, 1000, 4000]], np.uint16))
    assert coloured[0, 0].tolist() == [0, 0, 0]
    near, far = coloured[0, 1].astype(int), coloured[0, 2].astype(int)
    assert near[2] > near[0], "near is red"
    assert far[0] > far[2], "far is blue"


def test_a_sweep_is_thinned_and_says_so(recorded: Web):
    content = json.loads(recorded.client.get("/datasets/room/sweeps/lidar0.json?time=3").text)
    assert content["caption"].startswith("lidar0 at 3.000 s: 20,000 points, 6,000 of them shown")
    points = np.frombuffer(base64.b64decode(content["points_m"]["bdata"]), "<f4").reshape(-1, 3)
    assert points[-1].tolist() == [19_999.0, 0.0, 0.0]
    assert len(points) == 6000


@pytest.mark.parametrize(
    ("path", "status", "text"),
    [
        ("/datasets/room/frames/imu2.jpg", 404, "sensor imu2 takes no images"),
        ("/datasets/room/frames/none.jpg", 404, "no sensor"),
        ("/datasets/room/sweeps/camera0.json", 404, "sensor camera0 is no LiDAR"),
        ("/datasets/nope/frames/camera0.jpg", 404, "unknown dataset"),
        ("/datasets/room/frames/camera1.jpg", 404, "has nothing at 20.000 s or later"),
    ],
)
def test_what_cannot_be_shown_says_why(recorded: Web, path: str, status: int, text: str):
    answer = recorded.client.get(path, headers={"Accept": "application/json"})
    assert answer.status_code == status
    assert text in answer.text


def test_a_topic_of_another_type_and_a_damaged_recording_are_one_line(web: Web):
    answer = web.client.get("/datasets/room/frames/camera0.jpg?time=0", headers={"Accept": "application/json"})
    assert answer.status_code == 400
    assert "holds std_msgs/msg/UInt8, which cannot be shown" in answer.text
    (web.hive.catalogue.dataset_folder("room") / "room.bag").write_bytes(b"#ROSBAG V2.0\nrest")
    answer = web.client.get("/datasets/room/frames/camera0.jpg?time=1", headers={"Accept": "application/json"})
    assert answer.status_code == 400
    assert "cannot be read as a recording" in answer.text


def test_the_page_shows_motion_frames_and_works_without_scripts(recorded: Web):
    page = recorded.client.get("/datasets/room?time=5").text
    assert page.count("overview=") == 2 * 3 * THUMBNAILS, "each on sight, and for browsers without scripts"
    assert "/datasets/room/frames/camera0.jpg?time=5.0" in page
    assert 'data-sweep="/datasets/room/sweeps/lidar0.json"' in page
    assert "m/s on average" in page
    assert "There are no runs on this dataset yet." not in page
    figures = json.loads(recorded.client.get("/datasets/room/figures.json").text)["figures"]
    assert {"speed", "angular_rate", "path_xz"} <= set(figures)


def test_many_visitors_read_two_recordings_at_once(recorded: Web, monkeypatch: pytest.MonkeyPatch):
    dataset = recorded.hive.catalogue.dataset("room")
    shown, reading, most = DatasetViews(), [], []
    really = views.frames_at

    def slow(*arguments):
        reading.append(1)
        most.append(len(reading))
        try:
            yield from really(*arguments)
        finally:
            reading.pop()

    monkeypatch.setattr("slamhive.services.datasets.views.frames_at", slow)
    threads = [threading.Thread(target=shown.frame, args=(dataset, "camera0", float(at))) for at in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(most) == 8
    assert max(most) <= 2


def test_the_cache_forgets_another_recording_of_the_same_name(recorded: Web):
    dataset = recorded.hive.catalogue.dataset("room")
    shown = DatasetViews()
    first = shown.frame(dataset, "camera0", 1.0)
    assert shown.frame(dataset, "camera0", 1.0) is first
    assert shown.frame(replace(dataset, checksum="sha256:" + "1" * 64), "camera0", 1.0) is not first


def test_a_ground_truth_is_summarised_once_until_it_changes(web: Web):
    dataset = web.hive.catalogue.dataset("room")
    path = dataset.groundtruth_path
    assert path is not None
    shown = DatasetViews()
    first = shown.motion(dataset)
    assert first is not None
    assert shown.motion(dataset) is first
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[: len(lines) // 2]))
    again = shown.motion(dataset)
    assert again is not None
    assert again.poses == first.poses // 2
    path.unlink()
    with pytest.raises(NotFound):
        shown.motion(dataset)


def test_motion_is_that_of_a_known_path():
    times_s = np.arange(0, 10, 0.01)
    yaw = 0.5 * times_s
    quats = np.column_stack([np.zeros_like(yaw), np.zeros_like(yaw), np.sin(yaw / 2), np.cos(yaw / 2)])
    positions_m = np.column_stack([2.0 * times_s, np.zeros_like(yaw), np.zeros_like(yaw)])
    gap = (times_s > 4) & (times_s < 6)
    motion = motion_of(Poses(times_s[~gap], positions_m[~gap], quats[~gap]))
    assert np.allclose(motion.speeds_mps, 2.0)
    assert np.allclose(motion.angular_rates_radps, 0.5)
    assert not ((motion.times_s > 4.2) & (motion.times_s < 5.8)).any()
    assert len(motion_of(Poses(times_s[:1], positions_m[:1], quats[:1])).times_s) == 0


# -- a moment of a run -------------------------------------------------------------------------------------------------


def moment(web: Web, timestamp: object, run_id: int = 1):
    return web.client.get(f"/runs/{run_id}/moment.json?timestamp={timestamp}", headers={"Accept": "application/json"})


def test_a_moment_of_a_run_is_what_its_sensors_saw_then(recorded: Web):
    content = moment(recorded, 1005.04).get_json()
    assert content["words"].startswith("The position error is ")
    assert content["words"].endswith(" m. The frame took 30.0 ms.")
    left, right = content["views"]
    assert (left["sensor"], left["time_s"]) == ("camera0", pytest.approx(5.0))
    shown = recorded.client.get(left["frame"])
    assert int(np.median(pixels_of(shown.data))) == pytest.approx(5 * 5, abs=2)
    assert right == {"sensor": "camera1", "problem": "the recording has nothing at this time or later"}


def test_a_dropped_frame_says_so(recorded: Web):
    assert moment(recorded, 1004.92).get_json()["words"].endswith("This frame was dropped.")
    assert moment(recorded, 990).get_json()["words"] == (
        "No matched pose is near. The algorithm reported no frame near this time."
    )


def test_a_moment_before_the_first_pose_has_no_error(recorded: Web):
    assert moment(recorded, 1000.02).get_json()["words"].startswith("The position error is ")
    assert moment(recorded, 999.7).get_json()["words"].startswith("No matched pose is near.")


def test_timestamps_of_headers_need_not_be_the_times_of_the_recording(tmp_path: Path, recorded: Web):
    folder = recorded.hive.catalogue.dataset_folder("room")
    with BagWriter(tmp_path / "late.bag") as late:
        for number in range(20):
            stamp_ns = START_NS + number * 100_000_000
            late.points(LIDAR, stamp_ns, stamp_ns + 5_000_000_000_000, np.zeros(3, POINT))
    (folder / "room.bag").write_bytes((tmp_path / "late.bag").read_bytes())
    dataset = recorded.hive.catalogue.dataset("room")
    seen = views.received_s(dataset, dataset.sensor("lidar0"), 1001.2004)
    assert seen == pytest.approx(1.2)  # half a millisecond less than the timestamp of the header is that header
    assert views.received_s(dataset, dataset.sensor("lidar0"), 1001.201) == pytest.approx(1.3)
    assert views.received_s(dataset, dataset.sensor("lidar0"), 2000) is None


@pytest.mark.parametrize("timestamp", ["", "x", "nan", "-1", "1e300"])
def test_a_timestamp_that_is_none_is_one_line(web: Web, timestamp: str):
    answer = moment(web, timestamp)
    assert answer.status_code == 400
    error = answer.get_json()["error"]
    assert error["message"] == f"timestamp expects a time in s, got {timestamp!r}"
    assert error["remedy"].startswith("give a header timestamp in s")


def test_a_run_without_its_dataset_still_shows_its_error(web: Web):
    web.hive.catalogue.remove_dataset("room")
    content = moment(web, 1005.0).get_json()
    assert content["words"].startswith("The position error is ")
    assert [view.keys() for view in content["views"]] == [{"sensor", "problem"}]


def test_the_plots_of_a_run_know_their_timestamps(shown: Web):
    timeline = shown.client.get("/runs/1/figures.json").get_json()["timeline"]
    assert timeline["origins"]["error"] == pytest.approx(1000.0)
    assert timeline["origins"]["latency"] == pytest.approx(1000.0)
    assert (timeline["from_s"], timeline["until_s"]) == (pytest.approx(1000.0), pytest.approx(1039.9))
    assert shown.client.get("/runs/5/figures.json").get_json()["timeline"] is None


def test_dropped_frames_are_crosses_in_the_plot_of_latencies(shown: Web):
    content = shown.client.get("/runs/1/figures.json").get_json()
    assert [trace["name"] for trace in content["figures"]["latency"]["data"]][-1] == "dropped"
    assert "dropped frames have none and are crosses at 0." in content["captions"]["latency"]


# -- the same for programs ---------------------------------------------------------------------------------------------


def test_programs_get_frames_sweeps_and_moments(recorded: Web):
    frame = recorded.client.get("/api/v1/datasets/room/frames/camera0?time=11.4")
    assert frame.mimetype == "image/jpeg"
    assert float(frame.headers["X-Frame-Time"]) == pytest.approx(12.0)
    sweep = recorded.client.get("/api/v1/datasets/room/sweeps/lidar0?time=3").get_json()
    assert (sweep["time_s"], sweep["points"], len(sweep["positions_m"])) == (3.0, 20_000, views.MOST_POINTS)
    assert sweep["positions_m"][-1] == [19_999.0, 0.0, 0.0]
    dropped = recorded.client.get("/api/v1/runs/1/moment?timestamp=1004.92").get_json()
    assert dropped["frame"]["dropped"]
    assert recorded.client.get("/api/v1/runs/1/moment?timestamp=soon").status_code == 400
    assert recorded.client.get("/api/v1/datasets/room/frames/none").status_code == 404


def test_programs_get_the_data_of_plots(shown: Web):
    page = shown.client.get("/runs/1/figures/error.csv").data
    assert shown.client.get("/api/v1/runs/1/plots/error").data == page
    assert page.startswith(b"time_s,error_m\n")
    refused = shown.client.get("/api/v1/runs/1/plots/voltage")
    assert (refused.status_code, "error" in refused.get_json()["remedy"]) == (404, True)
