"""Experiments: progress, previews, starts and changes."""

from __future__ import annotations

from flask import request, url_for

from slamhive.schema.api_answers import CellPage, Experiments, ExperimentWithFile, GridAnswer
from slamhive.schema.api_requests import ExperimentRequest, RepeatsRequest, VisibilityRequest, YamlRequest
from slamhive.schema.experiment import Cell, ExperimentPreview, ExperimentStatus, Grid
from slamhive.services.experiments import ExperimentSource
from slamhive.services.sharing import SharingChange
from slamhive.web.api.arguments import CELL_ARGUMENTS, GRID_ARGUMENTS
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive
from slamhive.web.experiment_fields import SOURCE
from slamhive.web.experiment_page import CellsQuery, GridQuery


@TABLE.get(Section.EXPERIMENTS, "/experiments", Experiments)
def experiments() -> Experiments:
    """All experiments with their progress, the newest first."""
    return Experiments(experiments=tuple(map(ExperimentStatus.of, hive().experiments.list())))


@TABLE.post(Section.EXPERIMENTS, "/experiments", ExperimentStatus, body=ExperimentRequest, status=201)
def start_experiment(body: ExperimentRequest) -> ExperimentStatus:
    """Store the experiment in the file and queue its runs. The same file again completes an interrupted start."""
    source = ExperimentSource(body.yaml, SOURCE)
    return ExperimentStatus.of(hive().experiments.start(source, body.executor, visibility=body.visibility))


@TABLE.post(Section.EXPERIMENTS, "/experiments/preview", ExperimentPreview, body=YamlRequest)
def preview_experiment(body: YamlRequest) -> ExperimentPreview:
    """Preview the experiment in the file; nothing is stored."""
    return ExperimentPreview.of(hive().experiments.preview(ExperimentSource(body.yaml, SOURCE)))


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}", ExperimentWithFile)
def experiment(name: str) -> ExperimentWithFile:
    """The progress of one experiment, its file and its axes."""
    services = hive().experiments
    return ExperimentWithFile.of(services.status(name), yaml=services.source(name).text, axes=services.axes(name))


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/cells", CellPage, CELL_ARGUMENTS)
def experiment_cells(name: str) -> CellPage:
    """A page of the configurations of one experiment, with runs and metrics."""
    query = CellsQuery.from_args(request.args)
    page = hive().experiments.cells(name, query.after, query.limit)
    following = None
    if page.next_number is not None:
        following = url_for("api.experiment_cells", name=name, after=page.next_number, limit=query.limit)
    return CellPage(cells=tuple(map(Cell.of, page.cells)), total=page.total, next=following)


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/grid", GridAnswer, GRID_ARGUMENTS)
def experiment_grid(name: str) -> GridAnswer:
    """Runs by state, and failures by reason, over two axes of one experiment."""
    services = hive().experiments
    query = GridQuery.from_args(request.args, {axis: len(found) for axis, found in services.axes(name).items()})
    return GridAnswer(grid=None if query is None else Grid.of(services.grid(name, query.rows, query.columns)))


@TABLE.post(Section.EXPERIMENTS, "/experiments/{name}/{action}", ExperimentStatus, status=202)
def change_experiment(name: str, action: str) -> ExperimentStatus:
    """Pause, resume or cancel one experiment, or queue its failed runs again."""
    services = hive().experiments
    changes = {
        "pause": services.pause,
        "resume": services.resume,
        "cancel": services.cancel,
        "retry-failed": services.retry_failed,
    }
    changes[action](name)
    return ExperimentStatus.of(services.status(name))


@TABLE.post(Section.EXPERIMENTS, "/experiments/{name}/share", ExperimentStatus, body=VisibilityRequest)
def share_experiment(name: str, body: VisibilityRequest) -> ExperimentStatus:
    """Choose who may see one experiment and its runs; its owner may, and admins."""
    hive().sharings.experiment(name, SharingChange(body.visibility))
    return ExperimentStatus.of(hive().experiments.status(name))


@TABLE.post(Section.EXPERIMENTS, "/experiments/{name}/repeats", ExperimentStatus, body=RepeatsRequest, status=201)
def add_repeats(name: str, body: RepeatsRequest) -> ExperimentStatus:
    """Add repeats of each configuration and seed of one experiment."""
    hive().experiments.add_repeats(name, body.count)
    return ExperimentStatus.of(hive().experiments.status(name))
