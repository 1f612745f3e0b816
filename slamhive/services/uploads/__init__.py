"""Files that programs send in parts, and what is imported from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.uploads.importing import UploadImports, import_dataset, import_runs
    from slamhive.services.uploads.stored import PART_BYTES, StoredUpload, Uploads

__all__ = ["PART_BYTES", "StoredUpload", "UploadImports", "Uploads", "import_dataset", "import_runs"]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
