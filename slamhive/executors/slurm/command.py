"""The commands of Slurm: ``sbatch``, ``squeue``, ``scancel`` and ``scontrol``. Needs no accounting, but uses it."""

from __future__ import annotations

import json
import logging
import os
import shlex
import subprocess
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Forbidden, InvalidInput
from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.process.environment import INHERITED
from slamhive.executors.slurm.jobs import ArraySubmission, JobRequest, chunks, comments_of_tasks, submission, tasks_in

ALLOWED_OPTIONS = frozenset(
    ("partition", "account", "qos", "constraint", "gres", "exclusive", "exclude", "nodelist", "reservation")
)
"""What the setting ``SLURM_OPTIONS`` may hold. Everything else follows from the run."""
_PASSED_ON = (*INHERITED, "USER", "HOME", "SLURM_CONF")
_WHOLE_TASK_LISTS = {"SLURM_BITSTR_LEN": "0"}
_TIMEOUT_S = 60.0
_CONTROLLER_AWAY = (
    "unable to contact slurm controller", "connection refused", "timed out", "connection timeout",
    # It was killed while it was asked.
    "transport endpoint is not connected", "connection reset by peer", "broken pipe", "zero bytes were transmitted",
    "missing socket error",
)  # fmt: skip
_NO_CONFIGURATION = ("could not establish a configuration", "unable to process configuration")
_WAITING = frozenset(("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "SPECIAL_EXIT"))
_RUNNING = frozenset(("RUNNING", "COMPLETING", "SUSPENDED", "STOPPED", "SIGNALING", "STAGE_OUT", "RESIZING"))
_NEVER = frozenset(("PartitionConfig", "BadConstraints", "PartitionNodeLimit", "PartitionTimeLimit", "NodeNotAvail"))
"""Reasons of waiting jobs that no node and no partition can ever run."""
_SLURM_ENDED = frozenset(("NODE_FAIL", "BOOT_FAIL", "REVOKED", "PREEMPTED"))
_SLURM_FAILED = frozenset(("JobLaunchFailure", "NodeDown", "SystemFailure"))
"""States, and reasons of the state FAILED, for which the script of a job is not to blame."""

_NOWHERE = "None assigned"
_UNKNOWN_TASK = "Slurm does not know it any more"


@dataclass(frozen=True, slots=True)
class SlurmJob:
    """One job as ``squeue`` shows it.

    Attributes:
        number: Of the job; of a task that waits, that of its array.
        comment: Names its run; see :mod:`slamhive.executors.slurm.jobs`.
        states: The state and, from Slurm 23.11 on, its flags.
        reason: Why it is in this state.
        node: Where it is or was; empty if nowhere yet.
        task: The number of its array, and its own in there.
    """

    number: int
    comment: str
    states: tuple[str, ...]
    reason: str
    node: str
    task: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """The name of the job for commands: tasks of an array share a number until they start."""
        return str(self.number) if self.task is None else f"{self.task[0]}_{self.task[1]}"

    @property
    def waits(self) -> bool:
        """It has no node yet."""
        return not self.runs and not _WAITING.isdisjoint(self.states)

    @property
    def runs(self) -> bool:
        """Its processes may live."""
        return not _RUNNING.isdisjoint(self.states)

    @property
    def over(self) -> bool:
        """It has ended in some way."""
        return not (self.waits or self.runs)

    @property
    def ended_by_slurm(self) -> bool:
        """It is over because its node or Slurm failed, or because Slurm took its node away."""
        return self.lost_its_node or (self.over and self.reason in _SLURM_FAILED)

    @property
    def lost_its_node(self) -> bool:
        """It is over because its node failed, or because Slurm took it away."""
        return self.over and not _SLURM_ENDED.isdisjoint(self.states)

    @property
    def cancelled_on_a_node(self) -> bool:
        """It was cancelled after it got a node: a node does so itself with a job that it could not launch."""
        return self.over and bool(self.node) and "CANCELLED" in self.states

    @property
    def never_starts(self) -> bool:
        """It asks for what no node of its partition has."""
        return self.waits and self.reason in _NEVER

    @property
    def text(self) -> str:
        """Number, state, reason and node in words."""
        reason = f" ({self.reason})" if self.reason not in ("", "None") else ""
        return f"job {self.name} is {' '.join(self.states)}{reason}{f' on {self.node}' if self.node else ''}"


def read_options(text: str) -> list[str]:
    """The value of ``SLURM_OPTIONS`` as arguments of ``sbatch``. Raises InvalidInput."""
    try:
        options = shlex.split(text)
    except ValueError as error:
        raise InvalidInput(f"SLURM_OPTIONS={text!r}: {error}", "close the quotation mark") from None
    for option in options:
        name = option.removeprefix("--").partition("=")[0]
        if not option.startswith("--") or name not in ALLOWED_OPTIONS:
            known = ", ".join(f"--{name}" for name in sorted(ALLOWED_OPTIONS))
            raise InvalidInput(f"SLURM_OPTIONS has {option!r}", f"write --NAME=VALUE with one of {known}")
    return options


def parse_jobs(text: str) -> list[SlurmJob]:
    """The jobs in the output of ``squeue --json``. Raises EngineUnavailable if it is something else."""
    try:
        content = json.loads(text)
        # With its controller away, squeue prints an empty list and ends with 0.
        errors = [str(error.get("description")) for error in content.get("errors", ())]
        jobs = _jobs(content["jobs"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise EngineUnavailable(
            f"squeue --json answered something unknown: {text[:80]!r} ({type(error).__name__})", "try squeue by hand"
        ) from None
    if errors:
        raise EngineUnavailable(f"squeue could not list the jobs: {'; '.join(errors)}", "try scontrol ping")
    return jobs


def _jobs(entries: Sequence[dict[str, Any]]) -> list[SlurmJob]:
    """Each job and each task. Tasks that wait have one entry together, and those that were cancelled then have none."""
    found: list[SlurmJob] = []
    arrays: dict[int, tuple[list[str], set[int]]] = {}
    for entry in entries:
        state = entry["job_state"]
        states = (state,) if isinstance(state, str) else tuple(state)
        job = SlurmJob(
            int(entry["job_id"]), entry["comment"] or "", states, entry["state_reason"], entry["nodes"] or ""
        )
        array, comments = _number(entry.get("array_job_id")), comments_of_tasks(job.comment)
        if not array or not comments:
            found.append(job)
            continue
        task = _number(entry.get("array_task_id"))
        tasks = list(tasks_in(entry.get("array_task_string") or "")) if task is None else [task]
        arrays.setdefault(array, (comments, set()))[1].update(tasks)
        found += [replace(job, comment=comments[task], task=(array, task)) for task in tasks]
    for array, (comments, known) in arrays.items():
        missing = set(range(len(comments))) - known
        found += [SlurmJob(array, comments[task], ("CANCELLED",), _UNKNOWN_TASK, "", (array, task)) for task in missing]
    return found


def _number(value: Any) -> int | None:
    """A number, which later versions wrap to say whether it is set."""
    if isinstance(value, dict):
        return int(value["number"]) if value.get("set") else None
    return None if value is None else int(value)


def list_jobs() -> list[SlurmJob]:
    """The jobs of this user that the controller remembers: those that wait, run, or ended some minutes ago.

    Older versions list those of others as well.
    """
    return parse_jobs(_run(["squeue", "--json", "--me"]))


def accounted_jobs(number: str) -> list[SlurmJob]:
    """The job with this number as the accounting database remembers it; nothing without one, or if it is away."""
    if not number:
        return []
    fields = "--format=JobIDRaw,State,Reason,NodeList"
    try:
        found = parse_accounted(
            _run(["sacct", "--noheader", "--parsable2", "--allocations", f"--jobs={number}", fields])
        )
        # The last task of an array has its number, for which sacct shows all tasks.
        return [job for job in found if str(job.number) == number]
    except (EngineUnavailable, StartFailed):
        return []


def parse_accounted(text: str) -> list[SlurmJob]:
    """The lines of ``sacct``; those of another form are left out. Who ended a job stands behind its state."""
    found = []
    for line in text.splitlines():
        number, state, reason, node = (*line.replace(_NOWHERE, "").split("|"), "", "", "")[:4]
        if number.isdigit() and state:
            found.append(SlurmJob(int(number), "", (state.split()[0],), reason or "None", node))
    return found


def submit(submission: ArraySubmission) -> None:
    """Submit a job or an array. Raises StartFailed with the words of ``sbatch`` if Slurm refuses it."""
    _run(["sbatch", "--parsable", *submission.arguments], submission.script)


def send_signal(job: SlurmJob, name: str) -> None:
    """Send a signal to the process of the job's script alone. Does nothing if the job has ended."""
    _cancel(["--batch", f"--signal={name}", job.name])


def cancel(job: SlurmJob) -> None:
    """End the job. Does nothing if it has ended."""
    _cancel([job.name])


def _cancel(arguments: Sequence[str]) -> None:
    try:
        _run(["scancel", *arguments])
    except StartFailed:
        return  # it has ended


def ping() -> str:
    """Call ``scontrol ping``; raises EngineUnavailable if no controller answers."""
    try:
        return " ".join(_run(["scontrol", "ping"]).split())
    except StartFailed:
        raise EngineUnavailable("Slurm's controller is down", "ask whoever runs the cluster") from None


@dataclass(frozen=True, slots=True)
class SlurmNode:
    """One node as ``sinfo`` shows it."""

    name: str
    state: str
    cpu_count: int
    memory_mb: int
    gres: str = ""

    @property
    def takes_jobs(self) -> bool:
        """Return whether a job could start there now or soon."""
        return self.state.rstrip("*$~#!%@^-+") in {"idle", "mixed", "allocated", "completing"} and "*" not in self.state

    @property
    def drained(self) -> bool:
        """Return whether somebody keeps further jobs away from it."""
        return self.state.startswith("drain")


def list_nodes(options: Sequence[str]) -> list[SlurmNode]:
    """The nodes of the partition that ``options`` name, or of all partitions."""
    partition = [option for option in options if option.startswith("--partition=")]
    return parse_nodes(_run(["sinfo", "--noheader", "--Node", "--format=%N %T %c %m %G", *partition]))


def parse_nodes(text: str) -> list[SlurmNode]:
    """The lines of ``sinfo``, which has one for each partition of a node. Raises EngineUnavailable for others."""
    found: dict[str, SlurmNode] = {}
    try:
        for line in filter(str.strip, text.splitlines()):
            name, state, cpus, memory, *gres = line.split()
            found[name] = SlurmNode(name, state, int(cpus.rstrip("+")), int(memory.rstrip("+")), "".join(gres))
    except ValueError:
        raise EngineUnavailable(f"sinfo answered something unknown: {line[:80]!r}", "try sinfo by hand") from None
    return [found[name] for name in sorted(found)]


def drain(node: str, drained: bool) -> None:
    """Keep further jobs away from a node, or end that. Raises Forbidden if Slurm does not let this user do it."""
    asked = ["State=DRAIN", "Reason=drained by SLAM Hive"] if drained else ["State=RESUME"]
    try:
        _run(["scontrol", "update", f"NodeName={node}", *asked])
    except StartFailed as error:
        raise Forbidden(f"node {node} is not changed: {error.message}", "ask whoever runs the cluster") from None


def run_on(node: str, options: Sequence[str], program: Sequence[str], patience_s: int) -> str:
    """Return the output of a program on a node. Raises StartFailed if it fails, or if the node stays busy."""
    place = [f"--nodelist={node}", "--nodes=1", "--ntasks=1", "--mem=500M", "--time=2", "--chdir=/"]
    return _run(["srun", *options, *place, f"--immediate={patience_s}", *program])


def version() -> str:
    """Such as ``slurm-wlm 22.05.8``."""
    return _run(["sbatch", "--version"]).strip()


def _run(command: Sequence[str], stdin: str = "") -> str:
    """The output of a command. Jobs inherit its environment, so that it gets no secrets."""
    environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ} | _WHOLE_TASK_LISTS
    try:
        done = subprocess.run(
            command, input=stdin, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except FileNotFoundError:
        raise EngineUnavailable(
            f"there is no {command[0]} on this machine", "install Slurm's commands, or work on a login node"
        ) from None
    except subprocess.TimeoutExpired:
        raise EngineUnavailable(f"{command[0]} has not answered for {_TIMEOUT_S:.0f} s", "try scontrol ping") from None
    if done.returncode:
        raise _failure(command[0], done.stderr)
    return done.stdout


def _failure(program: str, said: str) -> EngineUnavailable | StartFailed:
    """The error that the words of a command mean."""
    lines = [line.removeprefix(f"{program}: ").removeprefix("error: ") for line in said.splitlines() if line.strip()]
    text = "; ".join(lines) or "it says nothing"
    lower = text.lower()
    if "unrecognized option" in lower and "json" in lower:
        return EngineUnavailable("this Slurm is too old: its squeue has no --json", "use Slurm 21.08 or later")
    if any(words in lower for words in _CONTROLLER_AWAY):
        return EngineUnavailable(f"Slurm's controller does not answer: {text}", "try scontrol ping")
    if any(words in lower for words in _NO_CONFIGURATION):
        return EngineUnavailable("Slurm has no configuration on this machine", "set SLURM_CONF, or use a login node")
    return StartFailed(f"{program} refuses: {text}", "compare SLURM_OPTIONS and the limits of the run with sinfo")


# Slurm as a worker's threads share it: one look at the jobs for all who ask, one ``sbatch`` for all who submit.


logger = logging.getLogger(__name__)


class Queue:
    """The jobs that Slurm knows, and the way to further ones. Safe to share between threads.

    Args:
        read: Lists the jobs.
        send: Submits a job or an array.
    """

    def __init__(
        self,
        read: Callable[[], list[SlurmJob]] = list_jobs,
        send: Callable[[ArraySubmission], None] = submit,
    ) -> None:
        self._read, self._send = read, send
        self._reading, self._sending, self._noting = threading.Lock(), threading.Lock(), threading.Lock()
        self._jobs: list[SlurmJob] = []
        self._read_at_s: float | None = None
        self._waiting: list[tuple[JobRequest, Future[None]]] = []

    def jobs(self, age_s: float) -> list[SlurmJob]:
        """The jobs as they were at most ``age_s`` ago. Whoever waits for the look of another thread takes the next."""
        oldest_s = monotonic_s() - age_s
        with self._reading:
            if self._read_at_s is None or self._read_at_s < oldest_s:
                begun_s = monotonic_s()
                self._jobs = self._read()
                self._read_at_s = begun_s
            return self._jobs

    def forget(self) -> None:
        """Mark what was read as out of date."""
        with self._reading:
            self._read_at_s = None

    def submit(self, request: JobRequest) -> None:
        """Return when Slurm has the job. What is asked for while another ``sbatch`` works goes out in an array.

        So nobody waits for company, and a slow Slurm is asked less often. Raises what :func:`command.submit` raises.
        """
        answer: Future[None] = Future()
        with self._noting:
            self._waiting.append((request, answer))
        with self._sending:
            if not answer.done():
                with self._noting:
                    waiting, self._waiting = self._waiting, []
                answers = {id(request): answer for request, answer in waiting}
                for chunk in chunks(request for request, _ in waiting):
                    self._send_chunk(chunk, [answers[id(request)] for request in chunk])
        self.forget()
        answer.result()

    def _send_chunk(self, requests: Sequence[JobRequest], answers: Sequence[Future[None]]) -> None:
        try:
            self._send(submission(requests))
        except StartFailed as error:
            if len(requests) > 1:
                # Arrays may be switched off, or too many for a limit that lets some of the jobs through.
                logger.info("Slurm takes no array of %d jobs: %s", len(requests), error.message)
                for request, answer in zip(requests, answers, strict=True):
                    self._send_chunk([request], [answer])
                return
            answers[0].set_exception(error)
        except Exception as error:  # noqa: BLE001 - it is raised where the answer is awaited
            for answer in answers:
                answer.set_exception(error)
        else:
            for answer in answers:
                answer.set_result(None)
