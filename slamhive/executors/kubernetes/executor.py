"""Runs algorithms as Jobs of Kubernetes, on nodes that share the storage of the data root.

Kubernetes chooses the node, gets the image and enforces limits. A supervisor in the pod writes to the shared storage
how the run goes and how it ended. A Job is found by its labels: nothing is remembered here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slamhive.base.errors import SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.domain.algorithm import AlgorithmPackage, GivenGpu
from slamhive.executors.base import (
    Capabilities,
    EngineUnavailable,
    Executor,
    ExecutorContext,
    GpuGiver,
    LiveKeys,
    Node,
    PackageNeed,
    ProgressCallback,
    ProtectionFinding,
)
from slamhive.executors.host_counters import HostReading
from slamhive.executors.host_log import handed_over
from slamhive.executors.kubernetes import answers
from slamhive.executors.kubernetes.answers import Document, Right
from slamhive.executors.kubernetes.cluster import Cluster, why_no_connection
from slamhive.executors.kubernetes.manifest import selector
from slamhive.executors.kubernetes.node_runs import NodeRunFiles
from slamhive.executors.kubernetes.options import CLUSTER_OPTIONS, OPTIONS, read_options
from slamhive.executors.kubernetes.run_files import PodRunFiles, PodUsage, Started
from slamhive.executors.kubernetes.run_jobs import NodeImages, PodWatch, RunJobs
from slamhive.executors.kubernetes.supervisor import HOST_KEY
from slamhive.executors.node_store.controller import NodeStore
from slamhive.executors.process.executor import wait_until
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, Protections, RunHandle, Running, RunStatus, UsageSource

KILL_WAIT_S = 10.0
_USAGE_WAIT_S = 2.0
RIGHTS = (
    *(Right(verb, "jobs", "batch") for verb in ("create", "get", "list", "delete")),
    *(Right(verb, "pods") for verb in ("list", "watch", "delete")),
)
"""What the worker cannot do without."""
USEFUL_RIGHTS = (Right("list", "events"), Right("list", "nodes"))
"""What makes messages better."""


STORE_RIGHTS = (Right("create", "secrets"), Right("delete", "secrets"))
"""What it cannot do without if nodes share no storage."""
_CLAIM_AND_STORE = "KUBERNETES_OPTIONS has --claim, but SHARED_STORAGE is false; choose one of them"


class KubernetesExecutor(Executor):
    """The executor ``kubernetes``. Safe to share between threads."""

    name = "kubernetes"
    options = OPTIONS
    capabilities = Capabilities(
        isolates=True,
        limits=frozenset({Limit.CORES, Limit.MEMORY, Limit.PROCESSES, Limit.DISK, Limit.TIME}),
        needs=PackageNeed.IMAGE,
        shares_files=False,
        gpu=GpuGiver.ENGINE,
        drains=True,
    )

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._options = read_options(context.value(CLUSTER_OPTIONS))
        self._cluster = Cluster(self._options)
        self._store = None if context.nodes is None else NodeStore(context.data, context.nodes)
        self._jobs = RunJobs(self._cluster, self._options, context, self._store)
        self._watch = PodWatch(self._cluster, selector(context.installation))
        self._images = NodeImages(context, self._options.registry)

    def unavailable_because(self) -> str | None:
        """Why no Job can be made; None if the API server answers and lets us list Jobs."""
        problem = why_no_connection()
        if problem is None and self._store is not None:
            problem = _CLAIM_AND_STORE if self._options.claim else self._store.unavailable_because()
        if problem is not None:
            return problem
        try:
            self._jobs.all()
        except SlamHiveError as error:
            return str(error)
        return None

    def examine(self) -> list[ProtectionFinding]:
        """Report the cluster, the worker's rights, the nodes that answer, and the way of files and images to them."""
        cluster, options = self._cluster, self._options
        needed = (*RIGHTS, *USEFUL_RIGHTS, *(() if self._store is None else STORE_RIGHTS))
        missing = [right.text for right in needed if not cluster.may(right)]
        rights = f"the worker may not {', '.join(missing)}" if missing else "all that are needed"
        nodes = cluster.nodes()
        ready = [] if nodes is None else answers.ready_nodes(nodes)
        counted = "unknown" if nodes is None else f"{len(ready)} of {len(nodes)} take runs"
        if self._store is not None:
            storage = self._store.examine()
        else:
            same_path = f"nodes need {self._context.data.resolve()} at the same path"
            storage = ProtectionFinding("storage", f"claim {options.claim}" if options.claim else same_path)
        return [
            ProtectionFinding("cluster", f"{cluster.version()}, namespace {cluster.namespace}"),
            ProtectionFinding("rights", rights, "apply deploy/kubernetes/base/rights.yaml" if missing else None),
            ProtectionFinding("nodes", counted, None if ready or nodes is None else "see kubectl get nodes"),
            storage,
            ProtectionFinding(
                "images", f"registry {options.registry}" if options.registry else "nodes need them already"
            ),
        ]

    def examine_nodes(self) -> list[ProtectionFinding]:
        """Return whether each node takes runs, and the most that a run can get there. Raises Unavailable."""
        nodes = self._all_nodes()
        ready = answers.ready_nodes(nodes)
        findings = []
        for node in nodes:
            name, takes = str(node["metadata"]["name"]), node["metadata"]["name"] in ready
            state = "takes runs" if takes else "takes no runs now"
            remedy = None if takes else f"see kubectl describe node {name}"
            findings.append(ProtectionFinding(name, f"{state}, {answers.allocatable(node)}", remedy))
        return findings

    def nodes(self) -> list[Node]:
        """The nodes with the labels that ``KUBERNETES_OPTIONS`` asks for. Raises Unavailable."""
        found = [answers.node(node) for node in self._all_nodes() if answers.has_labels(node, self._options.node)]
        return found if self._store is None else self._store.with_caches(found)

    def drain(self, node: str, drained: bool) -> None:
        """Keep further pods away like ``kubectl cordon``: pods that run there go on."""
        self._cluster.cordon(node, drained)

    def check_package(self, package: AlgorithmPackage) -> None:
        """Refuse packages that need a user of their own."""
        self._images.check(package)

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The image that pods would use now."""
        return self._images.identity(package)

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Build the image with Docker, and push it if there is a registry."""
        self._images.check(package)
        return self._images.build(package, progress)

    def has(self, package: AlgorithmPackage, identity: str) -> bool:  # noqa: ARG002 - an identity names one image
        """Return whether a pod could use the image. What a registry has is only known at a start."""
        return bool(self._options.registry) or self._images.has(identity)

    def check_gpu(self) -> None:
        """Return whether a node has the extended resource, as far as the worker may know."""
        nodes, resource = self._cluster.nodes(), self._options.gpu
        if nodes is not None and not answers.offered(resource, self._options.node, nodes):
            raise Unavailable(f"no node of Kubernetes has {resource}", "install its device plugin, or set --gpu")

    def start(self, spec: RunSpec) -> RunHandle:
        """Make the Job of the run unless there is one, and wait a little for its pod.

        Raises EngineUnavailable while the pod waits for a node.
        """
        files = self._files(spec.work, spec.key)
        handle = self._handle(spec, self._jobs.start(spec, files))
        return replace(handle, variant_checksum=files.made_variant())

    def poll(self, handle: RunHandle) -> RunStatus:
        """Return the supervisor's record, else the word of Kubernetes on the pod."""
        files, key = self._files_of(handle), handle.data["key"]
        ended = files.ended()
        if ended is not None:
            return self._explained(ended, key)
        if not files.there:
            return Gone("its work folder was removed from outside")
        going_on = Running(as_of=files.as_of, delivering=files.delivering)
        if _goes_on(self._watch.of_run(key)):
            return going_on
        pod = self._jobs.pod(key)  # asked directly: the watch may be behind
        if _goes_on(pod):
            return going_on
        lost: Exited | Gone = Gone(answers.how_it_was_lost(pod))
        if pod is not None and answers.ran_out_of_memory(pod):
            lost = Exited(137, out_of_memory=True)
        return files.ended() or lost  # it may have been recorded meanwhile

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """SIGTERM to all processes of the run, SIGKILL after ``grace_s``; the supervisor does it."""
        files, arrived = self._files_of(handle), None
        if not files.there or files.ended() is not None:
            return
        files.ask_to_stop(grace_s)
        while not wait_until(lambda: files.ended() is not None or self._is_lost(handle), grace_s + KILL_WAIT_S):
            if not files.delivering or files.arrived == arrived:
                self._jobs.delete(handle.data["key"])
                return
            arrived = files.arrived

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Copy what the supervisor has kept of the output."""
        write_aside(path, self._files_of(handle).log(self._context.log_max_bytes))

    def remove(self, handle: RunHandle) -> None:
        """End the run, delete its Job and its work folder."""
        self.stop(handle, 0.0)
        files = self._files_of(handle)
        files.forget()
        self._jobs.delete(handle.data["key"])
        files.remove()

    def discard(self, spec: RunSpec) -> None:
        """The same for a run whose handle was lost; a pod that starts just now finds that it may not."""
        files = self._files(spec.work, spec.key)
        if not files.block():
            self.stop(_handle_of(spec), 0.0)
            files.forget()
        self._jobs.delete(spec.key)
        files.remove()

    def refresh(self, spec: RunSpec, handle: RunHandle) -> None:
        """Copy the files that are watched."""
        for output in spec.outputs:
            self._files_of(handle).copy_live(output)

    def collect(self, spec: RunSpec, handle: RunHandle) -> None:
        """Take the outputs over."""
        self._files_of(handle).collect(spec)

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """The counters that the supervisor hands over; None if the run has ended."""
        files = self._files_of(handle)
        wait_until(lambda: files.usage() is not None or not files.there or files.ended() is not None, _USAGE_WAIT_S)
        over = files.delivering or files.ended() is not None
        return PodUsage(files) if files.usage() is not None and not over else None

    def host_reading(self, handle: RunHandle) -> HostReading | None:
        """Return the supervisor's readings of its node."""
        return handed_over((self._files_of(handle).usage() or {}).get(HOST_KEY))

    def hidden_bytes(self, handle: RunHandle) -> int:
        """Return the size of files on a node that shares no storage."""
        return self._files_of(handle).written_bytes()

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Delete the Jobs of this installation whose runs are over."""
        jobs = self._jobs.all()
        live = live_keys()
        stale = [job for job in jobs if answers.key_of(job) not in live]
        for job in stale:
            self._jobs.delete_stale(job)
        if self._store is not None:
            self._store.sweep(live_keys)
        return [str(job["metadata"]["name"]) for job in stale]

    def close(self) -> None:
        """End the watch and close connections."""
        self._watch.stop()
        self._cluster.close()

    def _files_of(self, handle: RunHandle) -> PodRunFiles:
        return self._files(Path(handle.data["work"]), handle.data["key"])

    def _files(self, work: Path, key: str) -> PodRunFiles:
        return PodRunFiles(work) if self._store is None else NodeRunFiles(work, key, self._store)

    def _all_nodes(self) -> list[Document]:
        nodes = self._cluster.nodes()
        if nodes is None:
            raise Unavailable("the worker may not list nodes", "apply deploy/kubernetes/base/rights.yaml")
        return nodes

    def _is_lost(self, handle: RunHandle) -> bool:
        """Return whether nobody is there to end the run. No answer is no reason to believe it."""
        try:
            return isinstance(self.poll(handle), Gone)
        except EngineUnavailable:
            return False

    def _explained(self, ended: Exited | Gone, key: str) -> Exited | Gone:
        """An end from outside, with the reason that Kubernetes may know."""
        if isinstance(ended, Exited):
            return ended
        try:
            pod = self._jobs.pod(key)
        except EngineUnavailable:
            return ended
        why = None if pod is None else answers.given_up(pod)
        return ended if why is None else Gone(why)

    def _handle(self, spec: RunSpec, started: Started) -> RunHandle:
        handle = _handle_of(spec)
        job = self._jobs.name(spec.key)
        handle.data.update(started_at=started.at.isoformat(), node=started.node, job=job)
        where = f"pod on node {started.node} ({started.host.cpu_model}, {started.host.cpu_count} cores)"
        gpu = GivenGpu(started.node, uuid=started.gpu) if spec.asks_gpu else None
        return replace(handle, protections=_protections(where), host=started.host, gpu=gpu)


class MakingKubernetesExecutor(KubernetesExecutor):
    """The same for nodes that share no storage and have an image with SLAM Hive: they make variants."""

    capabilities = replace(KubernetesExecutor.capabilities, makes_variants=True)


def open_kubernetes(context: ExecutorContext) -> KubernetesExecutor:
    """The executor ``kubernetes``. Raises InvalidInput for options that it does not know."""
    makes_variants = context.nodes is not None and bool(read_options(context.value(CLUSTER_OPTIONS)).image)
    return MakingKubernetesExecutor(context) if makes_variants else KubernetesExecutor(context)


def _goes_on(pod: Document | None) -> bool:
    """Return whether the pod may still be running, or record how the run has ended."""
    return pod is not None and not answers.is_over(pod) and answers.given_up(pod) is None


def _handle_of(spec: RunSpec) -> RunHandle:
    return RunHandle(KubernetesExecutor.name, {"key": spec.key, "work": str(spec.work.resolve())})


def _protections(where: str) -> Protections:
    return Protections(
        held_by=where,
        processes="the supervisor ends a run that has too many",
        memory="enforced by the kernel",
        cpu="enforced by the kernel, requests equal limits",
        end="all processes of the pod are killed at once",
        priority="the supervisor counts with the run, and is subtracted from what is measured",
    )
