"""The filter language: what is understood, what it means, what is refused and where."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.run import RunState
from slamhive.filters.binding import Condition, matches, read_search
from slamhive.filters.fields import BUILT_IN, FieldKind, ParameterKind, vocabulary_of
from slamhive.filters.parser import MAX_TERMS, parse_filter
from slamhive.filters.syntax import FilterError, Sign
from slamhive.filters.words import in_words, matching

VOCABULARY = vocabulary_of(
    [
        ParameterKind("nFeatures", FieldKind.NUMBER, "features"),
        ParameterKind("deskew", FieldKind.FLAG),
        ParameterKind("matcher", FieldKind.CHOICE, choices=("orb", "sift")),
        ParameterKind("mixed", FieldKind.NUMBER),
        ParameterKind("mixed", FieldKind.TEXT),
        ParameterKind("seed", FieldKind.TEXT),
        ParameterKind("<b>x", FieldKind.TEXT),
    ],
    sensors={"stereo": ("orb-slam3-stereo",)},
    protocols={"0123456789ab": "SE(3), association 0.01 s"},
)


def read(text: str):
    return read_search(text, VOCABULARY)


def only(text: str) -> Condition:
    tree = read(text).tree
    assert isinstance(tree, Condition)
    return tree


@pytest.mark.parametrize(
    ("text", "canonical", "words"),
    [
        ("nFeatures => 2000", "nFeatures >= 2000", "nFeatures at least 2000 features"),
        ("ate.rmse<0.1", "ate.rmse < 0.1", "ATE RMSE below 0.1 m"),
        ("ate.rmse < 10 cm", "ate.rmse < 10 cm", "ATE RMSE below 0.1 m"),
        ("latency.p95 < 50ms", "latency.p95 < 50ms", "latency 95 % below 0.05 s"),
        ("ram.max =< 1 GB", "ram.max <= 1 GB", "RAM max at most 1 GB"),
        ("tracked_fraction > 75%", "tracked_fraction > 75%", "tracked fraction above 0.75"),
        ("dataset ~ MH_0*", "dataset ~ MH_0*", "dataset like MH_0*"),
        (
            "state == failed AND reason=timeout",
            "state = failed and reason = timeout",
            "state failed and reason timeout",
        ),
        ("reason ~ no*", "reason ~ no*", "reason one of nonzero exit, no trajectory"),
        ("sensor = stereo", "sensor = stereo", "sensors stereo"),
        ("dataset in (a, 'b c')", 'dataset in (a, "b c")', "dataset one of a, b c"),
        ("dataset not in [a]", "dataset not in (a)", "dataset none of a"),
        ("ate.rmse between 0.1 and 0.2", "ate.rmse between 0.1 and 0.2", "ATE RMSE from 0.1 m to 0.2 m"),
        (
            "has ate.rmse or missing nFeatures",
            "has ate.rmse or missing nFeatures",
            "with ATE RMSE or without nFeatures",
        ),
        ("not (state=failed or seed>1)", "not (state = failed or seed > 1)", "not (state failed or seed above 1)"),
        ("(state=failed or seed>1) and id<9", "(state = failed or seed > 1) and id < 9", None),
        ("((id<9))", "id < 9", "run below 9"),
        ("created_at > 2026-01-01", "created_at > 2026-01-01", "created since 2026-01-02"),
        ("created_at = 2026-01-01", "created_at = 2026-01-01", "created on 2026-01-01"),
        ("deskew = yes", "deskew = yes", "deskew true"),
        ("evaluated = no", "evaluated = no", "not evaluated"),
        ("disturbed = yes", "disturbed = yes", "disturbed"),
        ("disturbed_by = cpu_pressure", "disturbed_by = cpu_pressure", "disturbed by cpu pressure"),
        ("disturbed_by ~ *pressure", "disturbed_by ~ *pressure", None),
        ("matcher != orb", "matcher != orb", "matcher not orb"),
        ("parameter.seed = a", "parameter.seed = a", "seed a"),
        ("mixed > 3 and mixed = fast", "mixed > 3 and mixed = fast", "mixed above 3 and mixed fast"),
        ('dataset = "and"', 'dataset = "and"', "dataset and"),
        ('dataset = "say ""x"""', 'dataset = "say ""x"""', 'dataset say "x"'),
        ("dataset = Größe", "dataset = Größe", "dataset Größe"),
        ("", "", ""),
        (" \n ", "", ""),
    ],
)
def test_what_is_typed_has_one_spelling_and_words(text, canonical, words):
    found = read(text)
    assert found.text == canonical
    assert parse_filter(canonical) == parse_filter(text)
    if words is not None:
        assert in_words(found) == words


