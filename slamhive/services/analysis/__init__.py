"""Computing an analysis: select runs, build their table, make the report. Loads matplotlib, pandas and scipy."""

from __future__ import annotations

from slamhive.services.analysis.bundle import (
    PARQUET_REMEDY,
    WITHOUT_PARQUET,
    Printing,
    figures_json,
    page_of,
    parquet_there,
    report_content,
    report_environment,
    report_page,
    script_json,
    table_file,
    write_folder,
    zipped,
)
from slamhive.services.analysis.run import AnalysisLimits, AnalysisService, OfferedColumns, file_name, previews_of
