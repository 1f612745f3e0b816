"""The folder of a deleted run: ``<data>/trash/<uid>/`` holds its run folder as it was, and what else belongs to it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.domain.visibility import TEAM_SEES
from slamhive.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.files import write_aside
from slamhive.input_bounds import read_record
from slamhive.store.deleted_runs import Deleted

_UID = re.compile(r"[0-9a-f]{32}")
_FIELDS = {"id": int, "algorithm": str, "dataset": str, "at": str, "repeated_by": list}


@dataclass(frozen=True, slots=True)
class DeletedRun:
    """What a list shows of a deleted run. ``repeated_by``: runs that repeated it. ``kept``: its files are there.

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
