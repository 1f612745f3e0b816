"""Experiments: the list, one page each, and actions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.errors import NotFound, SlamHiveError, unknown
from slamhive.documents.experiment import SearchStanding
from slamhive.documents.limits import Limits, StopWhen, options_of
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.accounts import Action, Visibility
from slamhive.domain.metrics import CATALOGUE, described
from slamhive.domain.protocol import ALIGNMENT_LABELS, TrajectoryKind
from slamhive.domain.verdict import DEFAULT_RULE, Outcome
from slamhive.executors.registry import EXECUTORS
from slamhive.experiments.file import parse_experiment
from slamhive.filters.syntax import experiment_filter
from slamhive.services.experiments import (
    METRICS,
    ExperimentSource,
    question,
)
from slamhive.services.sharing import SharingChange
from slamhive.services.stored_analyses import may_analyse
from slamhive.web.context import caller, hive
from slamhive.web.errors import status_of, wants_json
from slamhive.web.experiment_fields import SOURCE
from slamhive.web.formatting import display_unit, plural
from slamhive.web.presenters import experiments as presenter
from slamhive.web.presenters import questions, rankings
from slamhive.web.presenters.experiment_builder import (
    MOST_TEXT,
    ExperimentDraft,
    builder,
    copied,
    deciding,
    draft_from_form,
    empty_draft,
    with_error,
)
from slamhive.web.presenters.scripts import experiment_scripts
from slamhive.web.queries import (
    PROGRESS,
    CellsQuery,
    GridQuery,
    page_number,
    repeats_count,
    search_of,
    stated_axes,
    stated_values,
)

blueprint = Blueprint("experiments", __name__, url_prefix="/experiments")

PAGE_LENGTH = 50
LARGE = rankings.LARGEST
"""With more configurations than this, a second request computes the grid."""

ACTION = "<any('pause', 'resume', 'cancel', 'retry-failed', 'add-repeats'):action>"
CELL_NUMBER = "<int(max=2147483647):number>"


@blueprint.app_context_processor
def _words_of_experiments() -> dict[str, Any]:
    return {"experiment_words": presenter}


@blueprint.get("")
def index() -> str:
    """List all experiments, in pages."""
    found = hive().experiments.list()
    pages = max(1, -(-len(found) // PAGE_LENGTH))
    page = page_number(request.args, pages)
    return render_template(
        "experiments/index.html",
        experiments=with_time_left(found[(page - 1) * PAGE_LENGTH : page * PAGE_LENGTH]),
        total=len(found),
        page=page,
        pages=pages,
    )


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show the question of one experiment, its answer, and one tab."""
    experiments = hive().experiments
    status = experiments.status(name)
    small = status.cells <= LARGE
    # The tab that the address names, or that its arguments belong to, or the ranking once there is one.
    args, tab = request.args, request.args.get("tab", "")
    if tab and tab not in TABS:
        raise unknown("tab", tab, list(TABS))
    if not tab and {"rows", "columns", "metric", "grid"} & args.keys():
        tab = "grid"
    elif not tab and ("after" in args or "limit" in args):
        tab = "runs"
    elif not tab:
        judged = status.counts[Outcome.GOOD] + status.counts[Outcome.FAILED] + status.counts[Outcome.CANCELLED]
        tab = "ranking" if judged and small else "grid"
    return render_template(
        "experiments/show.html",
        status=status,
        failed=status.ended_badly,
        failing=experiments.is_failing(status),
        answer=experiments.answer(name) if small else None,
        question=question(status.description, stated_values(parse_experiment(experiments.source(name).text))),
        mixed=hive().current_protocols.mixed_in(name),
        where=experiment_filter(name),
        tab=tab,
        tabs=TABS,
        **_TAB_WORDS[tab](status),
    )


TABS = {"ranking": "Ranking", "grid": "Grid", "runs": "Runs", "report": "Report", "setup": "Setup"}


def _ranking_words(status: ExperimentStatusDocument) -> dict[str, Any]:
    axes = {axis: len(found) for axis, found in hive().experiments.axes(status.name).items()}
    by = request.args.get("by") or ("algorithm" if axes.get("algorithm", 0) > 1 else "configuration")
    if by not in RANKED:
        raise unknown("ranking", by, list(RANKED))
    return {
        "by": by,
        "ranked_by": RANKED if axes.get("algorithm", 0) > 1 else {},
        "rankings": rankings.of_experiment(hive(), status, rankings.naming_axes(axes), by_algorithm=by == "algorithm"),
        "ranking_title": rankings.title(status),
        "ranking_columns": rankings.columns(),
    }


