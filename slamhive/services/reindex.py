"""Rebuilding the database from run folders, experiments, analyses and the ledger: it is their index."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.services.experiments import Restored
from slamhive.services.hive import Hive
from slamhive.services.ledger import LedgerRestore
from slamhive.services.runs import FolderRun, current_protocol, file_runs, found_evaluations, read_filed

BATCH = 100
"""Folders that are filed in one transaction."""


@dataclass
class ReindexReport:
    """What was found: ``skipped`` are folders that could not be read, with the reason.

    ``waiting`` runs had no folder, because no worker had begun them: the ledger has them. ``queued`` runs of
    ``experiments`` are in neither, and are queued again.
    """

    runs: int = 0
    evaluations: int = 0
    experiments: int = 0
    analyses: int = 0
    waiting: int = 0
    queued: int = 0
    skipped: list[tuple[Path, str]] = field(default_factory=list)


def run_folders(root: Path) -> list[RunFolder]:
    """All run folders, in the order of their ids."""
    return [RunFolder(entry) for entry in sorted((e for e in root.iterdir() if e.name.isdigit()), key=_number)]


def reindex(hive: Hive, progress: Callable[[int, int], None]) -> ReindexReport:
    """File every run folder: rows that exist are made equal to their folder, missing ones are added.

    What has no folder comes out of the ledger; rows that neither tells of stay as they are. ``progress`` is called
    with done and total.
    """
    with hive.store.unheard():
        report = _reindexed(hive, progress)
    hive.ledger.check()
    hive.store.refresh_statistics()
    return report


def _reindexed(hive: Hive, progress: Callable[[int, int], None]) -> ReindexReport:
    folders = run_folders(hive.settings.runs_folder)
    report = ReindexReport()
    ledger = LedgerRestore(hive.store, hive.catalogue, hive.ledger.files)
    for restored in hive.experiments.restore_rows():
        report.experiments += restored.problem is None
        _note(report, restored)
    ledger.restore_before_runs()
    ledger.restore_cells()
    for start in range(0, len(folders), BATCH):
        part = folders[start : start + BATCH]
        report.skipped += _file_folders(hive, part, report, ledger)
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
    return report


def _note(report: ReindexReport, restored: Restored) -> None:
    if restored.problem is not None:
        report.skipped.append((restored.folder.root, restored.problem))


def _file_folders(
    hive: Hive, folders: Sequence[RunFolder], report: ReindexReport, ledger: LedgerRestore
) -> list[tuple[Path, str]]:
    """File them together; the folders that were left out, with the reason. One of them keeps none else from filing."""
    runs, left_out = [], []
    for folder in folders:
        try:
            runs.append(_read(hive, folder, ledger))
        except SlamHiveError as error:
            left_out.append((folder.root, str(error)))
    try:
        if runs:
            ledger.repeat_later(hive.store.write(lambda t: file_runs(t, hive.catalogue, runs)))
    except (SlamHiveError, OverflowError) as error:
        if len(folders) > 1:
            return [entry for folder in folders for entry in _file_folders(hive, [folder], report, ledger)]
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
    return FolderRun(record, filed, found, current_protocol(folder, found), history, int(record.get("attempt", 1)))


def _number(path: Path) -> int:
    return int(path.name)
