"""Program of a job on its node: ``python -m slamhive.executors.slurm.node (supervise|measure) <work folder>``.

``supervise`` takes ``gpu`` as a further argument for a run that asked for one.

``... node report [NODE_URL]`` prints what the node has to offer, see :class:`NodeReport`.

The supervisor is the one of the process executor, in the foreground: the job lasts as long as it does. Beside it, and
outside of what counts for the run, a second process writes to ``usage.json`` ten times a second. It holds the usage of
the run, and the counters of the node.
"""

from __future__ import annotations

import functools
import json
import os
import platform
import sys
import time
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.files import write_aside
from slamhive.domain.algorithm import GivenGpu
from slamhive.domain.run import Host
from slamhive.executors.host import describe_host
from slamhive.executors.host_counters import HostCounters, HostReader
from slamhive.executors.node_store.on_node.connection import unreached_because
from slamhive.executors.process.executor import START_WAIT_S, containment_of, read_json, supervisor_of, wait_until
from slamhive.executors.process.shim import IDENTITY_FILE, supervise
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.tree_limit import ProcessTreeSource
from slamhive.executors.slurm.gpus import VISIBLE, GpuReadings, given_gpus
from slamhive.executors.slurm.runtimes import ContainerOrders, Tried, choose_runtime, command_of, try_runtimes
from slamhive.executors.status import RunHandle, UsageSource

USAGE_FILE = "usage.json"
GPU_KEY = "gpu"
HOST_KEY = "host"
PLACE_FILE = "place.json"
_INTERVAL_S = 0.1


@dataclass(frozen=True, slots=True)
class JobPlace:
    """Where a run takes place: the node, its job, and the container runtime with its version; empty for none.

    ``gpu`` is what the job got, if it asked for one.
    """

    node: str
    job: str
    runtime: str
    host: Host
    gpu: GivenGpu | None = None

    @classmethod
    def load(cls, work: Path) -> JobPlace:
        """Read what :func:`prepare` wrote into the work folder."""
        content = json.loads((work / PLACE_FILE).read_text(encoding="utf-8"))
        gpu = GivenGpu(**content["gpu"]) if content.get("gpu") else None
        return cls(**{**content, "host": Host(**content["host"]), "gpu": gpu})


@dataclass(frozen=True, slots=True)
class NodeReport:
    """This node, its container runtimes, and why it does not reach the worker; empty if it need not."""

    node: str
    host: Host
    runtimes: list[Tried]
    unreached: str = ""

    @classmethod
    def loads(cls, text: str) -> NodeReport:
        """Read what :func:`report` printed. Raises ValueError, KeyError or TypeError if it is something else."""
        content = json.loads(text)
        runtimes = [Tried(**entry) for entry in content["runtimes"]]
        return cls(content["node"], Host(**content["host"]), runtimes, content.get("unreached", ""))


def prepare(work: Path, *, gpu: bool = False) -> None:
    """Record where the run takes place, and complete the orders of a container. Without a runtime, end the process."""
    orders, runtime = ContainerOrders.load(work), None
    given = given_gpus(_node(), os.environ) if gpu else []
    visible = {name: os.environ[name] for name in VISIBLE if gpu and os.environ.get(name)}
    if orders is None and visible:
        spec = ShimSpec.load(work)
        replace(spec, environment={**spec.environment, **visible}).save(work)
    if orders is not None:
        names = [name for entry in given if (name := entry.uuid or entry.number) is not None]
        orders = replace(orders, gpus=names, environment={**orders.environment, **visible})
        try:
            runtime = choose_runtime(try_runtimes(orders.runtime))
        except LookupError as reasons:
            sys.exit(f"node {_node()} has no container runtime: {reasons}")
        called = command_of(orders, runtime)
        spec = replace(ShimSpec.load(work), command=called.arguments, environment=called.environment)
        replace(spec, forwarders=list(called.forwarders)).save(work)
    text = "" if runtime is None else runtime.text
    place = JobPlace(_node(), os.environ.get("SLURM_JOB_ID", ""), text, describe_host(), next(iter(given), None))
    write_aside(work / PLACE_FILE, json.dumps(asdict(place)))


def report(url: str = "") -> None:
    """Print what this node has to offer, as JSON; with ``url``, also whether it reaches the worker there."""
    unreached = unreached_because(url) if url else ""
    json.dump(asdict(NodeReport(_node(), describe_host(), list(try_runtimes()), unreached)), sys.stdout)


def _node() -> str:
    return os.environ.get("SLURMD_NODENAME") or platform.node()


def measure(work: Path) -> None:
    """Write what the run uses, and what else the node does, until the supervisor of the run ends."""
    if not wait_until((work / IDENTITY_FILE).exists, START_WAIT_S):
        return
    identity = read_json(work / IDENTITY_FILE) or {}
    data = {"pid": str(identity["pid"]), "birth": str(identity["birth"])}
    data["containment"] = json.dumps(identity["containment"])
    handle = RunHandle("", data)
    supervisor = supervisor_of(handle)
    if supervisor is None:
        return
    containment = containment_of(handle)
    source: UsageSource = (None if containment is None else containment.usage()) or ProcessTreeSource(supervisor)
    started_at = datetime.fromisoformat(identity["started_at"])
    meter = Meter(work, source, GpuReadings.of_run(JobPlace.load(work).gpu, supervisor), started_at)
    try:
        while supervisor_of(handle) is not None and meter.write():
            time.sleep(_INTERVAL_S)
    except FileNotFoundError:
        return  # the run was removed
    finally:
        source.close()


class Meter:
    """Writes what a run uses, and what else its node does, into the work folder of the run.

    The cores that count are those that Slurm gave the job.
    """

    def __init__(self, work: Path, source: UsageSource, gpu: GpuReadings | None, started_at: datetime) -> None:
        self._path = work / USAGE_FILE
        self._source = source
        self._gpu = gpu
        self._host = HostReader(HostCounters(os.sched_getaffinity(0)))
        self._began_s = monotonic_s() - (utc_now() - started_at).total_seconds()

    def write(self) -> bool:
        """Write one reading; False once the run is gone. It is not flushed to disk: only the newest one counts."""
        usage = self._source.read()
        if usage is None:
            return False
        cpu_s, memory_bytes = usage
        content: dict[str, object] = {
            "cpu_s": cpu_s,
            "memory_bytes": memory_bytes,
            "totals": self._source.totals(),
            HOST_KEY: self._host.read(max(0.0, monotonic_s() - self._began_s), cpu_s).content,
        }
        if self._gpu is not None:
            content[GPU_KEY] = self._gpu.read()
        aside = self._path.with_name(f".{USAGE_FILE}")
        aside.write_text(json.dumps(content), encoding="ascii")
        aside.replace(self._path)
        return True


if __name__ == "__main__":
    if sys.argv[1] == "report":
        report(*sys.argv[2:3])
    elif sys.argv[1] == "measure":
        measure(Path(sys.argv[2]))
    else:
        supervise(Path(sys.argv[2]), functools.partial(prepare, gpu="gpu" in sys.argv[3:]))
