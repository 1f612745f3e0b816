"""One evaluation: read the trajectories, pair them, and run every evaluator.

This runs in the evaluation process or container, which has evo. A dataset with relations instead of a ground-truth
trajectory is evaluated by them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import evo
import numpy as np
from evo.core.result import Result

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.sensors import Matrix4
from slamhive.domain.verdict import ERROR, RELATION_ERROR, Hint
from slamhive.evaluation.evaluators.base import RELATIONS, MetricValues, Paired, absent
from slamhive.evaluation.evaluators.builtin import EVALUATORS
from slamhive.evaluation.evaluators.map_quality import MapQuality, map_metrics
from slamhive.evaluation.evaluators.relations import of_body, read_relations, relation_errors
from slamhive.evaluation.hints import find_hints
from slamhive.evaluation.job import EvaluationResult, EvaluationTask, failed_result
from slamhive.evaluation.pairing import pair, shifted
from slamhive.evaluation.references import NO_TRUTH, References
from slamhive.trajectory.layout import parse_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import rigid_transform

# Metrics of an estimate if the dataset has relations between poses and no ground-truth trajectory.


ESSENTIAL_WITHOUT_TRUTH = RELATION_ERROR
"""Such an evaluation has failed without this metric."""


def evaluate_without_truth(
    estimate: Trajectory, protocol: Protocol, T_body_estimate: Matrix4, files: Mapping[str, Path], keys: Iterable[str]
) -> MetricValues:
    """Errors of the relations, and metrics that need the map alone.

    Args:
        estimate: The trajectory of the algorithm.
        protocol: Its time offset and gap threshold are used; its alignment must not leave the scale open.
        T_body_estimate: Pose of the frame that the estimate describes in the body frame, 16 numbers by rows.
        files: See :class:`~slamhive.evaluation.evaluators.base.Paired`.
        keys: All metrics of all evaluators; those that need a ground-truth trajectory are missing.

    Raises:
        InvalidInput: The relations cannot be compared with the estimate.
    """
    _check(protocol)
    if RELATIONS not in files:
        raise InvalidInput("the file of the dataset's relations does not exist", "put it back")
    on_clock = shifted(estimate, protocol.time_offset_s)
    body = of_body(on_clock, 1.0, rigid_transform(protocol.T_body_sensor or T_body_estimate, "T_body_sensor"))
    errors = relation_errors(read_relations(files[RELATIONS]), body, protocol.gap_threshold_s)
    try:
        maps = map_metrics(files, None)
    except InvalidInput as error:
        maps = absent(MapQuality.keys, str(error))
    missing = {key: NO_TRUTH for key in keys if key not in errors and key not in MapQuality.keys}
    return MetricValues({**errors, **maps.values}, {**missing, **maps.missing})


def _check(protocol: Protocol) -> None:
    if protocol.alignment in (Alignment.SIM3, Alignment.SCALE):
        raise InvalidInput(
            f"relations are in metres, and the alignment {protocol.alignment} leaves the scale of the estimate open, "
            "which only a ground-truth trajectory could tell",
            "use se3 if the estimate is in metres",
        )
    if protocol.offset_search_s > 0:
        raise InvalidInput(
            "a time offset can be searched only where there is a ground-truth trajectory", "give time_offset_s instead"
        )


logger = logging.getLogger(__name__)

ENGINE = f"evo {evo.__version__.removeprefix('v')}"

ESSENTIAL = ERROR
"""An evaluation without this metric has failed."""

TOO_FAR_OFF = "it cannot be computed: the estimate is too far off for the numbers to hold"


@dataclass(frozen=True, slots=True)
class Evaluated:
    """The outcome of an evaluation before anything is written.

    Attributes:
        result: The metrics.
        paired: The trajectories; None if there is no ground-truth trajectory.
        archives: {file name without ending: evo's result}; holds ``ape`` if there is a pair.
    """

    result: EvaluationResult
    paired: Paired | None
    archives: Mapping[str, Result]


def evaluate(task: EvaluationTask, references: References) -> Evaluated | EvaluationResult:
    """Compute the metrics of ``task``; an EvaluationResult with a reason if they cannot be computed."""
    poses = matched_poses = 0
    paired: Paired | None = None
    try:
        reference = None if task.reference is None else references.of(task)
        estimate = _read_estimate(task)
        poses = len(estimate)
        if reference is None:
            keys = [key for _, evaluator in EVALUATORS for key in evaluator.keys]
            found = _finite(evaluate_without_truth(estimate, task.protocol, task.T_body_sensor, task.files, keys))
        else:
            paired = pair(reference, estimate, task.protocol, task.files, uncertainty_m=task.uncertainty_m)
            matched_poses = len(paired.aligned)
            found = all_metrics(paired)
        key = ESSENTIAL_WITHOUT_TRUTH if paired is None else ESSENTIAL
        if key not in found.values:
            reason = found.missing.get(key, "no evaluator computed it")
            return failed_result(task, f"{key}: {reason}", ENGINE, poses=poses, matched_poses=matched_poses)
    except InvalidInput as error:
        return failed_result(task, str(error), ENGINE, poses=poses, matched_poses=matched_poses)
    hints: tuple[Hint, ...] = ()
    if paired is not None:
        # An evaluation does not fail because the search for likely mistakes in its input does.
        try:
            hints = find_hints(paired, found.values)
        except (InvalidInput, ArithmeticError, np.linalg.LinAlgError) as error:
            logger.warning("no hints can be found: %s", error)
    result = EvaluationResult(
        id=task.id,
        fingerprint=task.protocol.fingerprint,
        reason=None,
        metrics=dict(found.values),
        poses=poses,
        matched_poses=matched_poses,
        engine=ENGINE,
        missing=dict(found.missing),
        hints=hints,
    )
    return Evaluated(result, paired, found.archives)


def all_metrics(paired: Paired) -> MetricValues:
    """The metrics of every evaluator. A value that is not finite is missing."""
    values: dict[str, float] = {}
    missing: dict[str, str] = {}
    archives: dict[str, Result] = {}
    for _, evaluator in EVALUATORS:
        # If one evaluator fails, its metrics are missing for that reason, and the others go on.
        try:
            found = _finite(evaluator.evaluate(paired))
        except InvalidInput as error:
            found = absent(evaluator.keys, str(error))
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            found = absent(evaluator.keys, f"it cannot be computed: {error}")
        values |= found.values
        missing |= found.missing
        archives |= found.archives
    broken = {origin.name: str(origin) for origin in EVALUATORS.origins() if origin.problem is not None}
    return MetricValues(values, missing | broken, archives)


def _finite(found: MetricValues) -> MetricValues:
    values = {key: float(value) for key, value in found.values.items() if math.isfinite(value)}
    missing = {key: TOO_FAR_OFF for key in found.values if key not in values} | dict(found.missing)
    return MetricValues(values, missing, found.archives)


def _read_estimate(task: EvaluationTask) -> Trajectory:
    if task.estimate.is_symlink():
        raise InvalidInput(f"the estimate {task.estimate.name} is a link, which is not followed")
    try:
        data = read_bounded(task.estimate)
        return parse_tum(data, f"estimate {task.estimate.name}", task.protocol.duplicates)
    except NotFound:
        raise InvalidInput(f"there is no estimate: {task.estimate.name} does not exist") from None
