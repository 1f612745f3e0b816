"""SLAM Hive in Python: search runs, read results, submit runs and experiments, on a data root or on a server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.client.analyses import Analyses, Analysis
    from slamhive.client.asynchronous import AsyncHive
    from slamhive.client.experiments import Experiment, Experiments
    from slamhive.client.hive import Hive
    from slamhive.client.runs import Batch, Run, RunList, Runs
    from slamhive.client.trajectory import RunTrajectory

__all__ = [
    "Analyses",
    "Analysis",
    "AsyncHive",
    "Batch",
    "Experiment",
    "Experiments",
    "Hive",
    "Run",
    "RunList",
    "RunTrajectory",
    "Runs",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
