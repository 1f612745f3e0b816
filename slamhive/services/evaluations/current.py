"""Current protocol of a run, whose metrics are shown, and the same run as published tools measure it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.base.settings import Settings
from slamhive.domain.metrics import described
from slamhive.domain.names import plural
from slamhive.domain.protocol import Protocol, ProtocolRequest, exactly, with_trajectory
from slamhive.domain.run import RunState
from slamhive.domain.side_by_side import MixedProtocols
from slamhive.evaluation.job import Artefacts
from slamhive.evaluation.presets import PRESETS, Preset
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import check_writable
from slamhive.services.evaluations.service import Evaluations, evaluation_notes
from slamhive.store import Store
from slamhive.store.records import EvaluationRecord, EvaluationState, ProtocolLabel, RunRecord


@dataclass(frozen=True, slots=True)
class Together:
    """Result of bringing runs under one protocol.

    Attributes:
        switched: How many had metrics under it, which lists show now.
        queued: The ids of the evaluations that will make it current.
        left_out: How many did not succeed, and so have nothing to evaluate.
    """

    switched: int
    queued: tuple[int, ...]
    left_out: int

    @property
    def words(self) -> str:
        """The result in one or two sentences."""
        parts = []
        if self.queued:
            parts.append(f"{plural(len(self.queued), 'evaluation')} queued; their errors replace those shown here.")
        if self.switched:
            parts.append(f"{plural(self.switched, 'run')} had been evaluated under this protocol and now show it.")
        if self.left_out:
            parts.append(f"{plural(self.left_out, 'run')} left out: only a run that succeeded can be evaluated.")
        return " ".join(parts) or "All of these runs are under this protocol already."


class CurrentProtocols:
    """Chooses the current protocol of runs, in the database and in their folders.

    Args:
        settings: Whether anything may be changed, and where the run folders lie.
        store: Runs and metrics.
        evaluations: Queues evaluations, and resolves a protocol request for a run.
    """

    def __init__(self, settings: Settings, store: Store, evaluations: Evaluations) -> None:
        self._settings = settings
        self._store = store
        self._evaluations = evaluations
        self._runs_folder = settings.runs_folder

    def figures(self, run_id: int) -> dict[str, dict[str, float]]:
        """The metrics of a run under each protocol: {fingerprint: {metric key: value}}."""
        found = self._store.read(lambda t: t.metrics.by_protocol(run_id))
        return {fingerprint: values for fingerprint, values in found.items() if fingerprint is not None}

    def use(self, run_ids: Iterable[int], fingerprint: str) -> None:
        """Make a protocol the current one of these runs: lists, searches and pages show its metrics.

        Raises NotFound for an unknown protocol, Conflict for a run without metrics under it; nothing is changed then.
        """
        wanted = list(run_ids)
        self._store.write(lambda t: t.evaluations.use(wanted, fingerprint))
        for run_id in wanted:
            RunFolder(self._runs_folder / str(run_id)).write_current_protocol(fingerprint)

    def use_asked(self, run_ids: Iterable[int], asked: ProtocolRequest) -> None:
        """Use, for each run, the protocol that the request means, like :meth:`use`."""
        runs = self._store.read(lambda t: t.runs.get_many(run_ids))
        chosen = [(run.id, self._evaluations.protocol_of(run, asked).fingerprint) for run in runs]
        for run_id, fingerprint in chosen:
            if fingerprint not in self.figures(run_id):
                raise Conflict(f"run {run_id} has no metrics under protocol {asked.name}", "evaluate it first")
        by_fingerprint: dict[str, list[int]] = defaultdict(list)
        for run_id, fingerprint in chosen:
            by_fingerprint[fingerprint].append(run_id)
        for fingerprint, members in by_fingerprint.items():
            self.use(members, fingerprint)

    def together(self, run_ids: Iterable[int], fingerprint: str) -> Together:
        """Bring runs under one protocol: use it for those with metrics under it, and queue the others that succeeded.

        A queued evaluation makes the protocol current when it succeeds. Raises NotFound for an unknown protocol,
        InvalidInput for one that does not fit a run; nothing is changed then.
        """
        check_writable(self._settings)
        asked = exactly(self._known(fingerprint), fingerprint)
        wanted = list(dict.fromkeys(run_ids))
        runs = self._store.read(lambda t: t.runs.get_many(wanted))
        done = self._store.read(lambda t: t.evaluations.having(wanted, fingerprint))
        current = {run.id for run in runs if run.protocol is not None and run.protocol.fingerprint == fingerprint}
        lacking = [run.id for run in runs if run.id not in done and run.state is RunState.SUCCEEDED]
        queued = self._evaluations.queue(lacking, asked, makes_current=True) if lacking else []
        switched = sorted(done - current)
        self.use(switched, fingerprint)
        return Together(len(switched), tuple(queued), len(wanted) - len(done) - len(lacking))

    def mixed(self, run_ids: Iterable[int]) -> MixedProtocols | None:
        """The protocols of these runs if their errors are not comparable, with the one that all can have."""
        return self._store.read(lambda t: t.evaluations.mixed_of(run_ids))

    def mixed_in(self, experiment: str) -> MixedProtocols | None:
        """The same for all runs of an experiment, however many. Raises NotFound."""
        return self._store.read(lambda t: t.evaluations.mixed_in(t.experiments.get(experiment).id))

    def _known(self, fingerprint: str) -> Protocol:
        found = self._store.read(lambda t: t.evaluations.definitions([fingerprint]))
        if fingerprint not in found:
            raise NotFound(f"unknown protocol {fingerprint[:40]!r}", "slamhive protocol list shows them")
        return found[fingerprint]

    def as_evaluated(self, ended: Iterable[EvaluationRecord]) -> list[RunRecord]:
        """The runs of these evaluations, in order, each with the metrics of its evaluation."""
        entries = list(ended)
        runs = self._store.read(lambda t: t.runs.get_many([entry.run_id for entry in entries], with_metrics=True))
        by_id = {run.id: run for run in runs}
        found: list[RunRecord] = []
        for entry in entries:
            run, protocol = by_id[entry.run_id], entry.protocol
            if run.protocol is not None and run.protocol.fingerprint != protocol.fingerprint:
                values = self._store.read(lambda t, run=run: t.metrics.by_protocol(run.id))  # type: ignore[misc]
                label = ProtocolLabel(protocol.fingerprint, with_trajectory(protocol.label, run.trajectory))
                own = {**values.get(None, {}), **values.get(protocol.fingerprint, {})}
                run = replace(run, protocol=label, metrics=own)
            found.append(run)
        return found

    def shown_otherwise(self, ended: Iterable[EvaluationRecord]) -> list[int]:
        """The runs of these evaluations, without failed ones, whose current protocol is another one."""
        fingerprints = {entry.run_id: entry.protocol.fingerprint for entry in ended if entry.reason is None}
        runs = self._store.read(lambda t: t.runs.get_many(fingerprints))
        return [run.id for run in runs if run.protocol is not None and run.protocol.fingerprint != fingerprints[run.id]]


# Metrics of one run as published tools compute them.

NOT_EVALUATED = "not evaluated"


@dataclass(frozen=True, slots=True)
class ToolFigures:
    """The metrics of a run that one tool would print.

    Attributes:
        name: The name of the preset.
        preset: The definition of the tool's metrics.
        protocol: The protocol for this run; None if the preset does not fit it.
        figures: {metric key: value} of the metrics that the tool prints, without missing ones.
        note: Why metrics are missing; None if there are all.
        samples: {metric key: number of pairs or segments behind it, in words}.
    """

    name: str
    preset: Preset
    protocol: Protocol | None
    figures: Mapping[str, float]
    note: str | None
    samples: Mapping[str, str] = field(default_factory=dict)


class Comparisons:
    """Evaluates a run under every preset.

    Args:
        store: Metrics and evaluations.
        evaluations: Queues them.
        runs_folder: The run folders, which hold the reasons for missing metrics.
    """

    def __init__(self, store: Store, evaluations: Evaluations, runs_folder: Path) -> None:
        self._store = store
        self._evaluations = evaluations
        self._runs_folder = runs_folder

    def queue(self, run_id: int) -> list[int]:
        """Queue the missing evaluations; returns their ids. Raises Conflict if the run did not succeed."""
        run = self._store.read(lambda t: t.runs.get(run_id))
        done = self._store.read(lambda t: t.metrics.by_protocol(run_id))
        queued: list[int] = []
        for name, preset in PRESETS:
            protocol, _ = self._protocol(run, name, preset)
            if protocol is not None and protocol.fingerprint not in done:
                queued += self._evaluations.queue([run_id], exactly(protocol, name), Artefacts.METRICS)
        return queued

    def of(self, run_id: int) -> list[ToolFigures]:
        """The metrics of every tool, as far as they have been evaluated."""
        return self.of_run(self._store.read(lambda t: t.runs.get(run_id)))

    def of_run(self, run: RunRecord) -> list[ToolFigures]:
        """Return the same as :meth:`of` for a run that was just read."""
        done = self._store.read(lambda t: t.metrics.by_protocol(run.id))
        evaluations = self._store.read(lambda t: t.evaluations.for_run(run.id))
        latest = {entry.protocol.fingerprint: entry for entry in evaluations}
        return [self._row(run, name, preset, done, latest) for name, preset in PRESETS]

    def _row(
        self,
        run: RunRecord,
        name: str,
        preset: Preset,
        done: Mapping[str | None, Mapping[str, float]],
        latest: Mapping[str, EvaluationRecord],
    ) -> ToolFigures:
        protocol, refusal = self._protocol(run, name, preset)
        if protocol is None:
            return ToolFigures(name, preset, None, {}, refusal)
        found = done.get(protocol.fingerprint)
        if found is None:
            return ToolFigures(name, preset, protocol, {}, _state(latest.get(protocol.fingerprint)))
        figures = {key: found[key] for key in preset.metrics if key in found}
        absent = [key for key in preset.metrics if key not in found]
        note = None
        if absent:
            # The evaluation wrote its reasons to the run folder.
            missing = evaluation_notes(RunFolder(self._runs_folder / str(run.id)), protocol.fingerprint).missing
            note = "; ".join(dict.fromkeys(missing.get(key, f"{key} is missing") for key in absent))
        samples = {key: words for key in figures if (words := described(key).sample(found))}
        return ToolFigures(name, preset, protocol, figures, note, samples)

    def _protocol(self, run: RunRecord, name: str, preset: Preset) -> tuple[Protocol | None, str | None]:
        try:
            return self._evaluations.protocol_of(run, exactly(preset.protocol, name)), None
        except InvalidInput as error:
            return None, f"does not fit: {error.message}"


def _state(evaluation: EvaluationRecord | None) -> str:
    if evaluation is None:
        return NOT_EVALUATED
    if evaluation.state is EvaluationState.FAILED:
        return evaluation.reason or "failed"
    return f"evaluation {evaluation.state.value}"
