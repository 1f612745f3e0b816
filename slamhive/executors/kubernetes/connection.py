"""Connections to the API server of a cluster, and the meaning of its refusals.

The official client takes half a second to import, so it is imported when a cluster is first asked.
"""

from __future__ import annotations

import atexit
import functools
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import urllib3.exceptions

from slamhive.errors import SlamHiveError
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.kubernetes.answers import message_of, missing_right
from slamhive.executors.kubernetes.options import Options
from slamhive.files import temporary_folder

IN_CLUSTER = Path("/var/run/secrets/kubernetes.io/serviceaccount")
_ANSWERS_LATER = frozenset((408, 429, 500, 502, 503, 504))
_ANONYMOUS = "system:anonymous"
_NOBODY = "the cluster does not accept the credentials of the kubeconfig: they are wrong or have expired"
_LOG_IN = "log in again until kubectl get jobs works"


class Refused(Exception):
    """The API server answered with an error code that the caller expects."""


@dataclass(frozen=True, slots=True)
class Connection:
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


def connect(options: Options) -> Connection:
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
            namespace = _namespace_of(options.context, config.list_kube_config_contexts(files))
            config.load_kube_config(
                files, options.context or None, configuration, temp_file_path=str(_credentials_folder())
            )
        else:
            namespace = (IN_CLUSTER / "namespace").read_text(encoding="utf-8").strip()
            config.load_incluster_config(client_configuration=configuration)
    api = client.ApiClient(configuration)
    return Connection(
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
            raise Refused from None
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


def _namespace_of(context: str, known: tuple[list[dict[str, Any]], dict[str, Any] | None]) -> str:
    contexts, active = known
    chosen = next((entry for entry in contexts if entry["name"] == context), active)
    return str(((chosen or {}).get("context") or {}).get("namespace") or "default")
