"""Metrics of an estimate if the dataset has relations between poses and no ground-truth trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.sensors import Matrix4
from slamhive.domain.verdict import RELATION_ERROR
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import RELATIONS, MetricValues, absent
from slamhive.evaluation.evaluators.map_quality import MapQuality, map_metrics
from slamhive.evaluation.evaluators.relations import of_body, read_relations, relation_errors
from slamhive.evaluation.pairing import shifted
from slamhive.evaluation.references import NO_TRUTH
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import rigid_transform

ESSENTIAL = RELATION_ERROR
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
