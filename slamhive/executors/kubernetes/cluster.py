"""Jobs, pods and nodes of a cluster: requests as methods, answers as plain data, errors as ours."""

from __future__ import annotations

import atexit
import functools
import importlib.util
import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import urllib3.exceptions

from slamhive.base.errors import Forbidden, SlamHiveError
from slamhive.base.files import temporary_folder
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.kubernetes.answers import Document, Right, message_of, missing_right
from slamhive.executors.kubernetes.options import Options

# Connections to the API server of a cluster, and the meaning of its refusals.
#
# The official client takes half a second to import, so it is imported when a cluster is first asked.


IN_CLUSTER = Path("/var/run/secrets/kubernetes.io/serviceaccount")
_ANSWERS_LATER = frozenset((408, 429, 500, 502, 503, 504))
_ANONYMOUS = "system:anonymous"
_NOBODY = "the cluster does not accept the credentials of the kubeconfig: they are wrong or have expired"
_LOG_IN = "log in again until kubectl get jobs works"


class ApiRefused(Exception):
    """The API server answered with an error code that the caller expects."""


@dataclass(frozen=True, slots=True)
class ApiConnection:
    """The interfaces of the official client, and the namespace that the kubeconfig names."""

    client: Any
    core: Any
    batch: Any
    rights: Any
    versions: Any
    namespace: str

    def close(self) -> None:
        """Close all sockets."""
        self.client.close()


def why_no_connection() -> str | None:
    """Why no connection can be made, found out without the client; None if nothing speaks against it."""
    if importlib.util.find_spec("kubernetes") is None:
        return "the Python package kubernetes is not installed; pip install 'slamhive[kubernetes]'"
    files = _kubeconfig_files()
    if any(path.is_file() for path in files) or (IN_CLUSTER / "token").is_file():
        return None
    return f"there is no kubeconfig at {':'.join(map(str, files))}; set KUBECONFIG"


def connect(options: Options) -> ApiConnection:
    """A connection with the credentials of the kubeconfig, or of the pod that this process is in.

    Nothing is sent yet. Raises EngineUnavailable.
    """
    problem = why_no_connection()
    if problem is not None:
        raise EngineUnavailable(problem)
    from kubernetes import client  # noqa: PLC0415 - it takes long to import

    config: Any = import_module("kubernetes.config")  # it has no types

    configuration = client.Configuration()
    configuration.retries = 0
    namespace = "default"
    with api_errors("reading the kubeconfig", EngineUnavailable):
        if any(path.is_file() for path in _kubeconfig_files()):
            # Named here, because the client reads KUBECONFIG only once.
            files = os.pathsep.join(map(str, _kubeconfig_files()))
            contexts, active = config.list_kube_config_contexts(files)
            chosen = next((entry for entry in contexts if entry["name"] == options.context), active)
            namespace = str(((chosen or {}).get("context") or {}).get("namespace") or "default")
            config.load_kube_config(
                files, options.context or None, configuration, temp_file_path=str(_credentials_folder())
            )
        else:
            namespace = (IN_CLUSTER / "namespace").read_text(encoding="utf-8").strip()
            config.load_incluster_config(client_configuration=configuration)
    api = client.ApiClient(configuration)
    return ApiConnection(
        client=api,
        core=client.CoreV1Api(api),
        batch=client.BatchV1Api(api),
        rights=client.AuthorizationV1Api(api),
        versions=client.VersionApi(api),
        namespace=options.namespace or namespace,
    )


