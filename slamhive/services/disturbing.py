"""Runs that were measured on a disturbed machine: the verdict, and the repetition where it is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from datetime import datetime

from slamhive.domain.disturbance import Disturbance, DisturbanceLimits, judge
from slamhive.domain.run import RunState
from slamhive.runs.folder import RunFolder
from slamhive.runs.host_load import read_host_load
from slamhive.services.experiments.storing import run_uid
from slamhive.services.retrying import retry_request
from slamhive.settings import Settings
from slamhive.store.experiment_records import ExperimentState
from slamhive.store.records import RunRecord
from slamhive.store.store import Transaction


def judge_run(folder: RunFolder, metrics: Mapping[str, float], settings: Settings) -> Disturbance:
    """Whether the run in ``folder`` with these metrics was disturbed, by the limits of this installation."""
    limits = DisturbanceLimits(
        **{entry.name: getattr(settings, f"disturbed_{entry.name}") for entry in fields(DisturbanceLimits)}
    )
    lag_s = metrics.get("playback.lag_max")
    return judge(read_host_load(folder.host), metrics["duration"], lag_s, limits)


def repeat_if_disturbed(t: Transaction, run: RunRecord, now: datetime) -> None:
    """Queue a run in the place of ``run`` if it has ended disturbed and may be repeated; done again, it adds nothing.

    The repetition may be repeated once less. Its uid follows from that of the run, and it is stored in the transaction
    that ends the run: a worker that dies leaves both or none.
    """
    wanted = run.disturbance is not None and run.disturbance.disturbed and run.repeat_disturbed > 0
    if not wanted or run.state not in (RunState.SUCCEEDED, RunState.FAILED):
        return
    if run.experiment is not None and t.experiments.locked(run.experiment).state is ExperimentState.CANCELLED:
        return
    request = retry_request(t, run, run_uid(run.uid, "undisturbed"))
    t.runs.add_runs([replace(request, repeat_disturbed=run.repeat_disturbed - 1)], now)
