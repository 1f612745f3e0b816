"""Experiments in the web API. See ``docs/web.md``."""

from __future__ import annotations

from typing import Annotated

from flask import Blueprint, Response, request, url_for
from pydantic import BaseModel, ConfigDict, Field

from slamhive.schema import experiment as schema
from slamhive.services.experiments import ExperimentSource
from slamhive.sweep.experiment_model import MAX_REPEATS
from slamhive.web.context import hive
from slamhive.web.experiment_draft import MOST_TEXT
from slamhive.web.experiment_fields import SOURCE
from slamhive.web.experiment_page import CellsQuery, GridQuery
from slamhive.web.json_exchange import answer, read_body
from slamhive.web.security import require_api_header

blueprint = Blueprint("api_experiments", __name__, url_prefix="/api/v1/experiments")
blueprint.before_request(require_api_header)

CHANGE = "<any('pause', 'resume', 'cancel', 'retry-failed'):action>"


class _SourceBody(BaseModel):
    """An experiment as YAML; ``executor`` overrides the one in it."""

    model_config = ConfigDict(extra="forbid", strict=True)
    yaml: Annotated[str, Field(max_length=MOST_TEXT)]
    executor: str | None = None


class _PreviewBody(BaseModel):
    """An experiment as YAML."""

    model_config = ConfigDict(extra="forbid", strict=True)
    yaml: Annotated[str, Field(max_length=MOST_TEXT)]


class _RepeatsBody(BaseModel):
    """How many repeats to add per configuration and seed."""

    model_config = ConfigDict(extra="forbid", strict=True)
    count: Annotated[int, Field(ge=1, le=MAX_REPEATS)]


@blueprint.get("")
def experiments() -> Response:
    """All experiments, newest first."""
    return answer({"experiments": [schema.ExperimentStatus.of(status).content for status in hive().experiments.list()]})


@blueprint.post("/preview")
def preview() -> Response:
    """Preview an experiment without saving it."""
    body = read_body(_PreviewBody)
    return answer(schema.ExperimentPreview.of(hive().experiments.preview(ExperimentSource(body.yaml, SOURCE))).content)


@blueprint.post("")
def start() -> Response:
    """Save the experiment and queue its runs."""
    body = read_body(_SourceBody)
    started = hive().experiments.start(ExperimentSource(body.yaml, SOURCE), body.executor)
    return answer(schema.ExperimentStatus.of(started).content, 201)


@blueprint.get("/<name>")
def experiment(name: str) -> Response:
    """Progress of one experiment, its file and its axes."""
    services = hive().experiments
    content = schema.ExperimentStatus.of(services.status(name)).content
    content["yaml"] = services.source(name).text
    content["axes"] = {axis: list(values) for axis, values in services.axes(name).items()}
    return answer(content)


@blueprint.get("/<name>/cells")
def cells(name: str) -> Response:
    """A page of configurations with runs and metrics; ``next`` is the address of the following page."""
    query = CellsQuery.from_args(request.args)
    page = hive().experiments.cells(name, query.after, query.limit)
    following = None
    if page.next_number is not None:
        following = url_for("api_experiments.cells", name=name, after=page.next_number, limit=query.limit)
    cells = [schema.Cell.of(cell).content for cell in page.cells]
    return answer({"cells": cells, "total": page.total, "next": following})


@blueprint.get("/<name>/grid")
def grid(name: str) -> Response:
    """Progress over the axes ``rows`` and ``columns``."""
    services = hive().experiments
    query = GridQuery.from_args(request.args, {axis: len(found) for axis, found in services.axes(name).items()})
    grid = None if query is None else schema.Grid.of(services.grid(name, query.rows, query.columns)).content
    return answer({"grid": grid})


@blueprint.post(f"/<name>/{CHANGE}")
def change(name: str, action: str) -> Response:
    """Pause, resume or cancel, or queue failed runs again."""
    services = hive().experiments
    changes = {
        "pause": services.pause,
        "resume": services.resume,
        "cancel": services.cancel,
        "retry-failed": services.retry_failed,
    }
    changes[action](name)
    return answer(schema.ExperimentStatus.of(services.status(name)).content, 202)


@blueprint.post("/<name>/repeats")
def add_repeats(name: str) -> Response:
    """Add repeats of each configuration and seed."""
    hive().experiments.add_repeats(name, read_body(_RepeatsBody).count)
    return answer(schema.ExperimentStatus.of(hive().experiments.status(name)).content, 201)
