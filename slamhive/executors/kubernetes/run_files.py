"""The folder that worker and pod share for one run: what the supervisor is to do, and what it has written.

The algorithm can write there too. So nothing is believed that could harm the worker: no link is followed, sizes are
bounded, and a record that makes no sense is a lost run.
"""

from __future__ import annotations

import io
import json
import os
import stat
import tempfile
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import slamhive
from slamhive.base.errors import Unavailable
from slamhive.base.files import remedy_of, temporary_folder, write_aside
from slamhive.base.tree import remove_tree
from slamhive.domain.run import Host
from slamhive.executors.cgroup import file_cache_bytes, parse_flat, present
from slamhive.executors.kubernetes.pod_files import (
    CLAIM_FILE,
    LOG_FOLDER,
    ORDER_FILE,
    STARTED_FILE,
    STOP_FILE,
    SUPERVISOR_FILE,
    USAGE_FILE,
)
from slamhive.executors.kubernetes.supervisor import used_cpu_s
from slamhive.executors.packing import pack_folder
from slamhive.executors.process.exit_file import EXIT_FILE, assemble
from slamhive.executors.spec import RunOutput, RunSpec
from slamhive.executors.status import Exited, Gone
from slamhive.executors.transfer import unpack_live, unpack_output

_FOLDER = "pod"
_MOST_BYTES = 1_000_000
_LONGEST_WORDS = 190
_MOST = 2**62
_UNKNOWN = "unknown"
_MEMORY_FILES = (
    ("memory/memory.usage_in_bytes", "memory/memory.stat", "memory/memory.max_usage_in_bytes"),
    ("memory.current", "memory.stat", "memory.peak"),
)
"""Usage, statistics and peak under versions 1 and 2 of control groups."""
_MAKES_NO_SENSE = (KeyError, TypeError, ValueError, OverflowError)


@dataclass(frozen=True, slots=True)
class Started:
    """Start of the algorithm: time and place. ``gpu`` is the UUID that the pod knows of its GPU."""

    at: datetime
    node: str
    host: Host
    gpu: str | None = None


