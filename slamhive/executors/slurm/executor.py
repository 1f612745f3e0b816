"""Runs algorithms as jobs of Slurm, on nodes that share the file system of the worker.

A job starts the supervisor of the process executor on its node. What it writes into the work folder says how the run
goes and how it ended. Slurm is asked for everything else, by the comment of the job: nothing is remembered here.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar

from slamhive.base.clock import utc_now
from slamhive.base.errors import Unavailable
from slamhive.base.files import write_aside
from slamhive.executors.base import (
    Capabilities,
    EngineUnavailable,
    EvaluationPlace,
    ExecutorContext,
    GpuGiver,
    ImageMissing,
    LiveKeys,
    Node,
    PackageNeed,
    ProtectionFinding,
    StartFailed,
)
from slamhive.executors.gpu import GpuUse
from slamhive.executors.host_counters import HostReading
from slamhive.executors.host_log import handed_over
from slamhive.executors.process.environment import shim_spec_of
from slamhive.executors.process.executor import (
    KILL_WAIT_S,
    START_WAIT_S,
    ProcessExecutor,
    RecordedEnd,
    note_asked,
    read_end,
    read_json,
    remove_work,
    wait_until,
)
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.shim import IDENTITY_FILE
from slamhive.executors.slurm import command
from slamhive.executors.slurm.command import Queue
from slamhive.executors.slurm.gpus import offers, read_gpu, use_of
from slamhive.executors.slurm.jobs import ERRORS_FILE, comment_of, job_commands, job_limits, job_request, node_program
from slamhive.executors.slurm.node import GPU_KEY, HOST_KEY, USAGE_FILE, JobPlace, NodeReport
from slamhive.executors.slurm.options import CONTAINERS, GPU, JOB_OPTIONS, OPTIONS, PYTHON
from slamhive.executors.slurm.runtimes import NONE, Tried, choose_runtime
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import BY_SIGNAL, Exited, Gone, Protections, RunHandle, Running, RunStatus, UsageSource

logger = logging.getLogger(__name__)

_QUEUE_AGE_S = 1.0
"""All runs of a worker share one look at the queue in this time."""
_SHORT_AGE_S = 0.25
"""The same while somebody waits for the end of a job."""
_MOST_JOBS = 3
"""A run fails to start when Slurm remembers so many jobs of it that have ended by no fault of theirs."""
_NO_FAULT = frozenset(("COMPLETED", "FAILED", "TIMEOUT"))
_SLURM_SAYS = "slurmstepd"


class SlurmExecutor(ProcessExecutor):
    """The executor ``slurm``. It has the environments of the process executor. Safe to share between threads."""

    name = "slurm"
    options = OPTIONS
    capabilities = Capabilities(
        limits=frozenset({Limit.CORES, Limit.MEMORY, Limit.PROCESSES, Limit.DISK}),
        needs=PackageNeed.ENVIRONMENT,
        elsewhere=True,
        gpu=GpuGiver.ENGINE,
        drains=True,
        evaluates_in=EvaluationPlace.PROCESS,
    )

    _printed: ClassVar[Path | None] = None
    """Where nodes write what jobs themselves print, see ``job_request``."""

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._options = command.read_options(context.value(JOB_OPTIONS))
        self._gpu = read_gpu(context.value(GPU))
        self._queue = Queue()

    def unavailable_because(self) -> str | None:
        """Why no job can be submitted; None if a controller answers."""
        problem = super().unavailable_because()
        try:
            command.ping()
        except (EngineUnavailable, StartFailed) as error:
            return str(error)
        return problem

    def examine(self) -> list[ProtectionFinding]:
        """Report the version of Slurm, and the additions to each job."""
        options = " ".join(self._options) or "none"
        return [ProtectionFinding("version", command.version()), ProtectionFinding("SLURM_OPTIONS", options)]

    def examine_nodes(self) -> list[ProtectionFinding]:
        """Report the machine and container runtime of each node, and why the other runtimes cannot be used."""
        return survey_nodes(self._options, self._context.value(CONTAINERS), self._context.value(PYTHON))

    def nodes(self) -> list[Node]:
        """The nodes of the partition, or of all."""
        return [
            Node(node.name, node.state, node.takes_jobs, node.drained, node.cpu_count, node.memory_mb * 2**20)
            for node in command.list_nodes(self._options)
        ]

    def drain(self, node: str, drained: bool) -> None:
        """By ``scontrol``, which needs the rights of an operator."""
        command.drain(node, drained)

    def no_part_of_a_core(self) -> str | None:
        """Refuse: Slurm gives whole cores, and its jobs may set no limits of CPU time below them."""
        return "Slurm gives whole cores to its jobs"

    def check_gpu(self) -> None:
        """Return whether a node that takes jobs, or may again, has the gres."""
        if not any(offers(node.gres, self._gpu) for node in command.list_nodes(self._options)):
            raise Unavailable(f"no node of Slurm has the gres {self._gpu}", "see sinfo -o '%N %G', or set SLURM_GPU")

    def start(self, spec: RunSpec) -> RunHandle:
        """Submit a job unless there is one, and wait a little. Raises EngineUnavailable while it waits for a node."""
        work = spec.work.resolve()
        if not _begun(work):
            # Unless Slurm has a job of the run: a second one would find the lock of the first and end.
            if all(job.over for job in self._jobs(spec.key, 0.0)):
                others = set(spec.placing.other_nodes)
                if others and others.issuperset(node.name for node in command.list_nodes(self._options)):
                    raise StartFailed(f"run {spec.run_id}: {spec.placing.nobody}", "same_cpu: false allows others")
                commands = self._commands(replace(spec, limits=job_limits(spec.limits)), work)
                installation = self._context.installation
                request = job_request(spec, installation, self._options, self._gpu, commands, self._printed)
                # For a node that shares no files, the script holds the ticket of the run.
                self._queue.submit(request._replace(secret=not self.capabilities.shares_files))
            # A job that is over, or never starts, is not waited for.
            wait_until(
                lambda: _begun(work) or all(job.over or job.never_starts for job in self._jobs(spec.key)), START_WAIT_S
            )
        identity = read_json(work / IDENTITY_FILE)
        if identity is None:
            raise self._why_not_started(spec, work)
        place = JobPlace.load(work)
        data = {name: str(identity[name]) for name in ("pid", "birth", "started_at")}
        if self.capabilities.shares_files:
            # The clock of the node may differ from this one, by which times of runs are recorded.
            said = datetime.fromisoformat(identity["started_at"])
            found = start_by_this_clock(work / IDENTITY_FILE, said)
            difference = difference_in_words(place.node, said, found)
            if difference is not None:
                logger.warning("run %d: %s", spec.run_id, difference)
                data |= {"started_at": found.isoformat(), "clock": difference}
        data |= {"work": str(work), "key": spec.key, "timeout_s": str(spec.timeout_s)}
        data |= {"node": place.node, "job": place.job}
        protections = Protections(**identity["protections"])
        container = f"a container of {place.runtime}, " if place.runtime else ""
        where = f"{container}job {place.job} of Slurm on node {place.node}, {protections.held_by}"
        return RunHandle(self.name, data, replace(protections, held_by=where), place.host, place.gpu)

    def poll(self, handle: RunHandle) -> RunStatus:
        """``exit.json`` says how the run ended. Without it, Slurm knows whether the job goes on or what ended it."""
        ended = self._ended(handle)
        if ended is not None:
            return ended
        jobs = self._jobs(handle.data["key"])
        if any(job.runs or job.waits for job in jobs):
            return self._running(handle)
        return self._ended(handle) or self._without_end(handle, jobs)  # it may have been recorded meanwhile

    def _ended(self, handle: RunHandle) -> Exited | Gone | None:
        """Return the end of the run, as far as it is recorded. Slurm and its users end jobs by signals."""
        end = _end_of(handle, shares_files=self.capabilities.shares_files)
        if end is None:
            return None
        exited, outside = end
        if exited.timed_out or exited.out_of_memory or exited.process_limit:
            return exited
        if not outside and exited.exit_code not in BY_SIGNAL:
            return exited
        key = handle.data["key"]
        if outside:
            wait_until(lambda: not self._active(key), KILL_WAIT_S)  # only then does the state of the job tell why
        jobs = self._jobs(key, 0.0)
        lost = next((job for job in jobs if job.lost_its_node), None)
        if lost is not None:
            return Gone(f"Slurm has ended it, because its node failed: {lost.text}")
        return Gone(f"it was ended from outside: {_said_of(jobs)}") if outside else exited

    def _running(self, handle: RunHandle) -> Running:  # noqa: ARG002 - not all know it better
        """Return the status of a run whose job goes on."""
        return Running()

    def _without_end(self, handle: RunHandle, jobs: list[command.SlurmJob]) -> RunStatus:
        """The status of a run whose jobs are over, but did not record how it ended."""
        jobs = jobs or command.accounted_jobs(handle.data["job"])
        if any("OUT_OF_MEMORY" in job.states for job in jobs):
            return Exited(137, out_of_memory=True)
        return Gone(f"the job has ended, but its supervisor could not record how: {_said_of(jobs)}")

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """SIGTERM to all processes of the run, SIGKILL after ``grace_s``, and the end of the job."""
        self._ask_to_end(handle, grace_s)
        self._end_jobs(handle.data["key"])

    def remove(self, handle: RunHandle) -> None:
        """End the job and delete the work folder."""
        self.stop(handle, 0.0)
        remove_work(Path(handle.data["work"]))

    def discard(self, spec: RunSpec) -> None:
        """End the jobs of the key and delete the work folder."""
        work = spec.work.resolve()
        self.remove(RunHandle(self.name, {"key": spec.key, "work": str(work)}))

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """End the jobs of this installation whose runs are over, and remove the remains of environments."""
        self._environments.sweep()
        prefix = comment_of(self._context.installation, "")
        found = [job for job in self._queue.jobs(0.0) if not job.over and job.comment.startswith(prefix)]
        live = live_keys()
        stale = [job for job in found if job.comment.removeprefix(prefix) not in live]
        for job in stale:
            command.cancel(job)
        return [f"job {job.name}" for job in stale]

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """Return the job's measurements on its node; None if the run has ended."""
        work = Path(handle.data["work"])
        if not work.is_dir():
            return None
        wait_until(lambda: (work / USAGE_FILE).exists() or (work / EXIT_FILE).exists(), START_WAIT_S)
        return NodeUsage(work) if not (work / EXIT_FILE).exists() else None

    def host_reading(self, handle: RunHandle) -> HostReading | None:
        """Return the job's readings of its node."""
        return handed_over(_measured(handle).get(HOST_KEY))

    def gpu_use(self, handle: RunHandle, uuid: str | None) -> GpuUse:  # noqa: ARG002 - the node knows it
        """Return the job's measurements on its node."""
        return use_of(_measured(handle).get(GPU_KEY))

    def _commands(self, spec: RunSpec, work: Path) -> str:
        """Return the script of the job. It finds its orders in the work folder. Raises ImageMissing."""
        self._give_orders(spec, work)
        return job_commands(work, gpu=spec.asks_gpu)

    def _give_orders(self, spec: RunSpec, work: Path) -> None:
        """Write into the work folder what the job starts. Raises ImageMissing."""
        environment = self._environments.find(spec.package, spec.identity)
        if not environment.ready:
            raise ImageMissing(f"the environment {spec.identity} of {spec.package} is gone", "build it again")
        shim_spec_of(spec, environment, work, self._context, None).save(work)

    def _why_not_started(self, spec: RunSpec, work: Path) -> EngineUnavailable | StartFailed:
        jobs = self._jobs(spec.key, 0.0)
        active = [job for job in jobs if not job.over]
        said = "; ".join(job.text for job in active or jobs) or "Slurm does not know its job"
        if any(job.never_starts for job in active):
            return StartFailed(f"no node meets what run {spec.run_id} asks for: {said}", "compare it with sinfo -Nl")
        if active:
            return EngineUnavailable(f"run {spec.run_id} waits in Slurm: {said}", "see squeue")
        printed = last_line(work)
        if not printed and len(jobs) < _MOST_JOBS and all(_is_blameless(job) for job in jobs):
            # A controller that is killed forgets the jobs of the last 5 s; a node may fail before the run begins.
            return EngineUnavailable(f"run {spec.run_id} did not start and is submitted again: {said}", "see squeue")
        return StartFailed(f"the job of run {spec.run_id} did not start: {said}{printed}")

    def _ask_to_end(self, handle: RunHandle, grace_s: float) -> None:
        """Signals to the supervisor on the node, until the algorithm has ended."""
        key, work = handle.data["key"], Path(handle.data["work"])
        note_asked(handle)
        self._queue.forget()  # another worker may have submitted the job just now
        for name, patience_s in (("TERM", grace_s), ("USR1", KILL_WAIT_S)):
            # A signal to a job that waits would never be answered.
            jobs = [] if self._has_ended(work) else [job for job in self._active(key) if job.runs]
            for job in jobs:
                command.send_signal(job, name)
            if not jobs or wait_until(lambda: self._has_ended(work) or not self._active(key), patience_s):
                break

    def _has_ended(self, work: Path) -> bool:
        """Return whether the algorithm is known to have ended."""
        return (work / EXIT_FILE).exists()

    def _end_jobs(self, key: str) -> None:
        """End what is left of the jobs, and wait until they are over."""
        if any(job.runs for job in self._active(key)):
            wait_until(lambda: not self._active(key), KILL_WAIT_S)
        for job in self._active(key):
            command.cancel(job)
        if not wait_until(lambda: not self._active(key), START_WAIT_S):
            raise EngineUnavailable(f"Slurm does not end the job of {key}", "see squeue")

    def _active(self, key: str) -> list[command.SlurmJob]:
        """The jobs of the key that wait or run now."""
        return [job for job in self._jobs(key, _SHORT_AGE_S) if not job.over]

    def _jobs(self, key: str, age_s: float = _QUEUE_AGE_S) -> list[command.SlurmJob]:
        comment = comment_of(self._context.installation, key)
        return [job for job in self._queue.jobs(age_s) if job.comment == comment]


