"""Plots in the text of an analysis are added, replaced, moved and removed; the rest of the text stays."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.web.analysis_editor import entries, find_entry, moved_entry, replaced_entry, with_entry, without_entry

TEXT = """name: x  # why
select: {runs: {experiment: trial}}
forms:
  # what a reader sees first
  - form: table
    note: |
      # not a comment
      but text

  - {form: line, x: nFeatures}
  -
    form: pareto
    metrics: [cpu.mean, ate.rmse]
    log: true
# after the plots
failed_when: {tracked_path_below: 0.9}
"""
UNLISTED = (
    "",
    "name: x\n",
    "forms: [{form: table}]\n",
    "forms:\n",
    "forms: table\n",
    "a: b: c\n",
    "x: \u2028\nforms:\n- form: table\n",
)


def plots(text: str) -> list[Any]:
    return list(strict_yaml.parse(text, "text")["forms"] or [])


def test_entries_say_what_they_are() -> None:
    assert [entry.key for entry in entries(TEXT)] == ["table", "line", "pareto"]
    assert [entry.words for entry in entries(TEXT)][1:] == ["x: nFeatures", "metrics: [cpu.mean, ate.rmse], log: true"]
    assert [entries(text) for text in UNLISTED] == [[]] * len(UNLISTED)
    assert [entry.key for entry in entries("forms:\n- 1\n")] == [""]


def test_comments_go_with_the_plot_below_them_and_texts_with_their_own() -> None:
    first, second, third = plots(TEXT)
    removed = without_entry(TEXT, 1)
    assert plots(removed) == [second, third]
    assert "what a reader sees first" not in removed
    assert "# after the plots" in removed
    assert plots(without_entry(TEXT, 2)) == [first, third]
    last = without_entry(TEXT, 3)
    assert plots(last) == [first, second]
    assert "# after the plots\nfailed_when" in last
    moved = moved_entry(TEXT, 1, 1)
    assert plots(moved) == [second, first, third]
    assert moved.index("form: line") < moved.index("what a reader sees first") < moved.index("form: table")
    assert plots(moved_entry(TEXT, 3, -1)) == [first, third, second]
    replaced = replaced_entry(TEXT, 1, {"form": "best"})
    assert plots(replaced) == [{"form": "best"}, second, third]
    assert "what a reader sees first" in replaced
    for changed in (removed, last, moved, replaced):
        assert "name: x  # why" in changed
        assert strict_yaml.parse(changed, "text")["failed_when"] == {"tracked_path_below": 0.9}


@pytest.mark.parametrize("number", [0, 4, -1])
def test_a_plot_that_is_not_there_is_named(number: int) -> None:
    with pytest.raises(NotFound, match=f"the text has no plot {number}"):
        find_entry(TEXT, number)


def test_a_list_in_one_line_is_not_changed() -> None:
    for change in (lambda text: without_entry(text, 1), lambda text: with_entry(text, {"form": "table"})):
        with pytest.raises(InvalidInput, match="'forms' is written in one line"):
            change("name: x\nforms: [{form: table}]\n")


WORDS = st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp")), max_size=8)
ENTRY = st.dictionaries(
    st.sampled_from(["form", "x", "metrics", "note"]),
    st.one_of(WORDS, st.integers(-(2**31), 2**31), st.booleans(), st.lists(WORDS, max_size=3)),
    min_size=1,
)


@settings(deadline=None)
@given(st.lists(ENTRY, min_size=1, max_size=5), ENTRY, st.data())
def test_the_text_changes_as_the_list_does(
    written: list[dict[str, Any]], other: dict[str, Any], data: st.DataObject
) -> None:
    text = strict_yaml.dump({"name": "x", "forms": written, "use": "all"})
    number = data.draw(st.integers(1, len(written)))
    place = number - 1
    assert [dict(entry.content) for entry in entries(text)] == written
    assert plots(without_entry(text, number)) == [*written[:place], *written[place + 1 :]]
    assert plots(replaced_entry(text, number, other)) == [*written[:place], other, *written[place + 1 :]]
    assert plots(with_entry(text, other)) == [*written, other]
    if number < len(written):
        swapped = [*written[:place], written[number], written[place], *written[number + 1 :]]
        assert plots(moved_entry(text, number, 1)) == swapped
        assert plots(moved_entry(text, number + 1, -1)) == swapped
