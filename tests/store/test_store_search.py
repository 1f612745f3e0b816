"""What SQL finds is what a filter over plain values finds; hostile values find what they say and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.configuration import Configuration, Variant, VariantStep
from slamhive.domain.run import RunState
from slamhive.filters.binding import Search, read_search
from slamhive.filters.fields import vocabulary_of
from slamhive.filters.syntax import FilterError
from slamhive.store import RunSort, Store, Transaction, open_store, run_listing, searches
from slamhive.store.records import SavedSearchRecord
from tests.store import search_world as world
from tests.store.conftest import BOTH
from tests.store.search_world import BEGIN, Known, Probe
from tests.store.store_samples import SE3, SIM3, Samples, dataset

pytestmark = pytest.mark.integration

SORTS = ("id", "created_at", "ended_at", "reason", "state", "algorithm", "dataset", "experiment", "ate.rmse",
         "cpu.mean", "rpe.rmse", "nFeatures", "seed", "configuration")  # fmt: skip


class World:
    """A store that is filled, and what it is filled with."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.runs = world.fill(store)

    def ids(self, text: str, sort: RunSort | None = None) -> list[int]:
        """The ids that the store finds, in the order of the list."""
        return [run.id for run in self.store.read(lambda tx: tx.runs.page(read(text), sort, limit=1000)).records]

    def paged(self, text: str, sort: RunSort, limit: int) -> list[int]:
        """The same, page after page."""
        found: list[int] = []
        after = None
        while True:
            page = self.store.read(lambda tx, key=after: tx.runs.page(read(text), sort, key, limit))  # type: ignore[misc]
            found += [run.id for run in page.records]
            after = page.next_key
            if after is None:
                return found


def read(text: str) -> Search:
    return read_search(text, world.VOCABULARY)


@pytest.fixture(params=BOTH, scope="module")
def filled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The world, on both kinds of database."""
    if request.param == "sqlite":
        folder: Path = tmp_path_factory.mktemp("search")
        store = open_store(f"sqlite:///{folder}/search.db")
        yield World(store)
        store.close()
        return
    server = request.getfixturevalue("database_server")
    store = open_store(server.create_database("slamhive_search"))
    yield World(store)
    store.close()
    server.drop_database("slamhive_search")


@pytest.fixture(params=["few", "many"])
def plan(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways to find a page: collect and sort, or walk along the order. The world is small for both."""
    if request.param == "many":
        monkeypatch.setattr(run_listing, "COUNTED", 2)


