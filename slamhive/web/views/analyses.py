"""Analyses: the list, the editor, the page of one analysis, its files, and actions."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.analysis.report import ReportPage
from slamhive.base.errors import Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.settings import Mode
from slamhive.domain.accounts import Action, Visibility
from slamhive.domain.bibliography import bibtex
from slamhive.services.search_actions import MOST_OF_A_REQUEST
from slamhive.services.sharing import SharingChange
from slamhive.services.stored_analyses import (
    FIGURES,
    MAX_TEXT_BYTES,
    MEDIA_TYPES,
    MOST_PREVIEWED_RUNS,
    PAGE,
    may_analyse,
)
from slamhive.store.records import AnalysisState
from slamhive.web import context
from slamhive.web.analysis_editor import (
    BOUNDS,
    AnalysisChanges,
    cards,
    choosing,
    entries,
    experiment_text,
    first_text,
    selector_text,
    title_of,
    with_title,
)
from slamhive.web.context import caller, hive
from slamhive.web.errors import status_of
from slamhive.web.limits import CHECKS, CREATIONS
from slamhive.web.request_input import form_text, uploaded_text
from slamhive.web.security import FIGURES_POLICY

if TYPE_CHECKING:
    from slamhive.services.analysis import OfferedColumns
    from slamhive.web.analysis_editor import Entry

blueprint = Blueprint("analyses", __name__, url_prefix="/analyses")

_LINE = re.compile(r" line (\d+)")


@blueprint.get("")
def index() -> str:
    """List the listed analyses."""
    return render_template("analyses/index.html", analyses=hive().stored_analyses.listed(), taken=_taken())


@blueprint.get("/new")
def new() -> str:
    """The editor with a first analysis of an ``experiment``, or of the runs that ``where`` selects."""
    name = request.args.get("experiment")
    if name:

        def crossed(first: str, second: str) -> bool:
            """Tell if values of two axes are combined; on linked axes, one value follows from the other."""
            grid = hive().experiments.grid(name, first, second)
            return len(grid.cells) > max(len(grid.rows), len(grid.columns))

        return _editor(experiment_text(name, hive().experiments.axes(name), crossed))
    return _editor(first_text(request.args.get("where", "")[:50_000]))


@blueprint.post("/check")
def check() -> Response:
    """Check an analysis file without saving it; returns its name or the error and its line, and the list of plots."""
    _count(CHECKS, "checks")
    text = _text()
    plots = render_template("analyses/_plots.html", plots=entries(text), taken=_taken())
    try:
        name = hive().stored_analyses.check(text)
    except SlamHiveError as error:
        found = _LINE.search(error.message)
        line = int(found[1]) if found else None
        return make_response(jsonify(ok=False, message=error.message, remedy=error.remedy, line=line, plots=plots))
    mixed = _mixed(text)["mixed"]
    if mixed is not None:
        words, remedy = f"{name}: {mixed.words}", mixed.remedy
        return make_response(jsonify(ok=False, message=words, remedy=remedy, line=None, plots=plots))
    return make_response(jsonify(ok=True, message=f"{name}: valid.", remedy=None, line=None, plots=plots))


def _mixed(text: str) -> dict[str, Any]:
    """The protocols of the runs of an analysis if no plot may draw their errors together, and the filter of the runs.

    Very many runs have no filter: their numbers would make the page too large.
    """
    try:
        runs = hive().analyses.mixed_runs(text)
    except SlamHiveError:
        runs = ()  # the selection has a fault of its own, which the check or the report names
    found = hive().current_protocols.mixed(runs)
    where = f"id in ({', '.join(map(str, runs))})" if len(runs) <= MOST_OF_A_REQUEST else None
    return {"mixed": None if found is None or found.only_trajectories else found, "where": where}


@blueprint.post("/previews")
def previews() -> str:
    """The list of plots with small pictures of them; an error says why there are none."""
    _count(CHECKS, "checks")
    text = _text()
    return render_template("analyses/_plots.html", plots=entries(text), taken=_taken(), **_previews(text))


@blueprint.post("")
def create() -> Response:
    """Save the analysis and redirect to its page."""
    services = hive()
    text = _text()
    do = request.form.get("do", "")
    if do == "check":
        return _checked(text)
    if do == "preview":
        _count(CHECKS, "checks")
        return make_response(_editor(text, **_previews(text)))
    try:
        changed = AnalysisChanges(text, lambda: cards(_offered(text)), request.form).made(do)
        if changed is not None:
            return make_response(_editor(changed.text, notice=changed.notice, editing=changed.editing))
        _count(CREATIONS, "analyses")
        record = services.stored_analyses.create(text, listed="unlisted" not in request.form)
    except (InvalidInput, NotFound) as error:
        return make_response(_editor(text, error), status_of(error))
    computer = context.analysis_computer()
    if computer is not None:
        computer.wake()
    return make_response(redirect(address("analyses.show", token=record.token), 303))


@blueprint.get("/select")
def select() -> str:
    """Turn limits into an analysis file for the constraint selector."""
    args = request.args
    text, problem = "", None
    asked = any(args.get(name) for name in (*BOUNDS, "sensors", "datasets"))
    if asked:
        try:
            text = selector_text(args, args.getlist("sensors")[:20], args.getlist("datasets")[:200])
        except InvalidInput as error:
            problem = error
    services = hive()
    datasets = sorted(entry.name for entry in services.store.read(lambda t: t.catalogue.datasets()))
    return render_template(
        "analyses/select.html", args=args, text=text, problem=problem, taken=_taken(), datasets=datasets
    )


@blueprint.get("/<token>")
def show(token: str) -> Response:
    """Show the report, its progress, or why it failed."""
    services = hive()
    record = services.stored_analyses.get(token)
    folder = services.stored_analyses.folder(token)
    page: ReportPage | None = None
    if record.state is AnalysisState.DONE:
        page = ReportPage.stored(folder.read_result(PAGE))
    response = make_response(
        render_template(
            "analyses/show.html",
            analysis=record,
            source=folder.source,
            page=page,
            **(_mixed(folder.source) if page is not None and page.mixed_protocols else {"mixed": None}),
            bibliography="" if page is None else bibtex(page.references),
            progress=folder.read_progress(),
            waits_for_worker=services.settings.mode is not Mode.VIEW_ONLY and not services.worker_alive(),
            kept=services.settings.analyses_max_stored,
        )
    )
    if page is not None:
        response.headers["Content-Security-Policy"] = FIGURES_POLICY
    return response


@blueprint.get("/<token>/figures.json")
def figures(token: str) -> Response:
    """All plots of the report as Plotly JSON."""
    services = hive()
    record = services.stored_analyses.get(token)
    content = services.stored_analyses.folder(token).result_bytes(FIGURES)
    response = Response(content, mimetype="application/json", headers={"Content-Encoding": "gzip", "Vary": "Accept"})
    response.set_etag(f"{record.content_hash}-{record.ended_at}".replace(" ", "T"), weak=True)
    return response


@blueprint.get("/<token>/files/<name>")
def file(token: str, name: str) -> Response:
    """A plot for print, a table, the self-contained page, or everything as a zip file."""
    content = hive().analysis_files.get(token, name)
    response = Response(content, mimetype=MEDIA_TYPES[name.rpartition(".")[2]])
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return response


@blueprint.post("/<token>/list")
def put_in_list(token: str) -> Response:
    """List the analysis, or unlist it."""
    listed = request.form.get("listed") == "yes"
    hive().stored_analyses.list_or_not(token, listed=listed)
    flash("The analysis is listed." if listed else "The analysis is unlisted; keep its address.", "success")
    return _to_page(token)


@blueprint.post("/<token>/share")
def share(token: str) -> Response:
    """Choose who may see the analysis."""
    visibility = Visibility.named(request.form.get("visibility", ""))
    hive().sharings.analysis(token, SharingChange(visibility))
    flash(f"The analysis is {visibility} now, and is computed again.", "success")
    return _to_page(token)


@blueprint.post("/<token>/recompute")
def recompute(token: str) -> Response:
    """Compute the analysis again from the current runs."""
    hive().stored_analyses.recompute(token)
    return _to_page(token)


@blueprint.post("/<token>/delete")
def delete(token: str) -> Response:
    """Delete the analysis permanently."""
    hive().stored_analyses.delete(token)
    flash("The analysis is deleted.", "info")
    return make_response(redirect(address("analyses.index"), 303))


def _taken() -> bool:
    """True if this server takes an analysis of this caller."""
    return may_analyse(hive().settings) and Action.ANALYSE in caller().may


def _previews(text: str) -> dict[str, Any]:
    """The content of the template of the previews."""
    if not _taken():
        raise Forbidden("this server accepts no new analyses", "compute it in your own installation")
    try:
        return {"previews": hive().analysis_previews.of(text), "problem": None}
    except (InvalidInput, Unavailable) as error:
        return {"previews": None, "problem": str(error)}


def _editor(
    text: str,
    error: SlamHiveError | None = None,
    notice: str | None = None,
    editing: Entry | None = None,
    **previews: Any,
) -> str:
    offered = _offered(text)
    known = cards(offered)
    if editing is not None:
        known = [choosing(card, editing.content) if card.key == editing.key else card for card in known]
    return render_template(
        "analyses/new.html",
        text=text,
        title=title_of(text),
        error=error,
        notice=notice,
        cards=known,
        plots=entries(text),
        editing=editing,
        most_previews=MOST_PREVIEWED_RUNS,
        **previews,
        offered=offered,
        taken=_taken(),
        most_bytes=MAX_TEXT_BYTES,
        **_mixed(text),
    )


def _offered(text: str) -> OfferedColumns | None:
    """The columns that the runs of the text can be drawn over; None if it selects none."""
    try:
        return hive().analyses.offered(text)
    except SlamHiveError:
        return None


def _checked(text: str) -> Response:
    """The result of the Check button for browsers without scripts."""
    try:
        name = hive().stored_analyses.check(text)
    except InvalidInput as error:
        return make_response(_editor(text, error), status_of(error))
    mixed = _mixed(text)["mixed"]
    return make_response(_editor(text, notice=f"{name}: {mixed.words if mixed else 'valid.'}"))


def _text() -> str:
    uploaded = uploaded_text("file", MAX_TEXT_BYTES)
    return with_title(form_text("yaml"), request.form.get("title", "")) if uploaded is None else uploaded[1]


def _count(limit: str, what: str) -> None:
    """Apply the rate limit for visitors of a view-only server."""
    settings = hive().settings
    if settings.mode is Mode.VIEW_ONLY:
        if not may_analyse(settings):
            raise Forbidden("this server accepts no new analyses", "compute it in your own installation")
        context.rate_limit(limit).take(request.remote_addr or "", what)


def _to_page(token: str) -> Response:
    return make_response(redirect(address("analyses.show", token=token), 303))
