"""Rebuilding database rows from sealed run folders: the folder is the truth, the database its index."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.services.experiments.restoring import Restored
from slamhive.services.filing import current_protocol, file_evaluations, file_run, found_evaluations, read_filed
from slamhive.services.hive import Hive


@dataclass
class ReindexReport:
    """What was found: ``skipped`` are folders that could not be read, with the reason.

    ``queued`` runs of ``experiments`` had no folder, because no worker had begun them, and are queued again.
    """

    runs: int = 0
    evaluations: int = 0
    experiments: int = 0
    analyses: int = 0
    queued: int = 0
    skipped: list[tuple[Path, str]] = field(default_factory=list)


def run_folders(root: Path) -> list[RunFolder]:
    """All run folders, in the order of their ids."""
    return [RunFolder(entry) for entry in sorted((e for e in root.iterdir() if e.name.isdigit()), key=_number)]


def reindex(hive: Hive, progress: Callable[[int, int], None]) -> ReindexReport:
    """File every run folder: rows that exist are made equal to their folder, missing ones are added.

    Rows without a folder (queued runs) stay as they are; runs of experiments that have neither are queued again.
    ``progress`` is called with done and total.
    """
    folders = run_folders(hive.settings.runs_folder)
    report = ReindexReport()
    for restored in hive.experiments.restore_rows():
        report.experiments += restored.problem is None
        _note(report, restored)
    for done, folder in enumerate(folders, start=1):
        try:
            report.evaluations += _file_run(hive, folder)
            report.runs += 1
        except SlamHiveError as error:
            report.skipped.append((folder.root, str(error)))
        progress(done, len(folders))
    for restored in hive.experiments.restore_runs():
        report.queued += restored.queued
        _note(report, restored)
    for path, problem in hive.stored_analyses.restore():
        report.analyses += problem is None
        if problem is not None:
            report.skipped.append((path, problem))
    return report


def _note(report: ReindexReport, restored: Restored) -> None:
    if restored.problem is not None:
        report.skipped.append((restored.folder.root, restored.problem))


def _file_run(hive: Hive, folder: RunFolder) -> int:
    record = folder.read_record()
    if str(record.get("id")) != folder.root.name:
        raise InvalidInput(f"{folder.record} is the record of run {record.get('id')!r}", "folders must not be renamed")
    filed = read_filed(hive.settings, record, str(folder.record))
    evaluations = found_evaluations(folder)
    current = current_protocol(folder, evaluations)
    try:
        hive.store.write(lambda t: file_run(t, hive.catalogue, record, filed))
        hive.store.write(lambda t: file_evaluations(t, int(record["id"]), evaluations, current))
    except OverflowError:
        raise InvalidInput(f"{folder.record} holds a number that no database can hold") from None
    return len(evaluations)


def _number(path: Path) -> int:
    return int(path.name)
