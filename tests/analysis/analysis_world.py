"""A table of runs as an experiment gives it: known figures, repeats, failures, one protocol."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd

from slamhive.analysis.plot_types import PlotData, RunLatency, RunTrack, RunUsage
from slamhive.analysis.table import RunTable, make_table
from slamhive.domain.verdict import FailureRule

ALGORITHMS = {"kiss-icp": 0.02, "orb-slam3-stereo": 0.05, "rko-lio": 0.04}
DATASETS = ("kitti_06", "room", "v101")
RATES = (1.0, 2.0, 5.0, 10.0, 20.0)
SCALES = (0.2, 0.5, 0.8, 1.0)
REPEATS = 2


class NoFiles:
    """No run has left files."""

    def track(self, run_id: int) -> RunTrack | None:
        return None

    def usage(self, run_id: int, startup_s: float | None) -> RunUsage | None:
        return None

    def latency(self, run_id: int) -> RunLatency | None:
        return None

    def first_frame_s(self, run_id: int) -> float | None:
        return None


def sweep_table(rule: FailureRule | None = None, **changed: list[object]) -> RunTable:
    """3 algorithms x 3 datasets x 5 rates x 4 scales x 2 repeats; low rates are worse, the lowest fail for ORB."""
    draws = np.random.default_rng(0)
    cells = list(product(ALGORITHMS, DATASETS, RATES, SCALES))
    rows = [(place + 1, *cell) for place, cell in enumerate(cells) for _ in range(REPEATS)]
    configuration, algorithm, dataset, rate, scale = map(list, zip(*rows, strict=True))
    failed = [name.startswith("orb") and hertz == 1.0 for name, hertz in zip(algorithm, rate, strict=True)]
    ate = [
        None if bad else ALGORITHMS[name] * (1 + 5 / hertz) * (1 + 0.1 * draws.random())
        for name, hertz, bad in zip(algorithm, rate, failed, strict=True)
    ]
    count = len(rows)
    facts: dict[str, list[object]] = {
        "run_id": list(range(1, count + 1)),
        "configuration_id": list(configuration),
        "algorithm": algorithm,
        "dataset": dataset,
        "state": ["failed" if bad else "succeeded" for bad in failed],
        "reason": ["lost_tracking" if bad else None for bad in failed],
        "protocol": [None if bad else "aaaaaaaaaaaa" for bad in failed],
        "protocol_label": [None if bad else "SE(3)" for bad in failed],
        "sensors": ["stereo" if name.startswith("orb") else "lidar" for name in algorithm],
        **changed,
    }
    metrics: dict[str, list[float | None]] = {
        "ate.rmse": ate,
        "rpe.rmse": [None if value is None else value / 4 for value in ate],
        "tracked_fraction": [None if bad else 0.98 for bad in failed],
        "cpu.mean": [float(0.2 + hertz / 20 * share) for hertz, share in zip(rate, draws.random(count), strict=True)],
        "cpu.max": [2.0] * count,
        "ram.max": [float(3e8 * size) for size in scale],
    }
    return make_table(facts, {"image_rate": rate, "scale": scale}, metrics, rule)


def data_of(table: RunTable) -> PlotData:
    """What a form gets of a table alone."""
    return PlotData(table, pd.DataFrame(columns=["run_id", "protocol", "protocol_label", "metric", "value"]), NoFiles())
