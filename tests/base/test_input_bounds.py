from __future__ import annotations

import json
from pathlib import Path

import pytest

from slamhive.base.bounds import (
    check_text,
    check_value,
    decode,
    parse_json,
    parse_json_object,
    read_record,
    read_text,
    whole_number,
)
from slamhive.base.errors import InvalidInput, NotFound


@pytest.mark.parametrize("text", ["", "plain", "tab\tline\nend\r\n", "é 😀 ١٢٣", "\x85"])
def test_text_is_what_a_file_may_hold(text):
    assert check_text(text, "the name") == text


@pytest.mark.parametrize("character", ["\x00", "\x1b", "\x7f", "\x9f", "\ufffe", "\ud800"])
def test_what_is_not_text_is_named_with_its_place(character):
    with pytest.raises(InvalidInput, match=rf"the name holds the character U\+{ord(character):04X}"):
        check_text(f"a{character}b", "the name")


def test_what_programs_wrote_may_hold_control_characters():
    assert check_text("\x1b[31m", "the log", recorded=True) == "\x1b[31m"
    with pytest.raises(InvalidInput, match="U\\+DC80, half of a surrogate pair"):
        check_text("\udc80", "the log", recorded=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": [1, {"b": "\\ud800"}]}', "the body: a.1.b: holds the character U+D800"),
        ('{"a": {"\\u0000": 1}}', "the key holds the character U+0000"),
        ("[" * 100_000, "the body is nested deeper than 32 levels"),
        ('{"a":' * 100_000, "the body is nested deeper than 32 levels"),
        ("[" * 33 + "]" * 33, "is nested too deeply"),
        ("9" * 4420, "is a whole number of more than 64 bits"),
        (f"[{2**64 + 1}]", "is a whole number of more than 64 bits"),
        ("[1e999]", "1e999 is not a finite number"),
        ("[-Infinity]", "-Infinity is not a finite number"),
        ("NaN", "NaN is not a finite number"),
        ("{", "the body is not JSON that can be used"),
        (b"\xff", "the body line 1 is not UTF-8 text"),
        (b'{\n"a": "\xed\xa0\x80"}', "the body line 2 is not UTF-8 text"),
    ],
)
def test_json_beyond_the_bounds_is_refused_in_one_short_line(text, message):
    with pytest.raises(InvalidInput) as caught:
        parse_json(text, "the body")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_json_within_the_bounds_is_what_it_is():
    content = {"a": [1, 1.5, None, True, "é"], "b": {"c": -(2**64)}}
    assert parse_json(json.dumps(content), "x") == content
    assert parse_json(b"\xef\xbb\xbf" + json.dumps(content).encode(), "x") == content
    assert parse_json("[" * 32 + "]" * 32, "x")


def test_an_object_is_asked_for():
    with pytest.raises(InvalidInput, match="the body is not a JSON object"):
        parse_json_object("[1]", "the body")


def test_a_huge_number_is_refused_without_being_written():
    with pytest.raises(InvalidInput, match="more than 64 bits"):
        check_value({"a": 16**4000}, "x")
    with pytest.raises(InvalidInput, match="more than 64 bits"):
        check_value({16**4000: 1}, "x")


def test_files_are_read_to_their_limit_and_no_further(tmp_path: Path):
    with pytest.raises(InvalidInput, match="/dev/zero is larger than 1000 bytes"):
        read_text(Path("/dev/zero"), 1000)
    with pytest.raises(InvalidInput, match="does not exist"):
        read_text(tmp_path / "none", 1000)
    with pytest.raises(InvalidInput, match="Is a directory"):
        read_text(tmp_path, 1000)
    with pytest.raises(InvalidInput, match="cannot be read"):
        read_text(Path("a\x00b"), 1000)
    (tmp_path / "run.json").write_bytes(b'{"detail": "\\u001b[31m", "text": "\xc3\xa9"}')
    assert read_record(tmp_path / "run.json") == {"detail": "\x1b[31m", "text": "é"}


def test_a_byte_order_mark_is_no_text():
    assert decode(b"\xef\xbb\xbfa: 1", "x") == "a: 1"


@pytest.mark.parametrize("text", ["1", " 7 ", "007"])
def test_a_whole_number(text):
    assert whole_number(text, "limit", 1, 10) == int(text)


@pytest.mark.parametrize("text", ["", "0", "11", "-1", "1.0", "1e1", "٣", "²", "1_0", "x", "9" * 4420, "0" * 4420])
def test_no_whole_number_within_the_bounds(text):
    with pytest.raises(InvalidInput, match=r"limit '.*' is not allowed; use 1 to 10") as caught:
        whole_number(text, "limit", 1, 10)
    assert len(str(caught.value)) < 200


def test_messages_can_be_shown_by_every_terminal_and_page():
    error = NotFound("no run \x1b[31m\ud800\n of that\tname", "try \x00")
    assert str(error) == r"no run \x1b[31m\ud800 of that name; try \x00"
    long = str(NotFound(f"unknown {'x' * 100_000} here"))
    assert len(long) < 3000
    assert long.endswith("here")
