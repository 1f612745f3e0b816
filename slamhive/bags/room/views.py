"""Single pictures of the room, for whatever needs images without a recording: training an ORB vocabulary, say."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from slamhive.bags.geometry import Array, rotation_xyz, transform
from slamhive.bags.room.camera import Renderer
from slamhive.bags.room.rig import make_rig
from slamhive.bags.room.sensing import add_noise
from slamhive.bags.room.world import ROOM_SIZE_M, clearance_m

_CLEARANCE_M = 0.6
_VIEW_STREAM = 5


def sample_views(count: int, seed: int = 1, width: int = 640, height: int = 480) -> list[Array]:
    """``count`` noisy grey images (height, width) uint8 from random free places, looking in random directions."""
    rig = make_rig(width, height, lidar_rate_hz=10.0)
    rng = np.random.default_rng(np.random.SeedSequence([seed, _VIEW_STREAM]))
    images = []
    for _ in range(count):
        turn = rotation_xyz(rng.uniform(-0.2, 0.2), rng.uniform(-0.35, 0.35), rng.uniform(-np.pi, np.pi))
        T_world_camera = transform(turn, _free_place(rng)) @ rig.T_body_left
        images.append(add_noise(_renderer(seed).view(T_world_camera, rig.camera).grey, rng))
    return images


def _free_place(rng: np.random.Generator) -> Array:
    low = np.array([-ROOM_SIZE_M[0] / 2, -ROOM_SIZE_M[1] / 2, 0.0]) + _CLEARANCE_M
    high = np.array([ROOM_SIZE_M[0] / 2, ROOM_SIZE_M[1] / 2, ROOM_SIZE_M[2]]) - _CLEARANCE_M
    while True:
        place: Array = rng.uniform(low, high)
        if clearance_m(place) > _CLEARANCE_M:
            return place


@lru_cache(maxsize=1)
def _renderer(seed: int) -> Renderer:
    return Renderer(seed)
