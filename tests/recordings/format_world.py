"""Small folders of each format that can be imported, and ways to break them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamhive.domain.dataset import Dataset
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, ImportPlan, perform
from slamhive.recordings.reader import decode, messages, open_bag

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
FRAMES = 4
WIDTH, HEIGHT = 32, 24

Damage = Callable[[Path], object]


def silent(_fraction: float, _text: str) -> None:
    pass


def plan(source: Path, format_name: str | None = None, **options: Any) -> ImportPlan:
    return plan_import(source, ImportOptions(**options), format_name)[1]


def convert(source: Path, folder: Path, format_name: str | None = None, **options: Any) -> Dataset:
    return perform(plan(source, format_name, **options), folder, silent)


def recorded(dataset: Dataset) -> dict[str, list[Any]]:
    """The messages of a dataset by topic."""
    seen: dict[str, list[Any]] = {}
    with open_bag(dataset.bag_path) as reader:
        for connection, _, raw in messages(reader, dataset.bag_path):
            seen.setdefault(connection.topic, []).append(decode(reader, dataset.bag_path, connection, raw))
    return seen


def grey(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def colour(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth(number: int) -> Any:
    return np.random.default_rng(number).integers(1, 9000, (HEIGHT, WIDTH), dtype=np.uint16)


def draw(path: Path, pixels: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def write(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def rewrite(name: str, pattern: str, replacement: str) -> Damage:
    def change(source: Path) -> None:
        path = source / name
        text, changes = re.subn(pattern, replacement, path.read_text(), count=1)
        assert changes
        path.write_text(text)

    return change


def cut(name: str, size: int) -> Damage:
    return lambda source: (source / name).write_bytes((source / name).read_bytes()[:size])


def remove(name: str) -> Damage:
    return lambda source: (source / name).unlink()


EUROC_START_NS = 1403715274312143104
"""That of V1_01: too large for a float64 to hold exactly."""
_T_BS = "T_BS:\n  cols: 4\n  rows: 4\n  data: [{}]"
_IDENTITY = "1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1"


def make_euroc(folder: Path, *, distortion_model: str = "radial-tangential") -> Path:
    """A folder as the ASL publishes them, two cameras, an IMU and the estimated ground truth."""
    root = folder / "mav0"
    for number in (0, 1):
        times = [EUROC_START_NS + 50_000_000 * frame for frame in range(FRAMES)]
        write(root / f"cam{number}/data.csv", "#timestamp [ns],filename", *(f"{t},{t}.png" for t in times))
        write(
            root / f"cam{number}/sensor.yaml",
            "%YAML:1.0",
            "sensor_type: camera",
            _T_BS.format(f"0, -1, 0, 0.1, 1, 0, 0, {0.1 * number}, 0, 0, 1, 0, 0, 0, 0, 1"),
            f"resolution: [{WIDTH}, {HEIGHT}]",
            "camera_model: pinhole",
            "intrinsics: [20.5, 20.25, 15.5, 11.5]",
            f"distortion_model: {distortion_model}",
            "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]",
        )
        for frame, time_ns in enumerate(times):
            draw(root / f"cam{number}/data/{time_ns}.png", grey(10 * number + frame))
    samples = [f"{EUROC_START_NS + 5_000_000 * n},0.{n},0.2,0.3,0,0,9.81" for n in range(31)]
    write(root / "imu0/data.csv", "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z", *samples)
    write(
        root / "imu0/sensor.yaml",
        "%YAML:1.0",
        _T_BS.format(_IDENTITY),
        "rate_hz: 200",
        "gyroscope_noise_density: 1.6968e-04",
        "accelerometer_noise_density: 2.0e-3",
    )
    poses = [f"{EUROC_START_NS + 5_000_000 * n},{n},2,3,0.6,0.8,0,0,1,1,1,0,0,0,0,0,0" for n in range(31)]
    write(root / "state_groundtruth_estimate0/data.csv", "#timestamp, p_RS_R_x [m], ... q_RS_w []", *poses)
    return folder


CALIBRATION = f"""\
format: 1
name: other
bag: other.bag
duration_s: 1
checksum: sha256:{"0" * 64}
sensors:
- name: cam0
  kind: camera
  topic: /cam0/image_raw
  rate_hz: 30
  calibration: {{width: {WIDTH}, height: {HEIGHT}, fx: 20.5, fy: 20.25, cx: 15.5, cy: 11.5}}
