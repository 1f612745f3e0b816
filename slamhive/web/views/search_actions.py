"""Actions on all runs of a search: what they would change, and the change."""

from __future__ import annotations

from collections.abc import Sequence

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request

from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput
from slamhive.domain.accounts import Visibility
from slamhive.domain.run import NotesChange, split_tags
from slamhive.services.search_actions import MOST_OF_A_REQUEST, Acted, as_expected
from slamhive.services.sharing import SharingChange
from slamhive.web.context import hive
from slamhive.web.formatting import plural
from slamhive.web.presenters.runs import protocol_groups
from slamhive.web.presenters.scripts import search_commands
from slamhive.web.queries import RunListQuery, filled
from slamhive.web.views.runs import list_address

blueprint = Blueprint("search_actions", __name__, url_prefix="/runs/search")

UNDO_TOGETHER = "undo-together"
"""The category of a message with a button that restores what was deleted together at the time behind it."""
_LARGEST_COUNT = 2**53


@blueprint.get("")
def show() -> str:
    """The page with the number of matching runs, and the actions on all of them."""
    services = hive()
    services.check_writable()
    query = _asked()
    return render_template(
        "runs/search_actions.html",
        query=query,
        count=services.searches.exact_count(query.search),
        most=MOST_OF_A_REQUEST,
        known=services.notes.tags(),
        protocol_groups=protocol_groups(),
        commands=search_commands(query.search.text),
    )


@blueprint.post("/evaluate")
def evaluate() -> Response:
    """Evaluate all runs of the search that succeeded."""
    name = request.form.get("protocol")
    protocol = hive().protocols.named(name) if name else None
    acted = hive().search_actions.evaluate(_run_ids(), protocol)
    return _to_list(acted, f"Evaluations of {plural(acted.done, 'run')} queued.")


@blueprint.post("/retry")
def retry() -> Response:
    """Queue a new run for each run of the search that has ended."""
    acted = hive().search_actions.retry(_run_ids())
    return _to_list(acted, f"{plural(acted.done, 'run')} queued again.")


@blueprint.post("/tag")
def tag() -> Response:
    """Add and remove tags of all runs of the search."""
    form = request.form
    change = NotesChange(add=split_tags(form.get("add", "")), remove=split_tags(form.get("remove", "")))
    if not change.add and not change.remove:
        raise InvalidInput("no tag is named", "write tags to add, or to remove")
    acted = hive().search_actions.tag(_run_ids(), change)
    return _to_list(acted, f"The tags of {plural(acted.done, 'run')} are stored.")


@blueprint.post("/share")
def share() -> Response:
    """Choose who may see all runs of the search."""
    visibility = Visibility.named(request.form.get("visibility", ""))
    acted = hive().search_actions.share(_run_ids(), SharingChange(visibility))
    return _to_list(acted, f"{plural(acted.done, 'run')} set to {visibility}.")


@blueprint.post("/delete")
def delete() -> Response:
    """Move all runs of the search to the trash."""
    acted = hive().search_actions.delete(_run_ids())
    return _to_list(acted, f"{plural(acted.done, 'run')} moved to the trash.")


def _run_ids() -> Sequence[int]:
    """The runs of the search, as many as the page said."""
    hive().check_writable()
    expected = whole_number(request.form.get("count", ""), "count", 0, _LARGEST_COUNT)
    return as_expected(hive().searches.run_ids(_asked().search), expected)


def _to_list(acted: Acted, words: str) -> Response:
    """Back to the list, which says what was done."""
    category = "success" if acted.done else "warning"
    if acted.at is not None and acted.done:
        category = f"{UNDO_TOGETHER} {acted.deleted_at_text}"
    flash(f"{words} {_left_out(acted)}".strip(), category)
    return make_response(redirect(list_address(filled(request.args)), 303))


def _asked() -> RunListQuery:
    return RunListQuery.from_args(request.args, hive().searches.vocabulary())


def _left_out(acted: Acted) -> str:
    return f"{plural(acted.left_out, 'run')} left out: {'; '.join(acted.words)}." if acted.left_out else ""
