"""Versions of algorithm packages: kept, listed, verified, removed, and moved between machines."""

from __future__ import annotations

from slamhive.services.versions.importing import ImportedVersion, is_export
from slamhive.services.versions.keeping import check_version, identity_of_version, keep_version
from slamhive.services.versions.service import Finding, VersionReport, Versions

__all__ = [
    "Finding",
    "ImportedVersion",
    "VersionReport",
    "Versions",
    "check_version",
    "identity_of_version",
    "is_export",
    "keep_version",
]
