"""Images that somebody else made: taken by name, archive or Dockerfile, and completed to keep the contract."""

from __future__ import annotations

import importlib.util
import io
import json
import re
import shutil
import tarfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import docker
import docker.errors
import requests

from slamhive.base.files import temporary_folder
from slamhive.executors.base import CompletedImage, ImageMissing, ProgressCallback
from slamhive.executors.docker.engine import HARDENING, closing_chunks, engine_errors, labels_of_helper
from slamhive.executors.docker.images import (
    build_packed,
    follow_pull,
    get_image,
    load_image,
    name_image,
    packed_context,
)
from slamhive.packages.image_context import BuildContext

_USER = re.compile(r"[\w.-]+(?::[\w.-]+)?")
_NOBODY = "65534:65534"
PROBE_S = 60
_PIDS = 64
_MOST_SCRIPT_BYTES = 1_000_000_000
_NOT_IN_CONTEXT = ("image.tar", ".git")
PROBE = """
import importlib.util, json, sys
missing = [name for name in sys.argv[1:] if importlib.util.find_spec(name) is None]
places = [path for path in sys.path if path.endswith(("dist-packages", "site-packages"))]
system = [path for path in places if path.startswith("/usr/lib/python3/")]
print(json.dumps({"missing": missing, "place": (system + places + sys.path[-1:])[0]}))
"""
"""Runs in the Python of the image, 3.4 or later."""
_GET_PYTHON = """
set -e
if command -v apt-get >/dev/null; then apt-get update; apt-get install --no-install-recommends --yes python3
elif command -v apk >/dev/null; then apk add --no-cache python3
elif command -v dnf >/dev/null; then dnf install --assumeyes python3
elif command -v yum >/dev/null; then yum install --assumeyes python3
else echo 'it has none of apt-get, apk, dnf and yum'; exit 1; fi
"""
YAML = "yaml"


def repository_and_tag(name: str) -> tuple[str, str]:
    """The parts of a name; the engine takes a digest (``name@sha256:...``) in place of a tag."""
    repository, at, digest = name.partition("@")
    if at:
        first, colon, tag = repository.rpartition(":")
        return (first if colon and "/" not in tag else repository), digest
    first, colon, tag = name.rpartition(":")
    return (name, "latest") if not colon or "/" in tag else (first, tag)


