"""Datasets: the list, and one page each."""

from __future__ import annotations

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request, url_for

from slamhive.domain.variant import variant_from_json
from slamhive.errors import InvalidInput, NotFound
from slamhive.search.build import matching
from slamhive.services.runs import check_dataset_files, read_dataset_path
from slamhive.store.records import RunSort
from slamhive.web.context import hive, variant_maker
from slamhive.web.figures import best_plane, path_figures
from slamhive.web.formatting import plural
from slamhive.web.presenters.catalogue import lacking, step_kinds
from slamhive.web.run_form import read_steps

blueprint = Blueprint("datasets", __name__, url_prefix="/datasets")


@blueprint.get("")
def index() -> str:
    """List all datasets, and folders that cannot be read."""
    catalogue = hive().catalogue
    return render_template(
        "datasets/index.html",
        datasets=catalogue.datasets(),
        broken=[entry for entry in catalogue.broken() if not entry.is_algorithm],
    )


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show one dataset: sensors, calibration, ground truth, variants and compatible algorithms."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    runs = services.runs.page(matching(datasets=(name,)), RunSort(), None, 1)
    return render_template(
        "datasets/show.html",
        dataset=dataset,
        algorithms=[(algorithm, lacking(algorithm, dataset)) for algorithm in services.catalogue.algorithms()],
        run_count=runs.total,
        variants=[(entry, variant_from_json(entry.steps)) for entry in services.variants.entries(name)],
        cache_bytes=services.settings.variant_cache_bytes,
        making=variant_maker().latest(name),
        step_kinds=step_kinds(),
    )


@blueprint.post("/<name>/variants")
def make_variant(name: str) -> Response:
    """Start creating a variant, after all checks that are possible in advance."""
    services = hive()
    services.check_writable()
    dataset = services.catalogue.dataset(name)
    variant = services.variants.resolve(dataset, read_steps(request.form.get("steps", "")))
    if not variant:
        raise InvalidInput(f"these steps change nothing in {name}", "add a step that changes the data")
    check_dataset_files(dataset)
    services.variants.check(dataset, variant)
    variant_maker().start(dataset, variant)
    flash("The variant is being created. It appears in the list when it is finished.", "info")
    return _to_variants(name)


@blueprint.post("/<name>/variants/<key>/drop")
def drop_variant(name: str, key: str) -> Response:
    """Remove a variant that nothing uses."""
    services = hive()
    services.check_writable()
    entry = services.variants.find(key)
    if entry.dataset != name:
        raise NotFound(f"{name} has no variant {key[:40]!r}")
    services.variants.drop(entry.key)
    flash("The variant is removed. Runs that need it create it again.", "success")
    return _to_variants(name)


@blueprint.get("/<name>/figures.json")
def figures(name: str) -> Response:
    """The ground-truth path in all planes and in 3D."""
    track = read_dataset_path(hive().catalogue.dataset(name))
    if track is None:
        raise NotFound(f"dataset {name} has no ground truth to draw")
    return make_response(
        jsonify(
            figures=path_figures(track, None),
            captions={"path": f"Ground truth, {plural(track.poses, 'pose')}."},
            reasons={},
            best_plane=best_plane(track),
        )
    )


def _to_variants(name: str) -> Response:
    return make_response(redirect(url_for("datasets.show", name=name, _anchor="variants"), 303))
