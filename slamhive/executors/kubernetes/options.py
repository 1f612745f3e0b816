"""The setting ``KUBERNETES_OPTIONS``: how this installation uses its cluster."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field, fields

from slamhive.base.errors import InvalidInput
from slamhive.base.settings import ExecutorOption

_LABEL = re.compile(r"([A-Za-z0-9.-]+/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?")
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
_REGISTRY = re.compile(r"[a-z0-9][a-zA-Z0-9.:/_-]*[a-z0-9]")
_IMAGE = re.compile(r"[a-z0-9][a-zA-Z0-9.:/_@-]*[a-z0-9]")
_RESOURCE = re.compile(r"[a-z0-9][a-z0-9.-]*\.[a-z0-9-]+/[A-Za-z0-9][A-Za-z0-9_.-]*")
_REMEDY = "write --NAME=VALUE, see docs/kubernetes.md"


@dataclass(frozen=True, slots=True)
class Options:
    """The user's description of the cluster. Everything has a default.

    Attributes:
        context: The context of the kubeconfig; empty for its current one.
        namespace: Where Jobs are made; empty for the one of the context.
        registry: Where images are pushed to and pulled from; empty if the nodes have them already.
        claim: The persistent volume claim that holds the data root; empty if nodes see it at the path that it has here.
        queue: The queue of Kueue; empty for none.
        image: An image with SLAM Hive of the worker's version, by which nodes make variants. Without, the worker does.
        gpu: The extended resource that is one GPU.
        node: {label: value} of the nodes that runs may use.
    """

    context: str = ""
    namespace: str = ""
    registry: str = ""
    claim: str = ""
    queue: str = ""
    image: str = ""
    gpu: str = "nvidia.com/gpu"
    node: dict[str, str] = field(default_factory=dict)


_FORMS = {"namespace": _NAME, "claim": _NAME, "queue": _NAME, "registry": _REGISTRY, "image": _IMAGE, "gpu": _RESOURCE}


def read_options(text: str) -> Options:
    """Read ``--namespace=slam --registry=host/path --node=disk=ssd ...``. Raises InvalidInput naming the option."""
    try:
        parts = shlex.split(text)
    except ValueError as error:
        raise InvalidInput(f"KUBERNETES_OPTIONS={text!r}: {error}", "close the quotation mark") from None
    known = [entry.name for entry in fields(Options)]
    found: dict[str, str] = {}
    node: dict[str, str] = {}
    for part in parts:
        name, _, value = part.removeprefix("--").partition("=")
        if not part.startswith("--") or name not in known or not value:
            names = ", ".join(f"--{entry}" for entry in known)
            raise InvalidInput(f"KUBERNETES_OPTIONS has {part!r}", f"write --NAME=VALUE with one of {names}")
        if name == "node":
            node.update(_label(part, value))
        elif name in _FORMS and not _FORMS[name].fullmatch(value):
            raise InvalidInput(f"KUBERNETES_OPTIONS: {value!r} is no {name}", _REMEDY)
        else:
            found[name] = value
    return Options(**found, node=node)


def _label(part: str, text: str) -> dict[str, str]:
    label, separator, value = text.partition("=")
    if not separator or not _LABEL.fullmatch(label) or (value and not _LABEL.fullmatch(value)):
        raise InvalidInput(f"KUBERNETES_OPTIONS has {part!r}", "write --node=LABEL=VALUE")
    return {label: value}


# Options of users for Kubernetes.


CLUSTER_OPTIONS = ExecutorOption(
    "options",
    "",
    "How a cluster is used: --context, --namespace, --registry, --claim, --queue, --image, --gpu, --node",
)
OPTIONS = (CLUSTER_OPTIONS,)
