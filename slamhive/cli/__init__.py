"""The ``slamhive`` command."""

from __future__ import annotations

from slamhive.cli.main import main