class NodeUsage:
    """CPU and memory of a run as its job measures them."""

    on_this_machine = False

    def __init__(self, work: Path) -> None:
        self._work = work
        self._totals: dict[str, float] = {}

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory (bytes); None once the run has ended."""
        if (self._work / EXIT_FILE).exists():
            return None
        try:
            content = json.loads((self._work / USAGE_FILE).read_text(encoding="ascii"))
        except FileNotFoundError:
            return None
        self._totals = content["totals"]
        return content["cpu_s"], content["memory_bytes"]

    def totals(self) -> dict[str, float]:
        """Return the counters of the last reading."""
        return self._totals

    def close(self) -> None:
        """Nothing stays open."""


def _measured(handle: RunHandle) -> dict[str, Any]:
    return read_json(Path(handle.data["work"]) / USAGE_FILE) or {}


def _begun(work: Path) -> bool:
    return (work / IDENTITY_FILE).exists()


def _end_of(handle: RunHandle, *, shares_files: bool) -> RecordedEnd | None:
    """Return the end of the run. Slurm ends late runs by the signals that the supervisor knows, so the time says it."""
    end = read_end(handle)
    if end is None or end.exited.started_at is None or end.exited.ended_at is None:
        return end
    started_at, ended_at = end.exited.started_at, end.exited.ended_at
    if shares_files:  # a clock may also have been set while the run went on
        started_at = datetime.fromisoformat(handle.data["started_at"])
        ended_at = by_this_clock(Path(handle.data["work"]) / EXIT_FILE, ended_at)
    late = ended_at - started_at > timedelta(seconds=float(handle.data["timeout_s"]))
    by_signal = end.from_outside or end.exited.exit_code in BY_SIGNAL
    timed_out = late and by_signal
    return end._replace(exited=replace(end.exited, started_at=started_at, ended_at=ended_at, timed_out=timed_out))


def _said_of(jobs: Sequence[command.SlurmJob]) -> str:
    return "; ".join(job.text for job in jobs) or "Slurm does not know the job any more"


def _is_blameless(job: command.SlurmJob) -> bool:
    """Return whether another job may do better, since it has printed nothing.

    One that completes without a run has found the supervisor of another job. One that fails was killed with its node.
    So may have been one that reaches its time limit: a controller that was killed may show it as running until then.
    """
    return job.ended_by_slurm or job.cancelled_on_a_node or not _NO_FAULT.isdisjoint(job.states)


def last_line(work: Path) -> str:
    """Return the last output of the job, as the end of a message."""
    errors = work / ERRORS_FILE
    lines = errors.read_text(errors="replace").strip().splitlines() if errors.exists() else []
    own = [line for line in lines if not line.startswith(_SLURM_SAYS)]
    return f"; it printed: {own[-1]}" if own else ""


# Times that a node wrote by its own clock, by the clock of the worker: time limits compare them with it.
#
# The shared file system notes when a file was written, by one clock for all. Its difference from the clock of the
# worker is measured with a file that the worker writes itself.


START_FILE = "started-at.json"
_PROBE_FILE = "clock-probe"
_LEAST = timedelta(seconds=10)
"""Seconds may lie between a time and its writing: on a slow file system, or while processes are ended."""


def by_this_clock(file: Path, said: datetime) -> datetime:
    """The time at which ``file`` was written, if it is too far from the time ``said`` in it for equal clocks."""
    probe = file.with_name(_PROBE_FILE)
    try:
        probe.write_bytes(b"x")
        written = _written(file) - (_written(probe) - utc_now())
    except OSError:  # the disk is full: a time that may be wrong is better than no end of the run
        return said
    return said if abs(written - said) < _LEAST else written


def start_by_this_clock(file: Path, said: datetime) -> datetime:
    """The same for the start of a run. The answer is kept, because every look must give the same."""
    kept = read_json(file.with_name(START_FILE))
    if kept is not None:
        return datetime.fromisoformat(kept["started_at"])
    found = by_this_clock(file, said)
    if found != said:
        write_aside(file.with_name(START_FILE), json.dumps({"started_at": found.isoformat()}))
    return found


def difference_in_words(node: str, said: datetime, found: datetime) -> str | None:
    """The difference of the node's clock; None if ``said`` was taken as it is."""
    if said == found:
        return None
    ahead_s = (said - found).total_seconds()
    words = f"{abs(ahead_s):.0f} s {'ahead' if ahead_s > 0 else 'behind'}"
    return f"the clock of node {node} is {words}; times of the run are corrected"


