"""What the audit log says of a request that changes something."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from flask import request

from slamhive.clock import utc_now
from slamhive.domain.accounts import Caller
from slamhive.domain.visibility import Visibility
from slamhive.errors import InvalidInput
from slamhive.input_bounds import parse_json_object, whole_number
from slamhive.settings import NewRuns
from slamhive.store import Act, Store
from slamhive.store.audit import in_ranges

PAGES = "pages"
_LARGEST = 2**53 - 1
_MOST_NUMBERS = 1000
_NAMED = ("name", "group", "title", "executor", "node", "visibility", "search")
"""Fields of web forms that say on what something is done."""


def acting(store: Store, caller: Caller, new_runs: NewRuns) -> AbstractContextManager[None]:
    """What this thread stores from now on is done by the caller of this request, and belongs to them."""
    return store.acting(_act(caller, _subject()), Visibility(new_runs))


def signing_in(store: Store, name: str) -> AbstractContextManager[None]:
    """What this thread stores is the session of ``name``. Nothing is stored of somebody who is not let in."""
    return store.acting(_act(Caller(frozenset(), name[:64]), ""))


def _act(caller: Caller, subject: str) -> Act:
    return Act(
        uid=uuid.uuid4().hex,
        at=utc_now(),
        account=caller.account,
        via=f"token {caller.token}" if caller.token else PAGES,
        address=(request.remote_addr or "")[:64],
        action=str(request.endpoint)[:64],
        subject=subject,
    )


def _subject() -> str:
    """On what: values of the address, and selected runs and names of the web form. Never what could be a secret."""
    values = request.view_args or {}
    parts = [f"{name.removesuffix('_id')} {value}" for name, value in values.items()]
    parts += [f"{name} {request.form[name]}" for name in _NAMED if request.form.get(name)]
    return "; ".join([*parts, *_selected()])


def _selected() -> list[str]:
    """The runs that the web form or the JSON of the request names."""
    try:
        body = parse_json_object(request.get_data(), "the body") if request.is_json else {}
        runs = _runs_of_json(body) if request.is_json else _runs_of_form()
    except InvalidInput:  # the view says so
        return []
    visibility = [f"visibility {body['visibility']}"] if body.get("visibility") in list(Visibility) else []
    found = [f"search {body['where']}"] if isinstance(body.get("where"), str) else []
    return [*visibility, *found, *([in_ranges(sorted(runs))] if runs else [])]


def _runs_of_form() -> set[int]:
    return {whole_number(text, "run", 1, _LARGEST) for text in request.form.getlist("run")[:_MOST_NUMBERS]}


def _runs_of_json(body: Mapping[str, Any]) -> set[int]:
    runs = body.get("runs")
    return {run for run in runs[:_MOST_NUMBERS] if type(run) is int} if isinstance(runs, list) else set()
