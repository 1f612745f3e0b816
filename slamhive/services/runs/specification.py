"""Turn a queued run into what an executor needs: configuration file, inputs, limits and provenance."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamhive import __version__
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import hash_files, write_aside
from slamhive.base.settings import Settings
from slamhive.documents.catalogue import MatchDocument
from slamhive.documents.limits import NO_SLOW_DOWN, Limits, RunOptions
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage, Gpu, GpuNeed
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import match_of
from slamhive.domain.roles import BY_RULE, Chosen
from slamhive.executors.base import Capabilities, EngineUnavailable, Executor, ImageMissing
from slamhive.executors.spec import (
    DATASET_TARGET,
    RECORDING,
    ResourceLimits,
    RunInput,
    RunOutput,
    RunSpec,
    VariantOrder,
)
from slamhive.packages.algorithm_file import package_hash
from slamhive.packages.dataset_file import DATASET_FILE
from slamhive.packages.run_config import build_run_config
from slamhive.recordings.reader import inspect_bag
from slamhive.recordings.staging import PLAY_SCRIPT, checksum, current_script, shipped_script
from slamhive.run_folder.folder import RunFolder
from slamhive.runtime.config import to_yaml
from slamhive.runtime.paths import MAP_VARIABLE, ORB_VOCABULARY_VARIABLE, WEIGHTS_VARIABLE
from slamhive.services.configurations import FoundMap
from slamhive.services.datasets import IDENTITY, UsedVariant
from slamhive.services.weights import StoredWeights

CONTAINER_ROOT = "/slamhive"
COMMAND = ("python3", f"{CONTAINER_ROOT}/mapping.py")
_NICE = (
    "import os, sys; nice = max(int(sys.argv[1]), os.getpriority(os.PRIO_PROCESS, 0)); "
    "os.setpriority(os.PRIO_PROCESS, 0, nice); os.execv(sys.executable, [sys.executable, *sys.argv[2:]])"
)
"""Docker, Kubernetes and Slurm have no option for it, and an image may lack ``nice``, but every one has Python."""
CONTAINER_WEIGHTS = "/slamhive-weights"
CONTAINER_VOCABULARY = "/slamhive-vocabulary.txt"
_VARIANT_CHECKSUM = "variant_checksum"
MOST_BYTES_HASHED = 1_000_000
"""Larger inputs are hashed only if their hash is known already."""


@dataclass(frozen=True, slots=True)
class Job:
    """One run with its algorithm and dataset resolved, ready to be prepared.

    ``used`` is the variant of the dataset that the run sees, None for the dataset as it is. ``input_map`` is the map
    that it starts with. ``gpu`` is what it leased; with ``asks_gpu`` the engine gives it one. ``weights`` have been
    checked.
    """

    run_id: int
    key: str
    algorithm: Algorithm
    dataset: Dataset
    configuration: Configuration
    seed: int
    options: RunOptions
    used: UsedVariant | None = None
    input_map: FoundMap | None = None
    gpu: Gpu | None = None
    asks_gpu: bool = False
    weights: tuple[StoredWeights, ...] = ()

    @property
    def seen(self) -> Dataset:
        """The dataset that the run uses; metrics are computed with the ground truth of ``dataset``."""
        return self.dataset if self.used is None else self.used.dataset

    @property
    def order(self) -> VariantOrder | None:
        """The variant that the node of the run makes; None if the run sees files that are here."""
        return None if self.used is None else self.used.order


def check_disk(settings: Settings) -> None:
    """Raise Unavailable if the data root has less free space than the settings require."""
    free_mb = shutil.disk_usage(settings.data).free // 1_000_000
    if free_mb < settings.min_free_disk_mb:
        raise Unavailable(
            f"{settings.data} has {free_mb} MB free, {settings.min_free_disk_mb} MB are required",
            "free some space, or lower MIN_FREE_DISK_MB",
        )


def check_dataset_files(dataset: Dataset) -> None:
    """Raise InvalidInput if the recording is missing."""
    if not dataset.bag_path.exists():
        raise InvalidInput(f"dataset {dataset.name} lacks its recording {dataset.bag_path}", "import it again")


def recorded_topics(dataset: Dataset) -> dict[str, int]:
    """{topic: number of messages} from the index of the recording; raises InvalidInput if missing or damaged."""
    check_dataset_files(dataset)
    return {entry.topic: entry.count for entry in inspect_bag(dataset.bag_path).topics}


def check_recorded(
    dataset: Dataset, algorithm: Algorithm, recorded: Mapping[str, int], chosen: Chosen = BY_RULE
) -> None:
    """Raise InvalidInput if the recording lacks a topic that ``algorithm`` needs; see :func:`recorded_topics`."""
    for role, sensor in algorithm.assign(dataset, chosen).items():
        if not recorded.get(sensor.topic):
            raise InvalidInput(
                f"{dataset.bag_path} holds no messages on {sensor.topic}, which {algorithm.name} needs as {role}",
                f"correct the topic of {sensor.name} in dataset.yaml; recorded: {', '.join(sorted(recorded))}",
            )


def check_executor(executor: Executor, package: AlgorithmPackage, asked: Limits) -> None:
    """Raise InvalidInput if ``executor`` can never run the package, or does not enforce a limit that was asked for."""
    try:
        executor.check_package(package)
    except ImageMissing as error:
        raise InvalidInput(error.message, error.remedy) from None
    check_gpu(executor, package)
    memory_bytes = None if asked.memory_mb is None else asked.memory_mb * 1_000_000
    limits = ResourceLimits(asked.cpu_cores, memory_bytes, pids=None)
    refusal = executor.capabilities.refusal(executor.name, limits)
    if refusal is not None:
        raise InvalidInput(refusal, "leave the limit out, or choose another executor")
    if asked.slow_down != NO_SLOW_DOWN:
        check_slow_down(executor, asked)


LEAST_CORES = 0.01
"""The least CPU time that Docker and Linux grant."""


def check_slow_down(executor: Executor, asked: Limits) -> None:
    """Raise InvalidInput if ``executor`` cannot hold a run to a part of the time of its cores."""
    reason = executor.no_part_of_a_core()
    if reason is not None:
        raise InvalidInput(f"a slow-down of {asked.slow_down:g} cannot be held: {reason}", "leave slow_down out")
    if asked.cpu_cores is None and not executor.capabilities.takes_cores_here:
        raise InvalidInput(
            f"a slow-down of {asked.slow_down:g} needs a CPU limit: nobody knows the cores of a node of the executor "
            f"{executor.name} beforehand",
            "state the cores of the board too (--cpus, limits: {cpus: 4})",
        )
    if asked.cpu_cores is not None and asked.cpu_cores / asked.slow_down < LEAST_CORES:
        raise InvalidInput(
            f"{asked.cpu_cores:g} cores slowed down by {asked.slow_down:g} are less than {LEAST_CORES:g} cores",
            "raise the CPU limit, or slow down less",
        )


def check_gpu(executor: Executor, package: AlgorithmPackage) -> None:
    """Raise InvalidInput if the package requires a GPU and ``executor`` has none."""
    if package.gpu is GpuNeed.REQUIRED:
        try:
            executor.check_gpu()
        except EngineUnavailable:
            raise
        except Unavailable as error:
            raise InvalidInput(f"{package.name} requires a GPU: {error.message}", error.remedy) from None


def write_config(job: Job, folder: RunFolder) -> None:
    """Write ``config.yaml``: the exact bytes that are mounted."""
    config = build_run_config(job.algorithm, job.seen, job.configuration, job.run_id, job.seed, job.dataset)
    write_aside(folder.config, to_yaml(config))


def build_spec(
    job: Job,
    folder: RunFolder,
    settings: Settings,
    identity: str,
    cores: tuple[int, ...] | None,
    capabilities: Capabilities,
) -> RunSpec:
    """The specification of the run, as it is stored in the run folder.

    Args:
        job: What to run.
        folder: Its run folder; ``config.yaml`` has been written.
        settings: The limits for runs that ask for none.
        identity: The image digest or environment hash to use.
        cores: Core numbers of the worker's slot, None for all cores.
        capabilities: Of the executor: default limits that it does not enforce are left out.
    """
    limits = _limits(job, settings, cores, here=capabilities.takes_cores_here).only(capabilities.limits)
    results = RunOutput(
        "result",
        folder.result,
        f"{CONTAINER_ROOT}/result",
        live=tuple(path.name for path in folder.watched_files),
        max_bytes=limits.file_bytes,
        max_files=None if limits.files is None else limits.files + 1,
    )

    dataset, package = job.seen, job.algorithm.package
    inputs: list[RunInput] = []
    if not (package.standard_image or (package.folder / "Dockerfile").is_file()):
        # An image made for the published SLAM Hive does not hold its scripts. It gets a copy that it may change.
        inputs.append(_input("slamhive", package.folder / "slamhive", CONTAINER_ROOT, own_copy=True))
    inputs.append(_input("config", folder.config, f"{CONTAINER_ROOT}/config.yaml"))
    inputs.append(_input(RECORDING, dataset.bag_path, f"{DATASET_TARGET}/{dataset.bag}", content=dataset.checksum))
    if (dataset.folder / DATASET_FILE).is_file():
        inputs.append(_input(DATASET_FILE, dataset.folder / DATASET_FILE, f"{DATASET_TARGET}/{DATASET_FILE}"))
    script = current_script(dataset.folder / PLAY_SCRIPT) if job.order is None else shipped_script()
    # This program may be in a container itself, and the engine sees the data root but not the files of the program.
    copied = script == shipped_script()
    inputs.append(_input(PLAY_SCRIPT, script, f"{DATASET_TARGET}/{PLAY_SCRIPT}", own_copy=copied))
    if settings.orb_vocabulary:
        inputs.append(_input("vocabulary", Path(settings.orb_vocabulary), CONTAINER_VOCABULARY))
    for entry in job.weights:
        name, content = entry.weights.name, f"sha256:{entry.sha256}"
        inputs.append(_input(f"weights {name}", entry.path, f"{CONTAINER_WEIGHTS}/{name}", content=content))
    if job.input_map is not None:
        found = job.input_map
        inputs.append(_input("map", found.path, _map_target(found), content=found.map.content))

    return RunSpec(
        key=job.key,
        run_id=job.run_id,
        package=package.name,
        package_folder=package.folder,
        image=package.image,
        identity=identity,
        command=with_niceness(COMMAND, job.options.nice),
        inputs=tuple(inputs),
        outputs=(results,),
        environment=_environment(job, settings),
        limits=limits,
        timeout_s=time_limit_s(job, settings),
        work=folder.work,
        user=package.user,
        gpu=None if job.gpu is None else job.gpu.uuid,
        asks_gpu=job.asks_gpu,
        variant=job.order,
        shm_bytes=None if package.shm_mb is None else package.shm_mb * 1_000_000,
    )


def with_niceness(command: tuple[str, ...], nice: int) -> tuple[str, ...]:
    """The command of a Python program that first takes this niceness, unless it is started with a higher one."""
    return (command[0], "-c", _NICE, str(nice), *command[1:]) if nice else command


def _environment(job: Job, settings: Settings) -> dict[str, str]:
    variables = {ORB_VOCABULARY_VARIABLE: CONTAINER_VOCABULARY} if settings.orb_vocabulary else {}
    if job.weights:
        variables[WEIGHTS_VARIABLE] = CONTAINER_WEIGHTS
    return variables if job.input_map is None else {**variables, MAP_VARIABLE: _map_target(job.input_map)}


def _map_target(found: FoundMap) -> str:
    return f"{CONTAINER_ROOT}/map/{found.path.name}"


def time_limit_s(job: Job, settings: Settings) -> float:
    """The wall-clock limit: as asked for, or derived from the recording's duration and the playback rate."""
    if job.options.timeout_s is not None:
        return job.options.timeout_s
    duration_s = job.dataset.duration_s / min(job.configuration.playback.rate, 1.0) * job.options.slow_down
    factor = max(settings.run_timeout_factor, job.algorithm.package.time_factor)
    return factor * duration_s + settings.run_timeout_slack_s


