"""Trajectories that were sent from a web form: kept aside, looked at, and stored as runs once somebody agrees."""

from __future__ import annotations

import csv
import re
import secrets
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.sensors import SensorSetup
from slamhive.services.datasets import check_writable
from slamhive.services.imports import ImportReport, ImportRequest

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

MOST_FILES = 200
KEPT_S = 24 * 3600
"""What nobody agreed to is removed after a day, when the next files come."""
_TABLE = "table.csv"
_OWNER = "owner"
_TOKEN = re.compile(r"[0-9a-f]{32}")
_STRANGE = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True, slots=True)
class StagedFacts:
    """Facts that the files do not state: whose trajectories they are, on what, and with which sensors."""

    algorithm: str
    dataset: str
    setup: SensorSetup


class StagedTrajectories:
    """Keeps files of web forms until they are stored or discarded.

    Args:
        hive: The services.
    """

    def __init__(self, hive: Hive) -> None:
        self._hive = hive
        self._root = hive.settings.data / "staged-trajectories"

    def add(self, files: Iterable[tuple[str, IO[bytes]]], facts: StagedFacts, owner: str) -> str:
        """Keep the files aside; the token that names them.

        Raises InvalidInput without a file, for too many, for two of one name; NotFound for an unknown dataset.
        """
        check_writable(self._hive.settings)
        self._hive.catalogue.dataset(facts.dataset)
        self._sweep()
        token = secrets.token_hex(16)
        folder = self._root / token
        folder.mkdir(parents=True, mode=0o700)
        try:
            names = _written(folder, files)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        with (folder / _TABLE).open("w", newline="", encoding="utf-8") as stream:
            table = csv.writer(stream)
            table.writerow(["algorithm", "dataset", "trial", "file", "sensors"])
            table.writerows([facts.algorithm, facts.dataset, Path(name).stem, name, facts.setup] for name in names)
        (folder / _OWNER).write_text(owner, encoding="utf-8")
        return token

    def rehearse(self, token: str, owner: str) -> ImportReport:
        """Read everything and store nothing; raises NotFound for files of somebody else."""
        return self._hive.imports.carry_out(self._request(token, owner), lambda _done, _total: None, dry_run=True)

    def store(self, token: str, owner: str) -> ImportReport:
        """Store the files as runs, queue their evaluation, and forget them."""
        report = self._hive.imports.carry_out(self._request(token, owner), lambda _done, _total: None)
        self.discard(token, owner)
        if report.run_ids:
            self._hive.evaluations.queue(report.run_ids, None)
        return report

    def discard(self, token: str, owner: str) -> None:
        """Remove the files."""
        shutil.rmtree(self._request(token, owner).source.parent)

    def _request(self, token: str, owner: str) -> ImportRequest:
        folder = self._root / token
        known = _TOKEN.fullmatch(token) and (folder / _OWNER).is_file()
        if not known or (folder / _OWNER).read_text(encoding="utf-8") != owner:
            raise NotFound("these trajectories are not here any more", "choose the files again")
        return ImportRequest(source=folder / _TABLE, table=True)

    def _sweep(self) -> None:
        for folder in self._root.glob("*"):
            if utc_now().timestamp() - folder.stat().st_mtime > KEPT_S:
                shutil.rmtree(folder, ignore_errors=True)


def _written(folder: Path, files: Iterable[tuple[str, IO[bytes]]]) -> list[str]:
    """The names under which the files are kept; nothing of a name leads out of the folder."""
    names: list[str] = []
    for given, stream in files:
        name = _STRANGE.sub("_", given.replace("\\", "/").rpartition("/")[2])[-80:].lstrip(".")
        if not name or name in (_TABLE, _OWNER):
            raise InvalidInput(f"{given[:80]!r} is no name of a trajectory", "rename the file")
        if name in names:
            raise InvalidInput(f"two files are called {name!r}", "rename one of them")
        if len(names) == MOST_FILES:
            raise InvalidInput(
                f"there are more than {MOST_FILES} files", "send them in parts, or use slamhive runs import"
            )
        with (folder / name).open("wb") as target:
            shutil.copyfileobj(stream, target)
        names.append(name)
    if not names:
        raise InvalidInput("no file is chosen", "choose the files of the trajectories")
    return names
