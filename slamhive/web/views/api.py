"""The web API, version 1: JSON in, JSON out. See ``docs/web.md``."""

from __future__ import annotations

from typing import Annotated

from flask import Blueprint, Response, request, url_for
from pydantic import BaseModel, ConfigDict, Field

from slamhive.errors import InvalidInput, NotFound
from slamhive.schema.catalogue import Algorithm
from slamhive.schema.matching import Match
from slamhive.schema.run import Run
from slamhive.schema.submission import OPTIONS, Submission
from slamhive.services.configurations import configuration_document
from slamhive.services.datasets import dataset_document
from slamhive.web.configuration_query import CONFIGURATION_ID, ConfigurationQuery
from slamhive.web.context import hive
from slamhive.web.json_exchange import answer, read_body
from slamhive.web.run_query import EXPORT_LIMIT, RunQuery
from slamhive.web.security import require_api_header
from slamhive.web.views.runs import LARGEST_RUN_ID, RUN_ID

blueprint = Blueprint("api", __name__, url_prefix="/api/v1")
blueprint.before_request(require_api_header)


class _EvaluateBody(BaseModel):
    """Which runs to evaluate: ``runs``, or all that have not been if it is null."""

    model_config = ConfigDict(extra="forbid", strict=True)
    runs: list[Annotated[int, Field(ge=1, le=LARGEST_RUN_ID)]] | None = None
    alignment: str | None = None
    protocol: str | None = None


@blueprint.get("/runs")
def runs() -> Response:
    """A page of runs; the arguments are those of the runs page, ``next`` leads to the page after."""
    services = hive()
    query = RunQuery.from_args(request.args, services.searches.vocabulary(), EXPORT_LIMIT)
    page = services.runs.page(query.search, query.sort, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.runs", **query.at(page.next_key).args())
    return answer({"runs": [Run.of(run).content for run in page.records], "total": page.total, "next": following})


@blueprint.get(f"/runs/{RUN_ID}")
def run(run_id: int) -> Response:
    """One run with its metrics, evaluations and events."""
    return answer(hive().runs.in_full(run_id).content)


@blueprint.post("/runs")
def submit() -> Response:
    """Queue runs; answers with them."""
    queued = hive().runs.submit(read_body(Submission))
    return answer({"runs": [Run.of(run).content for run in queued]}, 201)


@blueprint.post("/runs/preview")
def preview() -> Response:
    """Check a submission without queueing it; answers with the sensors and what is taken from them."""
    return answer(Match.of_match(hive().configurations.check(read_body(Submission)).match).content)


@blueprint.post(f"/runs/{RUN_ID}/cancel")
def cancel(run_id: int) -> Response:
    """Ask for the run to be ended."""
    return answer(Run.of(hive().runs.cancel(run_id)).content, 202)


@blueprint.post(f"/runs/{RUN_ID}/retry")
def retry(run_id: int) -> Response:
    """Queue the same again as a new run."""
    return answer(Run.of(hive().runs.retry(run_id)).content, 201)


@blueprint.post("/evaluations")
def evaluate() -> Response:
    """Queue evaluations."""
    body = read_body(_EvaluateBody)
    if body.alignment is not None and body.protocol is not None:
        raise InvalidInput("alignment and protocol exclude each other", "give one of them")
    OPTIONS["alignment"].check(body.alignment)
    return answer({"queued": len(hive().evaluations.queue(body.runs, body.protocol or body.alignment))}, 202)


@blueprint.get("/algorithms")
def algorithms() -> Response:
    """All algorithms."""
    return answer({"algorithms": [Algorithm.of(entry).content for entry in hive().catalogue.algorithms()]})


@blueprint.get("/algorithms/<name>")
def algorithm(name: str) -> Response:
    """One algorithm."""
    return answer(Algorithm.of(hive().catalogue.algorithm(name)).content)


@blueprint.get("/configurations")
def configurations() -> Response:
    """A page of configurations; the arguments are those of the page, ``next`` leads on."""
    query = ConfigurationQuery.from_args(request.args)
    page = hive().configurations.page(query.filter, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.configurations", **query.at(page.next_key).args())
    return answer(
        {
            "configurations": [configuration_document(record).content for record in page.records],
            "total": page.total,
            "next": following,
        }
    )


@blueprint.get(f"/configurations/{CONFIGURATION_ID}")
def configuration(configuration_id: int) -> Response:
    """One configuration."""
    return answer(configuration_document(hive().configurations.get(configuration_id)).content)


@blueprint.get("/datasets")
def datasets() -> Response:
    """All datasets."""
    return answer({"datasets": [dataset_document(entry).content for entry in hive().catalogue.datasets()]})


@blueprint.get("/datasets/<name>/check")
def dataset_check(name: str) -> Response:
    """The last report of the checks of one dataset."""
    report = hive().dataset_checks.stored(hive().catalogue.dataset(name))
    if report is None:
        raise NotFound(f"dataset {name} has not been checked, or has changed since", f"slamhive dataset check {name}")
    return answer(report.content)


@blueprint.get("/datasets/<name>")
def dataset(name: str) -> Response:
    """One dataset."""
    return answer(dataset_document(hive().catalogue.dataset(name)).content)
