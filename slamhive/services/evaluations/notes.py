"""Notes of an evaluation in the run folder: why metrics are missing, and hints at mistakes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slamhive.domain.hint import Hint
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import RESULT_FILE, result_from_json
from slamhive.runs.folder import RunFolder

_MAX_RESULT_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class EvaluationNotes:
    """``missing``: {metric key: why it has no value}. ``hints``: likely mistakes that the errors point to."""

    missing: Mapping[str, str] = field(default_factory=dict)
    hints: tuple[Hint, ...] = ()


def evaluation_notes(folder: RunFolder, fingerprint: str | None) -> EvaluationNotes:
    """The notes of the evaluation under the protocol with this fingerprint; empty if there are none."""
    if fingerprint is None:
        return EvaluationNotes()
    try:
        with (folder.evaluation(fingerprint) / RESULT_FILE).open(encoding="utf-8") as stream:
            result = result_from_json(stream.read(_MAX_RESULT_BYTES))
    except (OSError, ValueError, InvalidInput):
        return EvaluationNotes()
    return EvaluationNotes(result.missing, result.hints)