@contextmanager
def api_errors(doing: str, failure: type[SlamHiveError], expected: int | None = None) -> Iterator[None]:
    """Turn the client's errors into ours: EngineUnavailable if nobody answers, ``failure`` for a refusal.

    Args:
        doing: What was being done, for the message (``"creating a Job"``).
        failure: The error for a refusal.
        expected: The code that becomes Refused.
    """
    from kubernetes.client.exceptions import ApiException  # noqa: PLC0415 - as above
    from kubernetes.config.config_exception import ConfigException  # noqa: PLC0415 - as above

    try:
        yield
    except ApiException as error:
        if error.status == expected:
            raise ApiRefused from None
        raise _refusal(doing, error, failure) from None
    except ConfigException as error:
        raise EngineUnavailable(f"the kubeconfig cannot be used: {error}", "set KUBECONFIG") from None
    except (urllib3.exceptions.HTTPError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise EngineUnavailable(
            f"{doing}: the API server does not answer ({type(reason).__name__})", "try kubectl get nodes"
        ) from None


def _refusal(doing: str, error: Any, failure: type[SlamHiveError]) -> SlamHiveError:
    body = error.body.decode(errors="replace") if isinstance(error.body, bytes) else str(error.body or error.reason)
    said = message_of(body)
    if error.status == 401 or _ANONYMOUS in said:
        return EngineUnavailable(_NOBODY, _LOG_IN)
    if error.status in _ANSWERS_LATER:
        return EngineUnavailable(f"{doing}: the API server answers later ({error.status}: {said})")
    right = missing_right(body) if error.status == 403 else None
    if right is None:
        return failure(f"{doing}: Kubernetes refuses it ({error.status}: {said})")
    return failure(
        f"{doing}: the worker lacks the right to {right.text}",
        "apply deploy/kubernetes/base/rights.yaml, or ask whoever runs the cluster",
    )


@functools.cache
def _credentials_folder() -> Path:
    """Where the client writes certificates and keys out of a kubeconfig, for all connections of this process.

    Otherwise it writes them into the temporary folder itself, where the key of a killed process would stay. Whoever
    sweeps temporary folders removes this one.
    """
    folder = temporary_folder()
    path = folder.__enter__()
    atexit.register(folder.__exit__, None, None, None)
    return path


def _kubeconfig_files() -> list[Path]:
    text = os.environ.get("KUBECONFIG", "")
    return [Path(part) for part in text.split(os.pathsep) if part] or [Path.home() / ".kube" / "config"]


_CONNECT_S, _ANSWER_S = 5.0, 30.0
_RAW = {"_preload_content": False, "_request_timeout": (_CONNECT_S, _ANSWER_S)}
_WATCH_SLACK_S = 10.0


class Expired(Exception):
    """The API server no longer knows what happened since the version that was asked for."""


class Cluster:
    """Asks one API server. Safe to share between threads. All methods may raise EngineUnavailable.

    Args:
        options: Which cluster and namespace.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._lock = threading.Lock()
        self._connection: ApiConnection | None = None

    @property
    def namespace(self) -> str:
        """Where Jobs are made."""
        return self._api().namespace

    def version(self) -> str:
        """Such as ``v1.36.2``."""
        return str(self._ask("asking for the version", lambda a: a.versions.get_code(**_RAW)).get("gitVersion"))

    def create_job(self, manifest: Document, failure: type[SlamHiveError]) -> bool:
        """Create a Job; False if there is one of that name. Raises ``failure`` if the API server refuses it."""
        try:
            self._ask(
                "creating a Job", lambda a: a.batch.create_namespaced_job(a.namespace, manifest, **_RAW), failure, 409
            )
        except ApiRefused:
            return False
        return True

    def job(self, name: str) -> Document | None:
        """The Job called ``name``; None if there is none."""
        try:
            return self._ask(
                "reading a Job", lambda a: a.batch.read_namespaced_job(name, a.namespace, **_RAW), expected=404
            )
        except ApiRefused:
            return None

    def jobs(self, selector: str) -> list[Document]:
        """The Jobs with these labels."""
        return _items(
            self._ask(
                "listing Jobs", lambda a: a.batch.list_namespaced_job(a.namespace, label_selector=selector, **_RAW)
            )
        )

    def delete_job(self, name: str) -> None:
        """Delete a Job; its pods go a little later. Does nothing if it is gone."""
        self._delete(
            "deleting a Job",
            lambda a: a.batch.delete_namespaced_job(name, a.namespace, propagation_policy="Background", **_RAW),
        )

    def create_secret(self, manifest: Document, failure: type[SlamHiveError]) -> None:
        """Create a Secret in place of one of its name. Raises ``failure`` if the API server refuses it."""
        self.delete_secret(manifest["metadata"]["name"])
        self._ask(
            "creating a Secret", lambda a: a.core.create_namespaced_secret(a.namespace, manifest, **_RAW), failure
        )

    def delete_secret(self, name: str) -> None:
        """Delete a Secret. Does nothing if it is gone."""
        self._delete("deleting a Secret", lambda a: a.core.delete_namespaced_secret(name, a.namespace, **_RAW))

    def pods(self, selector: str) -> list[Document]:
        """The pods with these labels."""
        return _items(self.pod_list(selector))

    def pod_list(self, selector: str) -> Document:
        """The same with the version of the list, from which a watch can go on."""
        return self._ask(
            "listing pods", lambda a: a.core.list_namespaced_pod(a.namespace, label_selector=selector, **_RAW)
        )

    def delete_pod(self, name: str) -> None:
        """Delete a pod at once, even if its node does not answer. Does nothing if it is gone."""
        self._delete(
            "deleting a pod",
            lambda a: a.core.delete_namespaced_pod(name, a.namespace, grace_period_seconds=0, **_RAW),
        )

    def watch_pods(self, selector: str, version: str, seconds: int) -> Iterator[Document]:
        """Yield the events of the pods with these labels after ``version``, for that long. Raises Expired."""
        api = self._api()
        try:
            with api_errors("watching pods", EngineUnavailable, 410):
                answer = api.core.list_namespaced_pod(
                    api.namespace,
                    label_selector=selector,
                    resource_version=version,
                    watch=True,
                    allow_watch_bookmarks=True,
                    timeout_seconds=seconds,
                    _preload_content=False,
                    _request_timeout=(_CONNECT_S, seconds + _WATCH_SLACK_S),
                )
                try:
                    yield from _events(answer.stream(amt=None, decode_content=False))
                finally:
                    answer.close()
                    answer.release_conn()
        except ApiRefused:
            raise Expired from None

    def events(self, name: str) -> list[Document]:
        """The events of a pod or Job; none if the worker may not read them."""
        chosen = f"involvedObject.name={name}"
        return (
            self._optional(
                "listing events", lambda a: a.core.list_namespaced_event(a.namespace, field_selector=chosen, **_RAW)
            )
            or []
        )

    def nodes(self) -> list[Document] | None:
        """All nodes; None if the worker may not list them."""
        return self._optional("listing nodes", lambda a: a.core.list_node(**_RAW))

    def cordon(self, name: str, cordoned: bool) -> None:
        """Keep further pods away from a node, or end that. Raises Forbidden if the worker may not."""
        body = {"spec": {"unschedulable": cordoned}}
        self._ask("changing a node", lambda a: a.core.patch_node(name, body, **_RAW), Forbidden)

    def may(self, right: Right) -> bool:
        """Return whether the worker has a right in the namespace, or for nodes in the cluster."""
        where = {} if right.resource == "nodes" else {"namespace": self.namespace}
        review = {
            "apiVersion": "authorization.k8s.io/v1",
            "kind": "SelfSubjectAccessReview",
            "spec": {
                "resourceAttributes": {"verb": right.verb, "resource": right.resource, "group": right.group, **where}
            },
        }
        answer = self._ask("asking for rights", lambda a: a.rights.create_self_subject_access_review(review, **_RAW))
        return bool(answer["status"].get("allowed"))

    def close(self) -> None:
        """Close connections."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def _api(self) -> ApiConnection:
        with self._lock:
            if self._connection is None:
                self._connection = connect(self._options)
            return self._connection

    def _ask(
        self,
        doing: str,
        call: Callable[[ApiConnection], Any],
        failure: type[SlamHiveError] = EngineUnavailable,
        expected: int | None = None,
    ) -> Document:
        """One request; its answer as data. Raises Refused for the code that is ``expected``."""
        api = self._api()
        with api_errors(doing, failure, expected):
            answer = call(api)
            content: Document = json.loads(answer.data)
            return content

    def _delete(self, doing: str, call: Callable[[ApiConnection], Any]) -> None:
        try:
            self._ask(doing, call, expected=404)
        except ApiRefused:
            return

    def _optional(self, doing: str, call: Callable[[ApiConnection], Any]) -> list[Document] | None:
        """A list that the worker can do without; None if it may not read it."""
        try:
            return _items(self._ask(doing, call, expected=403))
        except ApiRefused:
            return None


def _items(answer: Document) -> list[Document]:
    found: list[Document] = answer.get("items") or []
    return found


def _events(chunks: Iterable[bytes]) -> Iterator[Document]:
    """The events in the lines of a watch. Raises Expired for the event that says so."""
    rest = b""
    for chunk in chunks:
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            if not line.strip():
                continue
            try:
                event: Document = json.loads(line)
            except ValueError:
                raise EngineUnavailable("watching pods: the API server sent half a line") from None
            if event.get("type") == "ERROR":
                status = event.get("object") or {}
                if status.get("code") in (410, 504):
                    raise Expired
                raise EngineUnavailable(f"watching pods: {status.get('message', 'the API server reports an error')}")
            yield event