def provenance(job: Job, identity: str, number: int) -> dict[str, Any]:
    """The provenance of the run for ``run.json``; ``number`` is that of the package's version."""
    package = job.algorithm.package
    match = match_of(job.algorithm, job.seen, job.configuration.parameters, job.configuration.sensors)
    used_map = job.input_map
    return {
        "software": f"slamhive {__version__}",
        "algorithm": {
            "package": package.name,
            "mode": job.algorithm.mode,
            "version": package.version,
            "package_hash": package_hash(package.folder),
            "image": package.image,
            "identity": identity,
            "number": number,
        },
        "dataset": {
            "checksum": job.dataset.checksum,
            "duration_s": job.dataset.duration_s,
            "variant": IDENTITY if job.used is None else job.used.key,
            # Its node will say what it has made.
            _VARIANT_CHECKSUM: job.seen.checksum if job.order is None else None,
        },
        **({} if job.gpu is None else {"gpu": asdict(job.gpu)}),
        "trajectory": job.algorithm.trajectory,
        **({"weights": {entry.weights.name: entry.sha256 for entry in job.weights}} if job.weights else {}),
        "match": MatchDocument.of_match(match).content,
        **({} if used_map is None else {"map": {**asdict(used_map.map), "dataset": used_map.dataset}}),
    }


