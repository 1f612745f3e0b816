"""Runs beside each other, and beside the numbers of papers: the pages of a comparison and of claims."""

from __future__ import annotations

from flask import Blueprint, Response, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.errors import InvalidInput
from slamhive.services.claims import badge_svg
from slamhive.services.run_comparison import RunComparison, analysis_text, plots_of, read_run_id, read_run_ids
from slamhive.web.context import hive
from slamhive.web.presenters import comparison as presenter
from slamhive.web.presenters.scripts import comparison_scripts

blueprint = Blueprint("compare", __name__, url_prefix="/compare")

_GROUPS = ("", "configuration")


@blueprint.get("")
def show() -> Response:
    """The runs side by side. Lists of runs send each run by itself; the permanent address has one list."""
    if "run" in request.args:
        chosen = ",".join(map(str, sorted(read_run_ids(request.args.getlist("run")))))
        return make_response(redirect(address("compare.show", runs=chosen, group=_group() or None), 303))
    compared = asked_comparison()
    series = [] if compared.grouped else presenter.series_of(compared, hive().runs)
    runs = [run.id for run in compared.runs]
    return make_response(
        render_template(
            "compare/show.html",
            compared=compared,
            mixed=compared.mixed,
            where=f"id in ({', '.join(map(str, runs))})",
            heads=presenter.heads(compared),
            settings=presenter.setting_rows(compared),
            metrics=presenter.metric_groups(compared),
            differing=presenter.differing_metrics(compared),
            told=presenter.story(compared, series),
            base=compared.columns[compared.baseline].runs[0],
            args=presenter.address_args(compared),
            analysis=analysis_text(compared),
            scripts=comparison_scripts([run.id for run in compared.runs], hive().settings, grouped=compared.grouped),
        )
    )


@blueprint.get("/figures.json")
def figures() -> Response:
    """The plots of a comparison, with captions and the reasons for missing ones."""
    compared = asked_comparison()
    if compared.grouped:
        return make_response(jsonify(presenter.grouped_figures(plots_of(compared, hive().analyses))))
    return make_response(jsonify(presenter.single_figures(compared, presenter.series_of(compared, hive().runs))))


def asked_comparison() -> RunComparison:
    """The comparison that the address asks for; raises InvalidInput or NotFound."""
    run_ids = read_run_ids(request.args.getlist("runs"))
    baseline = request.args.get("baseline") or None
    return hive().run_comparisons.of(
        run_ids,
        request.args.get("protocol") or None,
        grouped=bool(_group()),
        baseline=None if baseline is None else read_run_id(baseline),
    )


def _group() -> str:
    group = request.args.get("group", "")
    if group not in _GROUPS:
        raise InvalidInput(f"group {group[:40]!r} is not allowed", "use configuration, or leave it out")
    return group


# -- claims of papers: the last answers, and their badges --------------------------------------------------------------

claims_blueprint = Blueprint("claims", __name__, url_prefix="/claims")


@claims_blueprint.get("")
def index() -> str:
    """List the files of claims that were checked."""
    return render_template("claims/index.html", found=hive().claims.all())


@claims_blueprint.get("/<name>", endpoint="show")
def show_claims(name: str) -> str:
    """Show the last answer about the claims of one file."""
    return render_template(
        "claims/show.html",
        answer=hive().claims.get(name),
        run_url=lambda run_id: address("runs.show", run_id=run_id),
    )


@claims_blueprint.get("/<name>/badge.svg")
def badge(name: str) -> Response:
    """The badge of one file, for a README."""
    return Response(badge_svg(claim.state for claim in hive().claims.get(name).claims), mimetype="image/svg+xml")
