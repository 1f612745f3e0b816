"""Acts on all runs of a search: in batches, so that neither memory nor a transaction grows with their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.names import plural
from slamhive.domain.protocol import ProtocolRequest
from slamhive.domain.run import NotesChange
from slamhive.store import Store

if TYPE_CHECKING:
    from slamhive.services.evaluations import Evaluations
    from slamhive.services.runs import Notes, RunService
    from slamhive.services.sharing import SharingChange, Sharings
    from slamhive.services.trash import Trash

BATCH = 500
MOST_OF_A_REQUEST = 2000
"""Runs that one request to a server changes, which takes some milliseconds each. The command line has no limit."""
REASONS_KEPT = 5

Progress = Callable[[int], None]
"""Takes the number of runs that are done."""


def silent(_done: int) -> None:
    """The progress of an action that nobody watches."""


@dataclass(frozen=True, slots=True)
class Acted:
    """Numbers of runs changed and left out, and the first different reasons why.

    ``at`` names what was deleted together, None after other actions.
    """

    done: int
    left_out: int = 0
    reasons: tuple[str, ...] = ()
    at: datetime | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """Why runs were left out, in lines; the last one says if there are more reasons."""
        others = ("and other reasons",) if len(self.reasons) == REASONS_KEPT < self.left_out else ()
        return (*self.reasons, *others)

    @property
    def deleted_at_text(self) -> str | None:
        """``at`` as ``deleted_together`` of the trash takes it."""
        return None if self.at is None else self.at.isoformat()


class SearchActions:
    """Evaluate, retry, tag, share and delete many runs, and restore what was deleted together.

    Each batch is stored by itself. After an interruption, the same command goes on with the runs that still match;
    only a retry must then be given the runs that were not retried yet. A run that an action does not fit, as deleting
    one that has not ended, is left out.

    Args:
        store: The database.
        runs, evaluations, notes, sharings, trash: What acts on a few runs.
    """

    def __init__(
        self, store: Store, runs: RunService, evaluations: Evaluations, notes: Notes, sharings: Sharings, trash: Trash
    ) -> None:
        self._store = store
        self._runs = runs
        self._evaluations = evaluations
        self._notes = notes
        self._sharings = sharings
        self._trash = trash

    def evaluate(self, run_ids: Sequence[int], protocol: ProtocolRequest | None, progress: Progress = silent) -> Acted:
        """Queue an evaluation of each run that succeeded; None is the protocol that each run was submitted with."""
        return in_batches(run_ids, lambda batch: self._evaluations.queue(batch, protocol), progress)

    def retry(self, run_ids: Sequence[int], progress: Progress = silent) -> Acted:
        """Queue a new run for each run that has ended."""
        return in_batches(run_ids, self._runs.retry_all, progress)

    def tag(self, run_ids: Sequence[int], change: NotesChange, progress: Progress = silent) -> Acted:
        """Change the tags of each run that has a folder."""
        return in_batches(run_ids, lambda batch: self._notes.change(batch, change), progress)

    def share(self, run_ids: Sequence[int], change: SharingChange, progress: Progress = silent) -> Acted:
        """Change owner and visibility; raises Forbidden for runs of others."""
        return in_batches(run_ids, lambda batch: self._sharings.runs(batch, change), progress)

    def delete(self, run_ids: Sequence[int], progress: Progress = silent) -> Acted:
        """Move each run that has ended, and is not being evaluated, to the trash.

        ``at`` of the result restores them together.
        """
        at = utc_now()
        placed = self._store.read(lambda t: t.deleted_runs.by_configuration(run_ids))
        return replace(in_batches(placed, lambda batch: self._trash.delete(batch, at), progress), at=at)


def as_expected(run_ids: Sequence[int], expected: int) -> Sequence[int]:
    """The runs of a search that somebody has seen to match ``expected`` runs.

    Raises Conflict if there are more or fewer by now, InvalidInput if they are too many for a request.
    """
    if len(run_ids) != expected:
        raise Conflict(
            f"the search matches {plural(len(run_ids), 'run')} now, not {expected}", "look at them, then try again"
        )
    if expected > MOST_OF_A_REQUEST:
        raise InvalidInput(
            f"{plural(expected, 'run')} are too many for one request",
            f"choose at most {MOST_OF_A_REQUEST}, or use slamhive runs on the server",
        )
    return run_ids


def in_batches(run_ids: Sequence[int], act: Callable[[Sequence[int]], object], progress: Progress) -> Acted:
    """Call ``act`` with at most ``BATCH`` runs at a time; with each run by itself where it refuses a batch.

    A Conflict, or a NotFound for a run that is gone meanwhile, leaves a run out. Any other error ends the action; what
    was done stays.
    """
    done = left_out = 0
    reasons: list[str] = []
    for start in range(0, len(run_ids), BATCH):
        batch = run_ids[start : start + BATCH]
        refused = _refused(batch, act)
        done += len(batch) - len(refused)
        left_out += len(refused)
        reasons = list(dict.fromkeys([*reasons, *refused]))[:REASONS_KEPT]
        progress(start + len(batch))
    return Acted(done, left_out, tuple(reasons))


def _refused(batch: Sequence[int], act: Callable[[Sequence[int]], object]) -> list[str]:
    """Act on a batch; why some of its runs were refused."""
    try:
        act(batch)
    except (Conflict, NotFound) as error:
        if len(batch) == 1:
            return [error.message]
        return [reason for run_id in batch for reason in _refused([run_id], act)]
    return []
