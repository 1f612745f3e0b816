"""An API server of Kubernetes in this process: the objects, rights and watches that an executor asks for, over HTTP.

It holds what is created, chooses nodes, and deletes pods with their Jobs, as controllers do. What the kubelets of nodes
do is left to a :class:`Kubelet`. Requests can be refused, answered late or not at all.

There is a package for this, ``kmock``. Its version 0.8 announces breaking changes and needs an event loop. It
knows neither versions that have expired nor selectors of labels, which is what these tests are about.
"""

from __future__ import annotations

import json
import re
import socket
import threading
import time
import uuid
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol, Self
from urllib.parse import parse_qsl, urlsplit

from slamhive.executors.kubernetes.answers import quantity

Document = dict[str, Any]
TOKEN = "a token that is accepted"
NAMESPACE = "default"
_PATH = re.compile(
    r"/(?:api/v1|apis/(?P<group>[a-z.0-9]+)/v1)(?:/namespaces/(?P<namespace>[^/]+))?/(?P<resource>[a-z]+)(?:/(?P<name>[^/]+))?"
)
_GROUPS = {"jobs": "batch", "selfsubjectaccessreviews": "authorization.k8s.io"}
_CODES = {400: "BadRequest", 401: "Unauthorized", 403: "Forbidden", 404: "NotFound", 409: "AlreadyExists", 410: "Gone"}
_EVENTS_BETWEEN_LOOKS_S = 0.05


class Kubelet(Protocol):
    """What happens on nodes."""

    def bound(self, pod: Document) -> None:
        """A pod has got its node."""

    def deleted(self, pod: Document, *, by_force: bool) -> None:
        """A pod is to end. The server forgets it afterwards."""


@dataclass(frozen=True)
class Trouble:
    """What happens to a request instead of its answer.

    Attributes:
        status: The code of a refusal; 0 to close the connection without an answer.
        message: Its message.
        done: Whether the request is carried out before, so that only its answer is lost.
        raw: What is sent of a watch before the connection is closed.
    """

    status: int = 0
    message: str = ""
    done: bool = False
    raw: bytes = b""


