"""Any filter, and any text that is none."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamhive.base.errors import InvalidInput
from slamhive.filters.parser import parse_filter
from slamhive.filters.syntax import (
    FilterComparison,
    Junction,
    Sign,
    Word,
    experiment_filter,
    filter_text,
    join,
    leaves,
)

pytestmark = pytest.mark.integration  # hypothesis takes long to load

WORDS = st.text(min_size=1, max_size=12) | st.sampled_from(["ate.rmse", "1 GB", "and", "has", "missing", "in", "x y"])


def comparison(name: str, sign: Sign, values: list[str]) -> FilterComparison:
    count = {Sign.BETWEEN: 2, Sign.HAS: 0, Sign.MISSING: 0}.get(sign, len(values) if "in" in sign else 1)
    return FilterComparison(Word(name), sign, tuple(map(Word, values[:count])))


LEAVES = st.builds(comparison, WORDS, st.sampled_from(Sign), st.lists(WORDS, min_size=2, max_size=4))
TREES = st.recursive(
    LEAVES,
    lambda inner: (
        st.builds(join, st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3))
        | st.builds(lambda part: Junction("not", (part,)), inner)
    ),
    max_leaves=8,
)


@settings(deadline=None)
@given(TREES)
def test_every_filter_can_be_written_and_read_again(tree):
    assert parse_filter(filter_text(tree)) == tree


@settings(deadline=None)
@given(st.text("abnotrdi<>=!~()[]'\", .-15\n#%*", max_size=40))
def test_any_text_is_a_filter_or_refused(text):
    with suppress(InvalidInput):
        tree = parse_filter(text)
        assert tree is None or list(leaves(tree))
        assert parse_filter(filter_text(tree)) == tree


@pytest.mark.parametrize("name", ["room", "not", "and", "1e5"])
def test_an_experiment_may_be_called_like_a_word_of_the_language(name: str):
    assert parse_filter(experiment_filter(name)) == comparison("experiment", Sign.EQUAL, [name])
