"""An evaluator of another package, kept from harming the others."""

from __future__ import annotations

from slamhive.errors import InvalidInput, one_line
from slamhive.evaluation.evaluators.base import Evaluator, MetricValues, Paired


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