class DockerImages:
    """Tools of an executor of Docker images; implements :class:`slamhive.executors.base.ImageTools`.

    Args:
        client: The engine.
        installation: For the labels of helper containers.
    """

    def __init__(self, client: docker.DockerClient, installation: str) -> None:
        self._client = client
        self._installation = installation

    def find(self, name: str) -> str | None:
        """The digest of the image called ``name``; None if the engine does not have it."""
        image = get_image(self._client, name)
        return None if image is None else str(image.id)

    def pull(self, name: str, progress: ProgressCallback) -> str:
        """Get an image from its registry; its digest."""
        repository, tag = repository_and_tag(name)
        with engine_errors(f"pulling {name}", ImageMissing):
            problem = follow_pull(self._client, repository, tag, name, progress)
        if problem is not None:
            raise ImageMissing(f"pulling {name}: {problem}", "load it from an archive: --image FILE.tar")
        digest = self.find(name)
        if digest is None:
            raise ImageMissing(f"{name} was pulled, but the engine does not have it", "try again")
        return digest

    def load(self, chunks: Iterable[bytes]) -> str:
        """Take the image of an archive; its digest."""
        return load_image(self._client, chunks)

    def build(self, folder: Path, name: str, progress: ProgressCallback) -> str:
        """Build the Dockerfile of ``folder`` with that folder as its context; the digest."""
        ignored = folder / ".dockerignore"
        lines = ignored.read_text(encoding="utf-8", errors="replace").splitlines() if ignored.is_file() else []
        exclude = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
        with packed_context(folder, [*exclude, *_NOT_IN_CONTEXT, "!Dockerfile"]) as context:
            return build_packed(self._client, name, context, progress)

    def complete(
        self, digest: str, modules: Collection[str], progress: ProgressCallback, *, builds: bool = True
    ) -> CompletedImage:
        """Ensure that the image has python3 and PyYAML, or put them on top; look for ``modules`` too.

        Without ``builds``, raises ImageMissing: a build on top of an image executes what the image asks for (ONBUILD),
        with the network.
        """
        user = str(self._client.images.get(digest).attrs["Config"].get("User") or "")
        added: list[str] = []
        found = self._probe(digest, modules)
        if not builds and (found is None or YAML in found["missing"]):
            raise ImageMissing(
                f"the image has no {'python3' if found is None else 'PyYAML'}", "install it in the image"
            )
        if found is None:
            progress("the image has no python3: installing it")
            try:
                digest = self._layer(digest, user, [f"RUN {json.dumps(['/bin/sh', '-c', _GET_PYTHON])}"], progress)
            except ImageMissing as error:
                raise ImageMissing(
                    f"the image has no python3, and it cannot be installed: {error.message}", "use an image that has it"
                ) from None
            added.append("python3")
            found = self._probe(digest, modules)
            if found is None:
                raise ImageMissing("python3 was installed, but does not start", "install it in the image")
        if YAML in found["missing"]:
            progress("the image has no PyYAML: adding it")
            digest = self._layer(digest, user, [f"COPY {json.dumps([YAML, found['place'] + '/' + YAML])}"], progress)
            added.append("PyYAML")
        missing = tuple(name for name in found["missing"] if name != YAML)
        return CompletedImage(digest, user, tuple(added), missing)

    def copy_scripts(self, digest: str, target: Path) -> bool:
        """Copy the plain files of ``/slamhive`` in the image to ``target``; False if it has none."""
        with engine_errors("looking into the image", ImageMissing):
            container = self._client.containers.create(
                digest, command=["true"], network_mode="none", labels=labels_of_helper("check", self._installation)
            )
            try:
                stream = container.get_archive("/slamhive")[0]
            except docker.errors.NotFound:
                return False
            else:
                with closing_chunks(stream) as chunks:
                    _unpack(chunks, target)
                return True
            finally:
                container.remove(force=True)

    def give_name(self, digest: str, name: str) -> None:
        """Call the image ``name``."""
        name_image(self._client, digest, name)

    def remove(self, name: str) -> None:
        """Take the name from an image, and remove the image unless something else uses it."""
        with engine_errors(f"removing {name}", ImageMissing):
            try:
                self._client.api.remove_image(name)
            except docker.errors.ImageNotFound:
                return

    def _layer(self, digest: str, user: str, steps: list[str], progress: ProgressCallback) -> str:
        """Put steps of a Dockerfile on top of an image, as root; the new digest."""
        if user and not _USER.fullmatch(user):
            raise ImageMissing(f"the image names the user {user[:40]!r}", "correct its USER")
        lines = [f"FROM {digest.removeprefix('sha256:')}", "USER root", *steps, *([f"USER {user}"] if user else [])]
        with temporary_folder() as folder:
            context = BuildContext(folder, "Dockerfile", {})
            (context.path / "Dockerfile").write_text("\n".join(lines) + "\n", encoding="utf-8")
            shutil.copytree(own_yaml(), folder / YAML, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
            with packed_context(folder) as packed:
                return build_packed(self._client, "the contract's needs", packed, progress)

    def _probe(self, digest: str, modules: Collection[str]) -> dict[str, Any] | None:
        """Ask the image's python3 about modules; None if there is no python3. Runs hardened, as nobody."""
        names = sorted({YAML, *modules})
        options = {**HARDENING, "user": _NOBODY, "pids_limit": _PIDS, "environment": {"PYTHONDONTWRITEBYTECODE": "1"}}
        with engine_errors("looking for python3", ImageMissing):
            container = self._client.containers.create(
                digest,
                entrypoint=["python3", "-I", "-c", PROBE, *names],
                command=[],
                labels=labels_of_helper("check", self._installation),
                **options,
            )
            try:
                container.start()
                code = int(container.wait(timeout=PROBE_S)["StatusCode"])
                said = container.logs(stdout=True, stderr=False, tail=1).decode(errors="replace")
            except docker.errors.APIError as error:
                if "executable file not found" in str(error) or "no such file" in str(error):
                    return None
                raise
            except requests.exceptions.ConnectionError as error:
                raise ImageMissing(f"python3 of the image does not end within {PROBE_S} s") from error
            finally:
                container.remove(force=True)
        return _answer(code, said)


def _answer(code: int, said: str) -> dict[str, Any] | None:
    """Return the output of the probe. With ``init`` the engine starts, and 127 says that there is no python3."""
    if code == 127:
        return None
    try:
        answer = json.loads(said)
        return {"missing": [str(name) for name in answer["missing"]], "place": str(answer["place"])}
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ImageMissing(f"python3 of the image does not work (exit code {code})", "mend the image") from None


def own_yaml() -> Path:
    """The pure Python part of PyYAML that this installation has; it runs on Python 3.3 and later."""
    found = importlib.util.find_spec(YAML)
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent


def _unpack(chunks: Iterable[bytes], target: Path) -> None:
    """Unpack the plain files of an archive of ``slamhive/``. Raises ImageMissing for names that leave it."""
    size_bytes = 0
    with tarfile.open(fileobj=_Chunks(iter(chunks)), mode="r|") as archive:
        for member in archive:
            inside = PurePosixPath(*PurePosixPath(member.name).parts[1:])
            if not member.isreg() or not inside.parts:
                continue
            size_bytes += member.size
            if inside.is_absolute() or ".." in inside.parts or size_bytes > _MOST_SCRIPT_BYTES:
                raise ImageMissing(f"/slamhive of the image cannot be copied: {member.name[:80]!r}")
            content = archive.extractfile(member)
            assert content is not None
            place = target / inside
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("xb") as stream:
                shutil.copyfileobj(content, stream)


class _Chunks(io.RawIOBase):
    """Chunks as a file."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks = chunks
        self._rest = b""

    def read(self, size: int = -1) -> bytes:
        """At most ``size`` bytes; empty at the end."""
        while len(self._rest) < size and (chunk := next(self._chunks, None)) is not None:
            self._rest += chunk
        taken, self._rest = self._rest[:size], self._rest[size:]
        return taken
