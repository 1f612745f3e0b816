"""Computing an analysis: select runs, build their table, make the report. Loads matplotlib, pandas and scipy."""

from __future__ import annotations

from slamhive.services.reports.bundle import (
    Printing,
    figures_json,
    report_content,
    report_environment,
    report_page,
    script_json,
    write_folder,
    zipped,
)
from slamhive.services.reports.offered import OfferedColumns
from slamhive.services.reports.page import page_of
from slamhive.services.reports.preview import previews_of
from slamhive.services.reports.report import file_name
from slamhive.services.reports.run import AnalysisLimits
from slamhive.services.reports.service import Analyses
from slamhive.services.reports.tables import (
    PARQUET_REMEDY,
    WITHOUT_PARQUET,
    parquet_there,
    table_file,
)

__all__ = [
    "PARQUET_REMEDY",
    "WITHOUT_PARQUET",
    "Analyses",
    "AnalysisLimits",
    "OfferedColumns",
    "Printing",
    "figures_json",
    "file_name",
    "page_of",
    "parquet_there",
    "previews_of",
    "report_content",
    "report_environment",
    "report_page",
    "script_json",
    "table_file",
    "write_folder",
    "zipped",
]
