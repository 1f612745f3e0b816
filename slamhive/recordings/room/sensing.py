"""The expensive part: frames and scans, rendered one by one or by worker processes, always in the order asked for."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from multiprocessing.connection import wait

import cv2
import numpy as np

from slamhive.base.errors import Unavailable
from slamhive.recordings.geometry import Array, rotation_xyz, transform
from slamhive.recordings.room.camera import Renderer
from slamhive.recordings.room.motion import motion_at
from slamhive.recordings.room.sensors import DEPTH_UNITS_PER_M, IMAGE_NOISE_GREY, Lidar, make_rig
from slamhive.recordings.room.world import ROOM_SIZE_M, clearance_m

_AHEAD_PER_WORKER = 2
_NOISE_STREAM_FRAMES, _NOISE_STREAM_SCANS = 2, 3


class TaskKind(StrEnum):
    """Requests to a worker."""

    FRAME = "frame"
    SCAN = "scan"


@dataclass(frozen=True, slots=True)
class Task:
    """One frame or scan: its number (which seeds its noise) and its time since the sequence's start."""

    kind: TaskKind
    number: int
    time_s: float


@dataclass(frozen=True, slots=True)
class Scene:
    """State of a sensing process; small, as it is sent to each."""

    seed: int
    duration_s: float
    width: int
    height: int
    lidar_rate_hz: float


class Senses:
    """Renders tasks of one scene in this process."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._rig = make_rig(scene.width, scene.height, scene.lidar_rate_hz)
        self._renderer = Renderer(scene.seed)
        self._lidar = Lidar(self._rig.lidar, self._rig.T_body_lidar, scene.duration_s)

    def sense(self, task: Task) -> tuple[Array, ...]:
        """``(left, right, depth)`` of a frame (uint8, uint8, uint16 in mm) or ``(points,)`` of a scan."""
        if task.kind is TaskKind.SCAN:
            return (self._lidar.scan(task.time_s, self._rng(_NOISE_STREAM_SCANS, task.number)),)
        T_world_body = motion_at(np.array([task.time_s]), self._scene.duration_s).T_world_body(0)
        rng = self._rng(_NOISE_STREAM_FRAMES, task.number)
        left = self._renderer.view(T_world_body @ self._rig.T_body_left, self._rig.camera)
        right = self._renderer.view(T_world_body @ self._rig.T_body_right, self._rig.camera)
        depth = np.rint(left.depth_m * DEPTH_UNITS_PER_M).astype(np.uint16)
        return add_noise(left.grey, rng), add_noise(right.grey, rng), depth

    def _rng(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self._scene.seed, stream, number]))


def add_noise(grey: Array, rng: np.random.Generator) -> Array:
    """The sensor's image: white noise added, rounded to uint8."""
    noise = rng.standard_normal(grey.shape, dtype=np.float32) * np.float32(IMAGE_NOISE_GREY)
    image: Array = np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)
    return image


def sense_all(scene: Scene, tasks: list[Task], workers: int) -> Iterator[tuple[Array, ...]]:
    """The results of ``tasks`` in their order; at most a few frames per worker are in memory at a time.

    Raises Unavailable if a worker process dies.
    """
    if workers == 1:
        senses = Senses(scene)
        for task in tasks:
            yield senses.sense(task)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(scene,))
    try:
        yield from _in_order(pool, tasks, workers * _AHEAD_PER_WORKER)
    except BrokenProcessPool:
        raise Unavailable("a process that renders the room ended", "is there enough memory? (200 MB each)") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _in_order(pool: ProcessPoolExecutor, tasks: list[Task], ahead: int) -> Iterator[tuple[Array, ...]]:
    pending: deque[Future[tuple[Array, ...]]] = deque()
    for task in tasks:
        if len(pending) >= ahead:
            yield pending.popleft().result()
        pending.append(pool.submit(_work, task))
    while pending:
        yield pending.popleft().result()


_worker: dict[str, Senses] = {}
"""The worker process's own renderer; stays empty in the parent."""


def _start_worker(scene: Scene) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _worker["senses"] = Senses(scene)


def _end_with_parent() -> None:
    """A killed parent cannot tell its workers, which would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _work(task: Task) -> tuple[Array, ...]:
    return _worker["senses"].sense(task)


# Single pictures of the room, for whatever needs images without a recording: training an ORB vocabulary, say.


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
