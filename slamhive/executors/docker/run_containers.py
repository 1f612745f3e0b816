"""The containers of runs in the engine: found by name, created once, started, removed, swept.

The engine remembers what runs: the name of a container follows from the run's key, and its labels hold the key, the run
and the installation. "No such container" (404) and "exists already" (409) are therefore answers, not errors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from datetime import timedelta
from typing import Any

import docker
import docker.errors

from slamhive.clock import monotonic_s, utc_now
from slamhive.errors import Unavailable
from slamhive.executors.base import EngineUnavailable, ExecutorContext, ImageMissing, LiveKeys, StartFailed
from slamhive.executors.docker.container import container_options, scratch_folder
from slamhive.executors.docker.engine import (
    INSTALLATION_LABEL,
    KEY_LABEL,
    OWNER_LABEL,
    boot_labels,
    container_name,
    engine_errors,
    engine_time,
    traits_of,
)
from slamhive.executors.identity import owner_is_dead
from slamhive.executors.local_files import has_written, make_own_copies
from slamhive.executors.spec import RunSpec
from slamhive.files import remedy_of

OWNER_PATIENCE = timedelta(minutes=5)
"""How long a container is kept that does not run, but whose process may live."""
_FORGOTTEN = "id already in use"
"""So Docker refuses to start a container of which containerd has a task."""
_CREATION_PATIENCE_S = 30.0
_CREATION_STEP_S = 0.05


class RunContainers:
    """The containers of the runs of one installation. ``engine`` gives the client, connecting where needed."""

    def __init__(self, engine: Callable[[], docker.DockerClient], context: ExecutorContext) -> None:
        self._engine = engine
        self._context = context

    def find(self, name_or_id: str) -> Any | None:
        """The container; None if the engine has none of that name or id."""
        with engine_errors("looking for the container", EngineUnavailable):
            try:
                return self._engine().containers.get(name_or_id)
            except docker.errors.NotFound:
                return None

    def create(self, spec: RunSpec) -> Any:
        """Create the container of a run, or find the one that somebody else creates meanwhile. Raises StartFailed."""
        scratch = scratch_folder(spec)
        try:
            scratch.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{scratch} cannot be made: {error.strerror}", remedy_of(error)) from None
        make_own_copies(spec)
        deadline_s = monotonic_s() + _CREATION_PATIENCE_S
        while True:
            container = self._try_create(spec) or self.find(container_name(spec.key))
            if container is not None:
                return container
            # A worker that was killed asked for it too: the engine has taken the name, and still makes the container.
            if monotonic_s() >= deadline_s:
                raise StartFailed(f"the engine does not finish the container of run {spec.run_id}", "try again")
            time.sleep(_CREATION_STEP_S)

    def _try_create(self, spec: RunSpec) -> Any | None:
        """Create the container; None if its name is taken."""
        with engine_errors(f"starting run {spec.run_id}", StartFailed):
            try:
                options = container_options(spec, self._context, traits_of(self._engine()))
                options["labels"] |= boot_labels()
                return self._engine().containers.create(**options)
            except docker.errors.ImageNotFound:
                raise ImageMissing(f"image {spec.image} ({spec.identity[:19]}) is gone", "build it again") from None
            except docker.errors.APIError as error:
                if error.status_code != 409:
                    raise
                return None

    def start(self, container: Any, spec: RunSpec) -> None:
        """Start a container that was created; it is removed if that fails.

        It is removed as well if it ran before, because nobody knows how the run ended: an engine that is killed
        forgets what it has just started.
        """
        if has_written(spec):
            self.remove(str(container.id))
            return
        try:
            with engine_errors(f"starting run {spec.run_id}", StartFailed):
                container.start()
        except StartFailed as error:
            self.remove(str(container.id))
            if _FORGOTTEN not in error.message:
                raise

    def remove(self, container_id: str) -> None:
        """Remove a container, running or not; one that is gone is no error."""
        with engine_errors("removing a container", EngineUnavailable):
            try:
                self._engine().api.remove_container(container_id, force=True, v=True)
            except docker.errors.NotFound:
                return
            except docker.errors.APIError as error:
                if error.status_code != 409:  # 409: it is being removed already
                    raise

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Remove those whose run is over, or whose process is dead; their names."""
        label = f"{INSTALLATION_LABEL}={self._context.installation}"
        with engine_errors("listing containers", EngineUnavailable):
            containers = self._engine().containers.list(all=True, filters={"label": label}, ignore_removed=True)
        keys = live_keys()
        stale = [entry for entry in containers if not _is_live(entry, keys)]
        for container in stale:
            self.remove(str(container.id))
        return [str(container.name) for container in stale]


def _is_live(container: Any, live_keys: Collection[str]) -> bool:
    """Return whether somebody still needs a container: the run of its key, or the process that it serves."""
    owner = container.labels.get(OWNER_LABEL)
    if owner is None:
        return container.labels.get(KEY_LABEL) in live_keys
    if owner_is_dead(owner):
        return False
    if container.status == "running":
        return True
    # Its owner is about to start it, or reads how it ended.
    since = engine_time(container.attrs["State"].get("FinishedAt")) or engine_time(container.attrs.get("Created"))
    return since is not None and utc_now() - since < OWNER_PATIENCE
