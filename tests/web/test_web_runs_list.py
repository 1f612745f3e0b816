"""The runs page: filter, sort, columns and paging, all in the address."""

from __future__ import annotations

import re
import time

import pytest
from werkzeug.datastructures import MultiDict

from slamhive.base.errors import SlamHiveError
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import RunState
from slamhive.filters.fields import Vocabulary
from slamhive.services.searches import LeftOut
from slamhive.store.records import Count
from slamhive.web.columns import all_columns
from slamhive.web.queries import RunListQuery, summary
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick


def listed(text: str) -> list[int]:
    return [int(number) for number in re.findall(r"<td class=\"number\"><a href=\"/runs/(\d+)\">", text)]


def test_words_say_what_is_shown_and_what_is_left_out(shown: Web):
    assert "Showing 5 of 5 runs: newest first." in shown.client.get("/runs").text
    text = shown.client.get("/runs?state=succeeded&sort=ate.rmse&order=desc").text
    assert "Showing 2 of 2 runs: state succeeded, sorted by ATE RMSE, largest first." in text
    assert "Left out: 3 runs that the filter does not match." in text


def test_sorting_by_a_metric_puts_runs_without_it_last(shown: Web):
    text = shown.client.get("/runs?sort=ate.rmse&order=asc&columns=id,ate.rmse").text
    assert listed(text)[0] == shown.runs["done"]
    assert 'aria-sort="ascending"' in text


def test_thousands_have_separators():
    query = RunListQuery.from_args(MultiDict(), Vocabulary())
    assert summary(query, 50, Count(1234), LeftOut(1234, {})) == "Showing 50 of 1,234 runs: newest first."


def test_what_was_not_counted_to_the_end_is_said():
    query = RunListQuery.from_args(MultiDict({"where": "ate.rmse < 1"}), Vocabulary())
    assert summary(query, 50, Count(10_000, exact=False), LeftOut(100_000, {"ate.rmse": 1})) == (
        "Showing 50 of more than 10,000 runs: ATE RMSE below 1 m, newest first. Left out: at most 90,000 runs that the "
        "filter does not match. 1 run has no ATE RMSE."
    )


@pytest.mark.parametrize("key", sorted({column.sort for column in all_columns().values() if column.sort}))
def test_every_column_with_an_order_sorts(shown: Web, key: str):
    orders = [
        [run["id"] for run in shown.client.get(f"/api/v1/runs?sort={key}&order={order}").get_json()["runs"]]
        for order in ("asc", "desc")
    ]
    assert [sorted(order) for order in orders] == [sorted(shown.runs.values())] * 2


@pytest.mark.integration
def test_every_metric_is_a_column_with_its_unit(shown: Web):
    text = shown.client.get("/runs?columns=" + ",".join(CATALOGUE)).text
    for metric in CATALOGUE.values():
        assert metric.label in text
    assert '<span class="unit">[MB]</span>' in text


def test_paging_by_key_visits_every_run_once(shown: Web):
    address, seen = "/runs?limit=2", []
    while address:
        text = shown.client.get(address).text
        seen += listed(text)
        following = re.search(r"rel=\"next\" href=\"([^\"]+)\"", text)
        address = following[1].replace("&amp;", "&") if following else ""
    assert seen == sorted(shown.runs.values(), reverse=True)


def test_the_address_holds_everything():
    address = {
        "state": "failed,succeeded",
        "algorithm": "a",
        "evaluated": "no",
        "from": "2026-01-01",
        "to": "2026-01-31",
        "sort": "ate.rmse",
        "order": "desc",
        "columns": "id,state",
        "limit": "7",
        "configuration": "3",
        "where": "cpu.mean < 2 or state = failed",
        "min.ate.rmse": "0.1",
        "max.ate.rmse": "10 cm",
        "pinned": "2",
        "colours": "yes",
        "sparks": "yes",
    }
    query = RunListQuery.from_args(MultiDict(address), Vocabulary())
    assert RunListQuery.from_args(MultiDict(query.args()), Vocabulary()) == query
    assert query.search.text == (
        "(cpu.mean < 2 or state = failed) and state in (failed, succeeded) and algorithm in (a) and configuration = 3 "
        "and created_at >= 2026-01-01 and created_at <= 2026-01-31 and evaluated = no "
        "and ate.rmse >= 0.1 and ate.rmse <= 10 cm"
    )
    assert RunListQuery.from_args(MultiDict(query.as_text().args()), Vocabulary()).search == query.search


@pytest.mark.parametrize(
    "arguments",
    ["state=dead", "reason=x", "sort=beauty", "order=up", "columns=x", "limit=0", "limit=9999", "limit=%C2%B2",
     "after=zzz", "from=today", "to=9999-12-31", "evaluated=maybe", "configuration=x", "min.ate.rmse=nan",
     "where=ate.rms+<+1", "group=dataset", "group=configuration&sort=reason",
     "pinned=-1", "pinned=99", "colours=blue", "sparks=1"],
)  # fmt: skip
def test_an_address_that_cannot_be_read_is_refused_in_words(shown: Web, arguments: str):
    answer = shown.client.get(f"/runs?{arguments}", headers={"Accept": "application/json"})
    assert answer.status_code in {400, 404}
    assert len(answer.get_json()["error"]["message"]) > 10


def test_a_filter_that_matches_nothing_offers_all(shown: Web):
    assert "No run matches this filter." in shown.client.get("/runs?dataset=nowhere").text


@pytest.mark.integration
def test_a_full_page_takes_50_ms_of_the_processor(web: Web):
    for run_id in world.add_runs(web.hive, 50):
        world.advance(web.hive, run_id, RunState.PREPARING)
    times_s = []
    for _ in range(8):
        began = time.process_time()
        assert len(listed(web.client.get("/runs").text)) == 50
        times_s.append(time.process_time() - began)
    assert min(times_s) < 0.05


def test_unknown_sort_names_the_near_one(shown: Web):
    with pytest.raises(SlamHiveError, match=r"ate\.rmse"):
        RunListQuery.from_args(MultiDict({"columns": "ate.rms"}), Vocabulary())