ORDERED = st.sampled_from(["=", "!=", "<", "<=", ">", ">="])
EXACT = st.sampled_from(["=", "!="])
TEXTUAL = st.sampled_from(["=", "!=", "~", "!~"])
PATTERNS = (*world.DATASETS, *world.MATCHERS, "*", "M*", "MH?01", "*o*", "mh*", "?rb", "[*]", "%", "_", "x\\_y", "|")
TESTS = st.one_of(
    st.builds(world.compare, st.just("ate.rmse"), ORDERED, st.sampled_from([0.05, 0.1, 0.2, 1.0])),
    st.builds(world.compare, st.just("cpu.mean"), ORDERED, st.sampled_from([0.1, 1.0, 2.5])),
    st.builds(world.compare, st.just("rpe.rmse"), ORDERED, st.just(1.0)),
    st.builds(world.compare, st.just("nFeatures"), ORDERED, st.sampled_from([1000, 2000, 2500])),
    st.builds(world.compare, st.sampled_from(["seed", "id", "configuration"]), ORDERED, st.integers(0, 40)),
    st.builds(world.compare, st.just("rate"), ORDERED, st.sampled_from([0.5, 1.0])),
    st.builds(world.compare, st.just("matcher"), TEXTUAL, st.sampled_from(PATTERNS)),
    st.builds(world.compare, st.sampled_from(["dataset", "algorithm", "executor", "package"]), TEXTUAL,
              st.sampled_from((*PATTERNS, *world.ALGORITHMS, "docker", "orb-slam3"))),
    st.builds(world.compare, st.just("state"), EXACT, st.sampled_from(["failed", "succeeded"])),
    st.builds(world.compare, st.just("reason"), EXACT, st.sampled_from(["timeout", "lost"])),
    st.builds(world.disturbed_by, EXACT, st.sampled_from(["others", "steal", "io_pressure", "throttling"])),
    st.builds(world.compare, st.just("sensor"), EXACT, st.sampled_from(["stereo", "lidar", "mono"])),
    st.builds(world.compare, st.sampled_from(["deskew", "evaluated", "disturbed"]), EXACT, st.booleans()),
    st.builds(world.compare, st.just("created_at"), st.sampled_from(["<", ">=", "="]),
              st.integers(0, 60).map(lambda place: BEGIN + timedelta(hours=7 * place))),
    st.builds(world.among, st.just("dataset"), st.lists(st.sampled_from(world.DATASETS), min_size=1, max_size=3),
              negated=st.booleans()),
    st.builds(world.among, st.just("nFeatures"), st.lists(st.sampled_from([1000, 2000]), min_size=1),
              negated=st.booleans()),
    st.builds(world.presence, st.sampled_from(["ate.rmse", "cpu.mean", "rpe.rmse", "matcher", "nFeatures", "reason",
                                               "dataset", "sensor", "disturbed", "disturbed_by"]), there=st.booleans()),
)  # fmt: skip
FILTERS = st.recursive(
    TESTS,
    lambda inner: (
        st.builds(world.joined, st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3))
        | st.builds(world.negated, inner)
    ),
    max_leaves=5,
)
OF_RUNS = FILTERS.filter(lambda test: not read(test.text).metrics)
"""Filters that compare no metric. Where runs are grouped, those compare means."""
QUIETLY = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def expected(runs: list[Known], test: Probe, protocol: str | None = None) -> list[int]:
    return sorted(run.id for run in runs if test.fits(run, protocol))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("indoor", {"room", "MH_01", "mh_01"}),
        ("indoor and not dark", {"room", "mh_01"}),
        ("attribute != dark", {"room", "mh_01", "MH%01"}),
        ("difficulty = easy or light = dark", {"room", "MH%01", "MH_01"}),
        ("has light", {"MH_01"}),
        ("missing difficulty", {"MH_01", "mh_01"}),
        ("attribute ~ *r* and attribute in (dark, easy)", {"room", "MH_01"}),
        ("gone", set()),
        ("place != indoor", set()),
    ],
)
def test_attributes_of_datasets_select_runs(filled: World, text: str, expected: set[str]) -> None:
    assert filled.ids(text) == [run.id for run in reversed(filled.runs) if run.columns["dataset"] in expected]


@QUIETLY
@given(test=FILTERS)
def test_sql_finds_what_a_plain_filter_finds(filled: World, plan: None, test: Probe):
    wanted = expected(filled.runs, test)
    assert sorted(filled.ids(test.text)) == wanted
    search = read(test.text)
    assert filled.store.read(lambda tx: tx.searches.exact_count(search)) == len(wanted)
    assert filled.store.read(lambda tx: tx.searches.run_ids(search)) == wanted
    count = filled.store.read(lambda tx: tx.searches.count(search))
    assert count.number == len(wanted) if count.exact else len(wanted) > count.number


def test_many_comparisons_find_what_the_narrowest_of_them_finds(filled: World, plan: None):
    parts = [f"ate.rmse < {0.2 + place} and nFeatures > {-place} and seed >= 0" for place in range(60)]
    found = filled.ids("ate.rmse < 0.2 and has nFeatures")
    assert 2 < len(found) < len(filled.runs)
    assert filled.ids(" and ".join(parts)) == found
    assert filled.ids(" or ".join(f"({part})" for part in parts[:1] * 50)) == found


@QUIETLY
@given(test=FILTERS, fingerprint=st.sampled_from([SE3.fingerprint, SIM3.fingerprint]))
def test_a_chosen_protocol_is_the_one_that_counts(filled: World, plan: None, test: Probe, fingerprint: str):
    text = f"protocol = {fingerprint} and ({test.text})"
    assert sorted(filled.ids(text)) == expected(filled.runs, test, fingerprint)


@QUIETLY
@given(test=FILTERS, key=st.sampled_from(SORTS), descending=st.booleans(), limit=st.integers(1, 30))
def test_pages_in_any_order_add_up(filled: World, plan: None, test: Probe, key: str, descending: bool, limit: int):
    sort = RunSort(key, descending=descending)
    found = filled.paged(test.text, sort, limit)
    assert sorted(found) == expected(filled.runs, test)
    by_id = {run.id: run for run in filled.runs}
    values = [by_id[run_id].value(key, None) for run_id in found if key not in {"ended_at", "experiment"}]
    there = [value for value in values if value is not None]
    assert values[: len(there)] == there
    assert there == sorted(there, reverse=descending)


