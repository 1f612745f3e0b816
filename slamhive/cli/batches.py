"""Run many evaluations, or wait until a worker has."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from slamhive.cli.output import counting_bar
from slamhive.executors.identity import worker_identity
from slamhive.services.evaluations import Evaluations
from slamhive.store import EvaluationRecord

PAUSE_S = 0.5
PART = 500
"""How many evaluations one query names."""


def evaluate_to_end(service: Evaluations, evaluation_ids: Sequence[int]) -> list[EvaluationRecord]:
    """Run the evaluations, or wait for the worker that does. Returns them as they ended, in their order.

    If this process is interrupted, the others stay queued.
    """
    stopping = threading.Event()
    service.take_over_from_the_dead()
    with counting_bar("evaluating", len(evaluation_ids)) as show:
        for start in range(0, len(evaluation_ids), PART):
            part = evaluation_ids[start : start + PART]
            runs = frozenset(record.run_id for record in service.records(part))
            while True:
                left = service.still_open(part)
                show(start + len(part) - len(left), "")
                if not left:
                    break
                if not service.work_once(worker_identity(), stopping, runs):
                    stopping.wait(PAUSE_S)
    return service.records(evaluation_ids)
