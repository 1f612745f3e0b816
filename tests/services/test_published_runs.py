"""Folders in the styles of ORB-SLAM and VINS run untouched, on Debian's ROS 1: real bags, topics and launch files.

Their systems are small nodes, which write a pose for each image that reaches them, and what they were told.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import docker
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import parse_step
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import ExecutorContext
from slamhive.executors.docker.images import KEPT, make_image
from slamhive.executors.registry import installation_id
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.recordings.room import RoomOptions
from slamhive.services.algorithms import PackageImportRequest
from slamhive.services.hive import Hive
from tests.foreign import folders
from tests.services.docker_base import project_base, run_docker

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.images, pytest.mark.timeout(1200)]

TEMPLATE = project_root() / "docs" / "extend" / "ros1-template"
NAMES = ("orb-slam2-ros-mono", "vins-fusion-stereo-imu")
FRAMES = 16
"""Of 1.5 s at 10 Hz."""
SLOWLY = Submission("", "room", playback_rate=0.2, executor="docker", evaluate=False)
"""A node that starts late on a busy machine misses messages: slowly, it is there before the fourth frame."""

PACKAGE = "<package format='2'><name>{name}</name><version>1.0.0</version><description>x</description></package>"
NODE = """#!/usr/bin/python3
import json, os, sys
import rospy
from sensor_msgs.msg import Image, Imu

class Listener:
    def __init__(self):
        self.seen = {"home": os.environ["HOME"]}
        self.lines = []

    def take(self, topic, message):
        self.seen[topic] = self.seen.get(topic, 0) + 1
        if topic == LEFT:
            self.seen["size"] = [message.width, message.height]
            self.lines.append("%f %d 0 0 0 0 0 1" % (message.header.stamp.to_sec(), len(self.lines)))

    def write(self):
        open(TRAJECTORY, "w").write("\\n".join(self.lines) + "\\n")
        json.dump(self.seen, open(SEEN, "w"))

listener = Listener()
rospy.init_node(NAME)
for topic, kind in TOPICS.items():
    rospy.Subscriber(topic, kind, lambda message, topic=topic: listener.take(topic, message), queue_size=1000)
rospy.on_shutdown(listener.write)
rospy.spin()
"""
ORB_NODE = NODE.replace(
    "class Listener",
    """NAME, LEFT = "Mono", "/camera/image_raw"
TOPICS = {LEFT: Image}
TRAJECTORY, SEEN = "/home/ORB_SLAM2/KeyFrameTrajectory.txt", "/slamhive/result/seen.json"

class Listener""",
)
VINS_NODE = NODE.replace(
    "class Listener",
    """told = dict(line.split(":", 1) for line in open("/slamhive/mappingtask.yaml").read().splitlines()[1:])
NAME, LEFT = "vins_node", json.loads(told["image0_topic"])
TOPICS = {LEFT: Image, json.loads(told["image1_topic"]): Image, json.loads(told["imu_topic"]): Imu}
TRAJECTORY, SEEN = "/home/output/vio_loop.csv", "/home/output/seen.json"

class Listener""",
)
ROSRUN = '#!/bin/sh\nexec "/opt/ros1/$1/$2"\n'
ROSNODE = """#!/usr/bin/python3
import rosgraph, xmlrpc.client
master = rosgraph.Master("/killer")
nodes = {node for kind in master.getSystemState() for _, found in kind for node in found} - {"/rosout"}
for node in nodes:
    xmlrpc.client.ServerProxy(master.lookupNode(node)).shutdown("/killer", "asked to")
"""
WHERE = """
subprocess.run("bash -c 'pwd > /slamhive/result/folder; echo $HOME > /slamhive/result/home'", shell=True)
subprocess.run("cp /slamhive/mappingtask.yaml /slamhive/cam0_pinhole.yaml /slamhive/result/", shell=True)
"""
VINS_MAPPING = (
    """
