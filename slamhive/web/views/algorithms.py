"""Algorithms: the list, and one page each."""

from __future__ import annotations

from flask import Blueprint, render_template

from slamhive.analysis.chart import algorithm_colours
from slamhive.filters.words import matching
from slamhive.store.records import RunSort
from slamhive.web.context import hive
from slamhive.web.presenters.catalogue import dataset_choices

blueprint = Blueprint("algorithms", __name__, url_prefix="/algorithms")


@blueprint.get("")
def index() -> str:
    """List all algorithms, and packages that cannot be read."""
    catalogue = hive().catalogue
    algorithms = catalogue.algorithms()
    names = [algorithm.name for algorithm in algorithms]
    return render_template(
        "algorithms/index.html",
        algorithms=algorithms,
        colours=algorithm_colours(names, names),
        broken=[entry for entry in catalogue.broken() if entry.is_algorithm],
    )


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show one algorithm: inputs, parameters and origin."""
    services = hive()
    algorithm = services.catalogue.algorithm(name)
    runs = services.runs.page(matching(algorithms=(name,)), RunSort(), None, 1)
    return render_template(
        "algorithms/show.html",
        algorithm=algorithm,
        choices=dataset_choices(algorithm, services.catalogue.datasets()),
        run_count=runs.total,
        versions=services.versions.of(algorithm.package.name)[::-1],
    )
