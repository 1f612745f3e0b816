"""Experiments: progress, previews, starts and changes."""

from __future__ import annotations

from dataclasses import fields
from typing import IO

from flask import Response, request, url_for

from slamhive.documents.api import (
    AnalysesDocument,
    AnalysisDocument,
    AnalysisRequest,
    AnalysisWithFile,
    CellPageDocument,
    CheckedFileDocument,
    ExperimentRequest,
    ExperimentsDocument,
    ExperimentWithFile,
    GridAnswer,
    ListingRequest,
    Removal,
    RepeatsRequest,
    VisibilityRequest,
    YamlRequest,
)
from slamhive.documents.challenge import (
    Challenge,
    ChallengeRanking,
    ChallengesDocument,
    ChallengeSubmission,
    ChallengeSubmissions,
    ImageEntry,
)
from slamhive.documents.claims import ClaimsDocument
from slamhive.documents.experiment import (
    CellDocument,
    Decision,
    ExperimentPreviewDocument,
    GridDocument,
    SearchStanding,
)
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.services.experiments import ExperimentSource
from slamhive.services.sharing import SharingChange
from slamhive.services.stored_analyses import MEDIA_TYPES
from slamhive.web import context
from slamhive.web.api.operation import (
    CELL_ARGUMENTS,
    ENTRY_ARGUMENTS,
    GRID_ARGUMENTS,
    PHASE_ARGUMENTS,
    TABLE,
    Bytes,
    Section,
)
from slamhive.web.context import hive
from slamhive.web.experiment_fields import SOURCE
from slamhive.web.queries import CellsQuery, GridQuery
from slamhive.web.request_input import answer
from slamhive.web.views.challenges import MOST_SENT_BYTES, cancel_submission, own_submissions, send_body, send_image


@TABLE.get(Section.EXPERIMENTS, "/experiments", ExperimentsDocument)
def experiments() -> ExperimentsDocument:
    """All experiments with their progress, the newest first."""
    return ExperimentsDocument(experiments=hive().experiments.list())


@TABLE.post(Section.EXPERIMENTS, "/experiments", ExperimentStatusDocument, body=ExperimentRequest, status=201)
def start_experiment(body: ExperimentRequest) -> ExperimentStatusDocument:
    """Store the experiment in the file and queue its runs. The same file again completes an interrupted start."""
    source = ExperimentSource(body.yaml, SOURCE)
    return hive().experiments.start(source, body.executor, visibility=body.visibility)


@TABLE.post(Section.EXPERIMENTS, "/experiments/preview", ExperimentPreviewDocument, body=YamlRequest)
def preview_experiment(body: YamlRequest) -> ExperimentPreviewDocument:
    """Preview the experiment in the file; nothing is stored."""
    return hive().experiments.preview(ExperimentSource(body.yaml, SOURCE))


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}", ExperimentWithFile)
def experiment(name: str) -> ExperimentWithFile:
    """The progress of one experiment, its file, its axes, and what it says so far in a sentence."""
    services = hive().experiments
    found = services.status(name)
    return ExperimentWithFile(
        **{field.name: getattr(found, field.name) for field in fields(found)},
        yaml=services.source(name).text,
        axes=services.axes(name),
        answer=services.answer(name),
    )


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/cells", CellPageDocument, CELL_ARGUMENTS)
def experiment_cells(name: str) -> CellPageDocument:
    """A page of the configurations of one experiment, with runs and metrics."""
    query = CellsQuery.from_args(request.args)
    page = hive().experiments.cells(name, query.after, query.limit)
    following = None
    if page.next_number is not None:
        following = url_for("api.experiment_cells", name=name, after=page.next_number, limit=query.limit)
    return CellPageDocument(cells=tuple(map(CellDocument.of, page.cells)), total=page.total, next=following)


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/grid", GridAnswer, GRID_ARGUMENTS)
def experiment_grid(name: str) -> GridAnswer:
    """Runs by state, and failures by reason, over two axes of one experiment."""
    services = hive().experiments
    query = GridQuery.from_args(request.args, {axis: len(found) for axis, found in services.axes(name).items()})
    return GridAnswer(grid=None if query is None else GridDocument.of(services.grid(name, query.rows, query.columns)))


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/decision", Decision)
def experiment_decision(name: str) -> Decision:
    """State of an experiment that finds out which candidate is best."""
    return hive().questions.decision(name)