RANKED = {"algorithm": "By algorithm", "configuration": "By configuration"}


def _grid_words(status: ExperimentStatusDocument) -> dict[str, Any]:
    experiments = hive().experiments
    stated = parse_experiment(experiments.source(status.name).text)
    later = status.cells > LARGE and request.args.get("grid") != "now"
    axes = stated_axes(stated) if later else {axis: len(found) for axis, found in experiments.axes(status.name).items()}
    wanted = GridQuery.from_args(request.args, axes)
    view = None
    if wanted is not None and not later:
        grid = experiments.grid(stated.name, wanted.rows, wanted.columns)
        view = presenter.grid_view(grid, lambda *place: search_of(stated, *place))
        if wanted.metric is not None:
            means = experiments.metric_grid(stated.name, wanted.rows, wanted.columns, wanted.metric)
            view = presenter.heat_map(view, grid, CATALOGUE[wanted.metric], means)
    return {
        "axes": list(axes),
        "asked": wanted,
        "grid": view,
        "metrics": {PROGRESS: "Progress"} | {key: CATALOGUE[key].label for key in METRICS},
    }


def _cells_words(status: ExperimentStatusDocument) -> dict[str, Any]:
    experiments = hive().experiments
    cells = CellsQuery.from_args(request.args)
    page = experiments.cells(status.name, cells.after, cells.limit)
    axes = rankings.naming_axes({axis: len(found) for axis, found in experiments.axes(status.name).items()})
    metrics = [CATALOGUE[key] for key in METRICS]
    # A run of each protocol in these cells knows its label.
    compared = {run.protocol: run.id for cell in page.cells for run in cell.runs if run.protocol is not None}
    protocols = [hive().runs.get(run_id).protocol for run_id in compared.values()]
    labels = {protocol.fingerprint: protocol.label for protocol in protocols if protocol is not None}
    return {
        "rule": DEFAULT_RULE.words,
        "shown_axes": axes,
        "page": page,
        "cells": cells,
        "metrics": metrics,
        "lines": presenter.cell_lines(status.name, page.cells, axes, metrics, labels),
    }


def _report_words(status: ExperimentStatusDocument) -> dict[str, Any]:
    services = hive()
    taken = may_analyse(services.settings) and Action.ANALYSE in caller().may
    return {"reports": services.stored_analyses.of_experiment(status.name), "taken": taken}


def _setup_words(status: ExperimentStatusDocument) -> dict[str, Any]:
    return {
        "source": hive().experiments.source(status.name).text,
        "scripts": experiment_scripts(status.name, hive().settings),
    }


_TAB_WORDS = {
    "ranking": _ranking_words,
    "grid": _grid_words,
    "runs": _cells_words,
    "report": _report_words,
    "setup": _setup_words,
}


@blueprint.get(f"/<name>/cells/{CELL_NUMBER}")
def cell(name: str, number: int) -> Response:
    """Redirect to the runs of one configuration of the experiment."""
    found = hive().experiments.cells(name, max(0, number - 1), 1).cells
    if not found or found[0].number != number:
        raise NotFound(f"experiment {name} has no configuration {number}")
    target = address("runs.index", experiment=name, configuration=found[0].configuration_id)
    return make_response(redirect(target, 302))


@blueprint.get("/<name>/experiment.yaml")
def download(name: str) -> Response:
    """The experiment file as it was submitted."""
    response = Response(hive().experiments.source(name).text, mimetype="application/yaml")
    response.headers["Content-Disposition"] = f'attachment; filename="{name}.yaml"'
    return response


@blueprint.post(f"/<name>/{ACTION}")
def act(name: str, action: str) -> Response:
    """Pause, resume, cancel, try failed runs again, or add repeats."""
    experiments = hive().experiments
    if action == "pause":
        experiments.pause(name)
        flash(f"{name} is paused. Runs in progress continue to their end.", "info")
    elif action == "resume":
        experiments.resume(name)
        flash(f"{name} is resumed.", "success")
    elif action == "cancel":
        experiments.cancel(name)
        flash(f"{name} is cancelled.", "info")
    elif action == "retry-failed":
        count = experiments.retry_failed(name)
        flash(f"{plural(count, 'failed run')} of {name} queued again." if count else "No run has failed.", "info")
    else:
        count = repeats_count(request.form)
        experiments.add_repeats(name, count)
        flash(f"{plural(count, 'repeat')} of each configuration of {name} queued.", "success")
    return make_response(redirect(address("experiments.show", name=name), 303))


