"""Jobs of Slurm that run in containers without root."""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from slamhive.base.errors import Unavailable
from slamhive.domain.algorithm import AlgorithmPackage, RunUser
from slamhive.executors.base import (
    Executor,
    ExecutorContext,
    ImageMissing,
    LiveKeys,
    PackageNeed,
    ProgressCallback,
    ProtectionFinding,
    StartFailed,
)
from slamhive.executors.process.environment import orders_for_limits
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.slurm.executor import SlurmExecutor
from slamhive.executors.slurm.image_folders import ImageFolder, ImageFolders, make_mount_point
from slamhive.executors.slurm.options import CONTAINERS
from slamhive.executors.slurm.runtimes import APPTAINER, NONE, RUNTIMES, ContainerOrders, write_sif
from slamhive.executors.spec import DATASET_TARGET, ROS_ENVIRONMENT, RunSpec
from slamhive.executors.transfer import make_own_copies, read_places, written_places
from slamhive.packages.image_context import CONTENT_LABEL, context_hash, dockerfile_of

logger = logging.getLogger(__name__)

_HOME = "/tmp"  # noqa: S108 - in the container
_SEPARATORS = ":,"
"""They end a path in the options of container runtimes."""


class ContainerSlurmExecutor(SlurmExecutor):
    """Runs the images of packages. They come from Docker on the machine of the worker, or from an archive."""

    capabilities = replace(SlurmExecutor.capabilities, needs=PackageNeed.IMAGE)

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._images = ImageFolders(context.data.resolve())

    def examine(self) -> list[ProtectionFinding]:
        """Also which runtime is used. Only the nodes know which they have."""
        found = f"{self._context.value(CONTAINERS)}; images are {'SIF files' if self._makes_sif else 'folders'}"
        return [*super().examine(), ProtectionFinding("SLURM_CONTAINERS", found)]

    def check_package(self, package: AlgorithmPackage) -> None:
        """Raise ImageMissing for a package that has to write into its image."""
        if package.user is not RunUser.WORKER:
            raise ImageMissing(
                f"{package.name} runs as {package.user.in_words} and writes into its image, which jobs cannot change",
                "choose another executor; slamhive doctor --all lists them",
            )

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The digest of the image that was unpacked for this version of the package; None if there is none."""
        if dockerfile_of(package, self._context.project_root) is not None:
            return self._images.with_label(CONTENT_LABEL, context_hash(package, self._context.project_root))
        with self._docker() as docker:
            found = docker.identity(package) if docker.unavailable_because() is None else None
        return found if found is not None and self._images.find(found) is not None else None

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Let Docker build the image and unpack it, unless that has been done. Raises ImageMissing."""
        known = self.identity(package)
        if known is not None:
            self._pack(known, progress)
            return known
        with self._docker() as docker:
            problem = docker.unavailable_because()
            if problem is not None:
                # Nothing in an image that was not built here says which package it belongs to.
                built = dockerfile_of(package, self._context.project_root) is not None
                by_number = "" if built else f", and run {package.name}@NUMBER, because it has no Dockerfile"
                raise ImageMissing(
                    f"{package.name} has no image here, and Docker cannot build it: {problem}",
                    f"where Docker is: slamhive algorithm export {package.name} FILE; then here: slamhive algorithm "
                    f"import FILE{by_number}; or set SLURM_CONTAINERS={NONE}",
                )
            identity = docker.build(package, progress)
            progress(f"{package.name}: unpacking its image for the nodes")
            unpacked = self._images.add(docker.save_image(identity), identity)
        self._pack(unpacked, progress)
        return unpacked

    def _pack(self, identity: str, progress: ProgressCallback) -> None:
        """Make a SIF file of the image, if nodes are to use Apptainer and it is here as well. They can do without."""
        image = self._images.find(identity)
        if not self._makes_sif or image is None or image.sif is not None:
            return
        progress(f"packing image {identity[:19]} into a SIF file")
        try:
            self._images.pack(identity, write_sif)
        except (Unavailable, OSError) as error:
            progress(f"nodes use the folder of image {identity[:19]}, since no SIF file could be made: {error}")

    @property
    def _makes_sif(self) -> bool:
        asked = self._context.value(CONTAINERS) == APPTAINER
        return asked and shutil.which(RUNTIMES[APPTAINER].program) is not None

    def has(self, package: AlgorithmPackage, identity: str) -> bool:  # noqa: ARG002 - a digest names one image
        """Return whether the image with this digest has been unpacked."""
        return self._images.find(identity) is not None

    def forget(self, package: str, identity: str, number: int) -> None:  # noqa: ARG002 - as above
        """Remove the folder of the image. Docker keeps its own."""
        self._images.remove(identity)

    def load_image(self, chunks: Iterable[bytes]) -> str:
        """Unpack the image of an archive; its digest. Needs no Docker."""
        identity = self._images.add(chunks)
        self._pack(identity, logger.info)
        return identity

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Also remove the remains of images that were being unpacked."""
        self._images.sweep()
        return super().sweep(live_keys)

    def _give_orders(self, spec: RunSpec, work: Path) -> None:
        image = self._image_of(spec)
        give_container_orders(spec, image, work, self._context)

    def _image_of(self, spec: RunSpec) -> ImageFolder:
        """The image of the run. Raises ImageMissing, StartFailed."""
        image = self._images.find(spec.identity)
        if image is None:
            raise ImageMissing(f"the image {spec.identity[:19]} of {spec.package} is gone", "build it again")
        if spec.user is not RunUser.WORKER:
            raise StartFailed(f"run {spec.run_id} cannot be {spec.user.in_words} in a job of Slurm")
        return image

    @contextlib.contextmanager
    def _docker(self) -> Iterator[Executor]:
        from slamhive.executors.docker.executor import DockerExecutor  # noqa: PLC0415 - the SDK takes long to load

        with contextlib.closing(DockerExecutor(self._context)) as docker:
            yield docker


def give_container_orders(spec: RunSpec, image: ImageFolder, work: Path, context: ExecutorContext) -> None:
    """Write into the work folder what the supervisor starts, and make what its container needs.

    Raises StartFailed, Unavailable.
    """
    orders = container_orders(spec, image, context.value(CONTAINERS))
    make_own_copies(spec)
    make_mount_points(orders)
    container_shim_spec(spec, orders, context).save(work)
    orders.save(work)


def container_orders(spec: RunSpec, image: ImageFolder, runtime: str) -> ContainerOrders:
    """Describe the container of a run. Raises StartFailed for a path that no runtime takes."""
    work = spec.work.resolve()
    # What is mounted into the folder of the dataset needs a place in it, which must not show in other runs.
    read = {DATASET_TARGET: work / "dataset", **read_places(spec)}
    written = {_HOME: work / "tmp", **written_places(spec)}
    orders = ContainerOrders(
        runtime=runtime,
        image=str(image.sif or image.root) if runtime == APPTAINER else str(image.root),
        command=list(spec.command),
        environment={**image.environment, **ROS_ENVIRONMENT, "HOME": _HOME, **spec.environment},
        read={target: str(path) for target, path in read.items()},
        written={target: str(path) for target, path in written.items()},
    )
    for source, target, _ in orders.mounts():
        if not set(_SEPARATORS).isdisjoint(source + target):
            raise StartFailed(f"{source} cannot be given to a container: its path has a colon or a comma", "rename it")
    return orders


def make_mount_points(orders: ContainerOrders) -> None:
    """Ensure that there is something to mount on: in the image, or in the folder that is mounted further out."""
    places = {target: Path(source) for source, target, _ in orders.mounts()}
    for place in (DATASET_TARGET, *orders.written):
        if not places[place].exists():
            places[place].mkdir(parents=True)
    for target, source in places.items():
        outer = [place for place in (DATASET_TARGET, *orders.written) if target.startswith(f"{place}/")]
        above = max(outer, key=len, default="")
        root = places.get(above, Path(orders.image))
        if root.is_file():
            continue  # Apptainer makes what a SIF file lacks
        make_mount_point(root, target.removeprefix(above), is_folder=source.is_dir())


def container_shim_spec(spec: RunSpec, orders: ContainerOrders, context: ExecutorContext) -> ShimSpec:
    """The orders for the supervisor; the node adds the command, since it knows its runtime."""
    return replace(
        orders_for_limits(spec, context),
        folder=orders.written[_HOME],
        readable=[orders.image, *orders.read.values()],
        writable=list(orders.written.values()),
        read_only=list(orders.read.values()),
    )