@TABLE.get(Section.EXPERIMENTS, "/experiments/{name}/search", SearchStanding)
def experiment_search(name: str) -> SearchStanding:
    """State of an experiment that searches for the best of many candidates."""
    return hive().questions.search(name)


@TABLE.post(Section.EXPERIMENTS, "/experiments/{name}/{action}", ExperimentStatusDocument, status=202)
def change_experiment(name: str, action: str) -> ExperimentStatusDocument:
    """Pause, resume or cancel one experiment, or queue its failed runs again."""
    services = hive().experiments
    changes = {
        "pause": services.pause,
        "resume": services.resume,
        "cancel": services.cancel,
        "retry-failed": services.retry_failed,
    }
    changes[action](name)
    return services.status(name)


@TABLE.post(Section.EXPERIMENTS, "/experiments/{name}/share", ExperimentStatusDocument, body=VisibilityRequest)
def share_experiment(name: str, body: VisibilityRequest) -> ExperimentStatusDocument:
    """Choose who may see one experiment and its runs; its owner may, and admins."""
    hive().sharings.experiment(name, SharingChange(body.visibility))
    return hive().experiments.status(name)


@TABLE.post(
    Section.EXPERIMENTS, "/experiments/{name}/repeats", ExperimentStatusDocument, body=RepeatsRequest, status=201
)
def add_repeats(name: str, body: RepeatsRequest) -> ExperimentStatusDocument:
    """Add repeats of each configuration and seed of one experiment."""
    hive().experiments.add_repeats(name, body.count)
    return hive().experiments.status(name)


# -- analyses: reports that a worker computes from a file --------------------------------------------------------------


@TABLE.get(Section.ANALYSES, "/analyses", AnalysesDocument)
def analyses() -> AnalysesDocument:
    """The listed analyses."""
    return AnalysesDocument(analyses=tuple(map(AnalysisDocument.of, hive().stored_analyses.listed())))


@TABLE.post(Section.ANALYSES, "/analyses", AnalysisDocument, body=AnalysisRequest, status=201)
def create_analysis(body: AnalysisRequest) -> AnalysisDocument:
    """Store an analysis file and queue its computation."""
    record = hive().stored_analyses.create(body.yaml, listed=body.listed)
    computer = context.analysis_computer()
    if computer is not None:
        computer.wake()
    return AnalysisDocument.of(record)


@TABLE.post(Section.ANALYSES, "/analyses/check", CheckedFileDocument, body=YamlRequest)
def check_analysis(body: YamlRequest) -> CheckedFileDocument:
    """Check an analysis file without storing it."""
    return CheckedFileDocument(name=hive().stored_analyses.check(body.yaml))


@TABLE.get(Section.ANALYSES, "/analyses/{token}", AnalysisWithFile)
def analysis(token: str) -> AnalysisWithFile:
    """One analysis: its state, its file, and the files of its report."""
    return hive().analysis_files.document(token)


@TABLE.get(Section.ANALYSES, "/analyses/{token}/report", ("application/json",))
def analysis_report(token: str) -> Response:
    """The whole report of one analysis: its plots and tables as data (`report.schema.json`)."""
    return answer(hive().analysis_files.report(token))


@TABLE.get(Section.ANALYSES, "/analyses/{token}/files/{key}", tuple(sorted(set(MEDIA_TYPES.values()))))
def analysis_file(token: str, key: str) -> Response:
    """One file of the report: a plot for print, a table, the self-contained page, or everything as a zip file."""
    content = hive().analysis_files.get(token, key)
    response = Response(content, mimetype=MEDIA_TYPES[key.rpartition(".")[2]])
    response.headers["Content-Disposition"] = f'attachment; filename="{key}"'
    return response