def with_made_variant(record: Mapping[str, Any], checksum: str) -> dict[str, Any]:
    """The dataset in the record of a run, once its node has made the variant."""
    return {**record["dataset"], _VARIANT_CHECKSUM: checksum}


def _input(name: str, source: Path, target: str, *, content: str | None = None, own_copy: bool = False) -> RunInput:
    """An input with its size, and with its content's identity unless reading it would take long."""
    try:
        files = [path for path in source.rglob("*") if path.is_file()] if source.is_dir() else [source]
        size_bytes = sum(path.stat().st_size for path in files)
        if content is None and size_bytes <= MOST_BYTES_HASHED:
            content = hash_files(source) if source.is_dir() else checksum(source)
    except OSError as error:
        raise InvalidInput(f"the {name} {source} cannot be read: {error.strerror}", "put it back") from None
    return RunInput(name, source, target, size_bytes, content, own_copy)


def _limits(job: Job, settings: Settings, cores: tuple[int, ...] | None, *, here: bool) -> ResourceLimits:
    """The limits of the run; ``here``: it takes cores of this machine, whose numbers mean nothing on another one."""
    cores = cores if here else None
    memory_mb = job.options.memory_mb or settings.run_memory_mb or job.algorithm.package.memory_mb
    return ResourceLimits(
        cpu_cores=cpu_limit(job.options, settings.run_cpu_cores or None, cores, here=here),
        memory_bytes=memory_mb * 1_000_000,
        pids=settings.run_pids,
        cpuset=cores,
        disk_bytes=disk_limit_bytes(settings),
        files=settings.run_files,
    )


def cpu_limit(asked: Limits, default: float | None, cores: tuple[int, ...] | None, *, here: bool) -> float | None:
    """The cores whose time a run may use, None for no limit; see :func:`check_slow_down`.

    Args:
        asked: What was asked for.
        default: For runs that ask for none.
        cores: Numbers of the cores of its slot, None for all.
        here: It takes cores of this machine.
    """
    limit = asked.cpu_cores or default
    if asked.slow_down == NO_SLOW_DOWN:
        return limit
    if here:
        # Of the cores that it has: a part of more than there are would be too much.
        most = len(os.sched_getaffinity(0)) if cores is None else len(cores)
        limit = min(limit or most, most)
    return None if limit is None else max(LEAST_CORES, limit / asked.slow_down)


def disk_limit_bytes(settings: Settings) -> int:
    """Bytes that the run may write: as set, but other runs and the database keep their free space."""
    spared_bytes = settings.min_free_disk_mb * 500_000
    return max(0, min(settings.run_disk_mb * 1_000_000, shutil.disk_usage(settings.data).free - spared_bytes))
