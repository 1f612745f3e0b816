"""What the audit log says of a request that changes something."""

from __future__ import annotations

import uuid
from contextlib import AbstractContextManager

from flask import request

from slamhive.clock import utc_now
from slamhive.domain.accounts import Caller
from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.store import Act, Store
from slamhive.store.audit import in_ranges

PAGES = "pages"
_LARGEST = 2**53 - 1
_MOST_NUMBERS = 1000
_NAMED = ("name", "group", "title")
"""Fields of web forms that say on what something is done."""


def acting(store: Store, caller: Caller) -> AbstractContextManager[None]:
    """What this thread stores from now on is done by the caller of this request."""
    act = Act(
        uid=uuid.uuid4().hex,
        at=utc_now(),
        account=caller.account,
        via=f"token {caller.token}" if caller.token else PAGES,
        address=(request.remote_addr or "")[:64],
        action=str(request.endpoint)[:64],
        subject=_subject(),
    )
    return store.acting(act)


def signing_in(store: Store, name: str) -> AbstractContextManager[None]:
    """What this thread stores is the session of ``name``. Nothing is stored of somebody who is not let in."""
    return acting(store, Caller(frozenset(), name[:64]))


def _subject() -> str:
    """On what: values of the address, and selected runs and names of the web form. Never what could be a secret."""
    values = request.view_args or {}
    parts = [f"{name.removesuffix('_id')} {value}" for name, value in values.items()]
    parts += [f"{name} {request.form[name]}" for name in _NAMED if request.form.get(name)]
    return "; ".join([*parts, *_selected()])


def _selected() -> list[str]:
    try:
        runs = {whole_number(text, "run", 1, _LARGEST) for text in request.form.getlist("run")[:_MOST_NUMBERS]}
    except InvalidInput:  # the view says so
        return []
    return [in_ranges(sorted(runs))] if runs else []
