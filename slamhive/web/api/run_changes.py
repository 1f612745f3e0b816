"""Changes of runs: start, cancel, evaluate, tag, delete and restore."""

from __future__ import annotations

from slamhive.domain.found_action import FoundAction
from slamhive.domain.notes import NotesChange
from slamhive.errors import InvalidInput
from slamhive.schema.api_answers import ActedOn, DeletedRun, Queued, Removed, RunNumbers, Runs, TrashedRuns
from slamhive.schema.api_requests import (
    DeletionRequest,
    EvaluationRequest,
    FoundEvaluation,
    FoundRuns,
    FoundSharing,
    FoundTags,
    NotesRequest,
    RunSelection,
    SharingRequest,
    ShownProtocolRequest,
    TagsRequest,
)
from slamhive.schema.matching import Match
from slamhive.schema.run import Run
from slamhive.schema.submission import OPTIONS, Submission
from slamhive.services.found_runs import change_found
from slamhive.services.search_actions import as_expected
from slamhive.services.sharing import SharingChange
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive


@TABLE.post(Section.RUN_CHANGES, "/runs", Runs, body=Submission, status=201)
def submit(body: Submission) -> Runs:
    """Queue runs of one configuration; answers with them."""
    return Runs(runs=tuple(map(Run.of, hive().runs.submit(body))))


@TABLE.post(Section.RUN_CHANGES, "/runs/preview", Match, body=Submission)
def preview(body: Submission) -> Match:
    """Check a submission without queueing it; answers with the sensors and what is taken from them."""
    return Match.of_match(hive().configurations.check(body).match)


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/cancel", Run, status=202)
def cancel(run_id: int) -> Run:
    """Cancel a queued run, or ask for the end of an active one."""
    return Run.of(hive().runs.cancel(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/retry", Run, status=201)
def retry(run_id: int) -> Run:
    """Queue the same again as a new run."""
    return Run.of(hive().runs.retry(run_id))


@TABLE.post(Section.RUN_CHANGES, "/evaluations", Queued, body=EvaluationRequest, status=202)
def evaluate(body: EvaluationRequest) -> Queued:
    """Queue evaluations."""
    if body.alignment is not None and body.protocol is not None:
        raise InvalidInput("alignment and protocol exclude each other", "give one of them")
    OPTIONS["alignment"].check(body.alignment)
    return Queued(queued=len(hive().evaluations.queue(body.runs, body.protocol or body.alignment)))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/tools", Queued, status=202)
def evaluate_as_tools(run_id: int) -> Queued:
    """Queue an evaluation of one run as each published tool does it."""
    services = hive()
    services.check_writable()
    return Queued(queued=len(services.comparisons.queue(run_id)))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/protocol", Run, body=ShownProtocolRequest)
def show_protocol(run_id: int, body: ShownProtocolRequest) -> Run:
    """Choose the protocol whose metrics lists and searches show for one run."""
    services = hive()
    services.check_writable()
    services.current_protocols.use([run_id], body.protocol)
    return Run.of(services.runs.get(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/notes", Run, body=NotesRequest)
def annotate(run_id: int, body: NotesRequest) -> Run:
    """Replace the note or the tags of one run."""
    services = hive()
    services.notes.replace(run_id, body.note, body.tags)
    return Run.of(services.runs.get(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/tags", Runs, body=TagsRequest)
def tag(body: TagsRequest) -> Runs:
    """Add and remove tags of some runs."""
    hive().notes.change(body.runs, NotesChange(add=body.add, remove=body.remove))
    records = hive().store.read(lambda t: t.runs.get_many(body.runs, with_metrics=True))
    return Runs(runs=tuple(map(Run.of, records)))


@TABLE.post(Section.RUN_CHANGES, "/runs/share", Runs, body=SharingRequest)
def share(body: SharingRequest) -> Runs:
    """Choose who may see some runs; their owner may, and admins."""
    return Runs(runs=tuple(map(Run.of, hive().sharings.runs(body.runs, SharingChange(body.visibility)))))


@TABLE.post(Section.RUN_CHANGES, "/runs/delete", RunNumbers, body=RunSelection)
def delete(body: RunSelection) -> RunNumbers:
    """Move runs that have ended to the trash, with their files."""
    return RunNumbers(runs=tuple(run.id for run in hive().trash.delete(body.runs)))


@TABLE.get(Section.RUN_CHANGES, "/trash", TrashedRuns)
def trash() -> TrashedRuns:
    """The runs in the trash, the last deleted first."""
    return TrashedRuns(runs=tuple(map(DeletedRun.of, hive().trash.listed())))


@TABLE.post(Section.RUN_CHANGES, "/trash/restore", RunNumbers, body=RunSelection)
def restore(body: RunSelection) -> RunNumbers:
    """Take runs out of the trash, under their old numbers."""
    return RunNumbers(runs=tuple(hive().trash.restore(body.runs)))


@TABLE.post(Section.RUN_CHANGES, "/trash/empty", Removed)
def empty_trash() -> Removed:
    """Remove the files of all deleted runs for good."""
    return Removed(removed=hive().trash.empty())


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.EVALUATE}", ActedOn, body=FoundEvaluation, status=202)
def evaluate_found(body: FoundEvaluation) -> ActedOn:
    """Queue an evaluation of each run of a search that succeeded."""
    return _change_found(FoundAction.EVALUATE, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.RETRY}", ActedOn, body=FoundRuns, status=201)
def retry_found(body: FoundRuns) -> ActedOn:
    """Queue a new run for each run of a search that has ended."""
    return _change_found(FoundAction.RETRY, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.TAGS}", ActedOn, body=FoundTags)
def tag_found(body: FoundTags) -> ActedOn:
    """Add and remove tags of all runs of a search."""
    return _change_found(FoundAction.TAGS, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.SHARE}", ActedOn, body=FoundSharing)
def share_found(body: FoundSharing) -> ActedOn:
    """Choose who may see all runs of a search; their owner may, and admins."""
    return _change_found(FoundAction.SHARE, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.DELETE}", ActedOn, body=FoundRuns)
def delete_found(body: FoundRuns) -> ActedOn:
    """Move all runs of a search that have ended to the trash."""
    return _change_found(FoundAction.DELETE, body)


@TABLE.post(Section.RUN_CHANGES, "/trash/restore-together", RunNumbers, body=DeletionRequest)
def restore_together(body: DeletionRequest) -> RunNumbers:
    """Take out of the trash what was deleted together."""
    trash = hive().trash
    return RunNumbers(runs=tuple(trash.restore(trash.deleted_together(body.deleted_at))))


def _change_found(action: FoundAction, body: FoundRuns) -> ActedOn:
    services = hive()
    run_ids = as_expected(services.searches.find(body.where), body.count)
    return ActedOn.of(change_found(services, action, run_ids, body))
