"""An installation in which something of every kind is stored, by the use cases that users have."""

from __future__ import annotations

import threading
from pathlib import Path

from slamhive.base.clock import utc_now
from slamhive.documents.submission import Submission
from slamhive.domain.accounts import Identity, Role, Scope
from slamhive.domain.configuration import VariantStep
from slamhive.domain.protocol import Alignment
from slamhive.domain.run import NotesChange, RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.evaluation.job import Artefacts
from slamhive.services.accounts import TokenRequest
from slamhive.services.configurations import ConfigurationChange, Label
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.imports.request import ImportRequest
from slamhive.store import AuditAct
from slamhive.store.records import RunSort, SavedSearchRecord
from tests.services.imports.world import make_source
from tests.waiting import eventually

PASSWORD = "four words of everything"
EXPERIMENT = """
name: {name}
description: of {name}
algorithms: tiny
datasets: track
parameters: {{behaviour: good | crash, seconds: {seconds}}}
repeats: 2
executor: process
"""
ANALYSIS = (
    "name: {name}\nselect: {{all: {{where: 'id >= 1'}}}}\nforms:\n- {{form: distributions, metrics: [duration]}}\n"
)


def store_everything(hive: Hive, folder: Path) -> None:
    """Configurations, runs in every state, experiments, evaluations, searches, analyses, imports and accounts."""
    _describe_configurations(hive)
    _end_runs(hive)
    _import_runs(hive, folder)
    _evaluate_otherwise(hive)
    _write_notes(hive)
    _delete_runs(hive)
    _cancel_one_that_runs(hive)
    _save_searches(hive)
    _analyse(hive)
    _edit_definition(hive)
    _leave_waiting(hive)
    _add_accounts(hive)


def _describe_configurations(hive: Hive) -> None:
    book = hive.configurations
    fast = book.create(Submission("tiny", "track", {"seconds": 0.01}), Label("fast", "ends at once", "speed"))
    rarer = (VariantStep("rate", (), {"hz": 2.0}),)
    book.create(Submission("tiny", "track", {"seconds": 5.0}, variant=rarer))
    book.copy(fast.record.id, ConfigurationChange(parameters={"seconds": 9.5}), Label("slow", None, "speed"))
    gone = book.create(Submission("tiny", "track", {"seconds": 7.0}), Label("gone", "deleted again"))
    changed = book.create(Submission("tiny", "track", {"seconds": 8.0}), Label("changed", "a note", "kept"))
    book.modify(changed.record.id, ConfigurationChange(parameters={"seconds": 8.5}))
    book.delete([gone.record.id])
    unsaid = book.create(
        Submission("tiny", "track", {"seconds": 6.0}), Label("unsaid", "nothing is left of it", "left")
    )
    book.describe(unsaid.record.id, Label("", ""))
    book.group("left", [unsaid.record.id], remove=True)


def _end_runs(hive: Hive) -> None:
    """Runs that succeed and fail, one again; an experiment with repeats that were added and failures tried again."""
    hive.runs.submit(Submission("tiny", "track", {"seconds": 0.01}, repeat=2, priority=3, cpu_cores=1))
    (bad,) = hive.runs.submit(Submission("tiny", "track", {"behaviour": "crash", "seconds": 0.01}))
    hive.runs.submit(Submission("tiny", "bare", {"seconds": 0.01}))
    hive.experiments.start(ExperimentSource(EXPERIMENT.format(name="done", seconds=0.01), "done.yaml"))
    hive.worker().run(until_idle=True)
    hive.experiments.add_repeats("done", 1)
    hive.experiments.retry_failed("done")
    hive.runs.retry(bad.id)
    hive.worker().run(until_idle=True)


def _import_runs(hive: Hive, folder: Path) -> None:
    request = ImportRequest(make_source(folder / "elsewhere"), sensors={"": SensorSetup.STEREO})
    assert hive.imports.carry_out(request, lambda _done, _total: None).imported


