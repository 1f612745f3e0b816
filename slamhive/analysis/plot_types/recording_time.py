"""The time axis that the lines of runs share: the time of the recording."""

from __future__ import annotations

from collections.abc import Mapping

from slamhive.analysis.chart import Axis
from slamhive.analysis.plot_types import base

RECORDING_TIME = Axis("recording time", "s")
FROM_FIRST_FRAME = "The recording time is 0 s at the first frame."
_MOST_RUNS = 200
"""Runs that are asked for their first frame. All runs on a dataset have nearly the same."""


def recording_starts(data: base.PlotData) -> dict[int, float]:
    """{run: timestamp in s at which the recording time of its dataset is 0}, for datasets with a played frame.

    It is the earliest first frame of the runs on a dataset: cameras and LiDARs do not start at the same moment. Good
    and failed runs count, drawn or not, so that all plots of a selection have the same.
    """
    datasets = _datasets(data)
    earliest: dict[str, float] = {}
    for run, dataset in list(datasets.items())[:_MOST_RUNS]:
        first_s = data.files.first_frame_s(run)
        if first_s is not None:
            earliest[dataset] = min(first_s, earliest.get(dataset, first_s))
    return {run: earliest[dataset] for run, dataset in datasets.items() if dataset in earliest}


def _datasets(data: base.PlotData) -> Mapping[int, str]:
    pairs = data.table.frame[["run_id", "dataset"]].itertuples(index=False, name=None)
    return {int(run): str(dataset) for run, dataset in pairs}
