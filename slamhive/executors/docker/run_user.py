"""Runs whose image wants a user of its own: what they write is opened before the start and handed over afterwards.

Images of the published SLAM Hive write to ``/root`` or ``/home``, so they need the user that they were made for. The
container has no capabilities, so its root is no master of files on this machine: folders of the run are opened to it.
Meanwhile the folder of the run is closed to other users of the machine, since root could leave programs there that run
as root. Afterwards all files belong to the worker, who can delete them.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import docker
import docker.errors
import requests
from docker.types import Mount

from slamhive.base.files import remedy_of
from slamhive.base.tree import walk
from slamhive.domain.algorithm import RunUser
from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.docker.engine import HARDENING, engine_errors, information_of, labels_of_helper, traits_of
from slamhive.executors.spec import RunSpec
from slamhive.executors.transfer import read_places, written_places

logger = logging.getLogger(__name__)

ROOT = "0:0"
_OTHERS = 0o007
HANDOVER_S = 120
HANDOVER_CAPABILITIES = ["CHOWN", "DAC_OVERRIDE", "FOWNER"]
_PIDS = 16
HANDOVER = """
import os, sys
uid, gid = int(sys.argv[1]), int(sys.argv[2])
for place in sys.argv[3:]:
    for folder, folders, files in os.walk(place):
        for name in folders + files:
            os.lchown(os.path.join(folder, name), uid, gid)
"""
"""Runs in the Python of the image, 3.3 or later; ``chown`` takes away rights to run as the owner."""


def container_user(user: RunUser, *, rootless: bool) -> str | None:
    """The option ``user`` of a container; None for the user that the image names.

    Root of a rootless engine's containers is the user who runs the engine, and has no other rights on this machine.
    """
    if user is RunUser.IMAGE:
        return None
    return ROOT if rootless or user is RunUser.ROOT else f"{os.getuid()}:{os.getgid()}"


def in_words(user: RunUser, *, rootless: bool) -> str:
    """The user of the run in its container, for ``run.json`` and messages."""
    if user is RunUser.WORKER:
        inside = "; root in the container, which the engine without root makes this user" if rootless else ""
        return f"user {os.getuid()}:{os.getgid()} of the worker{inside}"
    return user.in_words


def is_foreign(user: RunUser, *, rootless: bool) -> bool:
    """Return whether the user of the run is not the worker's own."""
    return user is RunUser.IMAGE or (user is RunUser.ROOT and os.getuid() != 0 and not rootless)


def open_to_user(spec: RunSpec, *, rootless: bool) -> None:
    """Let the foreign user of a run write to its folders, and nobody else into them. Raises StartFailed."""
    if not is_foreign(spec.user, rootless=rootless):
        return
    for target, source in read_places(spec).items():
        files = [entry for entry in source.rglob("*") if entry.is_file()] if source.is_dir() else [source]
        for file in files:
            if not file.stat().st_mode & stat.S_IROTH:
                raise StartFailed(
                    f"run {spec.run_id} is {spec.user.in_words}, which may not read {file} ({target})",
                    f"chmod o+r {file}",
                )
    run_folder = spec.work.parent
    try:
        run_folder.chmod(stat.S_IMODE(run_folder.stat().st_mode) & ~_OTHERS)
        for place in (*written_places(spec).values(), spec.work / "tmp"):
            for path in (place, *place.rglob("*")):
                if not path.is_symlink():
                    path.chmod(0o777 if path.is_dir() or path.stat().st_mode & stat.S_IXUSR else 0o666)
    except OSError as error:
        problem = f"{run_folder} cannot be opened to {spec.user.in_words}: {error}"
        raise StartFailed(problem, remedy_of(error)) from None


def take_back(engine: Callable[[], docker.DockerClient], spec: RunSpec, installation: str) -> None:
    """Give what a foreign user has written in an ended run to this process's user, and close its folders again."""
    if spec.user is RunUser.WORKER:
        return
    if is_foreign(spec.user, rootless=traits_of(engine()).rootless):
        _hand_over(engine(), [*written_places(spec).values(), spec.work / "tmp"], spec.identity, installation)
        run_folder = spec.work.parent
        mode = stat.S_IMODE(run_folder.parent.stat().st_mode)  # that of new folders beside it
        for path in (run_folder, run_folder / "result"):
            if path.is_dir() and path.stat().st_uid == os.getuid():
                path.chmod(mode)


def _hand_over(client: docker.DockerClient, places: Iterable[Path], image: str, installation: str) -> None:
    """Give what lies in ``places``, folders of an ended run, to this process's user. Raises EngineUnavailable.

    Root does it itself. Others ask the engine for a container of the run's image, which has the rights to do this and
    sees the folders of this run alone.
    """
    strangers = [
        place for place in places if place.is_dir() and any(entry.status.st_uid != os.getuid() for entry in walk(place))
    ]
    if not strangers:
        return
    if os.getuid() == 0:
        _take(strangers)
        return
    mounts = [Mount(f"/handover/{number}", str(place), type="bind") for number, place in enumerate(strangers)]
    inside = [f"/handover/{number}" for number in range(len(strangers))]
    options = {**HARDENING, "mounts": mounts, "user": ROOT, "cap_add": HANDOVER_CAPABILITIES, "pids_limit": _PIDS}
    owner = ["0", "0"] if traits_of(client).rootless else [str(os.getuid()), str(os.getgid())]
    command = ["python3", "-I", "-c", HANDOVER, *owner, *inside]
    with engine_errors("handing over the files of a run", EngineUnavailable):
        security: Any = information_of(client).get("SecurityOptions") or []
        if any(str(option).startswith("name=userns") for option in security):
            options["userns_mode"] = "host"  # inside the namespace, users of this machine have no number
        container = client.containers.create(
            image, entrypoint=command, command=[], labels=labels_of_helper("handover", installation), **options
        )
        try:
            container.start()
            ended = container.wait(timeout=HANDOVER_S)["StatusCode"]
            if ended != 0:
                said = container.logs(tail=1).decode(errors="replace").strip()
                logger.warning("files in %s could not be handed over: %s", strangers[0], said)
        except requests.exceptions.RequestException as error:
            logger.warning("files in %s could not be handed over: %s", strangers[0], error)
        finally:
            container.remove(force=True, v=True)


def _take(places: Iterable[Path]) -> None:
    for place in places:
        for entry in walk(place):
            if entry.status.st_uid != os.getuid():
                os.chown(entry.name, os.getuid(), os.getgid(), dir_fd=entry.folder, follow_symlinks=False)
