"""The page of an experiment that chooses its runs: how it stands, what comes next, and why."""

from __future__ import annotations

from collections.abc import Sequence

from flask import Blueprint, render_template

from slamhive.documents.question import Decision
from slamhive.domain.metrics import described
from slamhive.web.context import hive
from slamhive.web.presenters import questions as presenter

blueprint = Blueprint("questions", __name__, url_prefix="/experiments")


@blueprint.get("/<name>/question")
def show(name: str) -> str:
    """Show the candidates of an experiment, the best first, and the answer or the next runs."""
    status = hive().experiments.status(name)
    found = hive().questions.standing(name)
    metric = described(found.metric)
    rows: Sequence[presenter.CandidateRow | presenter.SearchRow]
    rows = (
        presenter.candidate_rows(found, metric) if isinstance(found, Decision) else presenter.search_rows(found, metric)
    )
    return render_template(
        "experiments/question.html",
        status=status,
        found=found,
        decides=isinstance(found, Decision),
        facts=presenter.facts(found),
        rows=rows,
        unit=presenter.unit_of(metric),
        metric=metric,
    )
