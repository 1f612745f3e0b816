"""The registry of evaluators, and those that ship; a plug-in registers through the same door."""

from __future__ import annotations

from slamhive.evaluation.evaluators.alignment import AppliedAlignment
from slamhive.evaluation.evaluators.base import Evaluator
from slamhive.evaluation.evaluators.consistency import Consistency
from slamhive.evaluation.evaluators.coverage import Coverage
from slamhive.evaluation.evaluators.drift import ScaleErrors, StartEndDrift
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError, RelativeError
from slamhive.evaluation.evaluators.kitti import KittiProtocol
from slamhive.evaluation.evaluators.map_quality import MapQuality
from slamhive.evaluation.evaluators.relations import RelationErrors
from slamhive.evaluation.evaluators.relative import RelativeErrors
from slamhive.evaluation.evaluators.relative_size import RelativeSize
from slamhive.evaluation.evaluators.robustness import Robustness
from slamhive.evaluation.evaluators.rotation import RotationError
from slamhive.evaluation.evaluators.segments import SegmentErrors
from slamhive.registry import Registry

EVALUATORS: Registry[Evaluator] = Registry("evaluator", "slamhive.evaluators")

EVALUATORS.register("ate", AbsoluteError())
EVALUATORS.register("ate_size", RelativeSize())
EVALUATORS.register("ate_rot", RotationError())
EVALUATORS.register("rpe", RelativeError())
EVALUATORS.register("rpe_by", RelativeErrors())
EVALUATORS.register("kitti", KittiProtocol())
EVALUATORS.register("segment", SegmentErrors())
EVALUATORS.register("drift", StartEndDrift())
EVALUATORS.register("scale", ScaleErrors())
EVALUATORS.register("coverage", Coverage())
EVALUATORS.register("robustness", Robustness())
EVALUATORS.register("alignment", AppliedAlignment())
EVALUATORS.register("nees", Consistency())
EVALUATORS.register("relations", RelationErrors())
EVALUATORS.register("map", MapQuality())
