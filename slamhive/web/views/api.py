"""The web API, version 1: JSON in, JSON out. See ``docs/web.md``."""

from __future__ import annotations

from typing import Annotated

from flask import Blueprint, Response, request, url_for
from pydantic import BaseModel, ConfigDict, Field

from slamhive.domain.variant import variant_from_json
from slamhive.errors import InvalidInput
from slamhive.services.configurations import Submission, configuration_to_json
from slamhive.services.datasets import algorithm_to_json, dataset_to_json
from slamhive.services.runs import evaluation_to_json, run_to_json
from slamhive.web.configuration_query import CONFIGURATION_ID, ConfigurationQuery
from slamhive.web.context import hive
from slamhive.web.json_exchange import answer, read_body
from slamhive.web.run_form import checked_alignment
from slamhive.web.run_query import EXPORT_LIMIT, RunQuery
from slamhive.web.security import require_api_header
from slamhive.web.views.runs import LARGEST_RUN_ID, RUN_ID

blueprint = Blueprint("api", __name__, url_prefix="/api/v1")
blueprint.before_request(require_api_header)


class _StepBody(BaseModel):
    """A pre-processing step, as a run tells it; without sensors it is meant for all that it can treat."""

    model_config = ConfigDict(extra="forbid", strict=True)
    kind: str
    sensors: list[str] = []
    options: dict[str, int | float | str | bool] = {}


class _SubmitBody(BaseModel):
    """The body of a submission: the fields of :class:`Submission`, strictly typed."""

    model_config = ConfigDict(extra="forbid", strict=True)
    algorithm: str
    dataset: str
    parameters: dict[str, int | float | str | bool | list[float]] = {}
    repeat: int = 1
    executor: str | None = None
    seed: int = 0
    playback_mode: str = "realtime"
    playback_rate: float = 1.0
    evaluate: bool = True
    alignment: str | None = None
    cpu_cores: float | None = None
    memory_mb: int | None = None
    timeout_s: float | None = None
    priority: int = 0
    variant: list[_StepBody] = []


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
    return answer({"runs": [run_to_json(run) for run in page.records], "total": page.total, "next": following})


@blueprint.get(f"/runs/{RUN_ID}")
def run(run_id: int) -> Response:
    """One run with its metrics, evaluations and events."""
    services = hive()
    content = run_to_json(services.runs.get(run_id))
    content["evaluations"] = [
        evaluation_to_json(entry, services.runs.folder(run_id)) for entry in services.evaluations.of_run(run_id)
    ]
    content["events"] = [
        {
            "at": event.at.isoformat(timespec="milliseconds"),
            "from": None if event.from_state is None else event.from_state.value,
            "to": event.to_state.value,
            "why": event.why,
        }
        for event in services.runs.events(run_id)
    ]
    return answer(content)


@blueprint.post("/runs")
def submit() -> Response:
    """Queue runs; answers with them."""
    body = read_body(_SubmitBody)
    fields = body.model_dump()
    queued = hive().runs.submit(Submission(**{**fields, "variant": variant_from_json(fields["variant"])}))
    return answer({"runs": [run_to_json(run) for run in queued]}, 201)


@blueprint.post(f"/runs/{RUN_ID}/cancel")
def cancel(run_id: int) -> Response:
    """Ask for the run to be ended."""
    return answer(run_to_json(hive().runs.cancel(run_id)), 202)


@blueprint.post(f"/runs/{RUN_ID}/retry")
def retry(run_id: int) -> Response:
    """Queue the same again as a new run."""
    return answer(run_to_json(hive().runs.retry(run_id)), 201)


@blueprint.post("/evaluations")
def evaluate() -> Response:
    """Queue evaluations."""
    body = read_body(_EvaluateBody)
    if body.alignment is not None and body.protocol is not None:
        raise InvalidInput("alignment and protocol exclude each other", "give one of them")
    name = body.protocol or checked_alignment(body.alignment)
    return answer({"queued": len(hive().evaluations.queue(body.runs, name))}, 202)


@blueprint.get("/algorithms")
def algorithms() -> Response:
    """All algorithms."""
    return answer({"algorithms": [algorithm_to_json(entry) for entry in hive().catalogue.algorithms()]})


@blueprint.get("/algorithms/<name>")
def algorithm(name: str) -> Response:
    """One algorithm."""
    return answer(algorithm_to_json(hive().catalogue.algorithm(name)))


@blueprint.get("/configurations")
def configurations() -> Response:
    """A page of configurations; the arguments are those of the page, ``next`` leads on."""
    query = ConfigurationQuery.from_args(request.args)
    page = hive().configurations.page(query.filter, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.configurations", **query.at(page.next_key).args())
    return answer(
        {
            "configurations": [configuration_to_json(record) for record in page.records],
            "total": page.total,
            "next": following,
        }
    )


@blueprint.get(f"/configurations/{CONFIGURATION_ID}")
def configuration(configuration_id: int) -> Response:
    """One configuration."""
    return answer(configuration_to_json(hive().configurations.get(configuration_id)))


@blueprint.get("/datasets")
def datasets() -> Response:
    """All datasets."""
    return answer({"datasets": [dataset_to_json(entry) for entry in hive().catalogue.datasets()]})


@blueprint.get("/datasets/<name>")
def dataset(name: str) -> Response:
    """One dataset."""
    return answer(dataset_to_json(hive().catalogue.dataset(name)))
