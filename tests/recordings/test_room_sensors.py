"""The models of the room's sensors against each other and against first principles."""

from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.recordings.geometry import quaternions_from_rotations, rotation_xyz, transform
from slamhive.recordings.room.camera import Camera, Renderer, _project
from slamhive.recordings.room.sensors import (
    BASELINE_M,
    GRAVITY_MPS2,
    NO_NOISE,
    Lidar,
    LidarModel,
    make_rig,
    measure,
    sample_views,
)
from slamhive.recordings.room.world import clearance_m, motion_at, room_faces

pytestmark = pytest.mark.integration

CAMERA = Camera(320, 240, 215.0, 215.0, 159.5, 119.5)
R_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
NO_RANGE_NOISE = LidarModel(beams=8, columns=60, range_noise_m=0.0)


def looking(yaw_rad, position_m=(0.3, 0.4, 1.5), pitch_rad=0.05):
    return transform(rotation_xyz(0.03, pitch_rad, yaw_rad) @ R_BODY_OPTICAL, np.array(position_m))


@pytest.fixture(scope="module")
def renderer():
    return Renderer(seed=1)


def rays_world(T_world_camera):
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(x.shape)], axis=-1)
    return rays @ T_world_camera[:3, :3].T


@pytest.mark.parametrize("yaw_rad", [1.5, -2.8])
def test_depth_puts_every_pixel_on_a_surface(renderer, yaw_rad):
    T = looking(yaw_rad)
    view = renderer.view(T, CAMERA)
    points = T[:3, 3] + rays_world(T) * view.depth_m[..., None]
    assert view.depth_m.min() > 0
    for row, column in np.random.default_rng(0).integers((0, 0), (CAMERA.height, CAMERA.width), (200, 2)):
        assert abs(clearance_m(points[row, column])) < 2e-4


def test_depth_equals_the_range_to_the_wall_in_front(renderer):
    T = looking(np.pi / 2, (2.9, 0.4, 1.5), 0.0)
    view = renderer.view(T, CAMERA)
    ray = rays_world(T)[119, 160]
    assert view.depth_m[119, 160] == pytest.approx((3.0 - 0.4) / ray[1], rel=1e-5)


def test_a_known_corner_is_drawn_where_it_projects(renderer):
    T = looking(np.pi / 2, (0.6, 0.4, 1.55), 0.0)
    face = next(face for face in room_faces() if face.name == "board_north_right")
    corners = (face.corners_m - T[:3, 3]) @ T[:3, :3]
    x = CAMERA.fx * corners[:, 0] / corners[:, 2] + CAMERA.cx
    y = CAMERA.fy * corners[:, 1] / corners[:, 2] + CAMERA.cy
    grey = renderer.view(T, CAMERA).grey
    row, edge = round(y.mean()), (x[0] + x[3]) / 2
    assert grey[row, int(np.ceil(edge))] < 60  # the poster's dark frame begins at its left edge
    assert grey[row, int(np.floor(edge)) - 1] > 90  # and the wall is before it


@pytest.mark.parametrize("seed", range(8))
def test_no_face_that_is_left_out_is_in_the_picture(renderer, seed):
    draw = np.random.default_rng(seed)
    for _ in range(10):
        position_m = draw.uniform((-2.9, -2.4, 0.1), (2.9, 2.4, 2.4))
        T = looking(draw.uniform(-np.pi, np.pi), position_m, draw.uniform(-1.5, 1.5))
        found = renderer.perhaps_seen(T, CAMERA)
        seen = [index for index, face in enumerate(room_faces()) if _project(face, T, CAMERA) is not None]
        assert set(seen) <= set(found)
        assert len(found) < len(room_faces())


def test_stereo_images_agree_through_depth(renderer):
    T = looking(2.2)
    left = renderer.view(T, CAMERA)
    right = renderer.view(T @ transform(np.eye(3), np.array([BASELINE_M, 0.0, 0.0])), CAMERA)
    x, y = np.meshgrid(np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32))
    x -= np.float32(CAMERA.fx * BASELINE_M) / left.depth_m
    moved = cv2.remap(right.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1000)
    difference = np.abs(moved - left.grey)[moved > -1]
    assert np.median(difference) < 2.0
    assert left.grey.std() > 20


def test_pictures_have_enough_corners_for_feature_based_slam():
    detector: Any = cv2.ORB_create(2000)  # type: ignore[attr-defined]
    assert min(len(detector.detect(image)) for image in sample_views(2, seed=1)) > 500


