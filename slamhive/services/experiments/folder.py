"""``experiments/<name>/``: the files from which an experiment is restored if the database is lost."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.base import strict_yaml
from slamhive.base.bounds import read_record
from slamhive.base.errors import Conflict, InvalidInput, Unavailable
from slamhive.base.files import exclusive_lock, make_shared_folder, remedy_of, write_aside
from slamhive.documents.model import Document, Moment
from slamhive.domain.accounts import Sharing, Visibility
from slamhive.store.records import ExperimentState

SOURCE = "experiment.yaml"
RECORD = "experiment.json"
LOCK = ".lock"


class StoredExperiment(Document):
    """Content of ``experiment.json``: everything about an experiment except its source."""

    uid: str
    name: str
    content_hash: str
    state: ExperimentState
    executor: str
    repeats: int
    created_at: Moment
    format: int = 1
    owner: str | None = None
    visibility: Visibility | None = None
    conclusion: str | None = None

    @property
    def sharing(self) -> Sharing:
        """Owner and visibility."""
        return Sharing(self.owner, self.visibility)

    @property
    def text(self) -> str:
        """The content of the file."""
        return json.dumps(self.content, indent=1) + "\n"


class ExperimentFolder:
    """The folder of one experiment.

    Args:
        root: The folder, named after the experiment.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the experiment against other processes on this machine; raises Conflict if it is locked."""
        try:
            make_shared_folder(self.root)
            # Opening for reading is enough for a lock, even on another user's file.
            flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptor = os.open(self.root / LOCK, flags, 0o644)
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be used: {error.strerror}", remedy_of(error)) from None
        problem = f"experiment {self.root.name} is being changed by another process"
        with exclusive_lock(descriptor, Conflict(problem, "wait until it is done")):
            yield

    def write(self, stored: StoredExperiment, source: str | None = None) -> None:
        """Write ``stored``, and for a new experiment first its source, without which it is of no use."""
        if source is not None:
            write_aside(self.root / SOURCE, source)
        write_aside(self.root / RECORD, stored.text)

    def read(self) -> StoredExperiment | None:
        """Read the stored experiment; None if there is none; raises InvalidInput if it cannot be read."""
        path = self.root / RECORD
        if not path.exists():
            return None
        content = read_record(path)
        try:
            return StoredExperiment.read(content)
        except InvalidInput as error:
            raise InvalidInput(f"{path} is not complete: {error.message}", "restore it, or remove the folder") from None

    def source(self) -> str:
        """The original experiment file; raises InvalidInput."""
        return strict_yaml.read_text(self.root / SOURCE)


def experiment_folders(root: Path) -> list[ExperimentFolder]:
    """The folders of all stored experiments, sorted by name."""
    if not root.is_dir():
        return []
    return [ExperimentFolder(path.parent) for path in sorted(root.glob(f"*/{RECORD}"))]
