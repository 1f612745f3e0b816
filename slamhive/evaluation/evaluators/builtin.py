"""The registry of evaluators, and those that ship.

Evaluators of other packages come in through the entry-point group ``slamhive.evaluators``;
``docs/extend/index.md`` shows one with its metric.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.domain.metrics import METRICS
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators import GROUP
from slamhive.evaluation.evaluators.absolute import RelativeSize, RotationError
from slamhive.evaluation.evaluators.base import Evaluator
from slamhive.evaluation.evaluators.completeness import Coverage, Robustness
from slamhive.evaluation.evaluators.consistency import Consistency
from slamhive.evaluation.evaluators.drift import AppliedAlignment, ScaleErrors, StartEndDrift
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError, RelativeError
from slamhive.evaluation.evaluators.hilti import HiltiScore
from slamhive.evaluation.evaluators.kitti import KittiProtocol
from slamhive.evaluation.evaluators.map_quality import MapQuality
from slamhive.evaluation.evaluators.plugin import PluginEvaluator
from slamhive.evaluation.evaluators.relations import RelationErrors
from slamhive.evaluation.evaluators.relative import RelativeErrors
from slamhive.evaluation.evaluators.segments import SegmentErrors
from slamhive.registry import Registry, instances_of


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
EVALUATORS.register("kitti", KittiProtocol())
EVALUATORS.register("segment", SegmentErrors())
EVALUATORS.register("hilti", HiltiScore())
EVALUATORS.register("drift", StartEndDrift())
EVALUATORS.register("scale", ScaleErrors())
EVALUATORS.register("coverage", Coverage())
EVALUATORS.register("robustness", Robustness())
EVALUATORS.register("alignment", AppliedAlignment())
EVALUATORS.register("nees", Consistency())
EVALUATORS.register("relations", RelationErrors())
EVALUATORS.register("map", MapQuality())
