"""The controller's side."""

from __future__ import annotations

import os
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

from pydantic import TypeAdapter

from slamhive.base.files import write_aside
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import (
    Capabilities,
    EngineUnavailable,
    Executor,
    ExecutorContext,
    LiveKeys,
    PackageNeed,
    ProgressCallback,
    ProtectionFinding,
)
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, Protections, RunHandle, Running, RunStatus
from slamhive.executors.transfer import pack_inputs, unpack_live, unpack_output
from slamhive.packages.algorithm_file import package_hash
from slamhive_remote.wire import connect, raise_error, receive_json, receive_stream, send_json, send_stream

SPEC = TypeAdapter(RunSpec)


class RemoteExecutor(Executor):
    """The executor ``remote``. Address and token of the agent come from the environment."""

    name = "remote"
    capabilities = Capabilities(
        limits=frozenset({Limit.CORES, Limit.MEMORY, Limit.PROCESSES, Limit.DISK, Limit.TIME}),
        needs=PackageNeed.ENVIRONMENT,
        shares_files=False,
    )

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._address = os.environ.get("REMOTE_AGENT", "")
        self._token = os.environ.get("REMOTE_TOKEN", "")

    def unavailable_because(self) -> str | None:
        """Why no agent can be asked now."""
        try:
            self._ask("ping")
        except EngineUnavailable as error:
            return str(error)
        return None

    def examine(self) -> list[ProtectionFinding]:
        """What the agent says of itself."""
        return [ProtectionFinding("agent", self._ask("ping")["about"])]

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The environment that the agent has made for this version of the package."""
        found: str | None = self._ask("identity", package=package.name, hash=package_hash(package.folder))
        return found

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Send the package, and let the agent make its environment."""
        with tempfile.TemporaryFile() as archive:
            with tarfile.open(fileobj=archive, mode="w|") as tar:
                tar.add(package.folder, ".")
            archive.seek(0)
            with self._asked("build", package=package.name, hash=package_hash(package.folder)) as connection:
                send_stream(connection, archive)
                answer = receive_json(connection)
        raise_error(answer)
        for line in answer["lines"]:
            progress(line)
        return str(answer["identity"])

    def start(self, spec: RunSpec) -> RunHandle:
        """Send the inputs unless the agent has them all, then start; both steps can be done again."""
        if not self._ask("has", key=spec.key):
            with tempfile.TemporaryFile() as archive:
                pack_inputs(spec, archive)
                archive.seek(0)
                with self._asked("put", key=spec.key, spec=SPEC.dump_python(spec, mode="json")) as connection:
                    send_stream(connection, archive)
                    raise_error(receive_json(connection))
        answer = self._ask("start", key=spec.key)
        data = {"key": spec.key, "started_at": answer["started_at"]}
        return RunHandle(self.name, data, Protections(**answer["protections"]))

    def poll(self, handle: RunHandle) -> RunStatus:
        """The status that the agent tells."""
        answer = self._ask("poll", key=handle.data["key"])
        kind = answer.pop("kind")
        if kind == "exited":
            started_at, ended_at = (datetime.fromisoformat(answer.pop(name)) for name in ("started_at", "ended_at"))
            return Exited(**answer, started_at=started_at, ended_at=ended_at)
        return Running(**answer) if kind == "running" else Gone(**answer)

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """Let the agent end the run."""
        self._ask("stop", key=handle.data["key"], grace_s=grace_s)

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Fetch the log."""
        with self._fetched("log", handle) as log:
            if log is not None:
                write_aside(path, log.read())

    def remove(self, handle: RunHandle) -> None:
        """Let the agent remove the run."""
        self._ask("remove", key=handle.data["key"])

    def discard(self, spec: RunSpec) -> None:
        """The key is all that the agent needs."""
        self._ask("remove", key=spec.key)

    def refresh(self, spec: RunSpec, handle: RunHandle) -> None:
        """Fetch the files that are watched."""
        for output in spec.outputs:
            with self._fetched("live", handle, output=output.name, names=output.live) as archive:
                if archive is not None:
                    unpack_live(archive, output)

    def collect(self, spec: RunSpec, handle: RunHandle) -> None:
        """Fetch the outputs."""
        for output in spec.outputs:
            with self._fetched("outputs", handle, output=output.name) as archive:
                if archive is not None:
                    unpack_output(archive, output, spec.work)

    def usage_source(self, handle: RunHandle) -> RemoteUsage | None:
        """Asks the agent for each reading."""
        return RemoteUsage(self, handle) if self._ask("usage", key=handle.data["key"]) else None

    def hidden_bytes(self, handle: RunHandle) -> int:
        """Everything that the run has written lies with the agent."""
        return int(self._ask("size", key=handle.data["key"]))

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Let the agent remove the runs of this installation that are over."""
        found: list[str] = self._ask("keys")
        over = sorted(set(found) - set(live_keys()))
        self._ask("sweep", over=over)
        return over

    def _ask(self, what: str, **fields: Any) -> Any:
        with self._asked(what, **fields) as connection:
            answer = receive_json(connection)
        raise_error(answer)
        return answer

    @contextmanager
    def _asked(self, what: str, **fields: Any) -> Iterator[Connection]:
        with connect(self._address, self._token) as connection:
            try:
                send_json(connection, {"do": what, "installation": self._context.installation, **fields})
                yield connection
            except (OSError, EOFError) as error:
                raise EngineUnavailable(f"the agent has hung up while asked to {what}", "start it again") from error

    @contextmanager
    def _fetched(self, what: str, handle: RunHandle, **fields: Any) -> Iterator[IO[bytes] | None]:
        """A stream of the agent; None if it has nothing of the run."""
        with tempfile.TemporaryFile() as stream:
            with self._asked(what, key=handle.data["key"], **fields) as connection:
                answer = receive_json(connection)
                raise_error(answer)
                if answer["found"]:
                    receive_stream(connection, stream)
            yield stream if answer["found"] else None


class RemoteUsage:
    """CPU and memory as the agent reads them."""

    on_this_machine = False

    def __init__(self, executor: RemoteExecutor, handle: RunHandle) -> None:
        self._executor = executor
        self._handle = handle
        self._totals: dict[str, float] = {}

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory (bytes); None once the run has ended."""
        answer = self._executor._ask("usage", key=self._handle.data["key"])
        if answer is None:
            return None
        self._totals = answer["totals"]
        return answer["cpu_s"], answer["memory_bytes"]

    def totals(self) -> dict[str, float]:
        """As of the last reading."""
        return self._totals

    def close(self) -> None:
        """Each reading has a connection of its own."""
