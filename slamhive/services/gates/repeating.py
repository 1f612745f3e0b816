"""Runs of a gate, repeated until it can decide or its budget is spent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from slamhive.clock import monotonic_s
from slamhive.domain.gate import SIGNIFICANCE, Answer, Budget
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput
from slamhive.schema.gate import GateAnswer
from slamhive.services.gates.candidates import GateCheck
from slamhive.services.gates.service import Gates


@dataclass(frozen=True, slots=True)
class Repeats:
    """How runs are repeated: ``first`` of each configuration, then more within ``budget``; None: no more."""

    first: int
    budget: Budget | None = None
    executor: str | None = None

    def check(self, configurations: int) -> None:
        """Raise InvalidInput if the first repeats exceed the budget."""
        runs = self.first * configurations
        if self.budget is not None and self.budget.runs_left(0, 0.0) < runs:
            raise InvalidInput(
                f"{plural(self.first, 'repeat')} of {plural(configurations, 'configuration')} are {runs} runs; the "
                f"budget is {self.budget.words}",
                "give fewer --repeats or a larger --budget",
            )

    def significance(self, look: int) -> float:
        """The chance of a false alarm that look number ``look`` may have.

        Who looks again after each run finds something in the end. So with a budget each look has half the chance of the
        one before, and all looks together stay below :data:`SIGNIFICANCE`.
        """
        return SIGNIFICANCE if self.budget is None else SIGNIFICANCE / 2**look


def repeat_until_decided(
    gates: Gates,
    check: GateCheck,
    algorithms: Sequence[str],
    repeats: Repeats,
    work: Callable[[Sequence[int]], None],
    clock: Callable[[], float] = monotonic_s,
) -> GateAnswer:
    """Run the configurations of the baseline that belong to ``algorithms``, and compare.

    The number of repeats doubles from look to look, so that there are few looks. ``work`` runs the runs with these
    numbers to their end, evaluations included. Raises as :meth:`Gates.reruns` and :meth:`Gates.answer`.
    """
    reruns = gates.reruns(check, algorithms, repeats.executor)
    repeats.check(len(reruns))
    chosen = check.baseline.model_copy(update={"configurations": tuple(rerun.held for rerun in reruns)})
    check = replace(check, baseline=chosen)
    began_s = clock()
    run_ids: list[int] = []
    done, more, look = 0, repeats.first, 0
    while True:
        new = gates.start(reruns, more, done)
        work(new)
        run_ids += new
        done += more
        look += 1
        answer = gates.answer(check, run_ids, repeats.significance(look), look)
        if answer.answer is not Answer.UNDECIDED or repeats.budget is None:
            return answer
        more = min(done, repeats.budget.runs_left(len(run_ids), clock() - began_s) // len(reruns))
        if not more:
            note = f"The budget of {repeats.budget.words} is spent: {plural(len(run_ids), 'run')}."
            return answer.model_copy(update={"notes": (*answer.notes, note)})