def test_sample_views_depend_on_nothing_but_their_arguments():
    first, second = (sample_views(1, seed=3, width=160, height=120) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert first[0].dtype == np.uint8


def test_motion_derivatives_are_exact_and_the_path_is_free():
    times, step = np.linspace(0, 15, 301), 1e-5
    motion, later, before = (motion_at(times + shift, 15.0) for shift in (0, step, -step))
    velocity = (later.positions_m - before.positions_m) / (2 * step)
    acceleration = (later.velocities_mps - before.velocities_mps) / (2 * step)
    assert np.abs(velocity - motion.velocities_mps).max() < 1e-8
    assert np.abs(acceleration - motion.accelerations_mps2).max() < 1e-4
    turn = np.einsum("nji,njk->nik", before.R_world_body, later.R_world_body) / (2 * step)
    skew = (turn - turn.transpose(0, 2, 1)) / 2
    rates = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    assert np.abs(rates - motion.rates_body_radps).max() < 1e-6
    assert min(clearance_m(position) for position in motion.positions_m) > 0.5


@pytest.mark.parametrize("duration_s", [0.2, 5.0, 15.0, 40.0])
def test_motion_rests_first_and_returns_to_the_start(duration_s):
    motion = motion_at(np.array([0.0, duration_s]), duration_s)
    assert np.abs(motion.velocities_mps).max() < 1e-12
    assert np.allclose(motion.T_world_body(0), motion.T_world_body(1), atol=1e-9)


def test_imu_without_noise_integrates_back_to_the_ground_truth():
    rate_hz, duration_s = 1000.0, 4.0
    midpoints = (np.arange(int(rate_hz * duration_s)) + 0.5) / rate_hz
    samples = measure(motion_at(midpoints, duration_s), rate_hz, NO_NOISE, np.random.default_rng(0))
    ends = motion_at(np.array([0.0, duration_s / 2]), duration_s)
    R, p, v = ends.R_world_body[0], ends.positions_m[0], ends.velocities_mps[0]
    for rate, force in zip(samples.rates_radps[:2000], samples.specific_forces_mps2[:2000], strict=True):
        middle = R @ cv2.Rodrigues(rate / rate_hz / 2)[0]
        acceleration = middle @ force - np.array([0, 0, GRAVITY_MPS2])
        p = p + v / rate_hz + acceleration / rate_hz**2 / 2
        v = v + acceleration / rate_hz
        R = R @ cv2.Rodrigues(rate / rate_hz)[0]
    assert np.linalg.norm(p - ends.positions_m[1]) < 1e-4
    assert np.abs(R - ends.R_world_body[1]).max() < 1e-5


def test_imu_noise_has_the_stated_density():
    noise = make_rig(64, 48, 10.0).imu_noise
    still = motion_at(np.zeros(20000), 15.0)
    samples = measure(still, 200.0, noise, np.random.default_rng(0))
    white = np.diff(samples.rates_radps, axis=0).std() / np.sqrt(2)
    assert white == pytest.approx(noise.gyroscope_noise_density * np.sqrt(200.0), rel=0.03)


def test_scan_points_lie_on_surfaces_once_the_motion_is_undone():
    T_body_lidar = make_rig(64, 48, 10.0).T_body_lidar
    start_s, duration_s = 4.0, 15.0
    points = Lidar(NO_RANGE_NOISE, T_body_lidar, duration_s).scan(start_s, np.random.default_rng(0))
    motion = motion_at(start_s + points["time"].astype(np.float64), duration_s)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    body = xyz @ T_body_lidar[:3, :3].T + T_body_lidar[:3, 3]
    world = np.einsum("nij,nj->ni", motion.R_world_body, body) + motion.positions_m
    assert max(abs(clearance_m(point)) for point in world) < 1e-5
    still = motion_at(np.full(len(points), start_s), duration_s)
    distorted = np.einsum("nij,nj->ni", still.R_world_body, body) + still.positions_m
    assert np.linalg.norm(world - distorted, axis=1).max() > 0.05
    assert np.all(np.diff(points["time"]) >= 0)
    assert points.dtype.names == ("x", "y", "z", "intensity", "ring", "time")


def test_quaternions_match_their_rotations_and_do_not_flip():
    angles = np.linspace(0, 4 * np.pi, 100)
    R = rotation_xyz(0.3 * np.sin(angles), 0.2 * np.cos(angles), angles)
    quats = quaternions_from_rotations(R)
    x, y, z, w = quats.T
    assert np.allclose(np.linalg.norm(quats, axis=1), 1)
    assert np.allclose(R[:, 1, 0], 2 * (x * y + z * w))
    assert np.allclose(R[:, 0, 0], 1 - 2 * (y * y + z * z))
    assert np.all(np.sum(quats[1:] * quats[:-1], axis=1) > 0)
