"""Hints at common mistakes, as commands print them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from slamhive.cli.output import tell
from slamhive.domain.hint import Hint

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.store import EvaluationRecord

_NAMED_RUNS = 5


def hint_in_words(hint: Hint) -> str:
    """Return what was found, and what to do."""
    return f"{hint.sentence} Remedy: {hint.remedy}."


def hints_of(hive: Hive, ended: Iterable[EvaluationRecord]) -> dict[int, tuple[Hint, ...]]:
    """{run: hints} of successful evaluations that have hints."""
    from slamhive.services.evaluations import evaluation_notes  # noqa: PLC0415 - lists of runs show no hints

    found = {
        entry.run_id: evaluation_notes(hive.runs.folder(entry.run_id), entry.protocol.fingerprint).hints
        for entry in ended
        if entry.reason is None
    }
    return {run_id: hints for run_id, hints in found.items() if hints}


def print_hints(found: dict[int, tuple[Hint, ...]]) -> None:
    """Print each hint on stderr once, with the numbers of the first run that has it."""
    alike: dict[tuple[str, str], list[tuple[int, Hint]]] = {}
    for run_id, hints in found.items():
        for hint in hints:
            alike.setdefault((hint.key, hint.remedy.partition(":")[0]), []).append((run_id, hint))
    for members in alike.values():
        first, hint = members[0]
        numbers = ", ".join(str(run_id) for run_id, _ in members[:_NAMED_RUNS])
        more = f" and {len(members) - _NAMED_RUNS} more" if len(members) > _NAMED_RUNS else ""
        where = f"run {first}" if len(members) == 1 else f"runs {numbers}{more} (the numbers are those of run {first})"
        tell(f"hint for {where}: {hint_in_words(hint)}")
