"""The registry of evaluators, and those that ship; a plug-in registers through the same door."""

from __future__ import annotations

from slamhive.evaluation.evaluators.alignment import AppliedAlignment
from slamhive.evaluation.evaluators.base import Evaluator
from slamhive.evaluation.evaluators.coverage import Coverage
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError, RelativeError
from slamhive.registry import Registry

EVALUATORS: Registry[Evaluator] = Registry("evaluator", "slamhive.evaluators")

EVALUATORS.register("ate", AbsoluteError())
EVALUATORS.register("rpe", RelativeError())
EVALUATORS.register("coverage", Coverage())
EVALUATORS.register("alignment", AppliedAlignment())
