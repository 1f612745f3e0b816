"""The data of the 3D views: of a run with its map, of a comparison, and of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flask import Blueprint, Response, jsonify, make_response, request, url_for

from slamhive.analysis.colours import OKABE_ITO, RUN_COLOURS, colour_of
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput, NotFound
from slamhive.services.hive import Hive
from slamhive.services.run_comparison import RunComparison
from slamhive.services.runs import MapViews, RunScene, path_of
from slamhive.store.records import RunRecord
from slamhive.trajectory.alignment import IDENTITY, Similarity
from slamhive.web.context import hive
from slamhive.web.presenters.scenes import TRUTH, ShownMap, ShownPath, cloud_bytes, scene_json, truth_path
from slamhive.web.views.compare import asked_comparison
from slamhive.web.views.runs import RUN_ID

blueprint = Blueprint("scenes", __name__)

DETAILS = ("sample", "thinned", "compared")
"""How points of a map are chosen; the last one adds their distance to the reference map."""


@blueprint.get(f"/runs/{RUN_ID}/scene.json")
def run(run_id: int) -> Response:
    """All trajectories of a run, the ground truth, and where the points of its map can be had."""
    services = hive()
    record, scene = services.runs.get(run_id), services.runs.scene(run_id)
    dataset = _dataset_of(services, record)
    cloud, without_map = None, ""
    if scene.to_scene is not None:
        there = url_for("scenes.run_map", run_id=run_id)
        reference = _reference(dataset) if scene.aligned else None
        cloud, without_map = _map(services.map_views, services.runs.folder(run_id).map, there, reference)
    notes = [*scene.reasons, *filter(None, [without_map])]
    paths = [*_named(services, record, scene), *_truth(scene)]
    return _answer(f"Run {run_id}", paths, cloud, notes, z_up=scene.aligned and _z_up(dataset))


@blueprint.get(f"/runs/{RUN_ID}/map.bin")
def run_map(run_id: int) -> Response:
    """At most 100,000 points of the map of a run, in the frame of its 3D view."""
    services = hive()
    record = services.runs.get(run_id)
    frame = services.runs.map_frame(record)
    if frame.to_scene is None:
        raise NotFound(f"what moves the map of run {run_id} to the ground truth is not known", "download the file")
    reference = _reference(_dataset_of(services, record)) if frame.aligned else None
    return _points(services.map_views, services.runs.folder(run_id).map, reference, frame.to_scene)


@blueprint.get("/compare/scene.json")
def comparison() -> Response:
    """The evaluated trajectories of several runs on one dataset, that of the first run."""
    services = hive()
    compared = asked_comparison()
    first = compared.runs[0].dataset
    here = [(place, record) for place, record in _by_column(compared) if record.dataset == first]
    fingerprint = None if compared.protocol is None else compared.protocol.fingerprint
    scenes = {} if fingerprint is None else {run.id: services.runs.scene(run.id, fingerprint) for _, run in here}
    shown = {run_id: scene for run_id, scene in scenes.items() if scene.aligned}
    paths = [
        ShownPath(f"run {record.id}, {record.algorithm}", _column_colour(place), shown[record.id].paths[0])
        for place, record in here
        if record.id in shown
    ]
    truth = [path for scene in shown.values() for path in _truth(scene)][:1]
    notes = [
        _left_out([record.id for record in compared.runs if record.dataset != first], f"not on {first}"),
        _left_out([record.id for _, record in here if record.id not in shown], "not evaluated under this protocol"),
    ]
    dataset = _dataset_of(services, compared.runs[0])
    return _answer("Comparison of runs", [*paths, *truth], None, list(filter(None, notes)), z_up=_z_up(dataset))


@blueprint.get("/datasets/<name>/scene.json")
def dataset(name: str) -> Response:
    """The ground truth of a dataset, and where the points of its reference map can be had."""
    services = hive()
    shown = services.catalogue.dataset(name)
    path = None if shown.groundtruth_path is None else path_of(TRUTH, shown.groundtruth_path)
    if path is None:
        raise NotFound(f"dataset {name} has no ground truth to show")
    cloud, without_map = None, ""
    reference = _reference(shown)
    if reference is not None:
        cloud, without_map = _map(services.map_views, reference, url_for("scenes.dataset_map", name=name), None)
    notes = list(filter(None, [without_map]))
    return _answer(f"Dataset {name}", [truth_path(path)], cloud, notes, z_up=_z_up(shown))


@blueprint.get("/datasets/<name>/map.bin")
def dataset_map(name: str) -> Response:
    """At most 100,000 points of the reference map of a dataset."""
    services = hive()
    reference = _reference(services.catalogue.dataset(name))
    if reference is None:
        raise NotFound(f"dataset {name} has no reference map")
    return _points(services.map_views, reference, None, IDENTITY)


def _answer(title: str, paths: list[ShownPath], cloud: ShownMap | None, notes: list[str], **more: Any) -> Response:
    return make_response(jsonify(scene_json(title, paths, cloud, notes, **more)))


def _by_column(compared: RunComparison) -> list[tuple[int, RunRecord]]:
    """Each run with the number of its column, which decides its colour."""
    return [(place, record) for place, column in enumerate(compared.columns) for record in column.runs]


def _column_colour(place: int) -> str:
    return RUN_COLOURS[place % len(RUN_COLOURS)]


def _named(services: Hive, record: RunRecord, scene: RunScene) -> list[ShownPath]:
    """The paths of a run: the first in the algorithm's colour, the others in further ones."""
    colour = colour_of(record.algorithm, (entry.name for entry in services.catalogue.algorithms()))
    colours = [colour, *(other for other in OKABE_ITO if other != colour)]
    several = len(scene.paths) > 1
    return [
        ShownPath(f"{record.algorithm}, {path.kind}" if several else record.algorithm, colours[place], path)
        for place, path in enumerate(scene.paths)
    ]


def _truth(scene: RunScene) -> list[ShownPath]:
    return [] if scene.groundtruth is None else [truth_path(scene.groundtruth)]


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


def _dataset_of(services: Hive, record: RunRecord) -> Dataset | None:
    """The dataset of a run; None if it no longer exists."""
    try:
        return services.catalogue.dataset(record.dataset)
    except NotFound:
        return None


def _reference(dataset: Dataset | None) -> Path | None:
    """The reference map of a dataset."""
    return None if dataset is None or dataset.reference_map is None else dataset.folder / dataset.reference_map


def _z_up(dataset: Dataset | None) -> bool:
    return dataset is not None and dataset.groundtruth is not None and dataset.groundtruth.gravity_aligned