def _written(file: Path) -> datetime:
    return datetime.fromtimestamp(file.stat().st_mtime, UTC)


# -- the offers of the cluster's nodes: ``slamhive doctor cluster`` ----------------------------------------------------


MOST_NODES = 32
_AT_ONCE = 8
_PATIENCE_S = 20
_REACH = (
    "have the worker run and its port open; for https, put the certificate of its authority into those of the node "
    "(/usr/local/share/ca-certificates, then update-ca-certificates)"
)
_INSTALL = "install Charliecloud, Apptainer or Podman on the node"


def survey_nodes(options: Sequence[str], asked: str, python: str, url: str = "") -> list[ProtectionFinding]:
    """One finding for each node. Each node is asked by a short job, the first :data:`MOST_NODES` of them.

    Args:
        options: The options of the user for each job.
        asked: The container runtime that runs will use, ``auto`` or ``none``.
        python: The Python of the nodes; empty for the worker's own.
        url: Where nodes without shared storage reach the worker; empty for others.
    """
    nodes = command.list_nodes(options)
    findings = [
        ProtectionFinding(f"node {node.name}", f"takes no jobs: {node.state}", "see scontrol show node")
        for node in nodes
        if not node.takes_jobs
    ]
    ready = [node for node in nodes if node.takes_jobs]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        findings += pool.map(lambda node: _ask(node, options, asked, python, url), ready[:MOST_NODES])
    if len(ready) > MOST_NODES:
        findings.append(ProtectionFinding("more nodes", f"{len(ready) - MOST_NODES} were not asked"))
    return findings or [ProtectionFinding("nodes", "none", "see sinfo")]