@QUIETLY
@given(test=OF_RUNS, key=st.sampled_from((*searches.SORT_KEYS, "ate.rmse", "cpu.mean")), limit=st.integers(1, 9))
def test_groups_hold_every_run_once(filled: World, plan: None, test: Probe, key: str, limit: int):
    search, groups, after = read(test.text), [], None
    while True:
        page = filled.store.read(
            lambda tx, at=after: tx.searches.groups(search, RunSort(key), at, limit, ["ate.rmse", "cpu.mean"])  # type: ignore[misc]
        )
        groups += page.records
        after = page.next_key
        if after is None:
            break
    found = [run for run in filled.runs if test.fits(run, None)]
    assert sorted(group.configuration_id for group in groups) == sorted({run.columns["configuration"] for run in found})
    assert sum(group.runs for group in groups) == len(found)
    assert sum(group.failed for group in groups) == sum(run.columns["state"] == "failed" for run in found)
    assert sum(group.disturbed for group in groups) == sum(bool(run.columns["disturbed"]) for run in found)
    for group in groups:
        own = [run for run in found if run.columns["configuration"] == group.configuration_id]
        for label, figures in group.figures.items():
            for metric, spread in figures.items():
                key_of = None if label is None else label.fingerprint
                values = [
                    run.figures[key_of][metric]
                    for run in own
                    if run.columns["state"] != "failed"
                    and (label is None or run.current == key_of)
                    and metric in run.figures.get(key_of, {})
                ]
                assert spread.n == len(values)
                assert spread.mean == pytest.approx(sum(values) / len(values))
                assert (spread.minimum, spread.maximum) == (min(values), max(values))


def mean_of(runs: list[Known], metric: str) -> list[float]:
    """The mean of a metric over the runs that did not fail: one for each protocol that the runs are judged by."""
    values: dict[str | None, list[float]] = {}
    for run in runs:
        for protocol in {None, run.current}:
            if run.columns["state"] != "failed" and metric in run.figures.get(protocol, {}):
                values.setdefault(protocol, []).append(run.figures[protocol][metric])
    return [sum(found) / len(found) for found in values.values()]


@QUIETLY
@given(
    test=OF_RUNS,
    metric=st.sampled_from(["ate.rmse", "cpu.mean"]),
    sign=st.sampled_from(["<", ">="]),
    value=st.floats(0.0, 3.0).map(lambda value: round(value, 3)),
    key=st.sampled_from((*searches.SORT_KEYS, "ate.rmse")),
)
def test_conditions_on_metrics_choose_configurations_by_their_mean(
    filled: World, plan: None, test: Probe, metric: str, sign: str, value: float, key: str
):
    search = read(f"{metric} {sign} {value} and ({test.text})")
    page = filled.store.read(lambda tx: tx.searches.groups(search, RunSort(key), None, 1000, ["ate.rmse"]))
    by_configuration: dict[int, list[Known]] = {}
    for run in filled.runs:
        by_configuration.setdefault(run.columns["configuration"], []).append(run)
    fits = (lambda mean: mean < value) if sign == "<" else (lambda mean: mean >= value)
    wanted = {
        number: own
        for number, runs in by_configuration.items()
        if (own := [run for run in runs if test.fits(run, None)]) and any(map(fits, mean_of(own, metric)))
    }
    assert {group.configuration_id for group in page.records} == set(wanted)
    for group in page.records:
        assert group.runs == len(wanted[group.configuration_id])  # and no run is missing from the mean
        assert group.all_runs == len(by_configuration[group.configuration_id])
    assert page.runs.number == sum(map(len, wanted.values())) or not page.runs.exact


def test_a_mean_cannot_be_joined_with_a_single_run_by_or(filled: World) -> None:
    search = read("ate.rmse < 1 or state = failed")
    with pytest.raises(InvalidInput, match="compare the mean of a metric, which 'or' and 'not' cannot join with state"):
        filled.store.read(lambda tx: tx.searches.groups(search, RunSort("configuration"), None, 10, []))


def test_wildcards_of_sql_and_quotes_mean_themselves(filled: World):
    by_matcher = {text: expected(filled.runs, world.compare("matcher", "=", text)) for text in world.MATCHERS}
    assert sum(map(len, by_matcher.values())) > 20
    for text, ids in by_matcher.items():
        quoted = '"' + text.replace('"', '""') + '"'
        assert sorted(filled.ids(f"matcher = {quoted}")) == ids
    assert sorted(filled.ids("matcher ~ 50%")) == by_matcher["50%"]
    assert sorted(filled.ids("matcher ~ x_y")) == by_matcher["x_y"]
    assert filled.ids("dataset ~ mh_01") != filled.ids("dataset ~ MH_01")


