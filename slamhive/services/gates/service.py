"""Gates of one installation: baselines, checks of runs that exist, and runs to check."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING

from slamhive.base.errors import InvalidInput, SlamHiveError, unknown
from slamhive.documents.gate import BaselineConfiguration, GateAnswer
from slamhive.documents.submission import Submission
from slamhive.domain.gate import SIGNIFICANCE, chosen_margins
from slamhive.domain.packages import split_version
from slamhive.domain.protocol import Protocol
from slamhive.services.gates.baselines import Baselines, GateCheck, lacking, measured_pairs, pair_runs
from slamhive.store import Store

if TYPE_CHECKING:
    from slamhive.base.settings import Settings
    from slamhive.services.configurations import Configurations
    from slamhive.services.datasets import Catalogue
    from slamhive.services.gates.trials import Trials
    from slamhive.services.runs import RunService
    from slamhive.services.searches import Searches


@dataclass(frozen=True, slots=True)
class Rerun:
    """A configuration of a baseline that is to run again, and how it is submitted."""

    held: BaselineConfiguration
    submission: Submission


class Gates:
    """Compares runs with baselines.

    Args:
        settings: Mode, and where baselines are.
        store: The runs.
        searches: Finds runs by a filter.
        catalogue: What can run.
        configurations: Checks what is to run.
        runs: Submits runs.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        searches: Searches,
        catalogue: Catalogue,
        configurations: Configurations,
        runs: RunService,
    ) -> None:
        self._settings = settings
        self._store = store
        self._searches = searches
        self._catalogue = catalogue
        self._configurations = configurations
        self._runs = runs

    @cached_property
    def baselines(self) -> Baselines:
        """The frozen runs."""
        return Baselines(self._settings, self._store, self._searches)

    def prepare(
        self, reference: str, margins: Sequence[str] = (), ignored: Collection[str] = (), *, partial: bool = False
    ) -> GateCheck:
        """A check against a baseline.

        Args:
            reference: Name or file of the baseline.
            margins: Texts such as ``ate.rmse=5%``, on top of the defaults.
            ignored: Parameters that may differ.
            partial: See :class:`GateCheck`.

        Raises:
            NotFound: the baseline, or a metric, is unknown.
            InvalidInput: a margin cannot be used.
        """
        baseline = self.baselines.get(reference)
        return GateCheck(baseline, chosen_margins(margins, baseline.measured), frozenset(ignored), partial)

    def lacking(self, check: GateCheck, run_ids: Sequence[int]) -> dict[Protocol, list[int]]:
        """{protocol of the baseline: runs that were not evaluated under it}; raises as :meth:`answer`."""
        return self._store.read(lambda t: lacking(t, check, pair_runs(check, t.runs.get_many(run_ids))))

    def answer(
        self, check: GateCheck, run_ids: Sequence[int], significance: float = SIGNIFICANCE, looks: int = 1
    ) -> GateAnswer:
        """Compare runs with the baseline.

        Raises InvalidInput if none of them can be compared, or if they differ from it in protocol or dataset.
        """
        from slamhive.services.gates.checking import answer_of  # noqa: PLC0415 - loads scipy

        paired = self._store.read(lambda t: pair_runs(check, t.runs.get_many(run_ids)))
        pairs = self._store.read(lambda t: measured_pairs(t, check, paired))
        return answer_of(check, pairs, paired.notes, significance, looks)

    def reruns(self, check: GateCheck, algorithms: Sequence[str], executor: str | None = None) -> list[Rerun]:
        """Plan the runs to repeat for these algorithms, ``NAME`` or ``NAME@VERSION``. Nothing is queued yet.

        Raises NotFound for an algorithm that the baseline has no runs of, and InvalidInput or NotFound for what cannot
        run here.
        """
        configurations = check.baseline.configurations
        known = sorted({entry.algorithm for entry in configurations})
        chosen = {split_version(label)[0]: label for label in algorithms}
        if len(chosen) < len(set(algorithms)):
            raise InvalidInput("an algorithm is named with two versions", "check one version at a time")
        for name in chosen:
            if name not in known:
                raise unknown(f"algorithm of baseline {check.baseline.name}", name, known)
        found = []
        for held in configurations:
            if held.algorithm in chosen:
                submission = self._submission(check, held, chosen[held.algorithm], executor)
                self._configurations.check(submission)
                found.append(Rerun(held, submission))
        return found

    def start(self, reruns: Sequence[Rerun], repeats: int, seed: int) -> list[int]:
        """Queue ``repeats`` runs of each, to be evaluated as the baseline was: all or none. Returns their numbers."""
        queued: list[int] = []
        try:
            for rerun in reruns:
                submission = replace(rerun.submission, repeat=repeats, seed=seed)
                queued += [run.id for run in self._runs.submit(submission, rerun.held.protocol)]
        except SlamHiveError:
            for run_id in queued:
                self._runs.cancel(run_id)
            raise
        return queued

    def trials(self, metric: str, since: datetime | None = None) -> Trials:
        """Find and make runs that a search looks at; those from before ``since`` play no part."""
        from slamhive.services.gates.trials import Trials  # noqa: PLC0415 - loads numpy

        return Trials(self._store, self._searches, self._configurations, self._runs, metric, since)

    def _submission(
        self, check: GateCheck, held: BaselineConfiguration, algorithm: str, executor: str | None
    ) -> Submission:
        """A parameter that the package no longer has is left out, and so are those that the check ignores."""
        own = {parameter.key for parameter in self._catalogue.algorithm(algorithm).parameters}
        limits = held.runs[0].limits
        return Submission(
            algorithm,
            held.dataset,
            {key: value for key, value in held.parameters.items() if key in own and key not in check.ignored},
            executor=executor,
            playback_mode=held.playback.mode,
            playback_rate=held.playback.rate,
            **{**asdict(limits), "timeout_s": None},
            variant=held.variant,
            sensors=held.sensors,
            map=None if held.map is None else held.map.run,
        )
