"""Datasets: the list, and one page each."""

from __future__ import annotations

from flask import Blueprint, Response, jsonify, make_response, render_template

from slamhive.errors import NotFound
from slamhive.search.build import matching
from slamhive.services.series import read_dataset_path
from slamhive.store.records import RunSort
from slamhive.web.context import hive
from slamhive.web.figures import best_plane, path_figures
from slamhive.web.formatting import plural
from slamhive.web.presenters.catalogue import lacking

blueprint = Blueprint("datasets", __name__, url_prefix="/datasets")


@blueprint.get("")
def index() -> str:
    """All datasets, and folders that cannot be read."""
    catalogue = hive().catalogue
    return render_template(
        "datasets/index.html",
        datasets=catalogue.datasets(),
        broken=[entry for entry in catalogue.broken() if entry.folder.parent.name != "algorithms"],
    )


@blueprint.get("/<name>")
def show(name: str) -> str:
    """One dataset: sensors, calibration, ground truth, which algorithms can use it."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    runs = services.runs(matching(datasets=(name,)), RunSort(), None, 1)
    return render_template(
        "datasets/show.html",
        dataset=dataset,
        algorithms=[(algorithm, lacking(algorithm, dataset)) for algorithm in services.catalogue.algorithms()],
        run_count=runs.total,
    )


@blueprint.get("/<name>/figures.json")
def figures(name: str) -> Response:
    """The ground-truth path in its planes and in 3D."""
    track = read_dataset_path(hive().catalogue.dataset(name))
    if track is None:
        raise NotFound(f"dataset {name} has no ground truth that can be drawn")
    return make_response(
        jsonify(
            figures=path_figures(track, None),
            captions={"path": f"Ground truth, {plural(track.poses, 'pose')}."},
            reasons={},
            best_plane=best_plane(track),
        )
    )
