"""A plug-in of version 0.1, where plot types were called forms, works as it is."""

from __future__ import annotations

import pytest

from slamhive.analysis.chart import Axis, Chart
from slamhive.analysis.forms import FORMS, Form, FormData, FormOptions
from slamhive.analysis.forms.base import caption, raw_table, result_of, with_values
from slamhive.analysis.result import FormResult, PlotResult
from slamhive.schema.model import dump, load
from tests.analysis.analysis_world import data_of, sweep_table

pytestmark = pytest.mark.integration


def test_plug_ins_of_version_0_1_find_the_names_they_import():
    class OldOptions(FormOptions):
        metric: str = "ate.rmse"

    class Old(Form[OldOptions]):
        key = "old"
        title = "Old"
        description = "As a plug-in of version 0.1 was written."
        options = OldOptions

        def needs(self, options: OldOptions) -> frozenset[str]:
            return frozenset({options.metric})

        def build(self, data: FormData, options: OldOptions) -> FormResult:
            table = data.table
            chart = Chart("old", "Old", Axis("x"), Axis("y"), (), caption(table, len(table.frame), None))
            with_values(table, [options.metric])
            return result_of(table, None, [chart], [raw_table("old_raw", table, [options.metric])])

    assert "scatter" in FORMS.names()
    result = Old().build(data_of(sweep_table()), OldOptions())
    assert result.runs == len(sweep_table().frame)
    assert load(PlotResult, dump(PlotResult, result)).tables == result.tables