def _ask(node: command.SlurmNode, options: Sequence[str], asked: str, python: str, url: str) -> ProtectionFinding:
    name = f"node {node.name}"
    try:
        program = node_program("report", *([url] if url else []), python=python)
        said = command.run_on(node.name, options, program, _PATIENCE_S)
        return describe_node(name, NodeReport.loads(said), asked, url)
    except (StartFailed, EngineUnavailable) as error:
        return ProtectionFinding(name, f"{node.state}, not asked: {error.message}", error.remedy or "see squeue")
    except (ValueError, KeyError, TypeError):
        return ProtectionFinding(
            name, f"answered something unknown: {said[:80]!r}", "see whether it shares the installation"
        )


def describe_node(name: str, report: NodeReport, asked: str, url: str = "") -> ProtectionFinding:
    """A report in words: the machine, the runtime that runs will use, why not the others, and if it has no data why."""
    host = report.host
    machine = f"{host.cpu_model}, {host.cpu_count} CPUs, {host.memory_bytes / 1e9:.1f} GB"
    if asked == NONE:
        return ProtectionFinding(name, f"{machine}; package environments, no containers")
    candidates = [entry for entry in report.runtimes if asked in ("auto", entry.key)]
    try:
        chosen: Tried | None = choose_runtime(candidates)
    except LookupError:
        chosen = None
    others = "; ".join(f"not {entry.text}" for entry in report.runtimes if entry.problem)
    found = f"{machine}; {'no container runtime' if chosen is None else chosen.text}{f'; {others}' if others else ''}"
    if report.unreached:
        return ProtectionFinding(name, f"{found}; does not reach {url}: {report.unreached}", _REACH)
    return ProtectionFinding(name, found, _INSTALL if chosen is None else None)