class Refusal(Exception):
    """An answer with an error code."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class ApiServer:
    """Serves on a port of 127.0.0.1, which it keeps when it is stopped and started again.

    ``forbidden`` holds rights that nobody has, such as ``create jobs.batch``. ``suspends`` makes Jobs wait, as Kueue.
    """

    def __init__(self, kubelet: Kubelet, nodes: tuple[str, ...] = ("node1", "node2")) -> None:
        self.kubelet = kubelet
        self.requests: list[tuple[float, str]] = []
        """When (s) and what, such as ``list pods``; the oldest first."""
        self.forbidden: set[str] = set()
        self.suspends = False
        self.expires_by_event = False
        """Whether a watch that begins too late is told so by an event instead of code 410. Both happen."""
        self._objects: dict[tuple[str, str], Document] = {}
        self._changes: list[tuple[int, str, Document]] = []
        self._version = 1
        self._oldest = 0
        self._troubles: dict[str, deque[Trouble]] = defaultdict(deque)
        self._changed = threading.Condition(threading.RLock())
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None
        self._port = 0
        for name in nodes:
            self._keep("nodes", _node(name))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Serve what is there."""
        self._server = _Server(self, self._port)
        self._port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End as if killed: connections break, objects stay."""
        if self._server is None or self._thread is None:
            return
        ending, self._server = self._server, None
        ending.shutdown()
        ending.break_connections()
        with self._changed:
            self._changed.notify_all()
        ending.server_close()
        self._thread.join()

    def kubeconfig(self, path: Path, token: str = TOKEN, namespace: str = "") -> Path:
        """Write a kubeconfig for this server."""
        context = {"cluster": "tests", "user": "me"} | ({"namespace": namespace} if namespace else {})
        content = {
            "clusters": [{"name": "tests", "cluster": {"server": f"http://127.0.0.1:{self._port}"}}],
            "users": [{"name": "me", "user": {"token": token}}],
            "contexts": [{"name": "tests", "context": context}],
            "current-context": "tests",
        }
        path.write_text(json.dumps(content))
        return path

    def trouble(self, request: str, *troubles: Trouble) -> None:
        """What happens to the next requests of a kind, such as ``create jobs``."""
        self._troubles[request].extend(troubles)

    def asked(self, request: str) -> list[float]:
        """When (s) requests of a kind came."""
        return [when_s for when_s, what in self.requests if what == request]

    def all(self, resource: str) -> list[Document]:
        """All objects of a kind, as they are now."""
        with self._changed:
            return [deepcopy(found) for (kind, _), found in self._objects.items() if kind == resource]

    def one(self, resource: str) -> Document:
        """The only object of a kind."""
        (found,) = self.all(resource)
        return found

    def change(self, resource: str, name: str, change: Callable[[Document], object]) -> None:
        """Change an object, and let watches know."""
        with self._changed:
            found = deepcopy(self._objects[resource, name])
            change(found)
            self._keep(resource, found, "MODIFIED")

    def status(self, name: str, **status: Any) -> None:
        """Change the status of a pod."""
        self.change("pods", name, lambda pod: pod["status"].update(status))

    def remove(self, resource: str, name: str, *, silently: bool = False) -> None:
        """Forget an object; ``silently`` as an API server that is behind, whose watches do not show it."""
        with self._changed:
            found = self._objects.pop((resource, name), None)
            if found is not None and not silently:
                self._note(resource, "DELETED", found)

    def announce(self, kind: str, pod: Document) -> None:
        """Send an event to watches that nothing stands behind, as an API server that is behind does."""
        with self._changed:
            self._note("pods", kind, pod)

    def compact(self) -> None:
        """Forget what has happened, so that a watch cannot go on after it."""
        with self._changed:
            self._changes.clear()
            self._version += 1
            self._oldest = self._version

    def warn(self, name: str, reason: str, message: str) -> None:
        """Note a warning about an object."""
        event = {"type": "Warning", "reason": reason, "message": message, "lastTimestamp": _now()}
        self._keep(
            "events", {"metadata": {"name": f"{name}.{uuid.uuid4().hex}"}, "involvedObject": {"name": name}, **event}
        )

    def cordon(self, *names: str, cordoned: bool = True) -> None:
        """As ``kubectl cordon``."""
        for name in names:
            self.change("nodes", name, lambda node: node["spec"].update(unschedulable=cordoned))
        self.schedule()

    def lose(self, name: str) -> None:
        """A node is silent for so long that its pods are given up. They stay: nobody says that they have ended."""
        message = "Taint manager: deleting due to NoExecute taint"
        marked = {"type": "DisruptionTarget", "status": "True", "reason": "DeletionByTaintManager", "message": message}

        def give_up(pod: Document) -> None:
            pod["status"].setdefault("conditions", []).append(marked)
            pod["metadata"]["deletionTimestamp"] = _now()

        self.change("nodes", name, lambda node: node["status"]["conditions"][0].update(status="Unknown"))
        for pod in self.all("pods"):
            if pod["spec"].get("nodeName") == name:
                self.change("pods", pod["metadata"]["name"], give_up)

    def schedule(self) -> None:
        """Give nodes to pods that have none."""
        for pod in self.all("pods"):
            if not pod["spec"].get("nodeName"):
                self._bind(pod["metadata"]["name"])

    def _bind(self, name: str) -> None:
        nodes = [node for node in self.all("nodes") if not node["spec"].get("unschedulable") and _is_ready(node)]
        with self._changed:
            pod = deepcopy(self._objects["pods", name])
            fitting = [node for node in nodes if _fits(pod, node)]
            if fitting:
                pod["spec"]["nodeName"] = fitting[0]["metadata"]["name"]
                pod["status"]["conditions"] = []
            else:
                said = f"0/{len(self.all('nodes'))} nodes are available: no node takes it."
                refused = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": said}
                pod["status"]["conditions"] = [refused]
            self._keep("pods", pod, "MODIFIED")
        if fitting:
            self.kubelet.bound(pod)

    def _keep(self, resource: str, entry: Document, kind: str = "ADDED") -> None:
        with self._changed:
            self._objects[resource, entry["metadata"]["name"]] = entry
            self._note(resource, kind, entry)

    def _note(self, resource: str, kind: str, entry: Document) -> None:
        self._version += 1
        entry["metadata"]["resourceVersion"] = str(self._version)
        if resource == "pods":
            self._changes.append((self._version, kind, deepcopy(entry)))
        self._changed.notify_all()

    def handle(self, verb: str, resource: str, name: str, body: Document, query: dict[str, str]) -> Document:
        """The answer to a request. Raises Refusal."""
        right = f"{verb} {resource}" + (f".{_GROUPS[resource]}" if resource in _GROUPS else "")
        if resource == "selfsubjectaccessreviews":
            asked = body["spec"]["resourceAttributes"]
            wanted = f"{asked['verb']} {asked['resource']}" + (f".{asked['group']}" if asked["group"] else "")
            return {"status": {"allowed": wanted not in self.forbidden}}
        if right in self.forbidden:
            raise Refusal(403, _forbidden(verb, resource))
        if verb == "create":
            return self._create(resource, body)
        if verb == "list":
            found = [entry for entry in self.all(resource) if _selected(entry, query)]
            return {"metadata": {"resourceVersion": str(self._version)}, "items": found}
        if (resource, name) not in self._objects:
            raise Refusal(404, f'{resource} "{name}" not found')
        if verb == "patch":
            self.change(resource, name, lambda entry: entry["spec"].update(body["spec"]))
            self.schedule()
        if verb == "delete":
            return self._delete(resource, name, {**query, **body})
        return deepcopy(self._objects[resource, name])

    def _create(self, resource: str, body: Document) -> Document:
        with self._changed:
            name = body["metadata"]["name"]
            if (resource, name) in self._objects:
                raise Refusal(409, f'{resource} "{name}" already exists')
            made = deepcopy(body)
            made["metadata"] |= {"uid": str(uuid.uuid4()), "creationTimestamp": _now()}
            if resource == "jobs":
                made["spec"]["suspend"] = self.suspends
                made["status"] = {}
            self._keep(resource, made)
        if resource == "jobs" and not self.suspends:
            pod = deepcopy(made["spec"]["template"])
            pod["metadata"] |= {"name": f"{name}-{uuid.uuid4().hex[:5]}", "uid": str(uuid.uuid4())}
            pod["metadata"] |= {"creationTimestamp": _now(), "ownerReferences": [{"kind": "Job", "name": name}]}
            pod["status"] = {"phase": "Pending"}
            self._keep("pods", pod)
            self._bind(pod["metadata"]["name"])
        return made

    def _delete(self, resource: str, name: str, options: Document) -> Document:
        if resource == "jobs" and options.get("propagationPolicy") not in ("Background", "Foreground"):
            self.remove(resource, name)  # an API server leaves the pods then
        else:
            self.remove_with_owner(resource, name, by_force=str(options.get("gracePeriodSeconds")) == "0")
        return {"kind": "Status", "status": "Success"}

    def remove_with_owner(self, resource: str, name: str, *, by_force: bool = False) -> None:
        """Delete an object, with the pods of a Job.

        The pod of a silent node goes by force only; one with a finalizer never.
        """
        if resource != "pods":
            self.remove(resource, name)
            for pod in self.all("pods"):
                if any(owner["name"] == name for owner in pod["metadata"].get("ownerReferences", ())):
                    self.remove_with_owner("pods", pod["metadata"]["name"])
            return
        found = self._objects.get((resource, name))
        if found is None:
            return
        pod, node = found, self._objects.get(("nodes", found["spec"].get("nodeName", "")))
        if node is not None and _is_ready(node):
            self.kubelet.deleted(pod, by_force=by_force)
        elif node is not None and not by_force:
            return
        if not pod["metadata"].get("finalizers"):
            self.remove("pods", name)

    def events_after(self, query: dict[str, str], ended: threading.Event) -> Iterator[Document]:
        """The events of a watch of pods until its time is over. Raises ConnectionError if the server ends before."""
        seen = int(query["resourceVersion"])
        deadline_s = time.monotonic() + float(query["timeoutSeconds"])
        while time.monotonic() < deadline_s:
            if ended.is_set():
                raise ConnectionError
            with self._changed:
                fresh = [(version, kind, entry) for version, kind, entry in self._changes if version > seen]
                if not fresh:
                    self._changed.wait(min(_EVENTS_BETWEEN_LOOKS_S, max(0.0, deadline_s - time.monotonic())))
            for version, kind, entry in fresh:
                seen = version
                if _selected(entry, query):
                    yield {"type": kind, "object": entry}
        yield {"type": "BOOKMARK", "object": {"kind": "Pod", "metadata": {"resourceVersion": str(seen)}}}

    def expired(self, query: dict[str, str]) -> str | None:
        """Why a watch cannot begin where it wants to; None if it can."""
        seen = int(query["resourceVersion"])
        return f"too old resource version: {seen} ({self._oldest})" if seen < self._oldest else None

    def note(self, request: str) -> Trouble | None:
        """Remember a request; what is to happen to it instead of its answer."""
        self.requests.append((time.monotonic(), request))
        waiting = self._troubles[request]
        return waiting.popleft() if waiting else None


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, api: ApiServer, port: int) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.api = api
        self.connections: set[socket.socket] = set()
        self.ended = threading.Event()

    def break_connections(self) -> None:
        self.ended.set()  # for those that have just been accepted
        for connection in list(self.connections):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks is no news here."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = -1
    server: _Server

    def setup(self) -> None:
        super().setup()
        self.server.connections.add(self.connection)

    def finish(self) -> None:
        with suppress(OSError):
            super().finish()
        self.server.connections.discard(self.connection)

    def do_GET(self) -> None:
        self._answer("get")

    def do_POST(self) -> None:
        self._answer("create")

    def do_DELETE(self) -> None:
        self._answer("delete")

    def do_PATCH(self) -> None:
        self._answer("patch")

    def log_message(self, *_: object) -> None:
        """Nothing is printed."""

    def _answer(self, verb: str) -> None:
        address = urlsplit(self.path)
        query = dict(parse_qsl(address.query))
        if self.server.ended.is_set():
            self.close_connection = True
            return
        body = json.loads(self.rfile.read(int(self.headers.get("Content-Length") or 0)) or b"{}")
        if address.path == "/version/":
            self._send(200, {"gitVersion": "v1.36.2"})
            return
        found = _PATH.fullmatch(address.path)
        assert found is not None, address.path
        if verb == "get" and not found["name"]:
            verb = "watch" if query.get("watch") == "True" else "list"
        try:
            self._carry_out(verb, found["resource"], found["name"] or "", body, query)
        except Refusal as refusal:
            self._send(refusal.code, _status(refusal))

    def _carry_out(self, verb: str, resource: str, name: str, body: Document, query: dict[str, str]) -> None:
        """Answer a request, or do what a test wants to happen to it. Raises Refusal."""
        api = self.server.api
        trouble = api.note(f"{verb} {resource}")
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            raise Refusal(401, "Unauthorized")
        if trouble is not None:
            if trouble.status:
                raise Refusal(trouble.status, trouble.message)
            if trouble.done:
                api.handle(verb, resource, name, body, query)
            if trouble.raw:
                self._begin_chunks()
                self._chunk(trouble.raw)
            self.close_connection = True
        elif verb == "watch":
            self._watch(query)
        else:
            self._send(201 if verb == "create" else 200, api.handle(verb, resource, name, body, query))

    def _watch(self, query: dict[str, str]) -> None:
        expired = self.server.api.expired(query)
        if expired is not None and not self.server.api.expires_by_event:
            raise Refusal(410, expired)
        self._begin_chunks()
        status = _status(Refusal(410, expired or ""))
        told = iter([{"type": "ERROR", "object": status}])
        try:
            for event in told if expired else self.server.api.events_after(query, self.server.ended):
                self._chunk(json.dumps(event).encode() + b"\n")
            self.wfile.write(b"0\r\n\r\n")
        except ConnectionError:  # who asked has gone, or the server
            self.close_connection = True

    def _begin_chunks(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        self.wfile.flush()

    def _chunk(self, data: bytes) -> None:
        self.wfile.write(b"%x\r\n%s\r\n" % (len(data), data))
        self.wfile.flush()

    def _send(self, code: int, content: Document) -> None:
        data = json.dumps(content).encode()
        self.send_response(code)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
        self.wfile.flush()


def _node(name: str) -> Document:
    return {
        "metadata": {"name": name, "labels": {"kubernetes.io/hostname": name}},
        "spec": {},
        "status": {
            "allocatable": {"cpu": "4", "memory": "8Gi"},
            "conditions": [{"type": "Ready", "status": "True"}],
        },
    }


def _is_ready(node: Document) -> bool:
    return bool(node["status"]["conditions"][0]["status"] == "True")


def _fits(pod: Document, node: Document) -> bool:
    """Whether an empty node has what the run asks for, and the labels that it wants."""
    (run,) = pod["spec"]["containers"]
    given, asked = node["status"]["allocatable"], run["resources"]["requests"]
    wanted = pod["spec"].get("nodeSelector", {})
    enough = all(quantity(text) <= quantity(given.get(name, "0")) for name, text in asked.items())
    return enough and wanted.items() <= node["metadata"]["labels"].items()


def _selected(entry: Document, query: dict[str, str]) -> bool:
    """Whether an object has the labels that a request asks for, or is about what it asks for."""
    labels = [part.split("=", 1) for part in query.get("labelSelector", "").split(",") if part]
    if any(entry["metadata"].get("labels", {}).get(label) != value for label, value in labels):
        return False
    field, _, value = query.get("fieldSelector", "").partition("=")
    return not field or entry["involvedObject"]["name"] == value


def _forbidden(verb: str, resource: str) -> str:
    group, plural = _GROUPS.get(resource, ""), f"{resource}.{_GROUPS[resource]}" if resource in _GROUPS else resource
    return (
        f'{plural} is forbidden: User "system:serviceaccount:slam:worker" cannot {verb} resource "{resource}" '
        f'in API group "{group}" in the namespace "{NAMESPACE}"'
    )


def _status(refusal: Refusal) -> Document:
    status = {"kind": "Status", "apiVersion": "v1", "status": "Failure", "code": refusal.code, "message": str(refusal)}
    return status | {"reason": _CODES.get(refusal.code, "InternalError")}


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
