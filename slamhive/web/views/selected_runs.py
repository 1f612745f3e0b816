"""Actions on several runs that are selected in a list: evaluate, retry, tag, export and delete them; the trash."""

from __future__ import annotations

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput
from slamhive.documents.api import LARGEST_RUN_ID, MOST_RUNS
from slamhive.domain.accounts import Visibility
from slamhive.domain.run import NotesChange, split_tags
from slamhive.services.search_actions import MOST_OF_A_REQUEST
from slamhive.services.sharing import SharingChange
from slamhive.web.context import hive
from slamhive.web.formatting import plural
from slamhive.web.queries import filled
from slamhive.web.views.accounts import is_own_address
from slamhive.web.views.runs import list_address

blueprint = Blueprint("selected_runs", __name__, url_prefix="/runs")

UNDO = "undo"
"""The category of a message with a button that takes the named runs out of the trash again."""


@blueprint.post("/evaluate")
def evaluate() -> Response:
    """Evaluate the selected runs, or all that are not evaluated. Goes back to the list."""
    runs = _selected(request.form.getlist("run"))
    if not runs and not request.form.get("all"):
        return _nothing_selected()
    wanted = None if request.form.get("all") else runs
    protocol = request.form.get("protocol") or None
    # A list shows one protocol of each run: the one that was just chosen. A comparison has a choice of its own.
    shown = protocol is not None and not request.form.get("compared")
    queued = hive().evaluations.queue(wanted, protocol, makes_current=shown)
    flash(f"{plural(len(queued), 'evaluation')} queued." if queued else "There is nothing to evaluate.", "info")
    return _to_list()


@blueprint.post("/evaluate-together")
def evaluate_together() -> Response:
    """Evaluate all runs of a filter under one protocol, which lists then show. Goes back to the page that asked."""
    hive().check_writable()
    search = hive().searches.read(request.form.get("where", ""))
    run_ids = hive().searches.run_ids(search)
    if len(run_ids) > MOST_OF_A_REQUEST:
        raise InvalidInput(
            f"{plural(len(run_ids), 'run')} are too many for one request",
            f"choose at most {MOST_OF_A_REQUEST}, or use slamhive evaluate --where on the server",
        )
    found = hive().current_protocols.together(run_ids, request.form.get("protocol", ""))
    flash(found.words, "info")
    back = request.form.get("back", "")
    return make_response(redirect(back, 303)) if is_own_address(back) else _to_list()


@blueprint.post("/retry")
def retry() -> Response:
    """Queue a new run for each of the selected ones, or none. Goes back to the list."""
    runs = _selected(request.form.getlist("run"))
    if not runs:
        return _nothing_selected()
    number = len(hive().runs.retry_all(runs))
    words = (
        "1 run queued, which repeats the selected one."
        if number == 1
        else (f"{plural(number, 'run')} queued, which repeat the selected ones.")
    )
    flash(words, "success")
    return _to_list()


@blueprint.get("/export")
def export() -> Response:
    """The address of a file of the selected runs, with the columns of the list."""
    runs = _selected(request.args.getlist("run"))
    if not runs:
        return _back_without_selection()
    columns = request.args.get("columns", "")
    where = f"id in ({', '.join(map(str, runs))})"
    return make_response(redirect(address("searches.export", name="csv", where=where, columns=columns or None), 303))


@blueprint.get("/tags")
def tags() -> Response:
    """The web form that tags the selected runs."""
    hive().check_writable()
    runs = _selected(request.args.getlist("run"))
    if not runs:
        return _nothing_selected()
    services = hive()
    records = services.store.read(lambda t: t.runs.get_many(runs))
    given = sorted({tag for record in records for tag in record.tags})
    return make_response(render_template("runs/tags.html", runs=records, given=given, known=services.notes.tags()))


@blueprint.post("/tags")
def tag() -> Response:
    """Add and remove tags of the selected runs."""
    runs = _selected(request.form.getlist("run"))
    if not runs:
        return _nothing_selected()
    change = NotesChange(add=split_tags(request.form.get("add", "")), remove=tuple(request.form.getlist("remove")))
    hive().notes.change(runs, change)
    flash(f"The tags of {plural(len(runs), 'run')} are stored.", "success")
    return make_response(redirect(address("runs.index", columns="id,algorithm,dataset,state,tags,note"), 303))


