"""The orders of a supervisor: a file in the work folder, written by the executor."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from slamhive.base.files import write_aside
from slamhive.executors.process.containment_base import ContainmentRequest

SPEC_FILE = "shim-spec.json"


@dataclass(frozen=True, slots=True)
class ShimSpec:
    """The program to start, and its limits.

    ``cores`` are those to bind to. ``tasks`` counts processes and threads, as a container's limit of pids does. The
    fields after ``cpu_cores`` are for the containment, see ``ContainmentRequest``. ``read_only`` is for a command that
    makes a container of the files it is given: what the container must not change. None for any other command.
    ``forwarders`` are programs that pass signals on to the algorithm: they get none, or it would get each twice.
    """

    command: list[str]
    environment: dict[str, str]
    folder: str
    cores: list[int] | None
    memory_bytes: int | None
    tasks: int
    log_max_bytes: int
    file_bytes: int | None = None
    cpu_cores: float | None = None
    installation: str = ""
    key: str = ""
    readable: list[str] = field(default_factory=list)
    writable: list[str] = field(default_factory=list)
    containment: str | None = None
    read_only: list[str] | None = None
    forwarders: list[str] = field(default_factory=list)

    def save(self, work: Path) -> None:
        """Write into the work folder."""
        write_aside(work / SPEC_FILE, json.dumps(asdict(self)))

    @classmethod
    def load(cls, work: Path) -> ShimSpec:
        """Read from the work folder."""
        return cls(**json.loads((work / SPEC_FILE).read_text(encoding="utf-8")))

    def containment_request(self) -> ContainmentRequest:
        """Return the limits for the containment."""
        return ContainmentRequest(
            self.installation,
            self.key,
            self.tasks,
            self.memory_bytes,
            self.cpu_cores,
            tuple(map(Path, self.readable)),
            tuple(map(Path, self.writable)),
        )