"""
TUM_START_S = 1305031102.175304


def with_calibration(source: Path) -> dict[str, Any]:
    """The option with the intrinsics of a small camera, in a file beside ``source``."""
    path = source.with_name("camera.yaml")
    path.write_text(CALIBRATION)
    return {"calibration": (path,)}


def tum_pose(time_s: float, number: float) -> str:
    return f"{time_s:.6f} {number} 2 3 0 0 0.6 0.8"


def make_tum_rgbd(folder: Path) -> Path:
    """A folder as the benchmark publishes them: depth images are taken 10 ms after those with colour."""
    for kind, pixels, late_s in (("rgb", colour, 0.0), ("depth", depth, 0.01)):
        times = [f"{TUM_START_S + late_s + frame / 30:.6f}" for frame in range(FRAMES)]
        write(folder / f"{kind}.txt", "# color images", "# timestamp filename", *(f"{t} {kind}/{t}.png" for t in times))
        for frame, time in enumerate(times):
            draw(folder / f"{kind}/{time}.png", pixels(frame))
    poses = [tum_pose(TUM_START_S - 0.01 + n / 100, n) for n in range(14)]
    write(folder / "groundtruth.txt", "# ground truth trajectory", *poses)
    return folder


_MATRIX = "1 0 0 {} 0 1 0 2 0 0 1 3 0 0 0 1"


def make_7_scenes(folder: Path) -> Path:
    for frame in range(FRAMES):
        far = depth(frame)
        far[0, 0] = 65535
        draw(folder / f"frame-{frame:06d}.color.png", colour(frame))
        draw(folder / f"frame-{frame:06d}.depth.png", far)
        numbers = _MATRIX.format(frame).split()
        rows = [" ".join(numbers[start : start + 4]) for start in (0, 4, 8, 12)]
        write(folder / f"frame-{frame:06d}.pose.txt", *rows)
    return folder


def make_eth3d(folder: Path) -> Path:
    make_tum_rgbd(folder)
    write(folder / "calibration.txt", "20.5 20.25 15.5 11.5")
    return folder


def make_replica(folder: Path) -> Path:
    for frame in range(FRAMES):
        draw(folder / f"results/frame{frame:06d}.jpg", colour(frame))
        draw(folder / f"results/depth{frame:06d}.png", depth(frame))
    write(folder / "traj.txt", *(_MATRIX.format(frame) for frame in range(FRAMES)))
    camera = f'"w": {WIDTH}, "h": {HEIGHT}, "fx": 20.5, "fy": 20.25, "cx": 15.5, "cy": 11.5, "scale": 6553.5'
    write(folder.parent / "cam_params.json", f'{{"camera": {{{camera}}}}}')
    return folder


def make_tartanair(folder: Path) -> Path:
    for frame in range(2):
        for side in ("left", "right"):
            draw(folder / f"image_{side}/{frame:06d}_{side}.png", np.full((480, 640, 3), frame, dtype=np.uint8))
        (folder / "depth_left").mkdir(exist_ok=True)
        np.save(folder / f"depth_left/{frame:06d}_left_depth.npy", np.full((480, 640), 2.5 + frame, dtype=np.float32))
    write(folder / "pose_left.txt", *(f"{frame} 2 3 0 0 0.6 0.8" for frame in range(2)))
    return folder


def make_openloris(folder: Path) -> Path:
    make_tum_rgbd(folder)
    for old, new in (("rgb", "color"), ("depth", "aligned_depth")):
        (folder / old).rename(folder / new)
        text = (folder / f"{old}.txt").read_text()
        (folder / f"{old}.txt").unlink()
        (folder / f"{new}.txt").write_text(text.replace(f" {old}/", f" {new}/"))
    matrix = "!!opencv-matrix\n      rows: {}\n      cols: {}\n      dt: d\n      data: [ {} ]"
    write(
        folder / "sensors.yaml",
        "%YAML:1.0",
        "d400_color_optical_frame:",
        "   fps: 30",
        f"   width: {WIDTH}",
        f"   height: {HEIGHT}",
        "   intrinsics: " + matrix.format(1, 4, "20.5, 15.5, 20.25, 11.5"),
    )
    links = (("base_link", "d400_color_optical_frame", 0.5), ("d400_color_optical_frame", "d400_gyroscope", 0.25))
    lines = ["%YAML:1.0", "trans_matrix:"]
    for parent, child, x_m in links:
        lines += [f"   - parent_frame: {parent}", f"     child_frame: {child}"]
        lines += ["     matrix: " + matrix.format(4, 4, _MATRIX.format(x_m).replace(" ", ", "))]
    write(folder / "trans_matrix.yaml", *lines)
    for name, late_s in (("gyroscope", 0.0), ("accelerometer", 0.001)):
        rows = [f"{TUM_START_S + late_s + n / 200:.6f} {n} 0 9.81" for n in range(20)]
        write(folder / f"d400_{name}.txt", "# time x y z", *rows)
    return folder


def make_vslam_lab(folder: Path) -> Path:
    times = [EUROC_START_NS + 50_000_000 * frame for frame in range(FRAMES)]
    columns = ("rgb_0", "rgb_1", "depth_0")
    rows = [",".join(f"{time},{name}/{time}.png" for name in columns) for time in times]
    write(folder / "rgb.csv", ",".join(f"ts_{name} (ns),path_{name}" for name in columns), *rows)
    for name, pixels in zip(columns, (grey, colour, depth), strict=True):
        for frame, time in enumerate(times):
            draw(folder / f"{name}/{time}.png", pixels(frame))
    camera = (
        f"cam_model: pinhole, focal_length: [20.5, 20.25], principal_point: [15.5, 11.5], "
        f"image_dimension: [{WIDTH}, {HEIGHT}], fps: 20.0"
    )
    pose = "T_BS: [1, 0, 0, {}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
    write(
        folder / "calibration.yaml",
        "%YAML:1.0",
        "cameras:",
        f"  - {{cam_name: rgb_0, cam_type: gray+depth, depth_name: depth_0, depth_factor: 5000.0, {camera},",
        "     distortion_type: radtan4, distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05],",
        f"     {pose.format(0)}}}",
        f"  - {{cam_name: rgb_1, cam_type: rgb, {camera}, {pose.format(0.1)}}}",
        "imus:",
        f"  - {{imu_name: imu_0, sigma_g_c: 0.001, sigma_a_c: 0.02, fps: 200.0, {pose.format(0.3)}}}",
    )
    samples = [f"{EUROC_START_NS + 5_000_000 * n},0.1,0.2,0.3,0,0,9.81" for n in range(31)]
    write(folder / "imu_0.csv", "ts (ns),wx (rad s^-1),wy,wz,ax (m s^-2),ay,az", *samples)
    poses = [f"{EUROC_START_NS + 5_000_000 * n},{n},2,3,0,0,0.6,0.8" for n in range(31)]
    write(folder / "groundtruth.csv", "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw", *poses)
    return folder


def make_kitti_raw(folder: Path) -> Path:
    day = folder / "2011_09_26"
    projections = [f"P_rect_{n:02d}: 20 0 15.5 {-10 * n} 0 20 11.5 0 0 0 1 0" for n in range(4)]
    write(day / "calib_cam_to_cam.txt", "calib_time: now", "R_rect_00: 1 0 0 0 1 0 0 0 1", *projections)
    write(day / "calib_velo_to_cam.txt", "R: 0 -1 0 0 0 -1 1 0 0", "T: 0 -0.08 -0.27")
    write(day / "calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 1", "T: -0.8 0.3 -0.8")
    drive = day / "2011_09_26_drive_0001_sync"
    times = [f"2011-09-26 13:02:25.{100 + frame * 100}123456" for frame in range(FRAMES)]
    for name in ("image_00", "image_02", "velodyne_points", "oxts"):
        write(drive / name / "timestamps.txt", *times)
    for frame in range(FRAMES):
        draw(drive / f"image_00/data/{frame:010d}.png", grey(frame))
        draw(drive / f"image_02/data/{frame:010d}.png", colour(frame))
        path = drive / f"velodyne_points/data/{frame:010d}.bin"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(np.arange(40, dtype="<f4").tobytes())
        packet = [49.0 + frame * 1e-5, 8.4, 112.0 + frame, 0.0, 0.0, 0.5, *[0.0] * 5, 0.1, 0.2, 9.8, *[0.0] * 3]
        numbers = [*packet, 0.01, 0.02, 0.03, *[0.0] * 10]
        write(drive / f"oxts/data/{frame:010d}.txt", " ".join(str(number) for number in numbers))
    return drive


NUSCENES_SCENE = "scene-0061"
KITTI_360 = "2013_05_28_drive_0000_sync"


def make_kitti_360(folder: Path) -> Path:
    root = folder / "KITTI-360"
    calibration = root / "calibration"
    cameras = {n: f"0 0.1 0.995 1.5 1 0 0 {0.3 + 0.6 * n} 0 0.995 -0.1 -0.7" for n in range(4)}
    turned = {n: rigid_row([float(part) for part in row.split()]) for n, row in cameras.items()}
    write(calibration / "calib_cam_to_pose.txt", *(f"image_{n:02d}: {row}" for n, row in turned.items()))
    write(calibration / "calib_cam_to_velo.txt", "0 0 1 0.8 -1 0 0 0.3 0 -1 0 -0.4")
    sine, cosine = np.sin(0.02), np.cos(0.02)
    lines = ["calib_time: now"]
    for n in range(2):
        lines.append(f"P_rect_{n:02d}: 20 0 15.5 {-12 * n} 0 20 11.5 0 0 0 1 0")
        lines.append(f"R_rect_{n:02d}: {cosine} 0 {sine if n else -sine} 0 1 0 {-sine if n else sine} 0 {cosine}")
        lines.append(f"S_rect_{n:02d}: 32 24")
    write(calibration / "perspective.txt", *lines)
    images, scans, poses = (root / part / KITTI_360 for part in ("data_2d_raw", "data_3d_raw", "data_poses"))
    times = [f"2013-05-28 08:46:02.{frame}04381184" for frame in range(FRAMES)]
    for part in (images / "image_00", images / "image_01", scans / "velodyne_points", poses / "oxts"):
        write(part / "timestamps.txt", *times)
    for frame in range(FRAMES):
        for n in range(2):
            draw(images / f"image_{n:02d}/data_rect/{frame:010d}.png", grey(frame))
        path = scans / f"velodyne_points/data/{frame:010d}.bin"
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(np.arange(40, dtype="<f4").tobytes())
        packet = [49.0 + frame * 1e-5, 8.4, 112.0 + frame, 0.0, 0.0, 0.5, *[0.0] * 5, 0.1, 0.2, 9.8, *[0.0] * 3]
        numbers = [*packet, 0.01, 0.02, 0.03, *[0.0] * 10]
        write(poses / f"oxts/data/{frame:010d}.txt", " ".join(str(number) for number in numbers))
    rows = [
        f"{frame} 1 0 0 {1000 + frame} 0 -1 0 {3000 + 2 * frame} 0 0 -1 {116 + frame}" for frame in range(1, FRAMES)
    ]
    write(poses / "poses.txt", *rows)
    return root


def rigid_row(numbers: list[float]) -> str:
    """The rows of a transform, with the rotation nearest to the one in ``numbers``."""
    upper = np.array(numbers).reshape(3, 4)
    left, _, right = np.linalg.svd(upper[:, :3])
    upper[:, :3] = left @ right
    return " ".join(repr(float(value)) for value in upper.reshape(-1))


def make_video(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT))
    for frame in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), 40 * frame, dtype=np.uint8))
    writer.release()
    write(folder / "truth.txt", *(tum_pose(frame / 10, frame) for frame in range(FRAMES)))
    return path


def with_truth(source: Path) -> dict[str, Any]:
    return {**with_calibration(source), "groundtruth": source.with_name("truth.txt")}


FORMATS: dict[str, Callable[[Path], Path]] = {
    "euroc": make_euroc,
    "tum-rgbd": make_tum_rgbd,
    "kitti-raw": make_kitti_raw,
    "kitti-360": make_kitti_360,
    "7-scenes": make_7_scenes,
    "eth3d": make_eth3d,
    "tartanair": make_tartanair,
    "replica": make_replica,
    "openloris": make_openloris,
    "vslam-lab": make_vslam_lab,
    "video": make_video,
}
"""Makes a folder of each format."""
OPTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "tum-rgbd": with_calibration,
    "7-scenes": with_calibration,
    "video": with_truth,
    "nuscenes": lambda _source: {"sequence": NUSCENES_SCENE},
}
"""What users have to say of such a folder."""


def options_of(name: str, source: Path) -> dict[str, Any]:
    """What users have to say of the folder ``source`` of a format."""
    say = OPTIONS.get(name)
    return {} if say is None else say(source)
