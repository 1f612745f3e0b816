"""The registry of evaluators, and those that ship.

Evaluators of other packages come in through the entry-point group ``slamhive.evaluators``;
``docs/extend/index.md`` shows one with its metric.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.base.errors import InvalidInput, one_line
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.metrics import METRICS
from slamhive.evaluation.evaluators import GROUP
from slamhive.evaluation.evaluators.base import Evaluator, MetricValues, Paired
from slamhive.evaluation.evaluators.completeness import (
    AppliedAlignment,
    HiltiScore,
    Robustness,
    ScaleErrors,
    StartEndDrift,
    TrackingCoverage,
    TruthFloor,
)
from slamhive.evaluation.evaluators.consistency import Consistency
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError, RelativeError, RelativeSize, RotationError
from slamhive.evaluation.evaluators.map_quality import MapQuality
from slamhive.evaluation.evaluators.relations import RelationErrors
from slamhive.evaluation.evaluators.relative import DistanceErrors, RelativeErrors
from slamhive.evaluation.evaluators.segments import KittiProtocol, SegmentDistances, SegmentErrors

# An evaluator of another package, kept from harming the others.


class PluginEvaluator:
    """Whatever goes wrong in the evaluator of a plug-in leaves its own metrics out, and no others.

    Args:
        name: Of the plug-in.
        evaluator: Its evaluator.
    """

    def __init__(self, name: str, evaluator: Evaluator) -> None:
        self._name = name
        self._evaluator = evaluator
        self.keys = tuple(evaluator.keys)

    def evaluate(self, paired: Paired) -> MetricValues:
        """The metrics that the plug-in finds; raises InvalidInput naming the plug-in if it fails."""
        try:
            found = self._evaluator.evaluate(paired)
            others = sorted({*found.values, *found.missing} - set(self.keys))
            checked = MetricValues(
                {key: float(value) for key, value in found.values.items()},
                {key: one_line(str(reason)) for key, reason in found.missing.items()},
            )
        except InvalidInput:
            raise
        except Exception as error:
            raise InvalidInput(f"the evaluator {self._name!r} failed: {type(error).__name__}: {error}") from error
        if others:
            raise InvalidInput(f"the evaluator {self._name!r} found {others[0]!r}, which is none of its keys")
        return checked


def _read(name: str, found: Any) -> Mapping[str, Evaluator]:
    entry = instances_of(Evaluator)(name, found)
    owners = {key: other for other, evaluator in EVALUATORS for key in evaluator.keys}
    for key in found.keys:
        if key not in METRICS.entries:
            METRICS.refuse_broken(key)
            raise InvalidInput(f"its metric {key!r} is not defined", "announce it in the group slamhive.metrics")
        if key in owners:
            raise InvalidInput(f"its metric {key!r} is that of the evaluator {owners[key]!r}", "use another key")
    return {name: PluginEvaluator(name, found) for name in entry}


EVALUATORS: Registry[Evaluator] = Registry("evaluator", GROUP, _read)

EVALUATORS.register("ate", AbsoluteError())
EVALUATORS.register("ate_size", RelativeSize())
EVALUATORS.register("ate_rot", RotationError())
EVALUATORS.register("rpe", RelativeError())
EVALUATORS.register("rpe_by", RelativeErrors())
EVALUATORS.register("rpe_point", DistanceErrors())
EVALUATORS.register("kitti", KittiProtocol())
EVALUATORS.register("segment", SegmentErrors())
EVALUATORS.register("segment_point", SegmentDistances())
EVALUATORS.register("hilti", HiltiScore())
EVALUATORS.register("drift", StartEndDrift())
EVALUATORS.register("scale", ScaleErrors())
EVALUATORS.register("coverage", TrackingCoverage())
EVALUATORS.register("robustness", Robustness())
EVALUATORS.register("alignment", AppliedAlignment())
EVALUATORS.register("truth_floor", TruthFloor())
EVALUATORS.register("nees", Consistency())
EVALUATORS.register("relations", RelationErrors())
EVALUATORS.register("map", MapQuality())
