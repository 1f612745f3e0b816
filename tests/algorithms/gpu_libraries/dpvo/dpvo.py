"""``dpvo.dpvo.DPVO``: notes what it gets, and gives one row for each image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

made: list[DPVO] = []


class DPVO:
    """The signatures of upstream's class."""

    def __init__(self, cfg, network, ht=480, wd=640, viz=False):
        assert Path(network).is_file()
        self.cfg, self.size, self.viz = dict(cfg), (ht, wd), viz
        self.is_initialized = False
        self.taken = []
        made.append(self)

    def __call__(self, tstamp, image, intrinsics):
        assert image.array.shape == (3, *self.size)
        self.taken.append((tstamp, image, intrinsics))
        self.is_initialized = len(self.taken) > 2

    def terminate(self):
        numbers = np.arange(len(self.taken))
        rows = np.zeros((len(numbers), 7))
        rows[:, 0], rows[:, 5], rows[:, 6] = numbers, np.sin(0.05 * numbers), np.cos(0.05 * numbers)
        return rows, np.array([tstamp for tstamp, _, _ in self.taken])
