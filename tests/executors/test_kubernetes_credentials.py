"""Keys out of a kubeconfig do not stay after a process that was killed."""

from __future__ import annotations

import base64
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import yaml

from slamhive.base.files import TEMPORARY, sweep_temporary

pytestmark = pytest.mark.integration

KEY = b"the private key"
CONNECTS = """\
import os
from slamhive.executors.kubernetes.cluster import connect
from slamhive.executors.kubernetes.options import read_options
connection = connect(read_options(""))
assert open(connection.client.configuration.key_file, "rb").read() == b"the private key"
os.kill(os.getpid(), 9)
"""


def kubeconfig(path: Path) -> None:
    """Write a kubeconfig that holds its certificates and key."""
    data = base64.b64encode(KEY).decode()
    content = {
        "clusters": [{"name": "lab", "cluster": {"server": "https://127.0.0.1:1", "certificate-authority-data": data}}],
        "users": [{"name": "me", "user": {"client-certificate-data": data, "client-key-data": data}}],
        "contexts": [{"name": "lab", "context": {"cluster": "lab", "user": "me"}}],
        "current-context": "lab",
    }
    path.write_text(yaml.safe_dump(content))


def test_keys_of_a_killed_process_are_gone_with_the_next_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kubeconfig(tmp_path / "kubeconfig")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary), "KUBECONFIG": str(tmp_path / "kubeconfig")}
    assert subprocess.run([sys.executable, "-c", CONNECTS], env=environment, check=False).returncode == -signal.SIGKILL
    (left,) = temporary.iterdir()
    assert left.name.startswith(TEMPORARY)
    assert left.stat().st_mode & 0o077 == 0
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    sweep_temporary()
    assert list(temporary.iterdir()) == []
