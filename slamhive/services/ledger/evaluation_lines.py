"""Evaluations in the ledger: those requested, and how they ended."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from slamhive.domain.protocol import Protocol
from slamhive.evaluation.job import Artefacts
from slamhive.schema.ledger import AskedLine, EndedLine
from slamhive.services.ledger.book import Line
from slamhive.services.ledger.lines import NOT_A_LINE
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
    return AskedLine.of(asked, asked=asked.run_ids).content


def ended_lines(found: Mapping[int, Sequence[EndedEvaluation]]) -> Iterator[Line]:
    """Lines for ended evaluations, by run; the line of the request holds the protocol."""
    for run_id, entries in found.items():
        for entry in entries:
            times = (entry.created_at, entry.started_at, entry.ended_at)
            yield EndedLine.of(entry, ended=run_id, protocol=entry.protocol.fingerprint, times=times).content


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
        asked = AskedLine.read(line)
        found.protocols[asked.protocol.fingerprint] = asked.protocol
        for run_id in asked.asked:
            found.asked[run_id, asked.protocol.fingerprint, asked.at] = Artefacts(asked.artefacts)
        return
    ended = EndedLine.read(line)
    created_at, started_at, ended_at = ended.times
    found.ended[ended.ended][ended.ended, ended.protocol, created_at] = EndedEvaluation(
        protocol=found.protocols[ended.protocol],
        state=EvaluationState(ended.state),
        reason=ended.reason,
        artefacts=Artefacts(ended.artefacts),
        engine=ended.engine,
        created_at=created_at,
        started_at=started_at,
        ended_at=ended_at,
        attempt=ended.attempt,
    )
