"""The page of an experiment that chooses its runs: how it stands, what comes next, and why."""

from __future__ import annotations

from flask import Blueprint, render_template

from slamhive.domain.metrics import described
from slamhive.web.context import hive
from slamhive.web.presenters import questions as presenter

blueprint = Blueprint("questions", __name__, url_prefix="/experiments")


@blueprint.get("/<name>/question")
def show(name: str) -> str:
    """Show the candidates of an experiment, the best first, and the answer or the next runs."""
    status = hive().experiments.status(name)
    found = hive().questions.decision(name)
    metric = described(found.metric)
    return render_template(
        "experiments/question.html",
        status=status,
        found=found,
        facts=presenter.facts(found),
        rows=presenter.candidate_rows(found, metric),
        unit=presenter.unit_of(metric),
        metric=metric,
    )
