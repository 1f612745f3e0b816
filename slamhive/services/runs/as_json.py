"""A run as JSON, for command line, web API and exports."""

from __future__ import annotations

from typing import Any

from slamhive.domain.disturbance import disturbance_to_json
from slamhive.domain.hint import hints_to_json
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.stop_when import stop_when_to_json
from slamhive.domain.variant import variant_to_json
from slamhive.domain.verdict import Verdict
from slamhive.runs.folder import RunFolder
from slamhive.services.evaluations import evaluation_notes
from slamhive.services.json_values import plain, timestamp
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord


def run_to_json(run: RunRecord) -> dict[str, Any]:
    """The run with its metrics. Times are ISO 8601 in UTC; what is not known is null; absent metrics are left out."""
    return {
        "id": run.id,
        "uid": run.uid,
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "configuration": run.configuration_id,
        "parameters": {key: plain(value) for key, value in run.parameters.items()},
        "playback": {"mode": run.playback.mode.value, "rate": run.playback.rate},
        "variant": variant_to_json(run.variant),
        "executor": run.executor,
        "seed": run.seed,
        "state": run.state.value,
        "reason": None if run.reason is None else run.reason.value,
        "detail": run.detail,
        "created_at": timestamp(run.created_at),
        "started_at": timestamp(run.started_at),
        "ended_at": timestamp(run.ended_at),
        "exit_code": run.exit_code,
        "poses": run.poses,
        "limits": {"cpu_cores": run.cpu_cores, "memory_mb": run.memory_mb, "timeout_s": run.timeout_s},
        "retry_of": run.retry_of,
        "experiment": run.experiment,
        "cell": run.cell,
        "held": run.held,
        "stop_when": stop_when_to_json(run.stop_when),
        "repeat_disturbed": run.repeat_disturbed,
        "disturbance": None if run.disturbance is None else disturbance_to_json(run.disturbance),
        "protocol": None
        if run.protocol is None
        else {"fingerprint": run.protocol.fingerprint, "label": run.protocol.label},
        "verdict": None if run.verdict is None else verdict_to_json(run.verdict),
        "metrics": metrics_to_json(run.metrics or {}),
    }


def verdict_to_json(verdict: Verdict) -> dict[str, Any]:
    """Whether the run counts as failed, and why."""
    return {"kind": verdict.kind.value, "failed": verdict.failed, "words": verdict.words}


def metrics_to_json(values: dict[str, float]) -> dict[str, dict[str, Any]]:
    """``{key: {value, unit}}`` in the order of the catalogue."""
    return {key: {"value": values[key], "unit": metric.unit} for key, metric in CATALOGUE.items() if key in values}


def evaluation_to_json(evaluation: EvaluationRecord, folder: RunFolder) -> dict[str, Any]:
    """One evaluation: its protocol, state, failure reason, and hints at mistakes.

    ``folder`` is that of its run, which holds the hints of the last evaluation under the protocol.
    """
    succeeded = evaluation.state is EvaluationState.SUCCEEDED
    notes = evaluation_notes(folder, evaluation.protocol.fingerprint if succeeded else None)
    return {
        "id": evaluation.id,
        "run": evaluation.run_id,
        "protocol": {"fingerprint": evaluation.protocol.fingerprint, "label": evaluation.protocol.label},
        "state": evaluation.state.value,
        "reason": evaluation.reason,
        "hints": hints_to_json(notes.hints),
        "engine": evaluation.engine,
        "created_at": timestamp(evaluation.created_at),
        "ended_at": timestamp(evaluation.ended_at),
    }
