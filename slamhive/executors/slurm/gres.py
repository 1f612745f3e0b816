"""GPUs as generic resources of Slurm: what is asked for, which nodes have it, and which GPU a job got."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import zip_longest

from slamhive.domain.gpu import GivenGpu, Gpu
from slamhive.errors import InvalidInput, Unavailable
from slamhive.executors.gpu import list_gpus

_FORM = re.compile(r"(?P<name>[A-Za-z_]\w*)(:(?P<type>[A-Za-z][\w.-]*))?:1")
_DETAIL = re.compile(r"\([^)]*\)")
_OPTION = "--gres="
VISIBLE = ("CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")
"""By these variables a job of Slurm finds its GPUs, and so does the algorithm."""


def read_gpu(text: str) -> str:
    """The value of ``SLURM_GPU``. Raises InvalidInput: a run has one whole GPU."""
    if not _FORM.fullmatch(text):
        raise InvalidInput(f"SLURM_GPU={text!r} is not one GPU", "write NAME:1 or NAME:TYPE:1, such as gpu:a100:1")
    return text


def with_gpu(options: Sequence[str], gpu: str) -> list[str]:
    """``options`` of the user that also ask for ``gpu``, in one option: the last one would win.

    Who asks for the same resource for all jobs has chosen how many.
    """
    asked = [option.removeprefix(_OPTION) for option in options if option.startswith(_OPTION)][-1:]
    rest = [option for option in options if not option.startswith(_OPTION)]
    name = gpu.partition(":")[0]
    entries = [entry for text in asked for entry in text.split(",")]
    has_it = any(entry.partition(":")[0] == name for entry in entries)
    return [*rest, _OPTION + ",".join(entries if has_it else [*entries, gpu])]


def offers(gres: str, gpu: str) -> bool:
    """Return whether a node with these resources, such as ``gpu:a100:4(S:0-1),shard:8``, has ``gpu``."""
    wanted = _FORM.fullmatch(gpu)
    if wanted is None:
        return False
    for entry in _DETAIL.sub("", gres).split(","):
        name, *rest = entry.split(":")
        count = rest.pop() if rest and rest[-1].isdigit() else "1"
        if name == wanted["name"] and wanted["type"] in (None, *rest) and int(count):
            return True
    return False


def given_gpus(
    node: str, variables: Mapping[str, str], known: Callable[[], Sequence[Gpu]] = list_gpus
) -> list[GivenGpu]:
    """The GPUs of a job that asked for one, from its variables and the driver; one of unknown name if nothing says it.

    Args:
        node: Where the job is.
        variables: Of the job. The numbers in ``CUDA_VISIBLE_DEVICES`` are those that the driver shows to the job;
            ``SLURM_JOB_GPUS`` has those of the whole node.
        known: Lists the GPUs that the driver shows.
    """
    visible = next((found for name in VISIBLE if (found := _names(variables, name))), [])
    numbers = _names(variables, "SLURM_JOB_GPUS") or visible
    try:
        there = known()
    except Unavailable:
        there = ()
    by_name = {str(place): gpu for place, gpu in enumerate(there)} | {gpu.uuid: gpu for gpu in there}
    given = []
    for name, number in zip_longest(visible or numbers, numbers):
        gpu = by_name.get(name)
        given.append(GivenGpu(node, number or name, **({} if gpu is None else asdict(gpu))))
    return given or [GivenGpu(node)]


def _names(variables: Mapping[str, str], name: str) -> list[str]:
    """The entries of a variable; older versions of Slurm name no device by a word of their own."""
    return [entry for entry in variables.get(name, "").split(",") if entry not in ("", "NoDevFiles")]
