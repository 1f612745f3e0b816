"""Rebuild the database, which is an index of run folders, experiments, analyses and the ledger."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.accounts import NOT_SHARED
from slamhive.run_folder.folder import RunFolder
from slamhive.services.experiments import Restored
from slamhive.services.hive import Hive
from slamhive.services.ledger import LedgerRestore
from slamhive.services.runs import (
    FolderRun,
    current_protocol,
    file_runs,
    found_evaluations,
    found_notes,
    found_sharing,
    read_filed,
)
from slamhive.services.trash import deleted_runs

BATCH = 100
"""Folders filed in one transaction."""


@dataclass
class ReindexReport:
    """Counts of restored rows. ``skipped`` are the folders that could not be read, with the reason.

    ``waiting`` runs come from the ledger: they have no folder, because no worker had started them. ``queued`` runs of
    ``experiments`` were in neither and have been queued again.
    """

    runs: int = 0
    evaluations: int = 0
    experiments: int = 0
    analyses: int = 0
    waiting: int = 0
    queued: int = 0
    skipped: list[tuple[Path, str]] = field(default_factory=list)


def run_folders(root: Path) -> list[RunFolder]:
    """All run folders, sorted by id."""
    return [RunFolder(entry) for entry in sorted((e for e in root.iterdir() if e.name.isdigit()), key=_number)]


def reindex(hive: Hive, progress: Callable[[int, int], None]) -> ReindexReport:
    """File every run folder: existing rows are updated from their folder, missing rows are added.

    What has no folder is restored from the ledger. Rows that are in neither stay as they are. ``progress`` is called
    with the folders done and their total.
    """
    with hive.store.unheard():
        folders = run_folders(hive.settings.runs_folder)
        report = ReindexReport()
        deleted = [run.deleted for run in deleted_runs(hive.settings.trash_folder)]
        hive.store.write(lambda t: t.deleted_runs.remember(deleted))
        ledger = LedgerRestore(hive.store, hive.catalogue, hive.ledger.files, hive.settings.runs_folder)
        for restored in hive.experiments.restore_rows():
            report.experiments += restored.problem is None
            _note(report, restored)
        damaged = {path.name for path, _ in report.skipped}
        ledger.restore_before_runs()
        ledger.restore_cells()
        for start in range(0, len(folders), BATCH):
            part = folders[start : start + BATCH]
            report.skipped += _file_folders(hive, part, report, ledger, damaged)
            progress(start + len(part), len(folders))
        report.waiting = ledger.restore_after_runs()
        for restored in hive.experiments.restore_runs():
            report.queued += restored.queued
            _note(report, restored)
        ledger.restore_evaluations()
        report.skipped += [(hive.ledger.files.folder, problem) for problem in ledger.problems]
        for path, problem in hive.stored_analyses.restore():
            report.analyses += problem is None
            if problem is not None:
                report.skipped.append((path, problem))
    hive.ledger.check()
    hive.store.refresh_statistics()
    return report


def _note(report: ReindexReport, restored: Restored) -> None:
    if restored.problem is not None:
        report.skipped.append((restored.folder.root, restored.problem))


def _file_folders(
    hive: Hive, folders: Sequence[RunFolder], report: ReindexReport, ledger: LedgerRestore, damaged: Collection[str]
) -> list[tuple[Path, str]]:
    """File folders in one transaction, or one by one if that fails; return those left out, with the reason.

    ``damaged``: experiments that could not be restored. Only admins see their runs: the experiment may be private.
    """
    runs, left_out = [], []
    for folder in folders:
        try:
            run = _read(hive, folder, ledger)
            hidden = run.filed.file.request.experiment in damaged
            runs.append(replace(run, sharing=NOT_SHARED) if hidden else run)
        except SlamHiveError as error:
            left_out.append((folder.root, str(error)))
    try:
        if runs:
            ledger.later.update(hive.store.write(lambda t: file_runs(t, hive.catalogue, runs)))
    except (SlamHiveError, OverflowError) as error:
        if len(folders) > 1:
            return [entry for folder in folders for entry in _file_folders(hive, [folder], report, ledger, damaged)]
        too_large = f"{folders[0].record} holds a number that no database can hold"
        return [(folders[0].root, str(error) if isinstance(error, SlamHiveError) else too_large)]
    report.runs += len(runs)
    report.evaluations += sum(len(run.found) for run in runs)
    return left_out


def _read(hive: Hive, folder: RunFolder, ledger: LedgerRestore) -> FolderRun:
    record = folder.read_record()
    if str(record.get("id")) != folder.root.name:
        raise InvalidInput(f"{folder.record} is the record of run {record.get('id')!r}", "folders must not be renamed")
    filed = read_filed(hive.catalogue, record, str(folder.record))
    found = found_evaluations(folder)
    history = ledger.evaluations.of(int(record["id"]))
    current, attempt = current_protocol(folder, found), int(record.get("attempt", 1))
    return FolderRun(filed, found, current, history, attempt, found_notes(folder), found_sharing(folder))


def _number(path: Path) -> int:
    return int(path.name)
