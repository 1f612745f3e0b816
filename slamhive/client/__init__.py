"""SLAM Hive in Python: search runs, read results, submit runs and experiments, on a data root or on a server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.client.asynchronous import AsyncHive
    from slamhive.client.experiments import Analyses, Analysis, Experiment, Experiments
    from slamhive.client.hive import Hive
    from slamhive.client.runs import Batch, Run, RunList, Runs
    from slamhive.client.trajectory import RunTrajectory


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
