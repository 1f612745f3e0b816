"""The Job of a run and its pod: made once, waited for until the algorithm starts, found again, deleted."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from slamhive.base.clock import monotonic_s
from slamhive.domain.algorithm import AlgorithmPackage, RunUser
from slamhive.executors.base import EngineUnavailable, ExecutorContext, ImageMissing, ProgressCallback, StartFailed
from slamhive.executors.kubernetes import answers
from slamhive.executors.kubernetes.answers import Document, NotStarted, key_of
from slamhive.executors.kubernetes.cluster import Cluster, Expired
from slamhive.executors.kubernetes.manifest import (
    Who,
    job_manifest,
    job_name,
    node_job_manifest,
    outputs_on_node,
    places_of,
    prepare_inputs,
    resources,
    secret_manifest,
    secret_name,
    selector,
    volumes_of,
    with_courier,
)
from slamhive.executors.kubernetes.node_runs import hand_out
from slamhive.executors.kubernetes.options import Options
from slamhive.executors.kubernetes.pod_files import POD_FOLDER
from slamhive.executors.kubernetes.run_files import PodRunFiles, Started
from slamhive.executors.node_store.controller import NodeStore
from slamhive.executors.process.executor import wait_until
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Gone
from slamhive.packages.image_context import context_hash, dockerfile_of

START_WAIT_S = 20.0
"""A pod that takes longer to start is waited for by trying again, so that the worker can do something else."""
DELETION_WAIT_S = 15.0
CREATED_PATIENCE_S = 15.0
"""A container that was made starts within a second. One that takes so long was forgotten by its node."""
_ATTEMPTS = 3
_LOOK_EVERY_S = 0.25
_STEP_S = 0.02


class NeverBegan(StartFailed):
    """The pod of a run has ended before its supervisor began."""


class RunJobs:
    """The Jobs of one installation. All methods may raise EngineUnavailable.

    Args:
        cluster: Where they are.
        options: What the user says about the cluster.
        context: Names the installation and its data root.
        store: Hands runs out to nodes that share no storage; None if they do.
    """

    def __init__(
        self, cluster: Cluster, options: Options, context: ExecutorContext, store: NodeStore | None = None
    ) -> None:
        self._cluster = cluster
        self._options = options
        self._installation = context.installation
        self._data = context.data.resolve()
        self._log_max_bytes = context.log_max_bytes
        self._store = store
        self._cache = "" if context.nodes is None else context.nodes.cache

    def name(self, key: str) -> str:
        """The name of the Job of a run."""
        return job_name(self._installation, key)

    def all(self) -> list[Document]:
        """All Jobs of this installation."""
        return self._cluster.jobs(selector(self._installation))

    def pod(self, key: str) -> Document | None:
        """The newest pod of a run, asked from the API server; None if there is none."""
        pods = self._cluster.pods(selector(self._installation, key))
        return max(pods, key=lambda pod: str(pod["metadata"].get("creationTimestamp", "")), default=None)

    def start(self, spec: RunSpec, files: PodRunFiles) -> Started:
        """Make the Job of a run unless it was made, and wait a little until the algorithm has started.

        A pod that ended before its supervisor began is replaced: a kubelet that has just lost its API server may remove
        the files of a new pod. So is one that its node has forgotten. Raises ImageMissing, StartFailed.
        """
        for left in reversed(range(_ATTEMPTS)):
            if files.started() is None:
                self._make(spec, files)
            try:
                return self._wait_for_start(spec, files)
            except NeverBegan:
                if files.begun or not left:
                    raise
                self.delete(spec.key)
        raise AssertionError("the last attempt returns or raises")

    def _make(self, spec: RunSpec, files: PodRunFiles) -> None:
        """Prepare the files of the run and make its Job; both may have been done before. Raises StartFailed."""
        if self._store is not None:
            if self._cluster.job(self.name(spec.key)) is not None:
                return  # that Job has the ticket that counts
            files.prepare(spec, self._log_max_bytes)
            self._delete_secret(spec.key, self._store)
            given = hand_out(self._store, spec, files, self._log_max_bytes)
            self._cluster.create_secret(secret_manifest(spec, self._installation, given), StartFailed)
            job = node_job_manifest(spec, self._installation, self._options, _who(), given, self._cache)
            self._cluster.create_job(job, StartFailed)
            return
        files.prepare(spec, self._log_max_bytes)
        placed = prepare_inputs(outputs_on_node(spec, files.outputs), self._data, files.inputs)
        other = {POD_FOLDER: files.folder, "/tmp": files.scratch}  # noqa: S108 - the container's own
        volumes = volumes_of(places_of(placed, other), self._data, self._options.claim)
        self._cluster.create_job(job_manifest(spec, self._installation, self._options, _who(), volumes), StartFailed)

    def _wait_for_start(self, spec: RunSpec, files: PodRunFiles) -> Started:
        """Wait a little until the algorithm has started. Raises ImageMissing, StartFailed."""
        deadline_s, look_at_s, unschedulable = monotonic_s() + START_WAIT_S, 0.0, False
        created_since_s: float | None = None
        while True:
            started = files.started()
            if started is not None:
                return started
            failed = files.ended()
            if isinstance(failed, Gone):
                raise StartFailed(f"run {spec.run_id} cannot start: {failed.why}")
            if monotonic_s() >= look_at_s:
                look_at_s = monotonic_s() + _LOOK_EVERY_S
                found = self._look(spec, files)
                before, unschedulable = unschedulable, found.unschedulable
                # None if nodes may not be listed. A run that no node could take, even if it were empty, waits in vain.
                nodes = self._cluster.nodes() if unschedulable and not before else None
                if nodes is not None:
                    asked = resources(spec, self._options)
                    asked = asked if self._store is None else with_courier(asked)
                    never = answers.unmeetable(asked, self._options.node, nodes)
                    if never is not None:
                        problem = f"no node can ever take run {spec.run_id}: {never}"
                        raise StartFailed(problem, "change its limits, or add a node")
                    if answers.all_among(nodes, self._options.node, spec.placing.other_nodes):
                        raise StartFailed(f"run {spec.run_id}: {spec.placing.nobody}", "same_cpu: false allows others")
                created_since_s = (created_since_s or monotonic_s()) if found.created else None
                forgotten = created_since_s is not None and monotonic_s() - created_since_s >= CREATED_PATIENCE_S
                if forgotten and not files.begun:
                    raise NeverBegan(f"the pod of run {spec.run_id} did not start: {found.why}")
            if monotonic_s() > deadline_s:
                raise self._why_it_waits(spec)
            time.sleep(_STEP_S)

    def delete(self, key: str) -> None:
        """Delete the Job of a run and its pods, and wait until none is listed any more."""
        if self._store is not None:
            self._delete_secret(key, self._store)  # before the Job, which says whether something is left
        self._cluster.delete_job(self.name(key))
        chosen = selector(self._installation, key)

        def none_left() -> bool:
            pods = self._cluster.pods(chosen)
            for pod in pods:
                self._cluster.delete_pod(pod["metadata"]["name"])
            time.sleep(_LOOK_EVERY_S if pods else 0.0)
            return not pods

        if not wait_until(none_left, DELETION_WAIT_S):
            raise EngineUnavailable(f"Kubernetes does not delete the pod of {key}", "see kubectl get pods")

    def _delete_secret(self, key: str, store: NodeStore) -> None:
        """Delete the Secret of the newest ticket of a run, if it has one. There is no other."""
        mark = store.mark(key)
        if mark is not None:
            self._cluster.delete_secret(secret_name(self._installation, key, mark))

    def delete_stale(self, job: Document) -> None:
        """Delete a Job whose run is over."""
        key = answers.key_of(job)
        if key is None or self.name(key) != job["metadata"]["name"]:
            self._cluster.delete_job(job["metadata"]["name"])
        else:
            self.delete(key)

    def _look(self, spec: RunSpec, files: PodRunFiles) -> NotStarted:
        """Why the pod has not started. Raises ImageMissing or StartFailed if waiting for it is of no use."""
        pod = self.pod(spec.key)
        if pod is None:
            ended = self._failure(spec.key)
        else:
            ended = answers.how_it_was_lost(pod) if answers.is_over(pod) else None
        if ended is not None and files.started() is None:
            if pod is not None and answers.data_refused(pod):
                raise StartFailed(f"the pod of run {spec.run_id} did not start: {ended}")
            raise NeverBegan(f"the pod of run {spec.run_id} did not start: {ended}")
        if pod is None or ended is not None:
            return NotStarted("there is no pod yet")
        found = answers.why_not_started(pod)
        if found.image:
            self.delete(spec.key)
            raise explain_missing(spec.identity, self._options.registry, found.why)
        return found

    def _failure(self, key: str) -> str | None:
        """Why a Job without a pod will never have one; None if it may."""
        job = self._cluster.job(self.name(key))
        return "its Job was deleted from outside" if job is None else answers.job_failure(job)

    def _why_it_waits(self, spec: RunSpec) -> EngineUnavailable | StartFailed:
        pod, job = self.pod(spec.key), self._cluster.job(self.name(spec.key))
        begin = f"run {spec.run_id} waits in Kubernetes"
        if job is not None and answers.is_suspended(job):
            return EngineUnavailable(f"{begin}: its Job is suspended, for example by Kueue")
        named = pod or job
        warning = None if named is None else answers.last_warning(self._cluster.events(named["metadata"]["name"]))
        if warning is not None and warning.startswith("Unhealthy"):
            warning = None  # the courier is not ready yet
        if warning is not None and warning.startswith("FailedMount") and self._store is None:
            remedy = f"all nodes need {self._data} at the same path, or set --claim in KUBERNETES_OPTIONS"
            return StartFailed(f"the pod of run {spec.run_id} does not get its files: {warning}", remedy)
        said = "there is no pod yet" if pod is None else answers.why_not_started(pod).why
        if pod is not None and answers.why_not_started(pod).refused:
            return StartFailed(f"run {spec.run_id} cannot start: {said}", "see kubectl describe pods")
        return EngineUnavailable(f"{begin}: {warning or said}", "see kubectl get pods")


def _who() -> Who:
    return Who(os.getuid(), os.getgid())


# The pods of this installation as the cluster reports them: listed once, then watched, and never quite trusted.
#
# A watch may end, fall behind (410), stay silent, or come from an API server that is behind. So each watch has an
# end, and the next one goes on from its last version. The list is read again every few minutes, and what was not
# confirmed for too long is no answer. Callers ask the API server itself before they take a run for lost.


logger = logging.getLogger(__name__)

WATCH_S = 30
"""Each watch ends after so long, and thereby confirms that nothing else has happened."""
RELIST_S = 300.0
TRUSTED_S = WATCH_S + 15.0
"""What was not confirmed for longer is no answer."""
_FIRST_ANSWER_S = 20.0
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0


class PodSource(Protocol):
    """A cluster that is watched."""

    def pod_list(self, selector: str) -> Document:
        """The pods with these labels, and the version of the list."""

    def watch_pods(self, selector: str, version: str, seconds: int) -> Iterator[Document]:
        """Yield the events afterwards."""


class PodBook:
    """Knowledge of the pods, from lists and events."""

    def __init__(self) -> None:
        self.version: str | None = None
        """Where the next watch goes on; None if the list has to be read first."""
        self.pods: dict[str, Document] = {}
        """{uid: pod}"""

    def replace(self, listed: Document) -> None:
        """Take over a list."""
        self.pods = {pod["metadata"]["uid"]: pod for pod in listed.get("items") or ()}
        self.version = listed["metadata"]["resourceVersion"]

    def apply(self, event: Document) -> None:
        """Take over an event of a watch."""
        entry = event["object"]
        self.version = entry["metadata"]["resourceVersion"]
        if event["type"] == "DELETED":
            self.pods.pop(entry["metadata"]["uid"], None)
        elif event["type"] in ("ADDED", "MODIFIED"):
            self.pods[entry["metadata"]["uid"]] = entry

    def of_run(self, key: str) -> Document | None:
        """The newest pod of a run; None if there is none."""
        found = [pod for pod in self.pods.values() if key_of(pod) == key]
        return max(found, key=lambda pod: str(pod["metadata"].get("creationTimestamp", "")), default=None)


class PodWatch:
    """Follows the pods in a thread of its own, which begins with the first question. Safe to share between threads.

    Args:
        source: The cluster.
        selector: The labels of the pods.
        clock: Monotonic seconds.
    """

    def __init__(self, source: PodSource, selector: str, clock: Callable[[], float] = monotonic_s) -> None:
        self._source = source
        self._selector = selector
        self._clock = clock
        self._book = PodBook()
        self._changed = threading.Condition()
        self._confirmed_s: float | None = None
        self._listed_s = 0.0
        self._trouble: EngineUnavailable | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()

    def of_run(self, key: str) -> Document | None:
        """The pod of a run; None if there is none. Raises EngineUnavailable if nobody has confirmed it for long."""
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._follow, name="watch of pods", daemon=True)
                self._thread.start()
            self._changed.wait_for(lambda: self._confirmed_s is not None or self._trouble is not None, _FIRST_ANSWER_S)
            if self._confirmed_s is None or self._clock() - self._confirmed_s > TRUSTED_S:
                raise self._trouble or EngineUnavailable("watching pods: the API server is silent")
            return self._book.of_run(key)

    def stop(self) -> None:
        """End the thread with the present watch."""
        self._stopping.set()

    def follow_once(self) -> None:
        """List if that is due, then watch until the watch ends. Raises EngineUnavailable, Expired."""
        if self._book.version is None or self._clock() - self._listed_s > RELIST_S:
            listed = self._source.pod_list(self._selector)
            with self._changed:
                self._book.replace(listed)
                self._listed_s = self._clock()
                self._confirm()
        assert self._book.version is not None
        for event in self._source.watch_pods(self._selector, self._book.version, WATCH_S):
            with self._changed:
                self._book.apply(event)
                self._confirm()
            if self._stopping.is_set():
                return
        with self._changed:
            self._confirm()

    def forget(self) -> None:
        """Read the list again before the next watch."""
        with self._changed:
            self._book.version = None

    def _confirm(self) -> None:
        self._confirmed_s = self._clock()
        self._trouble = None
        self._changed.notify_all()

    def _follow(self) -> None:
        pause_s = _SHORTEST_PAUSE_S
        while not self._stopping.is_set():
            try:
                self.follow_once()
                pause_s = _SHORTEST_PAUSE_S
            except Expired:
                self.forget()
            except EngineUnavailable as error:
                logger.info("the watch of pods begins again: %s", error)
                self.forget()
                with self._changed:
                    self._trouble = error
                    self._changed.notify_all()
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


# -- the images of packages --------------------------------------------------------------------------------------------
#
# The Docker engine of the worker's machine builds them, and they are named as nodes find them.
# With a registry, the name of an image holds a hash of what it is made from. So a worker without Docker knows the name,
# and one name never means other content. Without a registry, nodes have to hold the image with its digest already.


_HASH_DIGITS = 12


class NodeImages:
    """Finds and builds images.

    Args:
        context: Names the project and the installation.
        registry: Where images are pushed to; empty for none.
    """

    def __init__(self, context: ExecutorContext, registry: str) -> None:
        self._context = context
        self._registry = registry

    def check(self, package: AlgorithmPackage) -> None:
        """Raise ImageMissing for a package that no pod of ours can run."""
        if package.user is not RunUser.WORKER:
            raise ImageMissing(
                f"{package.name} runs as {package.user.in_words}, and pods have the user of the worker only",
                "choose another executor; slamhive doctor --all lists them",
            )

    def has(self, digest: str) -> bool:
        """Return whether the Docker engine of this machine has an image, from which nodes can get it."""
        from slamhive.executors.docker.images import has_image  # noqa: PLC0415 - the SDK takes long to load

        with self._engine() as client:
            return has_image(client, digest)

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The image that a start would use now; None if it has to be built, as far as this machine can see."""
        if not self._registry:
            from slamhive.executors.docker.images import find_image  # noqa: PLC0415 - the SDK takes long to load

            with self._engine() as client:
                return find_image(client, package, self._context.project_root)
        return self.reference(package)

    def reference(self, package: AlgorithmPackage) -> str:
        """The name of the image in the registry. An image that somebody else made keeps the name that it has."""
        root = self._context.project_root
        if dockerfile_of(package, root) is None:
            return package.image
        return f"{self._registry}/{package.image}-{context_hash(package, root)[:_HASH_DIGITS]}"

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Build the image, and push it if there is a registry; its identity. Raises ImageMissing, EngineUnavailable."""
        from slamhive.executors.docker.engine import engine_errors  # noqa: PLC0415 - the SDK takes long to load
        from slamhive.executors.docker.images import make_image, name_image  # noqa: PLC0415 - as above

        reference = self.reference(package)
        with self._engine() as client:
            digest = make_image(client, package, self._context, progress)
            if not self._registry:
                return digest
            if dockerfile_of(package, self._context.project_root) is not None:
                name_image(client, digest, reference)
                repository, _, tag = reference.rpartition(":")
                with engine_errors(f"pushing {reference}", ImageMissing):
                    for event in client.api.push(repository, tag=tag, stream=True, decode=True):
                        if "error" in event:
                            problem = f"{reference} cannot be pushed: {event['error']}"
                            raise ImageMissing(problem, "try docker login, docker push")
                        progress(f"{reference}: {event.get('status', '')} {event.get('progress', '')}".strip())
        return reference

    @contextlib.contextmanager
    def _engine(self) -> Iterator[Any]:
        from slamhive.executors.docker.engine import connect  # noqa: PLC0415 - the SDK takes long to load

        try:
            client = connect()
        except EngineUnavailable as error:
            raise EngineUnavailable(
                f"images of pods are built on this machine: {error.message}",
                "start Docker here, or build elsewhere and set --registry in KUBERNETES_OPTIONS",
            ) from None
        with contextlib.closing(client):
            yield client


def explain_missing(image: str, registry: str, why: str) -> ImageMissing:
    """The error for an image that a node cannot get."""
    if registry:
        return ImageMissing(f"image {image}: {why}", "push it: slamhive algorithm build NAME, where Docker is")
    remedy = "load it there: docker save IMAGE | ctr -n k8s.io images import -, or set --registry"
    return ImageMissing(f"image {image[:19]}: {why}", remedy)