@blueprint.get("/share")
def sharing() -> Response:
    """The web form that says who may see the selected runs."""
    hive().check_writable()
    runs = _selected(request.args.getlist("run"))
    if not runs:
        return _nothing_selected()
    records = hive().store.read(lambda t: t.runs.get_many(runs))
    return make_response(render_template("runs/share.html", runs=records))


@blueprint.post("/share")
def share() -> Response:
    """Choose who may see the selected runs. Goes back to the one that it came from, or to the list."""
    runs = _selected(request.form.getlist("run"))
    if not runs:
        return _nothing_selected()
    visibility = Visibility.named(request.form.get("visibility", ""))
    hive().sharings.runs(runs, SharingChange(visibility))
    are = "is" if len(runs) == 1 else "are"
    flash(f"{plural(len(runs), 'run')} {are} {visibility} now.", "success")
    if request.form.get("back"):
        return make_response(redirect(address("runs.show", run_id=runs[0]), 303))
    return make_response(redirect(address("runs.index", columns="id,algorithm,dataset,state,owner,visibility"), 303))


@blueprint.get("/delete")
def confirm() -> Response:
    """Say what moves to the trash, before it does."""
    hive().check_writable()
    runs = _selected(request.args.getlist("run"))
    if not runs:
        return _nothing_selected()
    records = hive().store.read(lambda t: t.runs.get_many(runs))
    return make_response(render_template("runs/delete.html", runs=records))


@blueprint.post("/delete")
def delete() -> Response:
    """Move the selected runs to the trash."""
    runs = _selected(request.form.getlist("run"))
    if not runs:
        return _nothing_selected()
    hive().trash.delete(runs)
    flash(f"{plural(len(runs), 'run')} moved to the trash.", f"{UNDO} {' '.join(map(str, runs))}")
    return make_response(redirect(address("runs.index"), 303))


def _selected(texts: list[str]) -> list[int]:
    """The numbers of the selected runs, each once; raises InvalidInput."""
    if len(texts) > MOST_RUNS:
        raise InvalidInput(f"{len(texts)} runs are selected", f"select at most {MOST_RUNS}")
    return list(dict.fromkeys(whole_number(text, "run", 1, LARGEST_RUN_ID) for text in texts))


def _nothing_selected() -> Response:
    """Back to the list, which says that nothing is selected."""
    hive().check_writable()
    return _back_without_selection()


def _back_without_selection() -> Response:
    flash("No run is selected. Select runs, then press the button again.", "warning")
    return _to_list()


def _to_list() -> Response:
    """Back to the comparison or the list of runs that the action came from."""
    compared = request.form.get("compared")
    if compared:
        return make_response(redirect(address("compare.show", runs=compared), 303))
    return make_response(redirect(list_address({} if request.method == "GET" else filled(request.args)), 303))


# -- the trash: deleted runs, taken out again or removed for good ------------------------------------------------------


trash_blueprint = Blueprint("trash", __name__, url_prefix="/trash")
MOST_SHOWN = 500


@trash_blueprint.get("")
def index() -> str:
    """List the deleted runs."""
    found = hive().trash.listed()
    return render_template("trash/index.html", runs=found[:MOST_SHOWN], total=len(found))


@trash_blueprint.post("/restore")
def restore() -> Response:
    """Take runs out of the trash."""
    trash, deleted_at = hive().trash, request.form.get("deleted_at")
    numbers = [whole_number(text, "run", 1, LARGEST_RUN_ID) for text in request.form.getlist("run")]
    runs = trash.restore(trash.deleted_together(deleted_at) if deleted_at else numbers)
    flash(f"{plural(len(runs), 'run')} restored." if runs else "No run is selected.", "success" if runs else "warning")
    target = address("runs.show", run_id=runs[0]) if len(runs) == 1 else address("runs.index")
    return make_response(redirect(target, 303))


@trash_blueprint.post("/empty")
def empty() -> Response:
    """Remove the files of all deleted runs for good."""
    count = hive().trash.empty()
    flash(f"{plural(count, 'run')} removed for good." if count else "The trash is empty.", "info")
    return make_response(redirect(address("trash.index"), 303))
