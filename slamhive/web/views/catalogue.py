"""Datasets and algorithms: the lists, and one page each."""

from __future__ import annotations

from contextlib import suppress
from itertools import groupby

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request, url_for

from slamhive.analysis.chart import OKABE_ITO, algorithm_colours
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.documents.catalogue import public_sequence
from slamhive.documents.model import load
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import Dataset
from slamhive.filters.words import matching
from slamhive.recordings.views import FrameView
from slamhive.services.datasets import constant_in_words, stretch_in_words, strip_times_s
from slamhive.store.records import RunSort
from slamhive.web.context import dataset_checker, dataset_fetcher, hive, truth_judge, variant_maker
from slamhive.web.figures import sweep_json
from slamhive.web.presenters.catalogue import dataset_choices, ground_truth_figures, lacking, step_kinds
from slamhive.web.presenters.scripts import dataset_scripts
from slamhive.web.views.start import read_steps

_COLOUR = OKABE_ITO[0]
_RUNS = 8
"""How many runs the page of a dataset lists; a link leads to all."""

blueprint = Blueprint("datasets", __name__, url_prefix="/datasets")
public_blueprint = Blueprint("public_datasets", __name__, url_prefix="/public-datasets")


@blueprint.get("")
def index() -> str:
    """List all datasets, and folders that cannot be read."""
    catalogue = hive().catalogue
    return render_template(
        "datasets/index.html",
        collections=hive().fetching.collections.all,
        datasets=catalogue.datasets(),
        broken=[entry for entry in catalogue.broken() if not entry.is_algorithm],
    )


@public_blueprint.get("")
def index_of_public() -> str:
    """List public sequences that all words of the address fit, by collection, with what is fetched now."""
    words = request.args.get("words", "").strip()
    services = hive()
    problem = ""
    try:
        found = services.fetching.collections.search(words.split())
    except NotFound as error:
        found, problem = (), str(error)
    here = {dataset.name for dataset in services.catalogue.datasets()}
    entries = [(pair[0].name, public_sequence(*pair), pair[1].dataset_name) for pair in found]
    return render_template(
        "datasets/public.html",
        words=words,
        groups=[(name, list(group)) for name, group in groupby(entries, lambda entry: entry[0])],
        total=len(entries),
        here=here,
        problem=problem,
        unverified=any(entry.unverified for _, entry, _ in entries),
        work=dataset_fetcher().present,
    )


@public_blueprint.post("/fetch")
def fetch() -> Response:
    """Start fetching a sequence. The page shows its progress."""
    sequence = request.form.get("sequence", "")
    dataset_fetcher().start(sequence, accept_licence=bool(request.form.get("accept")))
    return make_response(redirect(url_for("public_datasets.index_of_public"), 303))


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show one dataset: sensors, calibration, ground truth, variants and compatible algorithms."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    runs = services.runs.page(matching(datasets=(name,)), RunSort(), None, _RUNS)
    motion = None
    with suppress(InvalidInput, NotFound):  # no ground truth that can be read; the page says so elsewhere
        motion = services.dataset_views.motion(dataset)
    return render_template(
        "datasets/show.html",
        dataset=dataset,
        algorithms=[(algorithm, lacking(algorithm, dataset)) for algorithm in services.catalogue.algorithms()],
        run_count=runs.total,
        scripts=dataset_scripts(name, services.settings),
        variants=[(entry, load(Variant, entry.steps)) for entry in services.variants.entries(name)],
        cache_bytes=services.settings.variant_cache_bytes,
        making=variant_maker().latest(name),
        report=services.dataset_checks.stored(dataset),
        checking=dataset_checker().latest(name),
        trial=services.truth_trials.stored(dataset),
        judging=truth_judge().latest(name),
        stretch_in_words=stretch_in_words,
        constant_in_words=constant_in_words,
        step_kinds=step_kinds(),
        runs=runs.records,
        strip_times_s=strip_times_s(dataset),
        time_s=asked_time_s(dataset),
        motion=motion,
    )


@blueprint.post("/<name>/check")
def check(name: str) -> Response:
    """Start checking the dataset."""
    dataset_checker().start(name)
    flash("The dataset is being checked. The findings appear when the check is finished.", "info")
    return make_response(redirect(url_for("datasets.show", name=name, _anchor="checks"), 303))


@blueprint.post("/<name>/trial")
def judge(name: str) -> Response:
    """Start judging the ground truth."""
    truth_judge().start(name)
    flash("The ground truth is being judged. The result appears when that is finished.", "info")
    return make_response(redirect(url_for("datasets.show", name=name, _anchor="trial"), 303))


@blueprint.post("/<name>/variants")
def make_variant(name: str) -> Response:
    """Start creating a variant, after all checks that are possible in advance."""
    variant_maker().start(name, read_steps(request.form.get("steps", "")))
    flash("The variant is being created. It appears in the list when it is finished.", "info")
    return _to_variants(name)


@blueprint.post("/<name>/variants/<key>/drop")
def drop_variant(name: str, key: str) -> Response:
    """Remove a variant that nothing uses."""
    variant_maker().drop(name, key)
    flash("The variant is removed. Runs that need it create it again.", "success")
    return _to_variants(name)


@blueprint.get("/<name>/figures.json")
def figures(name: str) -> Response:
    """The ground truth: its path in all planes, speed and angular rate."""
    dataset = hive().catalogue.dataset(name)
    found = ground_truth_figures(dataset, trial=hive().truth_trials.stored(dataset))
    if found is None:
        raise NotFound(f"dataset {name} has no ground truth to draw")
    return make_response(jsonify(found))


@blueprint.get("/<name>/frames/<sensor>.jpg")
def frame(name: str, sensor: str) -> Response:
    """The frame of a camera at ``time`` in s from the start, or number ``overview`` of its overview."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    number = request.args.get("overview", type=int)
    if number is None:
        return frame_answer(dataset, sensor)
    return _jpeg(services.dataset_views.thumbnail(dataset, sensor, number))


def frame_answer(dataset: Dataset, sensor: str) -> Response:
    """The frame of a camera at the time that the request states."""
    return _jpeg(hive().dataset_views.frame(dataset, sensor, asked_time_s(dataset)))


def _jpeg(view: FrameView) -> Response:
    response = make_response(view.jpeg)
    response.mimetype = "image/jpeg"
    response.headers["X-Frame-Time"] = f"{view.time_s:.6f}"
    return response


@blueprint.get("/<name>/sweeps/<sensor>.json")
def sweep(name: str, sensor: str) -> Response:
    """The sweep of a LiDAR at ``time`` in s from the start: its points, and a caption."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    view = services.dataset_views.sweep(dataset, sensor, asked_time_s(dataset))
    return make_response(jsonify(sweep_json(view, sensor)))


def asked_time_s(dataset: Dataset) -> float:
    """``time`` of the request; the middle of the recording without it or if it is no number."""
    time_s = request.args.get("time", type=float)
    if time_s is None or not 0 <= time_s <= dataset.duration_s:
        return dataset.duration_s / 2
    return time_s


def _to_variants(name: str) -> Response:
    return make_response(redirect(url_for("datasets.show", name=name, _anchor="variants"), 303))


# -- algorithms: the list, and one page each ---------------------------------------------------------------------------

algorithms_blueprint = Blueprint("algorithms", __name__, url_prefix="/algorithms")


@algorithms_blueprint.get("", endpoint="index")
def algorithms() -> str:
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


@algorithms_blueprint.get("/<name>", endpoint="show")
def show_algorithm(name: str) -> str:
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
