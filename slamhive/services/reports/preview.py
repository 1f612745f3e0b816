"""Small pictures of the plots of a report, for the page on which an analysis is written."""

from __future__ import annotations

import base64
from typing import Any

from slamhive.analysis.chart import THUMBNAIL
from slamhive.analysis.print_chart import print_chart
from slamhive.analysis.report import Plot, Report
from slamhive.domain.numbers import plural


def previews_of(report: Report) -> list[dict[str, Any]]:
    """For each plot, its first picture as PNG in base64, or what there is in place of one."""
    return [_preview(plot) for plot in report.forms]


def _preview(plot: Plot) -> dict[str, Any]:
    image, note = None, plot.error or ""
    if plot.result is not None and plot.result.charts:
        image = base64.b64encode(print_chart(plot.result.charts[0], THUMBNAIL)).decode()
        more = len(plot.result.charts) - 1
        note = f"and {plural(more, 'more plot')}" if more else ""
    elif plot.result is not None:
        tables = [table for table in plot.result.tables if not table.raw]
        note = ", ".join(f"{table.title}: {plural(len(table.rows), 'row')}" for table in tables) or "a table"
    return {"form": plot.form, "title": plot.title, "image": image, "note": note}
