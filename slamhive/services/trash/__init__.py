"""Deletes runs into a trash, and takes them out of it again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.trash.folder import DeletedFolder, deleted_runs
    from slamhive.services.trash.service import Trash

__all__ = ["DeletedFolder", "Trash", "deleted_runs"]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
