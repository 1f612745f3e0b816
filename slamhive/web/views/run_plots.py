"""The plots of a run, their data, and what its sensors saw at a moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flask import Blueprint, Response, jsonify, make_response, request, url_for

from slamhive.analysis.chart import RUN_COLOURS, colour_of
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.services.runs import MapViews, path_of
from slamhive.trajectory.alignment import IDENTITY, Similarity
from slamhive.web.context import hive
from slamhive.web.figures import best_plane, captions, figure_csv, run_figures, timeline
from slamhive.web.presenters import scenes
from slamhive.web.presenters.scenes import (
    TRUTH,
    ShownMap,
    ShownPath,
    algorithm_names,
    cloud_bytes,
    dataset_of,
    is_z_up,
    reference_of,
    run_paths,
    scene_json,
    truth_path,
    truth_paths,
)
from slamhive.web.small_plots import error_image
from slamhive.web.views.compare import asked_comparison
from slamhive.web.views.runs import LOG_TAIL_BYTES, RUN_ID

blueprint = Blueprint("run_plots", __name__, url_prefix="/runs")

LATEST_TIMESTAMP_S = 2**32
SPARK_KEPT_S = 60


@blueprint.get(f"/{RUN_ID}/figures.json")
def figures(run_id: int) -> Response:
    """All plots of a run, with captions and the reasons for missing ones."""
    services = hive()
    run = services.runs.get(run_id)
    series = services.runs.series(run_id)
    colour = colour_of(run.algorithm, (entry.name for entry in services.catalogue.algorithms()))
    track = series.groundtruth or series.estimate
    return make_response(
        jsonify(
            figures=run_figures(series, run.algorithm, colour),
            captions=captions(series, None if run.protocol is None else run.protocol.label),
            reasons=series.reasons,
            timeline=timeline(series),
            best_plane="xy" if track is None else best_plane(track),
        )
    )


@blueprint.get(f"/{RUN_ID}/error.svg")
def error_line(run_id: int) -> Response:
    """The error over time as a sparkline for lists, which load it when its row comes into view."""
    response = Response(error_image(hive().runs.error_over_time(run_id)), mimetype="image/svg+xml")
    response.cache_control.private = True
    response.cache_control.max_age = SPARK_KEPT_S
    return response


@blueprint.get(f"/{RUN_ID}/moment.json")
def moment(run_id: int) -> Response:
    """The error, the frame, and what the sensors saw at ``timestamp``, a header timestamp in s."""
    services = hive()
    run = services.runs.get(run_id)
    found = services.runs.moment(run_id, asked_timestamp_s())
    views = scenes.sensor_views(services, run, found.shown_at_s)
    return make_response(jsonify(words=scenes.words(found), views=views))


def asked_timestamp_s() -> float:
    """``timestamp`` of the request; raises InvalidInput."""
    timestamp_s = request.args.get("timestamp", type=float)
    if timestamp_s is None or not 0 <= timestamp_s <= LATEST_TIMESTAMP_S:
        raise InvalidInput(
            f"timestamp expects a time in s, got {request.args.get('timestamp', '')[:40]!r}",
            f"give a header timestamp in s, up to {LATEST_TIMESTAMP_S:g}",
        )
    return timestamp_s


@blueprint.get(f"/{RUN_ID}/log.json")
def log_tail(run_id: int) -> Response:
    """The end of the log of a run, for its page while it is going on."""
    return make_response(jsonify(log=hive().runs.log(run_id, LOG_TAIL_BYTES)))


@blueprint.get(f"/{RUN_ID}/figures/<figure>.csv")
def figure_data(run_id: int, figure: str) -> Response:
    """The data of one plot as CSV."""
    response = Response(figure_csv(hive().runs.series(run_id), figure), mimetype="text/csv")
    response.headers["Content-Disposition"] = f'attachment; filename="run-{run_id}-{figure}.csv"'
    return response


# -- the data of 3D views: of a run with its map, of a comparison, and of a dataset ------------------------------------

scenes_blueprint = Blueprint("scenes", __name__)

DETAILS = ("sample", "thinned", "compared")
"""How points of a map are chosen; the last one adds their distance to the reference map."""


@scenes_blueprint.get(f"/runs/{RUN_ID}/scene.json")
def run(run_id: int) -> Response:
    """All trajectories of a run, the ground truth, and where the points of its map can be had."""
    services = hive()
    record = services.runs.get(run_id)
    scene = services.runs.scene(record)
    dataset = dataset_of(services, record.dataset)
    cloud, without_map = None, ""
    if scene.to_scene is not None:
        there = url_for("scenes.run_map", run_id=run_id)
        reference = reference_of(dataset) if scene.aligned else None
        cloud, without_map = _map(services.map_views, services.runs.folder(run_id).map, there, reference)
    notes = [*scene.reasons, *filter(None, [without_map])]
    paths = [*run_paths(record.algorithm, scene, algorithm_names(services)), *truth_paths(scene)]
    return _answer(f"Run {run_id}", paths, cloud, notes, z_up=scene.aligned and is_z_up(dataset))


@scenes_blueprint.get(f"/runs/{RUN_ID}/map.bin")
def run_map(run_id: int) -> Response:
    """At most 100,000 points of the map of a run, in the frame of its 3D view."""
    services = hive()
    record = services.runs.get(run_id)
    frame = services.runs.map_frame(record)
    if frame.to_scene is None:
        raise NotFound(f"the place of run {run_id}'s map relative to the ground truth is unknown", "download the file")
    reference = reference_of(dataset_of(services, record.dataset)) if frame.aligned else None
    return _points(services.map_views, services.runs.folder(run_id).map, reference, frame.to_scene)


@scenes_blueprint.get("/compare/scene.json")
def comparison() -> Response:
    """The evaluated trajectories of several runs on one dataset, that of the first run."""
    services = hive()
    compared = asked_comparison()
    first = compared.runs[0].dataset
    # Each run with the number of its column, which decides its colour.
    columns = enumerate(compared.columns)
    here = [(place, record) for place, column in columns for record in column.runs if record.dataset == first]
    fingerprint = None if compared.protocol is None else compared.protocol.fingerprint
    scenes = {} if fingerprint is None else {run.id: services.runs.scene(run, fingerprint) for _, run in here}
    shown = {run_id: scene for run_id, scene in scenes.items() if scene.aligned}
    paths = [
        ShownPath(
            f"run {record.id}, {record.algorithm}", RUN_COLOURS[place % len(RUN_COLOURS)], shown[record.id].paths[0]
        )
        for place, record in here
        if record.id in shown
    ]
    truth = [path for scene in shown.values() for path in truth_paths(scene)][:1]
    notes = [
        _left_out([record.id for record in compared.runs if record.dataset != first], f"not on {first}"),
        _left_out([record.id for _, record in here if record.id not in shown], "not evaluated under this protocol"),
    ]
    dataset = dataset_of(services, compared.runs[0].dataset)
    return _answer("Comparison of runs", [*paths, *truth], None, list(filter(None, notes)), z_up=is_z_up(dataset))


@scenes_blueprint.get("/compare/moment.json")
def comparison_moment() -> Response:
    """The error and the frame of each run at ``timestamp``, and what the sensors of the baseline saw."""
    services = hive()
    compared = asked_comparison()
    base = compared.columns[compared.baseline].runs[0]
    fingerprint = None if compared.protocol is None else compared.protocol.fingerprint
    timestamp_s = asked_timestamp_s()
    here = [record for record in compared.runs if record.dataset == base.dataset]
    found = {record.id: services.runs.moment(record.id, timestamp_s, fingerprint) for record in here}
    lines = [f"Run {run_id}: {scenes.words(moment)}" for run_id, moment in found.items()]
    views = scenes.sensor_views(services, base, found[base.id].shown_at_s)
    return make_response(jsonify(words="\n".join(lines), views=views))


@scenes_blueprint.get("/datasets/<name>/scene.json")
def dataset(name: str) -> Response:
    """The ground truth of a dataset, and where the points of its reference map can be had."""
    services = hive()
    shown = services.catalogue.dataset(name)
    path = None if shown.groundtruth_path is None else path_of(TRUTH, shown.groundtruth_path)
    if path is None:
        raise NotFound(f"dataset {name} has no ground truth to show")
    cloud, without_map = None, ""
    reference = reference_of(shown)
    if reference is not None:
        cloud, without_map = _map(services.map_views, reference, url_for("scenes.dataset_map", name=name), None)
    notes = list(filter(None, [without_map]))
    return _answer(f"Dataset {name}", [truth_path(path)], cloud, notes, z_up=is_z_up(shown))


@scenes_blueprint.get("/datasets/<name>/map.bin")
def dataset_map(name: str) -> Response:
    """At most 100,000 points of the reference map of a dataset."""
    services = hive()
    reference = reference_of(services.catalogue.dataset(name))
    if reference is None:
        raise NotFound(f"dataset {name} has no reference map")
    return _points(services.map_views, reference, None, IDENTITY)


def _answer(title: str, paths: list[ShownPath], cloud: ShownMap | None, notes: list[str], **more: Any) -> Response:
    return make_response(jsonify(scene_json(title, paths, cloud, notes, **more)))


def _map(views: MapViews, path: Path, there: str, reference: Path | None) -> tuple[ShownMap | None, str]:
    """A map; otherwise None, and a sentence that says why."""
    try:
        return ShownMap(there, views.size(path, path.name), reference is not None), ""
    except NotFound:
        return None, f"There is no {path.name}, so no map is shown."
    except InvalidInput as error:
        return None, f"The map is not shown: {error}."


def _points(views: MapViews, path: Path, reference: Path | None, to_scene: Similarity) -> Response:
    """The points of a map with the ``detail`` of the request."""
    detail = request.args.get("detail", "thinned")
    if detail not in DETAILS:
        raise InvalidInput(f"detail={detail[:40]!r} is not allowed", f"use {', '.join(DETAILS)}")
    if detail == "sample":
        cloud = views.sample(path, path.name)
    elif detail == "thinned":
        cloud = views.thinned(path, path.name)
    elif reference is not None:
        cloud = views.compared(path, path.name, reference, to_scene)
    else:
        raise NotFound("there is no reference map to compare with", "use detail=thinned")
    return Response(cloud_bytes(cloud, to_scene), mimetype="application/octet-stream")


def _left_out(run_ids: Sequence[int], why: str) -> str:
    """A sentence about runs that are not shown; empty without any."""
    if not run_ids:
        return ""
    return f"Not shown, because {why}: {'run' if len(run_ids) == 1 else 'runs'} {', '.join(map(str, run_ids))}."
