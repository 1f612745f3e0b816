"""Requests to change all runs of a search: those of the web API, which the Python client makes on files too."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from slamhive.domain.found_action import FoundAction
from slamhive.domain.notes import NotesChange
from slamhive.errors import InvalidInput
from slamhive.schema.api_requests import FoundEvaluation, FoundRuns, FoundSharing, FoundTags
from slamhive.services.sharing import SharingChange

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.services.search_actions import Acted

    Carry = Callable[[Hive, Sequence[int], Any], Acted]


def _evaluate(hive: Hive, run_ids: Sequence[int], body: FoundEvaluation) -> Acted:
    protocol = None if body.protocol is None else hive.protocols.named(body.protocol)
    return hive.search_actions.evaluate(run_ids, protocol)


def _retry(hive: Hive, run_ids: Sequence[int], _body: FoundRuns) -> Acted:
    return hive.search_actions.retry(run_ids)


def _tag(hive: Hive, run_ids: Sequence[int], body: FoundTags) -> Acted:
    if not body.add and not body.remove:
        raise InvalidInput("no tag is named", "name tags to add, or to remove")
    return hive.search_actions.tag(run_ids, NotesChange(add=body.add, remove=body.remove))


def _share(hive: Hive, run_ids: Sequence[int], body: FoundSharing) -> Acted:
    return hive.search_actions.share(run_ids, SharingChange(body.visibility))


def _delete(hive: Hive, run_ids: Sequence[int], _body: FoundRuns) -> Acted:
    return hive.search_actions.delete(run_ids)


ACTIONS: Mapping[FoundAction, tuple[type[FoundRuns], Carry]] = MappingProxyType(
    {
        FoundAction.EVALUATE: (FoundEvaluation, _evaluate),
        FoundAction.RETRY: (FoundRuns, _retry),
        FoundAction.TAGS: (FoundTags, _tag),
        FoundAction.SHARE: (FoundSharing, _share),
        FoundAction.DELETE: (FoundRuns, _delete),
    }
)
"""What a request says, and what carries it out."""


def change_found(hive: Hive, action: FoundAction, run_ids: Sequence[int], body: FoundRuns) -> Acted:
    """Carry out the action for these runs. Raises InvalidInput or NotFound naming the value, Forbidden."""
    hive.check_writable()
    _, carry = ACTIONS[action]
    return carry(hive, run_ids, body)
