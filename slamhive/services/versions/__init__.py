"""Versions of algorithm packages: kept, listed, verified, removed, and moved between machines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.versions.importing import ImportedVersion, PackedVersion, is_export, opened_version
    from slamhive.services.versions.keeping import check_version, identity_of_version, keep_version
    from slamhive.services.versions.service import Finding, VersionReport, Versions

__all__ = [
    "Finding",
    "ImportedVersion",
    "PackedVersion",
    "VersionReport",
    "Versions",
    "check_version",
    "identity_of_version",
    "is_export",
    "keep_version",
    "opened_version",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