import yaml, subprocess
from string import Template
config = yaml.load(open("/slamhive/config.yaml", "r").read(), Loader=yaml.FullLoader)
values = {}
values.update(config["algorithm-parameters"])
values.update(config["dataset-parameters"] or {})
filled = Template(open("/slamhive/template_" + values["cam0_calib"], "r").read()).substitute(values)
open("/slamhive/" + values["cam0_calib"], "w").write(filled)
filled = Template(open("/slamhive/template.yaml", "r").read()).substitute(values)
open("/slamhive/mappingtask.yaml", "w").write(filled)
subprocess.run("bash -c 'source /opt/ros/kinetic/setup.bash; roscore & sleep 5; rosrun vins vins_node & sleep 3;"
               + " python3 /slamhive/dataset/rosbag_play.py; rosnode kill -a; sleep 2;"
               + " cp /home/output/vio_loop.csv /slamhive/result/traj.txt; mv /home/output/* /slamhive/result/;"
               + " touch /slamhive/result/finished'", shell=True)
"""
    + WHERE
)


@pytest.fixture(scope="module")
def ros_image(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The run-time image of ROS 1, made like those of the project's packages: by building one."""
    project_base()
    (algorithm,) = load_algorithms(TEMPLATE)
    context = ExecutorContext(tmp_path_factory.mktemp("context"), project_root(), "installation")
    with contextlib.closing(docker.from_env()) as engine:
        make_image(engine, algorithm.package, context, lambda _line: None)
    return "slam-hive-base:ros1-run"


@pytest.fixture
def room_hive(hive: Hive) -> Iterator[Hive]:
    options = RoomOptions(name="room", duration_s=1.5, width=160, height=120, camera_rate_hz=10.0, lidar_rate_hz=1.0)
    hive.catalogue.render_room(options, lambda _fraction, _text: None)
    yield hive
    mine = installation_id(hive.settings.data)[:8]
    kept = run_docker("images", "--format", "{{.Repository}}:{{.Tag}}", KEPT).stdout.split()
    names = (f"slam-hive-algorithm:{name}" for name in NAMES)
    for name in (*names, *(entry for entry in kept if entry.endswith(mine))):
        run_docker("rmi", "--force", name)


def complete(path: Path, base: str, package: str, program: str, node: str, home: str) -> Path:
    """Give the folder a Dockerfile that its sources are there for: a node, and what ROS images have besides."""
    sources = path / package
    sources.mkdir()
    (sources / "package.xml").write_text(PACKAGE.format(name=package))
    tools = {program: node, "rosrun": ROSRUN, "rosnode": ROSNODE}
    for name, text in tools.items():
        (sources / name).write_text(text)
        (sources / name).chmod(0o755)
    steps = (
        f"FROM {base}",
        f"COPY {package} /opt/ros1/{package}",
        f"RUN mv /opt/ros1/{package}/rosrun /opt/ros1/{package}/rosnode /usr/local/bin/",
        "RUN mkdir -p /opt/ros/melodic /opt/ros/kinetic /home/output /home/ORB_SLAM2 /root/.ros",
        "RUN touch /opt/ros/melodic/setup.bash /opt/ros/kinetic/setup.bash",
        f"ENV HOME=/root\nWORKDIR {home}",
        "",
    )
    return folders.write(path, Dockerfile="\n".join(steps))


def run_of(hive: Hive, path: Path, submission: Submission) -> Path:
    """Import the folder as it is, unless it was, and run it; returns the result folder."""
    if not (hive.settings.algorithms_folder / path.name).exists():
        with hive.algorithms.planned(str(path), PackageImportRequest(executor="docker")) as planned:
            hive.algorithms.perform(planned, lambda _line: None)
    (queued,) = hive.runs.submit(submission)
    hive.worker(only=[queued.id]).run(until_idle=True)
    run = hive.runs.get(queued.id)
    assert run.state is RunState.SUCCEEDED, f"{run.detail}: {hive.runs.log(run.id)[-2000:]}"
    assert run.poses is not None
    assert FRAMES - 3 <= run.poses <= FRAMES
    return Path(hive.runs.folder(run.id).trajectory).parent


def settings_of(text: str) -> dict[str, Any]:
    lines = (line.partition("#")[0].partition(":") for line in text.splitlines() if not line.startswith("%"))
    return {key.strip(): json.loads(value) for key, _, value in lines if value.strip()}


