"""Deletes runs into a trash, and takes them out of it again."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.base.bounds import read_record
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import remedy_of, write_aside
from slamhive.base.settings import Settings
from slamhive.domain.accounts import TEAM_SEES
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.ledger import Ledger, LedgerRestore
from slamhive.services.runs import (
    FolderRun,
    current_protocol,
    file_runs,
    found_evaluations,
    found_notes,
    found_sharing,
    read_filed,
)
from slamhive.store import RunRecord, Store, Transaction
from slamhive.store.runs import Deleted

# ``<data>/trash/<uid>/`` holds the run folder as it was, and what else belongs to it.

_UID = re.compile(r"[0-9a-f]{32}")
_FIELDS = {"id": int, "algorithm": str, "dataset": str, "at": str, "repeated_by": list}


@dataclass(frozen=True, slots=True)
class DeletedRun:
    """Row of a deleted run in lists. ``repeated_by``: runs that repeated it. ``kept``: its files are there.

    ``audience``: who saw it.
    """

    deleted: Deleted
    algorithm: str
    dataset: str
    repeated_by: tuple[int, ...] = ()
    kept: bool = True
    audience: str = TEAM_SEES


@dataclass(frozen=True, slots=True)
class DeletedFolder:
    """Paths of one deleted run. The description stays when the files are removed for good."""

    root: Path

    @property
    def run(self) -> Path:
        """The run folder as it was."""
        return self.root / "run"

    @property
    def description(self) -> Path:
        """``deleted.json``: number, algorithm, dataset, when it was deleted, which runs repeated it."""
        return self.root / "deleted.json"

    def write(self, run: DeletedRun) -> None:
        """Replace the description; make the folder."""
        content = {
            "id": run.deleted.run_id,
            "algorithm": run.algorithm,
            "dataset": run.dataset,
            "at": run.deleted.at.isoformat(),
            "repeated_by": list(run.repeated_by),
            "kept": run.kept,
            "audience": run.audience,
        }
        self.root.mkdir(parents=True, exist_ok=True)
        write_aside(self.description, json.dumps(content, indent=1) + "\n")

    def read(self) -> DeletedRun:
        """The description; raises NotFound or InvalidInput."""
        if not self.description.exists():
            raise NotFound(f"{self.root} holds no deleted run")
        content: dict[str, Any] = read_record(self.description)
        if any(not isinstance(content.get(name), kind) for name, kind in _FIELDS.items()):
            raise InvalidInput(f"{self.description} is not complete", "remove the folder, or move it away")
        try:
            deleted = Deleted(self.root.name, content["id"], datetime.fromisoformat(content["at"]))
        except ValueError as error:
            raise InvalidInput(f"{self.description}: {error}") from None
        repeated_by = tuple(entry for entry in content["repeated_by"] if isinstance(entry, int))
        kept = bool(content.get("kept", True))
        audience = str(content.get("audience", TEAM_SEES))
        return DeletedRun(deleted, content["algorithm"], content["dataset"], repeated_by, kept, audience)


def deleted_runs(root: Path) -> Iterator[DeletedRun]:
    """All deleted runs whose description can be read."""
    for path in sorted(root.iterdir()) if root.is_dir() else ():
        if _UID.fullmatch(path.name) and not path.is_symlink():
            with suppress(SlamHiveError):
                yield DeletedFolder(path).read()


# Files move before rows change, because folders are the truth.


class Trash:
    """Deleted runs of one installation.

    Args:
        settings: Mode, and where runs and deleted runs lie.
        store: The database.
        catalogue: Algorithms and datasets.
        ledger: What it has of evaluations, and of runs without a folder.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue, ledger: Ledger) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._ledger = ledger

    def delete(self, run_ids: Sequence[int], at: datetime | None = None) -> tuple[RunRecord, ...]:
        """Move runs that have ended to the trash; raises Conflict, with nothing changed, if one is still needed.

        Runs that are deleted with the same ``at`` can be restored together; the default is now.
        """
        check_writable(self._settings)
        wanted = list(dict.fromkeys(run_ids))

        def look(t: Transaction) -> tuple[tuple[RunRecord, ...], set[int], dict[int, list[int]]]:
            return t.runs.get_many(wanted), t.evaluations.with_open(wanted), t.deleted_runs.repeated_by(wanted)

        runs, evaluated, repeats = self._store.read(look)
        for run in runs:
            if not run.state.ended:
                raise Conflict(f"run {run.id} has not ended, it is {run.state}", "cancel it first")
            if run.id in evaluated:
                raise Conflict(f"run {run.id} is being evaluated", "wait until that has ended")
        deleted = [Deleted(run.uid, run.id, at or utc_now()) for run in runs]
        for run, entry in zip(runs, deleted, strict=True):
            folder = self._folder(run.uid)
            repeated_by = tuple(repeats.get(run.id, ()))
            folder.write(DeletedRun(entry, run.algorithm, run.dataset, repeated_by, audience=run.audience))
            if self._run_folder(run.id).exists():
                shutil.rmtree(folder.run, ignore_errors=True)
                _move(self._run_folder(run.id), folder.run)
        self._store.write(lambda t: t.deleted_runs.remove(deleted))
        return runs

    def deleted_together(self, at: str) -> list[int]:
        """The runs in the trash that one action deleted at ``at`` (ISO 8601), in order.

        Raises InvalidInput for what is no time, NotFound if there are none.
        """
        try:
            moment = datetime.fromisoformat(at)
        except ValueError:
            raise InvalidInput(f"{at[:40]!r} is not a time", "write it as 2026-05-04T12:00:00.123456+00:00") from None
        found = sorted(run.deleted.run_id for run in self.listed() if run.deleted.at == moment)
        if not found:
            raise NotFound(f"no run in the trash was deleted at {moment.isoformat()}", "see slamhive runs trash")
        return found

    def restore(self, run_ids: Sequence[int], progress: Callable[[int], None] = lambda _done: None) -> list[int]:
        """Take runs out of the trash, under their old numbers; ``progress`` takes how many are done.

        Raises NotFound for a run that is not there, Conflict if its number is in use again.
        """
        check_writable(self._settings)
        known = {run.deleted.run_id: run for run in self.listed()}
        for run_id in run_ids:
            if run_id not in known:
                raise NotFound(f"run {run_id} is not in the trash", "slamhive runs trash lists what is there")
            if self._run_folder(run_id).exists():
                raise Conflict(f"number {run_id} belongs to another run now", "import the old one from an archive")
        wanted = list(dict.fromkeys(run_ids))
        for done, run_id in enumerate(wanted, 1):
            self._restore(known[run_id])
            progress(done)
        return wanted

    def listed(self) -> list[DeletedRun]:
        """The runs in the trash that the viewer could see before, the last deleted first."""
        viewer = self._store.viewer
        found = deleted_runs(self._settings.trash_folder)
        seen = (run for run in found if run.kept and (viewer is None or viewer.sees(run.audience)))
        return sorted(seen, key=lambda run: run.deleted.at, reverse=True)

    def empty(self) -> int:
        """Remove the files of all deleted runs for good; how many there were."""
        check_writable(self._settings)
        self._store.note_act()
        runs = self.listed()
        for run in runs:
            folder = self._folder(run.deleted.uid)
            # That it was deleted stays known: an experiment would queue it again.
            folder.write(
                DeletedRun(run.deleted, run.algorithm, run.dataset, run.repeated_by, kept=False, audience=run.audience)
            )
            shutil.rmtree(folder.run, ignore_errors=True)
        return len(runs)

    def _restore(self, run: DeletedRun) -> None:
        number, uid = run.deleted.run_id, run.deleted.uid
        folder = self._folder(uid)
        ledger = LedgerRestore(self._store, self._catalogue, self._ledger.files, self._settings.runs_folder)
        if folder.run.exists():
            self._file(folder.run, self._run_folder(number), ledger)
        else:
            self._store.write(lambda t: t.deleted_runs.forget([uid]))
            ledger.restore_before_runs()
            ledger.restore_after_runs()
        self._store.write(lambda t: t.ledger.repeat(dict.fromkeys(run.repeated_by, number)))
        shutil.rmtree(folder.root, ignore_errors=True)

    def _file(self, source: Path, target: Path, ledger: LedgerRestore) -> None:
        """Move a run folder to its old place and file it; back to the trash if the database refuses it."""
        entry = self._read(RunFolder(source), ledger)
        _move(source, target)
        try:
            self._store.write(lambda t: file_runs(t, self._catalogue, [entry]))
        except SlamHiveError:
            _move(target, source)
            raise

    def _read(self, folder: RunFolder, ledger: LedgerRestore) -> FolderRun:
        record, found = folder.read_record(), found_evaluations(folder)
        filed = read_filed(self._catalogue, record, str(folder.record))
        current, attempt = current_protocol(folder, found), int(record.get("attempt", 1))
        said = found_notes(folder), found_sharing(folder)
        return FolderRun(filed, found, current, ledger.evaluations.of(filed.file.id), attempt, *said)

    def _folder(self, uid: str) -> DeletedFolder:
        return DeletedFolder(self._settings.trash_folder / uid)

    def _run_folder(self, run_id: int) -> Path:
        return self._settings.runs_folder / str(run_id)


def _move(source: Path, target: Path) -> None:
    try:
        source.rename(target)
    except OSError as error:
        raise Unavailable(f"{source} cannot be moved to {target}: {error.strerror}", remedy_of(error)) from None
