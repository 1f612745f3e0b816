"""Environments of test algorithms are made once and shared: each takes five seconds of CPU time."""

from __future__ import annotations

import os
from pathlib import Path

SHARED_ENVIRONMENTS = "TESTS_SHARE_ENVIRONMENTS_IN"
"""The variable that names the folder. All processes of one test session have the same."""


def share_environments(data: Path) -> None:
    """Let a data root use the environments that other tests have made. Does nothing outside pytest."""
    shared, own = os.environ.get(SHARED_ENVIRONMENTS), data / "environments"
    if shared and data.is_dir() and not own.exists():
        own.symlink_to(shared)
