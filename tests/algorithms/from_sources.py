"""What the tests of systems need that are compiled from the sources of other projects."""

from __future__ import annotations

import pytest

from slamhive.base.project import project_root
from slamhive.base.settings_sources import load_settings
from slamhive.executors.registry import declared_settings

NEEDS_SOURCES = pytest.mark.skipif(
    not load_settings(project_root(), further=declared_settings).source_archives,
    reason="SOURCE_ARCHIVES is empty: it names the folder with archives of the sources of other projects",
)
"""Skips a test where the setting is empty. One that names a folder without the source lets the test fail."""
