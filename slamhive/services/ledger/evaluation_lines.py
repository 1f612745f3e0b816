"""Evaluations in the ledger: those requested, and how they ended."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.evaluation.job import Artefacts
from slamhive.services.ledger.book import Line
from slamhive.services.ledger.lines import NOT_A_LINE, moment
from slamhive.store.changes import AskedEvaluations
from slamhive.store.filed_runs import EndedEvaluation
from slamhive.store.records import EvaluationState

logger = logging.getLogger(__name__)

Key = tuple[int, str, datetime]
"""Run, protocol fingerprint and time of the request, which together identify an evaluation."""


@dataclass
class LedgerEvaluations:
    """All evaluations of the ledger: those ``asked`` for, with protocols, and those that have ``ended``, by run."""

    protocols: dict[str, Protocol] = field(default_factory=dict)
    asked: dict[Key, Artefacts] = field(default_factory=dict)
    ended: dict[int, dict[Key, EndedEvaluation]] = field(default_factory=lambda: defaultdict(dict))

    def open(self) -> list[AskedEvaluations]:
        """Requested evaluations that have not ended, grouped as they were requested, oldest first."""
        together: dict[tuple[datetime, str, Artefacts], list[int]] = defaultdict(list)
        for (run_id, fingerprint, at), artefacts in self.asked.items():
            if (run_id, fingerprint, at) not in self.ended.get(run_id, ()):
                together[at, fingerprint, artefacts].append(run_id)
        return [
            AskedEvaluations(self.protocols[fingerprint], artefacts, at, run_ids)
            for (at, fingerprint, artefacts), run_ids in sorted(together.items(), key=lambda entry: entry[0][0])
        ]

    def of(self, run_id: int) -> list[EndedEvaluation]:
        """The ended evaluations of a run, in the order of their requests."""
        return sorted(self.ended.get(run_id, {}).values(), key=lambda entry: entry.created_at)


def asked_line(asked: AskedEvaluations) -> Line:
    """One line for evaluations that were queued together."""
    return {
        "at": asked.at.isoformat(),
        "protocol": asked.protocol.content,
        "artefacts": asked.artefacts.value,
        "asked": list(asked.run_ids),
    }


def ended_lines(found: Mapping[int, Sequence[EndedEvaluation]]) -> Iterator[Line]:
    """Lines for ended evaluations, by run; the line of the request holds the protocol."""
    for run_id, entries in found.items():
        for entry in entries:
            times = (entry.created_at, entry.started_at, entry.ended_at)
            yield {
                "ended": run_id,
                "protocol": entry.protocol.fingerprint,
                "state": entry.state.value,
                "reason": entry.reason,
                "artefacts": entry.artefacts.value,
                "engine": entry.engine,
                "times": [None if at is None else at.isoformat() for at in times],
                "attempt": entry.attempt,
            }


def read_evaluations(lines: Iterable[Line]) -> LedgerEvaluations:
    """Read all evaluations in ``lines``; malformed lines are skipped."""
    found = LedgerEvaluations()
    for line in lines:
        try:
            _read(line, found)
        except NOT_A_LINE as error:
            logger.warning("a malformed line of an evaluation is skipped: %r", error)
    return found


def _read(line: Line, found: LedgerEvaluations) -> None:
    if "asked" in line:
        protocol = protocol_from_content(line["protocol"])
        found.protocols[protocol.fingerprint] = protocol
        at, artefacts = moment(line["at"]), Artefacts(line["artefacts"])
        for run_id in line["asked"]:
            found.asked[int(run_id), protocol.fingerprint, at] = artefacts
        return
    run_id, fingerprint = int(line["ended"]), str(line["protocol"])
    created_at, started_at, ended_at = (None if text is None else moment(text) for text in line["times"])
    if created_at is None:
        raise ValueError("an evaluation that nobody asked for")
    found.ended[run_id][run_id, fingerprint, created_at] = EndedEvaluation(
        protocol=found.protocols[fingerprint],
        state=EvaluationState(line["state"]),
        reason=line["reason"],
        artefacts=Artefacts(line["artefacts"]),
        engine=line["engine"],
        created_at=created_at,
        started_at=started_at,
        ended_at=ended_at,
        attempt=int(line["attempt"]),
    )
