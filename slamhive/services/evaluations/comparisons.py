"""Compare the metrics of one run as computed by published tools."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.domain.metrics import described
from slamhive.domain.protocol import Protocol
from slamhive.domain.protocol_request import exactly
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.evaluation.presets import PRESETS, Preset
from slamhive.runs.folder import RunFolder
from slamhive.services.evaluations.notes import evaluation_notes
from slamhive.services.evaluations.service import Evaluations
from slamhive.store import Store
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord

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
        """As :meth:`of`, of a run that was just read."""
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
        note = self._why_missing(run.id, protocol, absent) if absent else None
        samples = {key: words for key in figures if (words := described(key).sample(found))}
        return ToolFigures(name, preset, protocol, figures, note, samples)

    def _protocol(self, run: RunRecord, name: str, preset: Preset) -> tuple[Protocol | None, str | None]:
        try:
            return self._evaluations.protocol_of(run, exactly(preset.protocol, name)), None
        except InvalidInput as error:
            return None, f"does not fit: {error.message}"

    def _why_missing(self, run_id: int, protocol: Protocol, keys: list[str]) -> str:
        """The reasons that the evaluation wrote to the run folder, joined."""
        missing = evaluation_notes(RunFolder(self._runs_folder / str(run_id)), protocol.fingerprint).missing
        reasons = dict.fromkeys(missing.get(key, f"{key} is missing") for key in keys)
        return "; ".join(reasons)


def _state(evaluation: EvaluationRecord | None) -> str:
    if evaluation is None:
        return NOT_EVALUATED
    if evaluation.state is EvaluationState.FAILED:
        return evaluation.reason or "failed"
    return f"evaluation {evaluation.state.value}"
