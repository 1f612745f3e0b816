"""The job file between the controller and the evaluation container: many runs for each start.

The controller writes ``job.json``. The entry script evaluates every task, writes ``result.json`` into its output folder
in one step, and prints one line of JSON for it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from types import UnionType

from slamhive.base.bounds import parse_json_object
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.domain.sensors import IDENTITY4, Matrix4
from slamhive.domain.verdict import Hint, hints_from_json

RESULT_FILE = "result.json"


class Artefacts(StrEnum):
    """Files that an evaluation writes besides the metrics."""

    METRICS = "metrics"
    FILES = "files"
    PLOTS = "plots"


@dataclass(frozen=True, slots=True)
class EvaluationTask:
    """One run to evaluate. Paths are those that the evaluating process sees.

    Attributes:
        id: Of the task, unique within a job.
        estimate: The trajectory.
        reference: The ground truth; None if the dataset has relations, in ``files``, instead of a trajectory.
        output: The folder for results.
        protocol: How to evaluate.
        T_body_sensor: Pose of the estimate's frame in the body frame of the ground truth. The ground truth, which is
            metric, is moved into that frame.
        artefacts: METRICS writes metrics only; FILES adds ``ape.zip``, ``rpe.zip`` and the aligned ``traj.tum``; PLOTS
            adds the plots of the published SLAM Hive.
        positions_only: The orientations of the ground truth mean nothing.
        files: Other files of the run by name; see :class:`~slamhive.evaluation.evaluators.base.Paired`.
        lever_arm_m: Point in the body frame that a ground truth of positions measures.
        uncertainty_m: Standard deviation of a position of the ground truth along each axis; None if it is not known.
        span_s: Only the ground truth between these times counts; None for all of it.
    """

    id: str
    estimate: Path
    reference: Path | None
    output: Path
    protocol: Protocol
    T_body_sensor: Matrix4 = IDENTITY4
    artefacts: Artefacts = Artefacts.FILES
    positions_only: bool = False
    files: Mapping[str, Path] = field(default_factory=dict)
    lever_arm_m: tuple[float, ...] | None = None
    uncertainty_m: float | None = None
    span_s: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """The outcome of one task. ``reason`` says in one line why it failed; ``metrics`` is then empty.

    ``missing`` says why a metric could not be computed, {metric key: one line}. ``hints`` are likely mistakes in the
    input.
    """

    id: str
    fingerprint: str
    reason: str | None
    metrics: dict[str, float]
    poses: int
    matched_poses: int
    engine: str
    missing: dict[str, str] = field(default_factory=dict)
    hints: tuple[Hint, ...] = ()

    @property
    def succeeded(self) -> bool:
        """True if the evaluation has metrics."""
        return self.reason is None


def failed_result(
    task: EvaluationTask, reason: str, engine: str, *, poses: int = 0, matched_poses: int = 0
) -> EvaluationResult:
    """The result of a task that could not be evaluated, with its one-line ``reason``."""
    return EvaluationResult(
        id=task.id,
        fingerprint=task.protocol.fingerprint,
        reason=" ".join(reason.split()),
        metrics={},
        poses=poses,
        matched_poses=matched_poses,
        engine=engine,
    )


def job_to_json(tasks: Sequence[EvaluationTask]) -> str:
    """The text of ``job.json``."""
    return json.dumps(
        {
            "format": 1,
            "tasks": [
                {
                    "id": task.id,
                    "estimate": str(task.estimate),
                    "reference": None if task.reference is None else str(task.reference),
                    "output": str(task.output),
                    "protocol": task.protocol.content,
                    "T_body_sensor": list(task.T_body_sensor),
                    "artefacts": task.artefacts.value,
                    "positions_only": task.positions_only,
                    "files": {name: str(path) for name, path in task.files.items()},
                    "lever_arm_m": None if task.lever_arm_m is None else list(task.lever_arm_m),
                    "uncertainty_m": task.uncertainty_m,
                    "span_s": None if task.span_s is None else list(task.span_s),
                }
                for task in tasks
            ],
        },
        indent=1,
    )


def job_from_json(text: str) -> tuple[EvaluationTask, ...]:
    """Read ``job.json``; raises InvalidInput if it is not one."""
    try:
        content = parse_json_object(text, "job.json")
        return tuple(
            EvaluationTask(
                id=entry["id"],
                estimate=Path(entry["estimate"]),
                reference=None if entry["reference"] is None else Path(entry["reference"]),
                output=Path(entry["output"]),
                protocol=protocol_from_content(entry["protocol"]),
                T_body_sensor=tuple(entry["T_body_sensor"]),
                artefacts=Artefacts(entry["artefacts"]),
                positions_only=entry["positions_only"],
                files={name: Path(path) for name, path in entry["files"].items()},
                lever_arm_m=None if entry["lever_arm_m"] is None else tuple(entry["lever_arm_m"]),
                uncertainty_m=entry["uncertainty_m"],
                span_s=None if entry["span_s"] is None else tuple(entry["span_s"]),
            )
            for entry in content["tasks"]
        )
    except SlamHiveError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InvalidInput(f"job.json is not an evaluation job: {error!r}") from None


def result_to_json(result: EvaluationResult) -> str:
    """The text of ``result.json``, and one progress line."""
    return json.dumps(asdict(result), allow_nan=False)


def result_from_json(text: str) -> EvaluationResult:
    """Read ``result.json``; raises InvalidInput if it is not one."""
    content = parse_json_object(text, RESULT_FILE, recorded=True)
    try:
        result = EvaluationResult(**{**content, "hints": hints_from_json(content.get("hints", ()))})
    except (TypeError, KeyError) as error:
        raise InvalidInput(f"{RESULT_FILE} is not an evaluation result: {error!r}") from None
    for name, kinds in _RESULT_TYPES.items():
        if not isinstance(getattr(result, name), kinds):
            raise InvalidInput(f"{RESULT_FILE} is not an evaluation result: {name} is {getattr(result, name)!r}")
    if not all(_is_number(value) for value in result.metrics.values()):
        raise InvalidInput(f"{RESULT_FILE} is not an evaluation result: a metric is no number")
    return result


_RESULT_TYPES: dict[str, type | UnionType] = {
    "id": str,
    "fingerprint": str,
    "reason": str | None,
    "metrics": dict,
    "poses": int,
    "matched_poses": int,
    "engine": str,
    "missing": dict,
}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