@TABLE.post(Section.ANALYSES, "/analyses/{token}/recompute", AnalysisDocument, status=202)
def recompute_analysis(token: str) -> AnalysisDocument:
    """Compute one analysis again from the current runs."""
    return AnalysisDocument.of(hive().stored_analyses.recompute(token))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/list", AnalysisDocument, body=ListingRequest)
def list_analysis(token: str, body: ListingRequest) -> AnalysisDocument:
    """Show one analysis in the list, or hide it; its address always works."""
    return AnalysisDocument.of(hive().stored_analyses.list_or_not(token, listed=body.listed))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/share", AnalysisDocument, body=VisibilityRequest, status=202)
def share_analysis(token: str, body: VisibilityRequest) -> AnalysisDocument:
    """Choose who may see one analysis. It is computed again, of the runs that each of its readers may see."""
    return AnalysisDocument.of(hive().sharings.analysis(token, SharingChange(body.visibility)))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/delete", Removal)
def delete_analysis(token: str) -> Removal:
    """Delete one analysis for good."""
    hive().stored_analyses.delete(token)
    return Removal(removed=token)


# -- claims of papers --------------------------------------------------------------------------------------------------


@TABLE.get(Section.CLAIMS, "/claims", ClaimsDocument)
def claims() -> ClaimsDocument:
    """The last answers about the claims of papers and READMEs."""
    return ClaimsDocument(files=tuple(hive().claims.all()))


# -- challenges: tasks, rankings, and submissions ----------------------------------------------------------------------


@TABLE.get(Section.CHALLENGES, "/challenges", ChallengesDocument)
def challenges() -> ChallengesDocument:
    """All challenges."""
    return ChallengesDocument(challenges=tuple(hive().challenges.briefs()))


@TABLE.get(Section.CHALLENGES, "/challenges/{name}", Challenge)
def challenge(name: str) -> Challenge:
    """The task of a challenge, its scoring, and its phases."""
    return hive().challenges.get(name)


@TABLE.get(Section.CHALLENGES, "/challenges/{name}/ranking", ChallengeRanking, PHASE_ARGUMENTS)
def challenge_ranking(name: str) -> ChallengeRanking:
    """The ranking of a phase; without teams while its scores are hidden."""
    return hive().challenges.ranking(name, request.args.get("phase") or None)


@TABLE.get(Section.CHALLENGES, "/challenges/{name}/submissions", ChallengeSubmissions)
def challenge_submissions(name: str) -> ChallengeSubmissions:
    """The submissions of the caller, the newest first."""
    return ChallengeSubmissions(submissions=tuple(own_submissions(name)))


@TABLE.post(
    Section.CHALLENGES,
    "/challenges/{name}/submissions",
    ChallengeSubmission,
    arguments=ENTRY_ARGUMENTS,
    body=Bytes(MOST_SENT_BYTES),
    status=202,
)
def submit_to_challenge(name: str, body: IO[bytes]) -> ChallengeSubmission:
    """Submit a zip archive of trajectories, each named after its sequence.

    The same files sent again on the same day are the same submission, and count once.
    """
    return send_body(name, request.args.get("team", ""), request.args.get("phase", ""), body)


@TABLE.post(Section.CHALLENGES, "/challenges/{name}/images", ChallengeSubmission, body=ImageEntry, status=202)
def submit_image_to_challenge(name: str, body: ImageEntry) -> ChallengeSubmission:
    """Submit an image, which runs on the recordings of the challenge.

    The answer comes when the upload has been checked. That takes about ten seconds for each GB.
    """
    return send_image(name, body)


@TABLE.post(Section.CHALLENGES, "/challenges/{name}/submissions/{submission}/cancel", ChallengeSubmission)
def cancel_challenge_submission(name: str, submission: str) -> ChallengeSubmission:
    """Cancel a submission whose result is not shown yet. It still counts for its day."""
    return cancel_submission(name, submission)
