"""The side that runs algorithms: ``python -m slamhive_remote.agent ROOT SOCKET``, the token in ``REMOTE_TOKEN``.

Everything that it knows lies below its root, so that it can be killed and started again. A run is a folder that is
renamed into place when all inputs are there. The algorithm runs by the process executor, on this machine.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sys
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.base.files import temporary_folder, write_aside
from slamhive.base.project import project_root
from slamhive.base.tree import remove_tree, unpack_trusted, walk
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ExecutorContext
from slamhive.executors.packing import pack_folder
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, RunHandle, Running, UsageSource
from slamhive.executors.transfer import relocated, unpack_inputs
from slamhive_remote.wire import error_to_json, receive_json, receive_stream, send_json, send_stream

SPEC = TypeAdapter(RunSpec)
SPEC_FILE, HANDLE_FILE, TIMED_OUT_FILE = "spec.json", "handle.json", "timed-out"
LOG_MAX_BYTES = 100_000
TIME_CHECK_S = 0.2
_PLAIN = re.compile(r"[A-Za-z0-9_.-]+")


class Agent:
    """Answers requests. Safe to share between threads: one lock for each run."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._locks: dict[str, threading.Lock] = {}
        self._sources: dict[str, UsageSource] = {}
        self._mutex = threading.Lock()

    def answer(self, connection: Connection) -> None:
        """Do what one connection asks for."""
        with connection, contextlib.suppress(OSError, EOFError):
            asked = receive_json(connection)
            try:
                with self._locked(asked):
                    getattr(self, f"_do_{asked['do']}")(connection, asked)
            except SlamHiveError as error:
                send_json(connection, error_to_json(error))
            except (OSError, tarfile.TarError) as error:
                send_json(connection, error_to_json(SlamHiveError(f"{type(error).__name__}: {error}")))

    def end_late_runs(self) -> None:
        """For ever: end the runs that have reached their time limit, whether or not a controller lives."""
        while True:
            for spec_path in self._root.glob(f"runs/*/*/{SPEC_FILE}"):
                asked = {"installation": spec_path.parent.parent.name, "key": spec_path.parent.name}
                with self._locked(asked), contextlib.suppress(SlamHiveError, OSError):
                    self._end_if_late(asked)
            time.sleep(TIME_CHECK_S)

    def _end_if_late(self, asked: dict[str, Any]) -> None:
        handle = self._handle(asked)
        if handle is None or not isinstance(self._executor(asked).poll(handle), Running):
            return
        ran_s = (datetime.now(UTC) - datetime.fromisoformat(handle.data["started_at"])).total_seconds()
        if ran_s > self._spec(asked).timeout_s:
            (self._folder(asked) / TIMED_OUT_FILE).touch()
            self._executor(asked).stop(handle, 0.5)

    def _do_ping(self, connection: Connection, _asked: dict[str, Any]) -> None:
        send_json(connection, {"about": f"answers, with its files below {self._root}"})

    def _do_identity(self, connection: Connection, asked: dict[str, Any]) -> None:
        package = self._package(asked)
        send_json(connection, self._executor(asked).identity(package) if package.folder.is_dir() else None)

    def _do_build(self, connection: Connection, asked: dict[str, Any]) -> None:
        package = self._package(asked)
        with temporary_folder(root=self._root) as aside:
            with tempfile.TemporaryFile() as archive:
                receive_stream(connection, archive)
                with tarfile.open(fileobj=archive, mode="r|") as tar:
                    unpack_trusted(tar, aside / "package")
            if not package.folder.is_dir():
                package.folder.parent.mkdir(parents=True, exist_ok=True)
                (aside / "package").rename(package.folder)
        lines: list[str] = []
        identity = self._executor(asked).build(package, lines.append)
        send_json(connection, {"identity": identity, "lines": lines})

    def _do_has(self, connection: Connection, asked: dict[str, Any]) -> None:
        send_json(connection, self._folder(asked).is_dir())

    def _do_put(self, connection: Connection, asked: dict[str, Any]) -> None:
        folder = self._folder(asked)
        with temporary_folder(root=self._root) as aside, tempfile.TemporaryFile() as archive:
            receive_stream(connection, archive)
            made = aside / "run"
            made.mkdir()
            unpack_inputs(archive, made)
            for output in asked["spec"]["outputs"]:
                (made / "outputs" / output["name"]).mkdir()
            spec = relocated(SPEC.validate_python(asked["spec"]), folder)
            write_aside(made / SPEC_FILE, SPEC.dump_json(spec))
            if not folder.is_dir():
                folder.parent.mkdir(parents=True, exist_ok=True)
                made.rename(folder)
        send_json(connection, None)

    def _do_start(self, connection: Connection, asked: dict[str, Any]) -> None:
        handle = self._executor(asked).start(self._spec(asked))
        write_aside(self._folder(asked) / HANDLE_FILE, json.dumps(handle.data))
        protections = {} if handle.protections is None else asdict(handle.protections)
        send_json(connection, {"started_at": handle.data["started_at"], "protections": protections})

    def _do_poll(self, connection: Connection, asked: dict[str, Any]) -> None:
        handle = self._handle(asked)
        status = Gone("the agent does not have it") if handle is None else self._executor(asked).poll(handle)
        content = asdict(status)
        if isinstance(status, Exited):
            content["timed_out"] = (self._folder(asked) / TIMED_OUT_FILE).exists()
            assert status.started_at is not None
            assert status.ended_at is not None
            content |= {"started_at": status.started_at.isoformat(), "ended_at": status.ended_at.isoformat()}
        send_json(connection, {"kind": type(status).__name__.lower(), **content})

    def _do_stop(self, connection: Connection, asked: dict[str, Any]) -> None:
        handle = self._handle(asked)
        if handle is not None:
            self._executor(asked).stop(handle, asked["grace_s"])
        send_json(connection, None)

    def _do_remove(self, connection: Connection, asked: dict[str, Any]) -> None:
        self._remove(asked)
        send_json(connection, None)

    def _do_log(self, connection: Connection, asked: dict[str, Any]) -> None:
        def write(stream: Any) -> None:
            handle = self._handle(asked)
            assert handle is not None
            with temporary_folder(root=self._root) as aside:
                self._executor(asked).save_log(handle, aside / "log")
                stream.write((aside / "log").read_bytes())

        self._send(connection, write if self._handle(asked) is not None else None)

    def _do_live(self, connection: Connection, asked: dict[str, Any]) -> None:
        self._send_output(connection, asked, asked["names"])

    def _do_outputs(self, connection: Connection, asked: dict[str, Any]) -> None:
        self._send_output(connection, asked, None)

    def _do_size(self, connection: Connection, asked: dict[str, Any]) -> None:
        places = (self._folder(asked) / name for name in ("outputs", "work"))
        send_json(connection, sum(entry.status.st_size for place in places for entry in walk(place) if entry.is_file))

    def _do_usage(self, connection: Connection, asked: dict[str, Any]) -> None:
        handle, name = self._handle(asked), f"{asked['installation']}/{asked['key']}"
        source = self._sources.get(name)
        if source is None and handle is not None:
            source = self._executor(asked).usage_source(handle)
        reading = None if source is None else source.read()
        if source is None or reading is None:
            self._sources.pop(name, None)
            send_json(connection, None)
            return
        self._sources[name] = source
        send_json(connection, {"cpu_s": reading[0], "memory_bytes": reading[1], "totals": source.totals()})

    def _do_keys(self, connection: Connection, asked: dict[str, Any]) -> None:
        send_json(connection, self._keys(asked))

    def _do_sweep(self, connection: Connection, asked: dict[str, Any]) -> None:
        for key in asked["over"]:
            self._remove({**asked, "key": key})
        self._executor(asked).sweep(lambda: self._keys(asked))
        send_json(connection, None)

    def _keys(self, asked: dict[str, Any]) -> list[str]:
        return sorted(path.name for path in (self._root / "runs" / asked["installation"]).glob("*"))

    def _remove(self, asked: dict[str, Any]) -> None:
        folder = self._folder(asked)
        if (folder / SPEC_FILE).exists():
            handle = self._handle(asked)
            self._executor(asked).discard(self._spec(asked))
            if handle is not None:
                self._executor(asked).remove(handle)
        remove_tree(folder)

    def _send_output(self, connection: Connection, asked: dict[str, Any], only: list[str] | None) -> None:
        folder = self._folder(asked) / "outputs" / asked["output"]
        self._send(connection, (lambda stream: pack_folder(folder, stream, only)) if folder.is_dir() else None)

    def _send(self, connection: Connection, write: Callable[[Any], None] | None) -> None:
        if write is None:
            send_json(connection, {"found": False})
            return
        with tempfile.TemporaryFile() as stream:
            write(stream)
            stream.seek(0)
            send_json(connection, {"found": True})
            send_stream(connection, stream)

    def _executor(self, asked: dict[str, Any]) -> ProcessExecutor:
        return ProcessExecutor(ExecutorContext(self._root, project_root(), asked["installation"], LOG_MAX_BYTES))

    def _package(self, asked: dict[str, Any]) -> AlgorithmPackage:
        folder = self._root / "packages" / asked["hash"].replace(":", "-") / asked["package"]
        return AlgorithmPackage(asked["package"], folder, asked["package"], "", "", "", "")

    def _folder(self, asked: dict[str, Any]) -> Path:
        for name in (asked["installation"], asked["key"]):
            if not _PLAIN.fullmatch(name):
                raise InvalidInput(f"{name!r} cannot be the name of a folder")
        return self._root.joinpath("runs", asked["installation"], asked["key"])

    def _spec(self, asked: dict[str, Any]) -> RunSpec:
        return SPEC.validate_json((self._folder(asked) / SPEC_FILE).read_bytes())

    def _handle(self, asked: dict[str, Any]) -> RunHandle | None:
        try:
            return RunHandle("process", json.loads((self._folder(asked) / HANDLE_FILE).read_text()))
        except FileNotFoundError:
            return None

    def _locked(self, asked: dict[str, Any]) -> threading.Lock:
        """One request for a run at a time, and one build; the rest has a lock that nobody else knows."""
        name = asked.get("key") or asked.get("package")
        with self._mutex:
            return threading.Lock() if name is None else self._locks.setdefault(name, threading.Lock())


def main(root: Path, address: str) -> None:
    """Answer until killed."""
    root.mkdir(parents=True, exist_ok=True)
    for left in root.glob(".slamhive-*"):
        shutil.rmtree(left, ignore_errors=True)
    agent = Agent(root)
    threading.Thread(target=agent.end_late_runs, daemon=True).start()
    Path(address).unlink(missing_ok=True)
    with Listener(address, "AF_UNIX", backlog=64, authkey=os.environ["REMOTE_TOKEN"].encode()) as listener:
        while True:
            try:
                connection = listener.accept()
            except (OSError, EOFError, AuthenticationError):
                continue  # who asked has hung up, or does not know the token
            threading.Thread(target=agent.answer, args=(connection,), daemon=True).start()


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2])
