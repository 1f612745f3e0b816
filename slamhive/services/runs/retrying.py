"""Retry runs: a new run takes over the request of an old one."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import datetime

from slamhive.domain.external import IMPORTED
from slamhive.domain.run import RunState
from slamhive.errors import Conflict
from slamhive.store import Transaction
from slamhive.store.experiment_records import ExperimentState
from slamhive.store.records import RunRecord, RunRequest


def check_retriable(old: RunRecord) -> None:
    """Raise Conflict for a run that has not ended or was imported."""
    if old.executor == IMPORTED:
        raise Conflict(f"run {old.id} was imported: it cannot be run again here", "import its next trial")
    if not old.state.ended:
        raise Conflict(f"run {old.id} is {old.state}", "only a run that has ended can be retried")


def retry_request(t: Transaction, old: RunRecord, uid: str) -> RunRequest:
    """The request for a new run with the options of ``old``; held if its experiment is paused."""
    experiment = None if old.experiment is None else t.experiments.locked(old.experiment)
    return RunRequest(
        uid=uid,
        configuration_id=old.configuration_id,
        executor=old.executor,
        seed=old.seed,
        priority=old.priority,
        evaluate=old.evaluate,
        cpu_cores=old.cpu_cores,
        memory_mb=old.memory_mb,
        timeout_s=old.timeout_s,
        retry_of=old.id,
        protocol=old.protocol_override,
        experiment_id=old.experiment_id,
        cell=old.cell,
        held=experiment is not None and experiment.state is ExperimentState.PAUSED,
        affinity=old.affinity,
        stop_when=old.stop_when,
        repeat_disturbed=old.repeat_disturbed,
    )


def repeat_if_disturbed(t: Transaction, run: RunRecord, now: datetime) -> None:
    """Queue a repetition of ``run`` if it ended disturbed and may be repeated; a second call adds nothing.

    The repetition may be repeated one time less. It is stored in the transaction that ends the run, so that a worker
    that dies leaves both changes or none.
    """
    wanted = run.disturbance is not None and run.disturbance.disturbed and run.repeat_disturbed > 0
    if not wanted or run.state not in (RunState.SUCCEEDED, RunState.FAILED):
        return
    if run.experiment is not None and t.experiments.locked(run.experiment).state is ExperimentState.CANCELLED:
        return
    request = retry_request(t, run, run_uid(run.uid, "undisturbed"))
    t.runs.add_runs([replace(request, repeat_disturbed=run.repeat_disturbed - 1)], now, deleted_too=False)


def run_uid(origin: str, *parts: object) -> str:
    """The uid of a run, from its place in an experiment or the run that it repeats: no run is stored twice."""
    text = "/".join(map(str, (origin, *parts)))
    return hashlib.sha256(text.encode()).hexdigest()[:32]
