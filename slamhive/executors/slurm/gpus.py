"""GPUs as generic resources of Slurm: what is asked for, which nodes have it, and which GPU a job got."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import zip_longest
from typing import Any

import psutil

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.algorithm import GivenGpu, Gpu
from slamhive.executors.gpu import GpuUse, below, gpu_use, list_gpus

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


# The use of the GPU that Slurm gave a run: read on the node, passed to the worker in ``usage.json``.


INTERVAL_S = 0.5
"""NVML is asked no more often than this: its driver samples the utilisation a few times a second."""
_WHY_NOT = "why_not"


class GpuReadings:
    """Readings as the content of JSON.

    Args:
        read: One reading; raises Unavailable, and is not called again then.
    """

    def __init__(self, read: Callable[[], GpuUse]) -> None:
        self._read = read
        self._content: dict[str, Any] = {}
        self._next_s = 0.0

    @classmethod
    def of_run(cls, gpu: GivenGpu | None, supervisor: psutil.Process) -> GpuReadings | None:
        """Those of the processes that ``supervisor`` has started; None without a GPU."""
        if gpu is None:
            return None
        belongs = below(supervisor)

        def read() -> GpuUse:
            if gpu.uuid is None:
                raise Unavailable(f"nobody knows the UUID of GPU {gpu.number} of {gpu.node}")
            return gpu_use(gpu.uuid, belongs)

        return cls(read)

    def read(self) -> dict[str, Any]:
        """The newest reading, or why there is none."""
        if _WHY_NOT in self._content or monotonic_s() < self._next_s:
            return self._content
        self._next_s = monotonic_s() + INTERVAL_S
        try:
            self._content = asdict(self._read())
        except Unavailable as error:
            self._content = {_WHY_NOT: str(error)}
        return self._content


def use_of(content: Mapping[str, Any] | None) -> GpuUse:
    """Parse the result of :meth:`GpuReadings.read`; raises Unavailable with the reason."""
    if content is None:
        raise Unavailable("the job of Slurm does not measure a GPU")
    if _WHY_NOT in content:
        raise Unavailable(content[_WHY_NOT])
    return GpuUse(**content)
