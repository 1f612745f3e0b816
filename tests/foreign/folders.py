"""Small folders in the styles of the published ones: what they have in common, without their systems."""

from __future__ import annotations

from pathlib import Path

MAPPING = """
import yaml, subprocess
from string import Template
config = yaml.load(open("/slamhive/config.yaml", "r").read(), Loader=yaml.FullLoader)
values = {}
values.update(config["algorithm-parameters"])
values.update(config["dataset-parameters"])
values["fps"] = float(values["fps"])
filled = Template(open("/slamhive/template.yaml", "r").read()).substitute(values)
open("/slamhive/mappingtask.yaml", "w").write(filled)
remap = " ".join(key + ":=" + value for key, value in config["algorithm-remap"].items())
save_map = (config["general-parameter"] or {}).get("save_map")
subprocess.run("bash -c 'source /opt/ros/melodic/setup.bash; roslaunch /slamhive/mono.launch " + remap
               + " & sleep 6; python3 /slamhive/dataset/rosbag_play.py; rosnode kill -a; sleep 2;"
               + " mv /home/ORB_SLAM2/KeyFrameTrajectory.txt /slamhive/result/traj.txt;"
               + " touch /slamhive/result/finished'", shell=True)
"""
TEMPLATE = """%YAML:1.0
Camera.fx: $fx   # focal length in pixels
Camera.fy: $fy
Camera.cx: $cx
Camera.cy: $cy
Camera.fps: $fps
Camera.width: $width
Camera.height: $height
ORBextractor.nFeatures: $nFeatures
Own.gain: $gain
"""
LAUNCH = """<launch>
  <arg name="mono_topic" default="/camera/image_raw"/>
  <!-- <arg name="old_topic" default="/old"/> -->
  <node pkg="ORB_SLAM2" type="Mono" name="Mono"><remap from="/camera/image_raw" to="$(arg mono_topic)"/></node>
</launch>
"""
DOCKERFILE = """FROM ros:melodic-perception
WORKDIR /home
COPY ORB_SLAM2 /home/ORB_SLAM2
RUN cd ORB_SLAM2 && sh build.sh
"""
VINS_MAPPING = MAPPING.replace("/slamhive/mono.launch", "").replace("roslaunch", "roscore & rosrun vins vins_node")
VINS_TEMPLATE = """imu: 1
imu_topic: "$imu_topic"
image0_topic: "$image0_topic"
image1_topic: "$image1_topic"
output_path: "/home/output"
image_width: $image_width
image_height: $image_height
cam0_calib: "$cam0_calib"
body_T_cam0: !!opencv-matrix
   data: $body_T_cam0
max_cnt: $max_cnt
fps: $fps
"""
CAMERA_TEMPLATE = "projection_parameters:\n   fx: $cam0_fx\n   k1: $cam0_k1\n   fx1: $cam1_fx\n"
LOAM_MAPPING = """
import yaml, subprocess
config = yaml.load(open("/slamhive/config.yaml", "r").read(), Loader=yaml.FullLoader)
arguments = " ".join(key + ":=" + str(value) for key, value in config["algorithm-parameters"].items())
arguments += " ".join(key + ":=" + str(value) for key, value in (config["algorithm-remap"] or {}).items())
subprocess.run("bash -c 'roslaunch /slamhive/loam.launch rviz:=false " + arguments + "'", shell=True)
"""
LOAM_LAUNCH = """<launch>
  <arg name="rviz" default="true" />
  <arg name="scanPeriod" default="0.1" />
  <arg name="lidar" default="HDL-64E" />
  <node pkg="loam" type="scan" name="scan"><remap from="/multi_scan_points" to="/points_raw" /></node>
</launch>
"""


def write(folder: Path, **files: str) -> Path:
    """Write a folder; ``__`` stands for a dot. The Dockerfile and others lie at its top, the rest in ``slamhive/``."""
    (folder / "slamhive").mkdir(parents=True, exist_ok=True)
    for key, text in files.items():
        name = key.replace("__", ".")
        place = folder / name if name in {"Dockerfile", "LICENSE", "README.md"} else folder / "slamhive" / name
        place.write_text(text, encoding="utf-8")
    return folder


def orb_slam2(root: Path, **more: str) -> Path:
    """Like orb-slam2-ros-mono: a template, a launch argument for the topic, sources that are not there."""
    files = {"mapping__py": MAPPING, "template__yaml": TEMPLATE, "mono__launch": LAUNCH, "Dockerfile": DOCKERFILE}
    return write(root / "orb-slam2-ros-mono", **{**files, **more})


def vins(root: Path) -> Path:
    """Like vins-fusion-stereo-imu: topics are parameters, templates of two levels, no launch file."""
    files = {"mapping__py": VINS_MAPPING, "template__yaml": VINS_TEMPLATE}
    return write(root / "vins-fusion-stereo-imu", **files, template_cam0_pinhole__yaml=CAMERA_TEMPLATE)


def loam(root: Path) -> Path:
    """Like loam: no template, parameters are launch arguments, a fixed topic."""
    return write(root / "loam", mapping__py=LOAM_MAPPING, loam__launch=LOAM_LAUNCH)