@pytest.mark.parametrize(
    "text",
    [
        'dataset = "\' OR 1=1 --"',
        'matcher = "x\'); DELETE FROM runs; --"',
        'algorithm = "<script>alert(1)</script>"',
        'dataset = "\u202e\U0001f600"',
        "dataset = NaN",
        "id = 99999999999999999999",
        "seed > 1e300",
        "id < -9223372036854775808",
    ],
)
def test_hostile_values_find_nothing_and_harm_nothing(filled: World, text: str):
    assert filled.ids(text) == []
    assert len(filled.ids("")) == len(filled.runs)


def test_a_pattern_of_many_stars_is_refused(filled: World):
    with pytest.raises(InvalidInput, match="at most 4 stars"):
        filled.ids("matcher ~ *a*a*a*a*a*")


def test_what_was_left_out_is_counted(filled: World):
    having = filled.store.read(lambda tx: tx.searches.with_metrics(read("ate.rmse < 1 and has rpe.rmse")))
    assert having == {"ate.rmse": sum(run.current is not None for run in filled.runs), "rpe.rmse": 0}
    assert filled.store.read(lambda tx: tx.searches.total()) == len(filled.runs)


def test_searches_are_saved_replaced_listed_and_deleted(filled: World):
    sort = RunSort("ate.rmse", descending=False)
    record = SavedSearchRecord("best", "ate.rmse < 0.1", ("id", "ate.rmse"), sort, False, 3, colours=True, sparks=True)
    other = SavedSearchRecord("best", "", ("id",), RunSort(), grouped=True)
    store = filled.store
    assert store.write(lambda tx: tx.searches.save(record, BEGIN))
    assert store.read(lambda tx: tx.searches.saved()) == [record]
    assert not store.write(lambda tx: tx.searches.save(other, BEGIN))
    assert store.read(lambda tx: tx.searches.saved_named("best")) == other
    with pytest.raises(NotFound, match="unknown saved search 'bst'; did you mean 'best'"):
        store.write(lambda tx: tx.searches.delete_saved("bst"))
    store.write(lambda tx: tx.searches.delete_saved("best"))
    assert store.read(lambda tx: tx.searches.saved()) == []


def test_state_of_everything(filled: World):
    assert {run.columns["state"] for run in filled.runs} >= {RunState.SUCCEEDED.value, RunState.FAILED.value}


def test_options_of_variants_are_searched_and_sorted_by(store: Store, samples: Samples):
    left = VariantStep("resolution", ("left",), {"scale": 0.5})
    right = VariantStep("resolution", ("right",), {"scale": 1.0})
    rates = [VariantStep("rate", ("left", "right"), {"keep": keep, "way": "even"}) for keep in (3, 2)]
    variants = [(left, right), (rates[0],), (rates[1], left)]

    def add(tx: Transaction, variant: Variant) -> int:
        algorithm_id = tx.catalogue.put_algorithm_named("a", "a", "a")
        dataset_id = tx.catalogue.put_dataset(dataset(), BEGIN)
        content = Configuration("a", "room", {}, variant=variant)
        return tx.configurations.get_or_create(content, algorithm_id, dataset_id, BEGIN)[0]

    stored = [store.write(lambda tx, chosen=variant: add(tx, chosen)) for variant in variants]  # type: ignore[misc]
    ids = [samples.queued(configuration_id=number)[0] for number in stored]
    plain = samples.queued()[0]
    names = store.read(lambda tx: vocabulary_of(tx.searches.parameters()))

    def found(text: str, sort: str = "id") -> list[int]:
        search = read_search(text, names)
        return [run.id for run in store.read(lambda tx: tx.runs.page(search, RunSort(sort, descending=False))).records]

    assert found("variant.rate.keep >= 2", "variant.rate.keep") == [ids[2], ids[1]]
    assert found("variant.rate.way = even and variant.rate.keep@left = 3") == [ids[1]]
    assert found("variant.resolution.scale = 0.5") == [ids[2]]  # the first has two scales, so none of its own
    assert found("variant.resolution.scale@left = 0.5") == [ids[0], ids[2]]
    assert found("variant = true") == ids
    assert found("variant = false") == [plain]
    with pytest.raises(FilterError, match=r"did you mean 'variant\.rate\.keep'"):
        found("variant.rate.kep = 1")
    without_runs = store.write(lambda tx: add(tx, (left,)))
    store.write(lambda tx: tx.configuration_book.delete(without_runs))
