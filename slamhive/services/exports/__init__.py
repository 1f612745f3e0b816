"""Tables of runs and groups as CSV, JSON and Parquet files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.exports.groups import GroupExport, by_protocol
    from slamhive.services.exports.runs import RunExport, disturbed_text, trust_text
    from slamhive.services.exports.table import Format, Page, Record, TableExport, safe_cell

__all__ = [
    "Format",
    "GroupExport",
    "Page",
    "Record",
    "RunExport",
    "TableExport",
    "by_protocol",
    "disturbed_text",
    "safe_cell",
    "trust_text",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