@pytest.mark.parametrize(
    ("text", "message", "place"),
    [
        ("nFeatres > 3", "unknown name 'nFeatres' (at character 1); did you mean 'nFeatures'?", "nFeatres"),
        ("id > 1 and ate.rms < 1", "did you mean 'ate.rmse'?", "ate.rms"),
        ("nFeatures ~ abc", "nFeatures is a number, ~ does not compare it", "nFeatures ~ abc"),
        ("nFeatures = abc", "nFeatures is a number, 'abc' is none", "abc"),
        ("ate.rmse < nan", "'nan' is none", "nan"),
        ("ate.rmse < inf", "'inf' is none", "inf"),
        ("ate.rmse < 1e999", "'1e999' is none", "1e999"),
        ("ate.rmse < 1 GB", "ate.rmse is a number, '1 GB' is none", "1 GB"),
        ("ate.rmse < ٣", "'٣' is none", "٣"),
        ("dataset < a", "dataset is a text, < does not compare it", "dataset < a"),
        ("state = faild", "state is never 'faild' (at character 9); did you mean 'failed'?", "faild"),
        ("sensor = sterio", "did you mean 'stereo'?", "sterio"),
        ("matcher = surf", "matcher is never 'surf'", "surf"),
        ("deskew = maybe", "deskew is a yes or no, 'maybe' is none", "maybe"),
        ("created_at > today", "created_at is a time, 'today' is none", "today"),
        ("created_at > 2026-02-30", "'2026-02-30' is none", "2026-02-30"),
        ("created_at > 9999-12-31", "'9999-12-31' is none", "9999-12-31"),
        ("ate.rmse <> 3", "has '>' where a value belongs", ">"),
        ("ate.rmse < 3 m m", "has 'm' where 'and', 'or' or the end belongs", "m"),
        ("ate.rmse like 3", "has 'like' where one of = != < <= > >= ~ !~ in between belongs", "like"),
        ("(ate.rmse < 3", "has its end where ')' belongs", ""),
        ("ate.rmse <", "has its end where a value belongs", ""),
        ("a ; drop table runs", "has ';' where one of", ";"),
        ("dataset = 'x", 'is not understood at "\'x"', "'"),
        ("dataset in ()", "has ')' where a value belongs", ")"),
        ("ate.rmse between 1 or 2", "has 'or' where 'and' belongs", "or"),
        ("seed = 1 and ate.rmse between 3 and 1 cm", "nothing lies between 3 and 1 cm", "ate.rmse between 3 and 1 cm"),
        (
            "created_at between 2026-02-01 and 2026-01-31",
            "nothing lies between",
            "created_at between 2026-02-01 and 2026-01-31",
        ),
        ("dataset = " + "x" * 191, "cannot be compared with this text", "x" * 191),
        ("protocol = 0", "no metric has been computed under protocol '0'", "0"),
        ("protocol > 0123456789ab", "a protocol is chosen with =", "protocol > 0123456789ab"),
        ("state=failed or protocol=0123456789ab", "protocol is chosen for the whole", "protocol=0123456789ab"),
        ("<script> = 1", "has '<' where a name belongs", "<"),
    ],
)
def test_what_is_not_understood_is_pointed_at(text, message, place):
    with pytest.raises(FilterError) as caught:
        read(text)
    error = caught.value
    assert message in str(error)
    assert "\n" not in str(error)
    assert text[error.place.start : error.place.end] == place
    line, carets = error.pointer
    assert line[carets.index("^") :].startswith(place[: len(line) - carets.index("^")])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x" * 1_000_000, "has 1000000 characters, at most"),
        ("(" * 10_000 + "id > 1" + ")" * 10_000, "nested deeper than 50 levels"),
        ("not " * 3_000 + "id > 1", "nested deeper than 50 levels"),
        (" and ".join(["id > 1"] * (MAX_TERMS + 1)), "at most 200 are allowed"),
        ("id in (" + ",".join("1" * 600) + ")", "more than 500 values"),
    ],
)
def test_limits(text, message):
    with pytest.raises(InvalidInput) as caught:
        read(text)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 300


def test_protocol_is_taken_out_of_the_outermost_and():
    found = read("protocol = 0123456789ab and ate.rmse < 1")
    assert found.protocol == "0123456789ab"
    assert only("ate.rmse < 1") == found.tree
    assert read('protocol = "SE(3), association 0.01 s"').protocol == "0123456789ab"
    assert in_words(found) == "ATE RMSE below 1 m, metrics under protocol 0123456789ab"


def test_days_are_spans():
    start, end = datetime(2026, 1, 31, tzinfo=UTC), datetime(2026, 2, 1, tzinfo=UTC)
    assert only("created_at < 2026-01-31").values == (start,)
    assert only("created_at <= 2026-01-31").values == (end,)
    assert only("created_at <= 2026-01-31").sign is Sign.LESS
    assert only("created_at > 2026-01-31").values == (end,)
    assert only("created_at = 2026-01-31").values == (start, end)
    assert only("created_at >= 2026-01-31T01:00+01:00").values == (start,)


def test_metrics_of_a_search_are_told_once():
    assert [field.name for field in read("ate.rmse < 1 or ate.rmse > 2 and has cpu.mean").metrics] == [
        "ate.rmse",
        "cpu.mean",
    ]


def test_patterns():
    assert matches("MH_01", "MH_0*")
    assert matches("a[b]c", "a[b]?")
    assert not matches("mh_01", "MH_*")
    assert not matches("MHx01", "MH_01")


def test_searches_made_in_code():
    made = matching(states=[RunState.FAILED], algorithms=("a", "b"), datasets=(), evaluated=True, configuration_id=3)
    assert in_words(made) == "state failed and algorithm one of a, b and configuration 3 and evaluated"
    assert matching().tree is None


def test_every_built_in_name_is_explained_by_its_label():
    assert all(field.label and field.name == name for name, field in BUILT_IN.items())