class PodRunFiles:
    """The files of one run below its work folder."""

    def __init__(self, work: Path) -> None:
        self.work = work.resolve()
        self.folder = self.work / _FOLDER
        self.outputs = self.work / "outputs"
        self.inputs = self.work / "inputs"
        self.scratch = self.work / "tmp"

    def made_variant(self) -> str | None:
        """The checksum of the recording that its node has made: on shared storage the worker makes variants."""
        return None

    def prepare(self, spec: RunSpec, log_max_bytes: int) -> None:
        """Write everything that the supervisor needs; may be done again. Raises Unavailable."""
        order = order_of(spec, log_max_bytes)
        try:
            for folder in (self.folder, self.scratch, *(self.outputs / output.name for output in spec.outputs)):
                folder.mkdir(parents=True, exist_ok=True)
            write_aside(self.folder / SUPERVISOR_FILE, supervisor_archive())
            write_aside(self.folder / ORDER_FILE, json.dumps(order))
        except OSError as error:
            raise Unavailable(f"{self.folder} cannot be written: {error.strerror}", remedy_of(error)) from None

    @property
    def there(self) -> bool:
        """Return whether the run was prepared, and not removed."""
        return (self.folder / ORDER_FILE).exists()

    @property
    def claimed(self) -> bool:
        """Return whether a supervisor has started, or none may start any more."""
        return (self.folder / CLAIM_FILE).exists()

    @property
    def begun(self) -> bool:
        """Return whether the supervisor has started, so that nobody may start another one."""
        return self.claimed

    def started(self) -> Started | None:
        """None if the supervisor has not recorded that the algorithm has started."""
        found = self.read(STARTED_FILE)
        try:
            return None if found is None else _start(found)
        except _MAKES_NO_SENSE:
            return None

    def ended(self) -> Exited | Gone | None:
        """Read how the run ended; None if the supervisor has not recorded it."""
        found = self.read(EXIT_FILE)
        if found is None:
            return None
        try:
            return _ending(found)
        except _MAKES_NO_SENSE as error:
            return Gone(f"the record of how the run ended is damaged: {type(error).__name__}: {error}")

    @property
    def delivering(self) -> bool:
        """Return whether the algorithm has ended, and its results are on their way."""
        return False

    @property
    def as_of(self) -> datetime | None:
        """Return the time of the last sign of the pod; None if its files are shared."""
        return None

    @property
    def arrived(self) -> str:
        """Return the share of the results that has arrived, in words."""
        return ""

    def forget(self) -> None:
        """Take nothing more from the pod."""

    def written_bytes(self) -> int:
        """Return the size of files that the worker does not see."""
        return 0

    def copy_live(self, output: RunOutput) -> None:
        """Bring the watched files of an output up to date on the controller."""
        source = self.outputs / output.name
        changed = [name for name in output.live if _differs(source / name, output.destination / name)]
        if not changed:
            return
        with tempfile.TemporaryFile() as stream:
            pack_folder(source, stream, changed)
            stream.seek(0)
            unpack_live(stream, output)

    def hand_over(self, output: RunOutput) -> None:
        """Bring an output to its destination, unless that was done before. Raises Unavailable.

        Nothing of it stays here: what a run has written is counted once.
        """
        source, done = self.outputs / output.name, self.work / f"handed-over-{output.name}"
        if not source.is_dir():
            return
        take_over(source, output, self.work)
        try:
            source.rename(done)  # in one step, so that nobody takes over what is half removed
            remove_tree(done)
        except OSError as error:
            raise Unavailable(f"{source} cannot be removed: {error.strerror}", remedy_of(error)) from None

    def collect(self, spec: RunSpec) -> None:
        """Bring all outputs to their destinations. Raises Unavailable."""
        for output in spec.outputs:
            self.hand_over(output)

    def usage(self) -> dict[str, Any] | None:
        """The last counters of the kernel that the supervisor wrote; None before the first."""
        return self.read(USAGE_FILE)

    def log(self, most_bytes: int) -> bytes:
        """Return the output of the run so far."""
        with temporary_folder() as folder:
            copy = RunOutput("log", folder / LOG_FOLDER, "", max_bytes=2 * most_bytes)
            take_over(self.folder / LOG_FOLDER, copy, folder)
            return assemble(copy.destination)

    def ask_to_stop(self, grace_s: float) -> None:
        """Let the supervisor end the run. A later call replaces the grace. Raises Unavailable."""
        try:
            write_aside(self.folder / STOP_FILE, str(grace_s))
        except FileNotFoundError:
            return  # the run was removed
        except OSError as error:
            raise Unavailable(f"{self.folder} cannot be written: {error.strerror}", remedy_of(error)) from None

    def block(self) -> bool:
        """Ensure that no supervisor starts any more; False if one has started already."""
        try:
            os.close(os.open(self.folder / CLAIM_FILE, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return False
        except FileNotFoundError:
            return True
        return True

    def remove(self) -> None:
        """Delete the work folder. Does nothing if it is gone. Raises Unavailable."""
        try:
            remove_tree(self.work)
        except OSError as error:
            raise Unavailable(f"{self.work} cannot be removed: {error.strerror}", remedy_of(error)) from None

    def read(self, name: str) -> dict[str, Any] | None:
        """Read the file of the supervisor; None if there is nothing yet, empty if it makes no sense."""
        try:
            # A listing makes NFS look at the server; what it says of single names may be old.
            if name not in [entry.name for entry in self.folder.iterdir()]:
                return None
            # The run may write here, so neither a link is followed nor a pipe waited for.
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            with os.fdopen(os.open(self.folder / name, flags), "rb") as stream:
                if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                    return {}
                content = json.loads(stream.read(_MOST_BYTES).decode(errors="replace"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}


def order_of(spec: RunSpec, log_max_bytes: int) -> dict[str, Any]:
    """Return the orders for the supervisor."""
    return {
        "command": list(spec.command),
        "timeout_s": spec.timeout_s,
        "log_max_bytes": log_max_bytes,
        "pids": spec.limits.pids,
        "file_bytes": spec.limits.file_bytes,
        "cores": None if spec.limits.cpuset is None else list(spec.limits.cpuset),
    }


def take_over(folder: Path, output: RunOutput, work: Path) -> None:
    """Copy what a pod has written to ``folder``: plain files within the bounds of ``output``. Raises Unavailable."""
    with tempfile.TemporaryFile() as stream:
        try:
            pack_folder(folder, stream)
            stream.seek(0)
            unpack_output(stream, output, work)
        except OSError as error:
            raise Unavailable(f"{output.destination} cannot be written: {error}", remedy_of(error)) from None


def _differs(source: Path, copy: Path) -> bool:
    """Return whether ``source`` is there and may hold something else than its ``copy``, which was made later."""
    try:
        original = source.lstat()
        known = copy.lstat()
    except FileNotFoundError:
        return source.exists()
    return original.st_size != known.st_size or original.st_mtime_ns >= known.st_mtime_ns


def _start(found: dict[str, Any]) -> Started:
    host = Host(
        cpu_model=_words(found["cpu"]),
        cpu_count=_count(found["cores"]),
        memory_bytes=_count(found.get("memory_bytes")),  # supervisors of version 0.1 did not record it
        kernel=_words(found.get("kernel", _UNKNOWN)),
        os=_UNKNOWN,  # a pod sees the system of its image
    )
    # Images hold other words than the UUID of a GPU in the same variable, such as ``all``.
    gpu = _words(found.get("gpu"))
    uuid = gpu if gpu.startswith("GPU-") else None
    return Started(_moment(found["started_s"]), str(found["node"]), host, uuid)


def _words(found: object) -> str:
    return "".join(character for character in str(found) if character.isprintable())[:_LONGEST_WORDS]


def _count(found: Any) -> int:
    return max(0, min(int(found or 0), _MOST))


def _ending(found: dict[str, Any]) -> Exited | Gone:
    if found["error"]:
        return Gone(f"the algorithm could not be started in its pod: {found['error']}")
    if found["ended_from_outside"]:
        return Gone("the pod was ended from outside: deleted, evicted, or its node was drained")
    return Exited(
        exit_code=int(found["exit_code"]),
        out_of_memory=bool(found["out_of_memory"]),
        process_limit=bool(found["process_limit"]),
        refused_processes=bool(found["process_limit"]),
        timed_out=bool(found["timed_out"]),
        started_at=_moment(found["started_s"]),
        ended_at=_moment(found["ended_s"]),
    )


class PodUsage:
    """CPU and memory of a run, from the kernel's counters of its container without the supervisor's share."""

    on_this_machine = False

    def __init__(self, files: PodRunFiles) -> None:
        self._files = files
        self._totals: dict[str, float] = {}

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory in use (bytes); None once the run has ended."""
        over = self._files.delivering or self._files.ended() is not None
        found = None if over else self._files.usage()
        try:
            usage = None if found is None else parse_usage(found)
        except _MAKES_NO_SENSE:
            return None
        if usage is None:
            return None
        cpu_s, memory_bytes, peak_bytes = usage
        self._totals = present({"ram.charged_max": peak_bytes})
        return cpu_s, memory_bytes

    def totals(self) -> dict[str, float]:
        """Return the counters of the last reading."""
        return self._totals

    def close(self) -> None:
        """Nothing stays open."""


def parse_usage(content: dict[str, Any]) -> tuple[float, int, int | None] | None:
    """CPU time (s), memory in use and peak (bytes) of what the supervisor wrote; None if a counter is missing."""
    if not content:
        return None
    files, own_bytes = content["files"], content["own_bytes"]
    cpu_s = used_cpu_s(files, content["own_cpu_s"])
    names = next((names for names in _MEMORY_FILES if names[0] in files), _MEMORY_FILES[0])
    current, statistics, peak = (files.get(name) for name in names)
    if cpu_s is None or current is None or statistics is None:
        return None
    in_use_bytes = int(current) - file_cache_bytes(parse_flat(statistics)) - own_bytes
    peak_bytes = None if peak is None else max(0, int(peak) - own_bytes)
    return cpu_s, max(0, in_use_bytes), peak_bytes


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


# What a pod executes, with the modules that it needs, in one file that the Python of any image can run.


SUPERVISOR_MODULES = (
    "executors/host_counters.py",
    "executors/kubernetes/pod_files.py",
    "executors/kubernetes/supervisor.py",
    "executors/process/exit_file.py",
    "base/errors.py",
    "run_folder/host_columns.py",
)
_ON_NODE = "executors/node_store/on_node"
COURIER_MODULES = (
    "executors/kubernetes/courier.py",
    "executors/kubernetes/pod_files.py",
    *(f"{_ON_NODE}/{name}.py" for name in ("cache", "connection", "results", "run")),
    "executors/packing.py",
    "executors/process/exit_file.py",
    "base/tree.py",
)
_MAIN = """\
import sys
from pathlib import Path
from slamhive.executors.kubernetes.{module} import main
sys.exit(main({argument}))
"""
_ALWAYS_THE_SAME = (1980, 1, 1, 0, 0, 0)


def supervisor_archive() -> bytes:
    """A file for ``python3 FILE FOLDER``, the same bytes each time."""
    return _pack(SUPERVISOR_MODULES, _MAIN.format(module="supervisor", argument="Path(sys.argv[1])"))


def courier_archive() -> bytes:
    """A file for ``python3 FILE (fetch|report)``, the same bytes each time."""
    return _pack(COURIER_MODULES, _MAIN.format(module="courier", argument="sys.argv[1]"))


def _pack(modules: tuple[str, ...], main: str) -> bytes:
    root = Path(slamhive.__file__).parent
    files = {f"slamhive/{name}": (root / name).read_text(encoding="utf-8") for name in modules}
    folders = {str(parent) for name in files for parent in Path(name).parents if parent != Path()}
    files |= {f"{folder}/__init__.py": "" for folder in folders}
    files["__main__.py"] = main
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, _ALWAYS_THE_SAME), text, zipfile.ZIP_DEFLATED)
    return packed.getvalue()