@blueprint.post("/<name>/share")
def share(name: str) -> Response:
    """Choose who may see the experiment and its runs."""
    visibility = Visibility.named(request.form.get("visibility", ""))
    hive().sharings.experiment(name, SharingChange(visibility))
    flash(f"{name} is {visibility} now.", "success")
    return make_response(redirect(address("experiments.show", name=name), 303))


def with_time_left(found: Iterable[ExperimentStatusDocument]) -> list[ExperimentStatusDocument]:
    """The same experiments, with the time left for active ones."""
    experiments = hive().experiments
    return [experiments.status(entry.name) if entry.state is ConfigurationStanding.ACTIVE else entry for entry in found]


# -- an experiment that chooses its runs: how it stands, what comes next, and why --------------------------------------

questions_blueprint = Blueprint("questions", __name__, url_prefix="/experiments")


@questions_blueprint.get("/<name>/question", endpoint="show")
def show_question(name: str) -> str:
    """Show the candidates of an experiment, the best first, and the answer or the next runs."""
    status = hive().experiments.status(name)
    found = hive().questions.standing(name)
    metric = described(found.metric)
    search = found if isinstance(found, SearchStanding) else None
    return render_template(
        "experiments/question.html",
        status=status,
        found=found,
        decides=search is None,
        facts=questions.facts(found),
        rows=questions.rows(found, metric),
        heads=[] if search is None else questions.heads(search),
        growth=[] if search is None else questions.growth_rows(search),
        plots=[] if search is None else questions.front_plots(search),
        unit=display_unit(metric).unit or "1",
        metric=metric,
    )


# -- the experiment builder: fields and YAML side by side, a preview, and the start ------------------------------------

experiment_builder_blueprint = Blueprint("experiment_builder", __name__, url_prefix="/new-experiment")
"""Not below ``/experiments``, where any name may be an experiment."""


@experiment_builder_blueprint.get("")
def new() -> str:
    """Show an empty builder, or one with a copy of the experiment ``copy``; with ``decide``, one that decides."""
    services = hive()
    services.check_writable()
    source = request.args.get("copy")
    draft = empty_draft() if source is None else copied(services, source)
    return _builder_page(deciding(services, draft) if "decide" in request.args else draft)


@experiment_builder_blueprint.post("")
def draft() -> Response | tuple[str, int]:
    """Return the edited draft as a page, or as JSON for the open one. Only ``do=start`` saves anything."""
    edited = draft_from_form(hive(), request.form)
    if request.form.get("do") == "start" and request.form.get("from") == "text":
        return _start(edited)
    if wants_json():
        return make_response(jsonify(_parts(edited)))
    return _builder_page(edited), 400 if edited.error else 200


def _start(edited: ExperimentDraft) -> Response | tuple[str, int]:
    if edited.preview is None:
        return _builder_page(edited), 400
    try:
        chosen = request.form.get("visibility")
        seen_by = Visibility.named(chosen) if chosen else None
        started = hive().experiments.start(ExperimentSource(edited.text, SOURCE), visibility=seen_by)
    except SlamHiveError as error:
        return _builder_page(with_error(edited, error)), status_of(error)
    flash(f"Started {started.name} with {plural(started.runs, 'run')}.", "success")
    return make_response(redirect(address("experiments.show", name=started.name), 303))


def _builder_page(edited: ExperimentDraft) -> str:
    visibility = request.form.get("visibility", "")
    return render_template("experiments/new.html", **_builder_words(edited), visibility=visibility)


def _parts(edited: ExperimentDraft) -> dict[str, Any]:
    """The parts that the open page replaces."""
    words = _builder_words(edited)
    return {
        "yaml": edited.text,
        "builder": None if edited.fields is None else render_template("experiments/_builder.html", **words),
        "preview": render_template("experiments/_preview.html", **words),
        "line": edited.line,
        "field": edited.field,
        "error": edited.error,
    }


def _builder_words(edited: ExperimentDraft) -> dict[str, Any]:
    installed = hive().catalogue.algorithms(), hive().catalogue.datasets()
    alignments = [("", "default for the sensors"), *((entry.value, label) for entry, label in ALIGNMENT_LABELS.items())]
    return {
        "draft": edited,
        "builder": None if edited.fields is None else builder(edited.fields, *installed),
        "alignments": alignments,
        "trajectories": [("", "traj.txt"), *((kind.value, kind.value) for kind in TrajectoryKind)],
        "limits": list(options_of(Limits)),
        "rules": list(options_of(StopWhen)),
        "executors": [("", "from the settings"), *((name, name) for name in EXECUTORS.names())],
        "most_text": MOST_TEXT,
    }
