"""The documents of a run that need its folder."""

from __future__ import annotations

from collections.abc import Sequence

from slamhive.domain.run import RunEvent
from slamhive.runs.folder import RunFolder
from slamhive.schema.run import Evaluation, RunWith, ShownEvent
from slamhive.services.evaluations import evaluation_notes
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord


def run_in_full(
    run: RunRecord, folder: RunFolder, evaluations: Sequence[EvaluationRecord], events: Sequence[RunEvent]
) -> RunWith:
    """A run with its moves and evaluations."""
    return RunWith.of(
        run,
        evaluations=[evaluation_document(entry, folder) for entry in evaluations],
        events=[ShownEvent.of(event) for event in events],
    )


def evaluation_document(evaluation: EvaluationRecord, folder: RunFolder) -> Evaluation:
    """One evaluation. Its hints lie in the run folder, for the last evaluation under a protocol."""
    succeeded = evaluation.state is EvaluationState.SUCCEEDED
    notes = evaluation_notes(folder, evaluation.protocol.fingerprint if succeeded else None)
    return Evaluation.of(evaluation, hints=notes.hints)
