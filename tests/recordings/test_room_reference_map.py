import numpy as np
import pytest

from slamhive.recordings.room.world import ROOM_SIZE_M, clearance_m, room_faces, sample_surfaces

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def points_m():
    return sample_surfaces(0.1)


def test_every_point_lies_on_a_surface(points_m):
    for point_m in points_m[::7]:
        assert clearance_m(point_m) == pytest.approx(0.0, abs=1e-9)


def test_every_open_surface_is_covered(points_m):
    """From the middle of the room in many directions: what a ray hits has a point of the grid beside it."""
    rng = np.random.default_rng(5)
    origin_m = np.array([1.5, 1.0, 1.4])
    rays = rng.standard_normal((200, 3))
    for ray in rays / np.linalg.norm(rays, axis=1, keepdims=True):
        hits = []
        for face in room_faces():
            facing = float(ray @ face.normal)
            if facing >= 0:
                continue
            distance_m = float((face.corner_m - origin_m) @ face.normal) / facing
            at = origin_m + distance_m * ray - face.corner_m
            if distance_m > 0 and 0 <= at @ face.u <= face.width_m and 0 <= at @ face.v <= face.height_m:
                hits.append(distance_m)
        hit_m = origin_m + min(hits) * ray
        assert np.linalg.norm(points_m - hit_m, axis=1).min() <= 0.1


def test_what_nobody_can_see_is_left_out(points_m):
    assert not ((points_m[:, 2] == 0) & (np.abs(points_m[:, :2] - [-1.6, 2.8]) < [1.0, 0.12]).all(axis=1)).any()
    area_m2 = 2 * (ROOM_SIZE_M[0] * ROOM_SIZE_M[1] + (ROOM_SIZE_M[0] + ROOM_SIZE_M[1]) * ROOM_SIZE_M[2])
    assert len(points_m) * 0.1**2 == pytest.approx(area_m2, rel=0.3)


def test_the_same_points_each_time():
    np.testing.assert_array_equal(sample_surfaces(0.3), sample_surfaces(0.3))