ORB_SETTINGS = {
    "Camera.fx": 105.6,
    "Camera.fy": 105.6,
    "Camera.cx": 79.5,
    "Camera.cy": 59.5,
    "Camera.fps": 10.0,
    "Camera.width": 160,
    "Camera.height": 120,
    "ORBextractor.nFeatures": 700,
    "Own.gain": 2,
}
"""The focal length of the room's camera is 0.66 widths."""
HALF_SETTINGS = {
    **ORB_SETTINGS,
    "Camera.fx": 52.8,
    "Camera.fy": 52.8,
    "Camera.cx": 39.5,
    "Camera.cy": 29.5,
    "Camera.width": 80,
    "Camera.height": 60,
}
"""Pixel centres are whole numbers, so cx becomes (79.5 + 0.5) / 2 - 0.5."""


def test_a_folder_like_orb_slam_runs_untouched_and_gets_the_camera_of_the_variant(
    room_hive: Hive, ros_image: str, tmp_path: Path
) -> None:
    path = folders.orb_slam2(tmp_path / "published", mapping__py=folders.MAPPING + WHERE)
    complete(path, ros_image, "ORB_SLAM2", "Mono", ORB_NODE, "/home/ORB_SLAM2")
    before = {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()}
    for steps, expected in (((), ORB_SETTINGS), ((parse_step("resolution scale=0.5"),), HALF_SETTINGS)):
        parameters = {"gain": "2", "nFeatures": "700"}
        asked = replace(SLOWLY, algorithm=path.name, parameters=parameters, variant=steps)
        result = run_of(room_hive, path, asked)
        written = settings_of((result / "mappingtask.yaml").read_text())
        assert written == pytest.approx(expected)
        seen = json.loads((result / "seen.json").read_text())
        assert seen.pop("/camera/image_raw") >= FRAMES - 3
        assert seen == {"home": "/root", "size": [expected["Camera.width"], expected["Camera.height"]]}
        assert [(result / name).read_text().strip() for name in ("folder", "home")] == ["/home/ORB_SLAM2", "/root"]
    assert {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()} == before
    with pytest.raises(InvalidInput, match=r"orb-slam2-ros-mono needs 1 camera sensor, dataset track has 0 \("):
        room_hive.runs.submit(Submission(path.name, "track", executor="docker"))
    assert_a_player_that_fails_is_the_reason(room_hive, path.name)


def assert_a_player_that_fails_is_the_reason(hive: Hive, algorithm: str) -> None:
    """The real ``rosbag play``, on a recording whose messages have damaged headers from its middle on."""
    recording = hive.catalogue.dataset("room").bag_path
    content = recording.read_bytes()
    half = len(content) // 2
    recording.write_bytes(content[:half] + content[half:].replace(b"op=\x02", b"op-\x02"))
    (queued,) = hive.runs.submit(Submission(algorithm, "room", {"gain": "2"}, executor="docker", evaluate=False))
    hive.worker(only=[queued.id]).run(until_idle=True)
    run = hive.runs.get(queued.id)
    assert run.reason is FailureReason.PLAYER_FAILED, hive.runs.log(run.id)
    assert run.detail == "the recording was not played: rosbag play failed: Error parsing header"


def test_a_folder_like_vins_runs_untouched_with_its_templates_of_two_levels(
    room_hive: Hive, ros_image: str, tmp_path: Path
) -> None:
    path = folders.write(folders.vins(tmp_path / "published"), mapping__py=VINS_MAPPING)
    complete(path, ros_image, "vins", "vins_node", VINS_NODE, "/home")
    before = {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()}
    result = run_of(room_hive, path, replace(SLOWLY, algorithm=path.name))
    camera = settings_of((result / "cam0_pinhole.yaml").read_text())
    assert camera == pytest.approx({"fx": 105.6, "k1": 0.0, "fx1": 105.6})
    written = (result / "mappingtask.yaml").read_text()
    assert 'image0_topic: "/left"\nimage1_topic: "/right"\n' in written
    assert "image_width: 160\nimage_height: 120\n" in written
    # The camera of the room is 9 cm before, 6 cm left of and 3.5 cm above the IMU.
    T_imu_cam0 = json.loads(written.split("data:")[1].split("\n")[0])
    assert [T_imu_cam0[place] for place in (3, 7, 11)] == pytest.approx([0.09, 0.06, 0.035])
    seen = json.loads((result / "seen.json").read_text())
    assert min(seen["/left"], seen["/right"]) >= FRAMES - 3
    assert seen["/imu"] > 200
    assert (seen["home"], seen["size"]) == ("/root", [160, 120])
    assert [(result / name).read_text().strip() for name in ("folder", "home")] == ["/home", "/root"]
    assert {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()} == before
