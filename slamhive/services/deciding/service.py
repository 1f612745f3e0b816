"""Experiments that choose their runs: taken a step further, and shown."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.documents.experiment import Decision, SearchStanding
from slamhive.experiments.experiment import DecidePlan
from slamhive.services.kept_answers import KeptViews
from slamhive.store import Transaction
from slamhive.store.records import ExperimentState

if TYPE_CHECKING:
    from slamhive.base.settings import Settings
    from slamhive.services.deciding.decide import DecisionStep
    from slamhive.services.deciding.look import QuestionLook
    from slamhive.services.deciding.optimise import SearchStep
    from slamhive.services.experiments import ExperimentService
    from slamhive.store import Store

logger = logging.getLogger(__name__)

TROUBLE_PAUSE_S = 30.0
"""A worker tries an experiment that it cannot take further again after so long."""

LONGEST_STEP_S = 60.0
"""Another process that takes an experiment a step further has ended after so long."""
PAUSE_S = 0.3

LEAST_AT_ONCE = 4
_KEPT_STEPS = 32


class Questions:
    """The experiments of an installation that choose their runs.

    Everything follows from the runs in the database. So whoever takes an experiment further, a worker, a command or the
    next one after a kill, comes to the same step.

    Args:
        settings: How many runs go on at once.
        store: The runs.
        experiments: Adds runs to them.
    """

    def __init__(self, settings: Settings, store: Store, experiments: ExperimentService) -> None:
        self._settings = settings
        self._store = store
        self._experiments = experiments
        self._not_before_s: dict[str, float] = {}
        self._waited: dict[str, Sequence[int]] = {}
        self._steps: KeptViews[bytes, DecisionStep | SearchStep] = KeptViews(_KEPT_STEPS, lambda _step: 1)

    def decision(self, name: str) -> Decision:
        """State of an experiment that compares; raises NotFound, or InvalidInput for one without that question."""
        found = self.standing(name)
        if not isinstance(found, Decision):
            raise InvalidInput(f"experiment {name} searches", "slamhive experiment optimise shows how it stands")
        return found

    def search(self, name: str) -> SearchStanding:
        """State of an experiment that searches; raises NotFound, or InvalidInput for one without that question."""
        found = self.standing(name)
        if isinstance(found, Decision):
            raise InvalidInput(f"experiment {name} compares", "slamhive experiment decide shows how it stands")
        return found

    def standing(self, name: str) -> Decision | SearchStanding:
        """State of the experiment; raises NotFound, or InvalidInput for one without a question."""
        return self._step(self._look(name)).decision

    def advance(self, name: str) -> int:
        """Take the experiment a step further: queue its next runs, or store its conclusion.

        Nothing happens while it is paused, and after its conclusion. A comparison waits for its runs; a search asks
        for others as soon as half of its places are free.

        Returns:
            The number of runs that were queued.

        Raises:
            NotFound: There is no such experiment.
            InvalidInput: It has no question.
            Conflict: Another process changes it, or the catalogue has changed since it was started.
        """
        look = self._look(name)
        if look.record.state is not ExperimentState.ACTIVE or not look.record.undecided:
            return 0
        step = self._step(look)
        if step.more:
            return len(self._experiments.ask_for_runs(name, step.more, look.asked))
        if step.ended:
            self._experiments.conclude(name, step.decision.words)
        return 0

    def unfinished(self, name: str) -> Sequence[int]:
        """The runs of an experiment that have not ended. One that chooses them and has none is taken a step further.

        Raises as :meth:`advance`.
        """
        until_s = monotonic_s() + LONGEST_STEP_S
        while True:
            found = self._experiments.unfinished(name)
            record = self._store.read(lambda t: t.experiments.get(name))
            going_on = record.undecided and record.complete and record.state is ExperimentState.ACTIVE
            if found or not going_on:
                return found
            try:
                if not self.advance(name):
                    time.sleep(PAUSE_S)  # it has ended, or another process has taken the step
            except Conflict:
                if monotonic_s() > until_s:
                    raise
                time.sleep(PAUSE_S)

    def work_once(self) -> bool:
        """Take each experiment that is undecided a step further; returns whether runs were queued."""
        queued = 0
        for record in self._store.read(lambda t: t.experiments.undecided()):
            if monotonic_s() < self._not_before_s.get(record.name, 0.0):
                continue
            waiting = self._store.read(lambda t, i=record.id: t.experiments.unfinished(i))  # type: ignore[misc]
            seen, self._waited[record.name] = self._waited.get(record.name), waiting
            if waiting and (waiting == seen or len(waiting) > self._at_once // 2):
                continue
            try:
                queued += self.advance(record.name)
            except Unavailable:
                raise
            except SlamHiveError as error:
                self._not_before_s[record.name] = monotonic_s() + TROUBLE_PAUSE_S
                logger.warning("experiment %s waits: %s", record.name, error)
        return queued > 0

    def _look(self, name: str) -> QuestionLook:
        from slamhive.services.deciding.look import look_at  # noqa: PLC0415 - a worker without questions needs it not

        def work(t: Transaction) -> QuestionLook:
            record = t.experiments.get(name)
            if record.question is None:
                raise InvalidInput(
                    f"experiment {name} has no question: it runs all of its combinations",
                    "a section decide or optimise in its file asks one",
                )
            return look_at(t, record)

        return self._store.read(work)

    def _step(self, look: QuestionLook) -> DecisionStep | SearchStep:
        """The step that follows from a look. It takes up to a second, and is kept until the runs have changed."""
        from slamhive.services.deciding.decide import next_decision  # noqa: PLC0415 - loads scipy
        from slamhive.services.deciding.optimise import next_search  # noqa: PLC0415 - the same

        plan = look.experiment.plan
        assert plan is not None
        if isinstance(plan, DecidePlan):
            return self._steps.get(look.fingerprint, lambda: next_decision(look, plan, self._settings.worker_slots))
        return self._steps.get(look.fingerprint, lambda: next_search(look, plan, self._at_once))

    @property
    def _at_once(self) -> int:
        """Runs of a search that go on together: fewer would make the model wait for each of them."""
        return max(LEAST_AT_ONCE, self._settings.worker_slots)
