"""Evaluations in the ledger: those that were asked for, and how they ended."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.services.ledger.book import Line
from slamhive.services.ledger.lines import NOT_A_LINE, moment
from slamhive.store.changes import AskedEvaluations
from slamhive.store.filed_runs import EndedEvaluation
from slamhive.store.records import EvaluationState

logger = logging.getLogger(__name__)

Key = tuple[int, str, datetime]
"""Run, fingerprint of the protocol and the time at which it was asked for: no two evaluations have the same."""


@dataclass
class LedgerEvaluations:
    """All evaluations of the ledger: ``asked`` for, with their protocols, and those that have ``ended``, by run."""

    protocols: dict[str, Protocol] = field(default_factory=dict)
    asked: dict[Key, Artefacts] = field(default_factory=dict)
    ended: dict[int, dict[Key, EndedEvaluation]] = field(default_factory=lambda: defaultdict(dict))

    def open(self) -> list[AskedEvaluations]:
        """Those that were asked for and have not ended, asked together as they were, the oldest first."""
        together: dict[tuple[datetime, str, Artefacts], list[int]] = defaultdict(list)
        for (run_id, fingerprint, at), artefacts in self.asked.items():
            if (run_id, fingerprint, at) not in self.ended.get(run_id, ()):
                together[at, fingerprint, artefacts].append(run_id)
        return [
            AskedEvaluations(self.protocols[fingerprint], artefacts, at, run_ids)
            for (at, fingerprint, artefacts), run_ids in sorted(together.items(), key=lambda entry: entry[0][0])
        ]

    def of(self, run_id: int) -> list[EndedEvaluation]:
        """Those of a run that have ended, in the order in which they were asked for."""
        return sorted(self.ended.get(run_id, {}).values(), key=lambda entry: entry.created_at)


def asked_line(asked: AskedEvaluations) -> Line:
    """Evaluations that were queued together."""
    return {
        "at": asked.at.isoformat(),
        "protocol": asked.protocol.content,
        "artefacts": asked.artefacts.value,
        "asked": list(asked.run_ids),
    }


def ended_lines(found: Mapping[int, Sequence[EndedEvaluation]]) -> Iterator[Line]:
    """Evaluations that have ended, by run; their protocols are reported where they were asked for."""
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
    """Everything that ``lines`` tell; what is none of ours is passed over."""
    found = LedgerEvaluations()
    for line in lines:
        try:
            _read(line, found)
        except (InvalidInput, *NOT_A_LINE) as error:
            logger.warning("a line of an evaluation is passed over: %r", error)
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