def _evaluate_otherwise(hive: Hive) -> None:
    """A second protocol for some, which is the current one of one; the evaluations of others still wait."""
    evaluations = hive.evaluations
    evaluations.queue([1, 2], hive.protocols.named("sim3"), Artefacts.METRICS)
    hive.worker().run(until_idle=True)
    fingerprints = set(hive.current_protocols.figures(1))
    (shown,) = {hive.runs.get(1).protocol.fingerprint}  # type: ignore[union-attr]
    hive.current_protocols.use([1], (fingerprints - {shown}).pop())
    evaluations.queue([1, 2], hive.protocols.named("none"))


def _write_notes(hive: Hive) -> None:
    """A note that was changed, tags of which one was removed again, and a note of which nothing is left."""
    hive.notes.change([1, 2], NotesChange("first", add=("paper", "draft")))
    hive.notes.change([1], NotesChange("second, with\ntwo lines", remove=("draft",)))
    hive.notes.change([3], NotesChange("gone"))
    hive.notes.change([3], NotesChange(""))


def _delete_runs(hive: Hive) -> None:
    """One that stays in the trash, and one that came back."""
    runs = hive.runs.submit(Submission("tiny", "track", {"seconds": 0.01}, seed=77, repeat=2, evaluate=False))
    hive.worker([run.id for run in runs]).run(until_idle=True)
    hive.trash.delete([run.id for run in runs])
    hive.trash.restore([runs[0].id])


def _cancel_one_that_runs(hive: Hive) -> None:
    (run,) = hive.runs.submit(Submission("tiny", "track", {"seconds": 30}, priority=9))
    worker = hive.worker([run.id])
    thread = threading.Thread(target=worker.run, kwargs={"until_idle": True})
    thread.start()
    eventually(lambda: hive.runs.get(run.id).state is RunState.RUNNING, "the run that is cancelled")
    hive.runs.cancel(run.id)
    thread.join()


def _save_searches(hive: Hive) -> None:
    for name, descending in (("first", True), ("second", False), ("third", True)):
        record = SavedSearchRecord(
            name, "state = succeeded", ("duration",), RunSort("duration", descending), True, 2, True, True
        )
        hive.searches.save(record)
    hive.searches.delete("second")


def _analyse(hive: Hive) -> None:
    """One that is done and not listed, one that waits, and one that was removed."""
    done = hive.stored_analyses.create(ANALYSIS.format(name="done"))
    hive.analysis_jobs.work_once("somebody", threading.Event())
    hive.stored_analyses.list_or_not(done.token, listed=False)
    hive.stored_analyses.delete(hive.stored_analyses.create(ANALYSIS.format(name="removed")).token)
    hive.stored_analyses.create(ANALYSIS.format(name="waits"))


def _edit_definition(hive: Hive) -> None:
    """What is stored from now on has another unit; what was stored keeps its own."""
    path = hive.catalogue.algorithm("tiny").package.folder / "algorithm.yaml"
    path.write_text(path.read_text().replace("unit: s,", "unit: ms,"))


def _leave_waiting(hive: Hive) -> None:
    """Runs and experiments of which no worker has begun anything."""
    waiting = hive.runs.submit(
        Submission("tiny", "track", {"seconds": 0.02}, repeat=3, seed=5, alignment=Alignment.SE3)
    )
    hive.runs.cancel(waiting[1].id)
    for name, seconds in (("waits", 0.03), ("paused", 0.04), ("cancelled", 0.05)):
        hive.experiments.start(ExperimentSource(EXPERIMENT.format(name=name, seconds=seconds), f"{name}.yaml"))
    hive.experiments.pause("paused")
    hive.experiments.cancel("cancelled")
    again = hive.experiments.run_ids("cancelled")[0]
    hive.runs.retry(hive.experiments.run_ids("done")[0])
    assert hive.runs.get(again).state is RunState.CANCELLED


def _add_accounts(hive: Hive) -> None:
    """An account with a session and a token, and one that is disabled; the audit log says who made the first."""
    act = AuditAct("a" * 32, utc_now(), "root", "command line", "", "account add", "anna as admin")
    with hive.store.acting(act):
        hive.accounts.add("anna", Role.ADMIN, PASSWORD)
    hive.accounts.sign_in("anna", PASSWORD)
    hive.accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    hive.accounts.link("anna", Identity("https://idp.example", "248"))
    hive.accounts.add("ben", Role.READER, PASSWORD)
    hive.accounts.disable("ben")
