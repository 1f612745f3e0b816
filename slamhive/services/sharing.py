"""Sharing: who owns runs, experiments and analyses, and who may see them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from slamhive.base.errors import Conflict, Forbidden, InvalidInput
from slamhive.base.settings import Settings
from slamhive.domain.accounts import Sharing, Visibility, viewer_of
from slamhive.domain.run import RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import check_writable
from slamhive.services.experiments import ExperimentFolder
from slamhive.services.ledger import LedgerFiles, shared_line
from slamhive.services.stored_analyses import AnalysisFolder
from slamhive.store import RunRecord, Store, Transaction
from slamhive.store.records import AnalysisRecord, AnalysisState

# Folders come before the database: they are the truth.


@dataclass(frozen=True, slots=True)
class SharingChange:
    """A new ``visibility`` and a new ``owner``; None keeps it."""

    visibility: Visibility | None = None
    owner: str | None = None

    def applied(self, sharing: Sharing) -> Sharing:
        """Owner and visibility after the change."""
        return Sharing(self.owner or sharing.owner, self.visibility or sharing.visibility)


class Sharings:
    """Changes who owns and who sees what. The owner may, and admins, and whoever uses the command line.

    Args:
        settings: Mode, and where folders lie.
        store: The database; its viewer is who asks.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store

    def runs(self, run_ids: Sequence[int], change: SharingChange) -> tuple[RunRecord, ...]:
        """Share runs; the runs afterwards. The folder of a run says it, and the ledger of one that has none yet.

        A run of an experiment belongs to the owner of the experiment, and is seen by no more people.

        Raises NotFound, Forbidden, Conflict for a run whose folder is lost, InvalidInput for what its experiment rules
        out; nothing is changed then.
        """
        runs = self._store.read(lambda t: t.runs.get_many(run_ids))
        self._check(change, [(f"run {run.id}", run.owner) for run in runs])

        def work(t: Transaction) -> list[str]:
            # The rows are locked before anything is looked at, so that a worker does not make the folder of a run
            # meanwhile.
            t.sharing.lock(run_ids)
            runs = t.runs.get_many(run_ids)
            within = self._experiments(t, runs)
            shared = {run.id: _of_run(run, change, within.get(run.id)) for run in runs}
            stated = {run.id: replace(shared[run.id], owner=None) if run.experiment else shared[run.id] for run in runs}
            folders = {run.id: RunFolder(self._settings.runs_folder / str(run.id)) for run in runs}
            waiting: dict[Sharing, list[int]] = {}
            for run in runs:
                if not folders[run.id].record.exists():
                    if run.state.ended and run.state is not RunState.CANCELLED:
                        raise Conflict(f"the folder of run {run.id} is lost", "slamhive doctor says what is missing")
                    waiting.setdefault(stated[run.id], []).append(run.id)

            # Folders and ledger first, then the rows.
            for run in runs:
                if folders[run.id].record.exists():
                    folders[run.id].write_sharing(stated[run.id])
            LedgerFiles(self._settings.ledger_folder).runs.append(
                shared_line(members, sharing) for sharing, members in waiting.items()
            )
            t.sharing.share_runs(shared)
            after = {run.id: run.audience for run in t.runs.get_many(run_ids)}
            return [after[run.id] for run in runs if after[run.id] != run.audience]

        # The audiences that runs have now and did not have before.
        narrowed = self._store.write(work)
        self._renew_analyses(narrowed)
        return self._store.read(lambda t: t.runs.get_many(run_ids, with_metrics=True))

    def experiment(self, name: str, change: SharingChange) -> Sharing:
        """Share an experiment; its runs follow. Raises NotFound and Forbidden; Conflict while it is being changed."""
        record = self._store.read(lambda t: t.experiments.get(name))
        self._check(change, [(f"experiment {name}", record.owner)])
        folder = ExperimentFolder(self._settings.experiments_folder / name)
        with folder.locked():
            stored = folder.read()
            if stored is None:
                raise Conflict(f"experiment {name} has no folder", "slamhive doctor says what is missing")
            sharing = change.applied(stored.sharing)
            content = {"owner": sharing.owner, "visibility": sharing.visibility}
            folder.write(stored.model_copy(update=content))
            self._store.write(lambda t: t.sharing.share_experiment(record.id, sharing))
        self._renew_analyses([sharing.audience()] if sharing != record.sharing else [])
        return sharing

    def analysis(self, token: str, change: SharingChange) -> AnalysisRecord:
        """Share an analysis. It is computed again, of the runs that each of its readers may see."""
        record = self._store.read(lambda t: t.analyses.get(token))
        self._check(change, [("this analysis", record.owner)])
        sharing = change.applied(record.sharing)
        if sharing == record.sharing:
            return record
        return self._computed_again(replace(record, owner=sharing.owner, visibility=sharing.visibility))

    def _check(self, change: SharingChange, owners: Iterable[tuple[str, str | None]]) -> None:
        """Raise Forbidden unless the viewer may share all of this."""
        check_writable(self._settings)
        viewer = self._store.viewer
        if change.owner is not None:
            owner = change.owner
            if viewer is not None:
                raise Forbidden("only admins give things to another account", "ask an admin of this server")
            self._store.read(lambda t: t.accounts.named(owner))
        for what, named in owners:
            if viewer is not None and named != viewer.account:
                whose = f"belongs to {named}" if named else "has no owner"
                raise Forbidden(f"{what} {whose}, so you cannot share it", "ask its owner or an admin")

    def _experiments(self, t: Transaction, runs: Sequence[RunRecord]) -> dict[int, tuple[str, Visibility]]:
        """{run: name and visibility of its experiment} of those that have one."""
        named = {run.experiment for run in runs if run.experiment is not None}
        known = {name: t.experiments.get(name).seen_by for name in named}
        return {run.id: (run.experiment, known[run.experiment]) for run in runs if run.experiment is not None}

    def _renew_analyses(self, audiences: Iterable[str]) -> None:
        """Compute those analyses again that may show what only these audiences may see now."""
        if not self._store.read(lambda t: t.accounts.in_use()):
            return
        hidden_now = set(audiences)
        with self._store.seen_by(None):
            for record in self._store.read(lambda t: t.analyses.all()) if hidden_now else ():
                reader = viewer_of(record.sharing.audience())
                if reader is not None and not all(reader.sees(audience) for audience in hidden_now):
                    self._computed_again(record)

    def _computed_again(self, record: AnalysisRecord) -> AnalysisRecord:
        folder = AnalysisFolder(self._settings.analyses_folder / record.token)
        queued = replace(
            record, state=AnalysisState.QUEUED, content_hash=None, reason=None, ended_at=None, size_bytes=None
        )
        folder.write_state(queued)
        self._store.write(lambda t: t.analyses.put(queued))
        folder.clear_results()
        return queued


def _of_run(run: RunRecord, change: SharingChange, experiment: tuple[str, Visibility] | None) -> Sharing:
    """Owner and visibility of a run after the change; raises InvalidInput for what its experiment rules out."""
    if experiment is None:
        return change.applied(Sharing(run.owner, run.visibility))
    name, most = experiment
    if change.owner is not None:
        raise InvalidInput(f"run {run.id} belongs to the owner of {name}", "give the experiment to another account")
    wanted = change.visibility
    if wanted is not None and wanted.within(most) is not wanted:
        raise InvalidInput(
            f"run {run.id} cannot be {wanted}: its experiment {name} is {most}", f"share {name} with more people"
        )
    own = run.visibility if wanted is None else wanted
    return Sharing(run.owner, None if own is most else own)
