from __future__ import annotations

from slamhive.base.errors import nearest


def test_the_nearest_name_is_suggested():
    assert nearest("ate.rms", ["ate.rmse", "cpu.mean"]) == "did you mean 'ate.rmse'?"


def test_where_none_is_near_the_known_names_are_listed():
    assert nearest("zzz", ["b", "a", "b"]) == "known: a, b"
    assert nearest("zzz", []) == "known: none"


def test_a_long_list_of_known_names_is_cut_and_says_so():
    listed = nearest("zzz", [f"name{number:03}" for number in range(200)])

    assert listed.endswith("name039 and 160 more")
    assert "name040" not in listed
