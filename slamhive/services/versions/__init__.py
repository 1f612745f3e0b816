"""Versions of algorithm packages: kept, listed, verified, removed, and moved between machines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.versions.exchange import (
        ImportedVersion,
        PackedVersion,
        check_version,
        identity_of_version,
        is_export,
        keep_version,
        opened_version,
    )
    from slamhive.services.versions.service import VersionFinding, VersionReport, Versions


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
