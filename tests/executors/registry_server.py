"""A registry of images on this machine: Debian's docker-registry."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import requests

from tests.waiting import eventually

CONFIGURATION = """
version: 0.1
log: {{level: error}}
storage: {{filesystem: {{rootdirectory: {storage}}}}}
http: {{addr: "{address}"}}
"""


@contextmanager
def running_registry(folder: Path) -> Iterator[str]:
    """A registry that keeps its files in ``folder``; its address. Skips the test where the program is missing."""
    program = shutil.which("docker-registry")
    if program is None:
        pytest.skip("docker-registry is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    settings = folder / "registry.yml"
    settings.write_text(CONFIGURATION.format(storage=folder / "images", address=address))
    quiet = subprocess.DEVNULL
    with subprocess.Popen([program, "serve", str(settings)], stdout=quiet, stderr=quiet) as server:
        try:
            eventually(lambda: _answers(address))
            yield address
        finally:
            server.terminate()


def _answers(address: str) -> bool:
    try:
        return requests.get(f"http://{address}/v2/", timeout=1).ok
    except requests.ConnectionError:
        return False
