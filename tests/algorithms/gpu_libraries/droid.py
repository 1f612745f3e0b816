"""``droid.Droid``, the interface of DROID-SLAM as its demo.py uses it. It tracks nothing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

made: list[Droid] = []


class Droid:
    """Notes what it gets, and gives one row for each image of the last stream."""

    def __init__(self, args):
        self.args = args
        self.frontend = SimpleNamespace(is_initialized=False)
        self.taken = []
        made.append(self)

    def track(self, tstamp, image, depth=None, intrinsics=None):
        assert depth is None
        assert image.array.shape == (1 + self.args.stereo, 3, *self.args.image_size)
        self.taken.append((tstamp, image, intrinsics))
        self.frontend.is_initialized = len(self.taken) >= self.args.warmup

    def terminate(self, stream=None):
        self.stream = list(stream)
        rows = np.zeros((len(self.stream), 7), dtype=np.float32)
        rows[:, 0], rows[:, 6] = np.arange(len(rows)), 1
        return rows
