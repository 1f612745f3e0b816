"""The stored page of an analysis for templates. Apart from `reports`, which takes 150 MB to load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.analysis.result_json import from_json


def page_forms(page: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The plots for templates, from :func:`slamhive.services.reports.page.page_json`."""
    forms = []
    for form in page["forms"]:
        tables = []
        for entry in form["tables"]:
            table = from_json(entry["table"])
            tables.append({"numeric": [], **entry, "table": table, "rows": table.rows})
        forms.append({"raw": [], **form, "charts": [from_json(chart) for chart in form["charts"]], "tables": tables})
    return forms
