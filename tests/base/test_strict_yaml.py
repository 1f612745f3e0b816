from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2", "x line 2: the key 'a' appears twice"),
        ("a: &b 1\nc: *b", "anchors and aliases"),
        ("a: !!python/object/apply:os.system [id]", "tag"),
        ("a: !custom 1", "tag"),
        ("- 1", "found list"),
        ("", "found nothing"),
        ("a: [1", "x line 1: did not find expected ',' or ']'"),
        ("? [1]\n: 2", "plain text"),
        ("a: " + "[" * 30 + "]" * 30, "nested deeper"),
        ("a: " + "[" * 100_000, "nested deeper"),
        ('b: 1\na: "\\ud800"', "x line 2: found invalid Unicode character escape code"),
        ('a: "\\0"', "x line 1: a: holds the character U+0000, a control character"),
        ('"\\udfff": 1', "x line 1: found invalid Unicode"),
        ("a: \ud800", "x: not valid YAML"),
        ("a: .inf", "x line 1: a: inf is not a finite number"),
        ("a: 1e400", "not a finite number"),
        ("a: 0x" + "f" * 4000, "x line 1: a: is a whole number of more than 64 bits"),
        ("a: " + "9" * 4420, "x line 1: a value is not a number that can be used"),
    ],
)
def test_traps_are_refused_in_one_line(text, message):
    with pytest.raises(InvalidInput) as caught:
        strict_yaml.parse(text, "x")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bomb_of_aliases_costs_nothing():
    bomb = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))
    with pytest.raises(InvalidInput, match="anchors"):
        strict_yaml.parse(bomb, "x")


def test_a_huge_text_is_not_parsed():
    with pytest.raises(InvalidInput, match="larger than"):
        strict_yaml.parse("a: 1\n" * 500_000, "x")


def test_an_endless_file_is_not_read_to_its_end():
    with pytest.raises(InvalidInput, match="/dev/zero is larger than 2000000 bytes; is it the right file"):
        strict_yaml.load(Path("/dev/zero"))


def test_binary_garbage_is_explained(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(InvalidInput, match="line 2 is not UTF-8 text"):
        strict_yaml.load(path)
    with pytest.raises(InvalidInput, match="Is a directory"):
        strict_yaml.load(tmp_path)
    with pytest.raises(InvalidInput, match=r"none\.yaml does not exist"):
        strict_yaml.load(tmp_path / "none.yaml")


AMBIGUOUS = (
    "no y ON 012 0o12 1_000 0x1F 0b1 -0x1 1e-9 1E6 .5 -.5 1. +.inf .NaN ~ null True = << 1:2:3 1:5.5 2026-01-31 0.1.2 "
    "1e5f - ? : a: #b &c *d !e [ { %f @g ` ' | > , --- ... é 日本"
)
TEXTS = [
    *AMBIGUOUS.split(),
    "",
    " a ",
    "a: b",
    "a #b",
    "x\n",
    "x\ny",
    "\t",
    "\x85",
    "a\u2028b",
    "2026-1-1 10:00",
    "word " * 60,
    '"',
]


def test_what_is_written_is_read_back_unchanged_by_readers_of_both_versions():
    content = {
        "numbers": [1.5, 2, 1e-9, 1e22, -5, 2**63],
        "plain": {"d": None, "e": True, "empty": {}, "list": [], "deep": [[1, "no"], {"a": 1}]},
        **{text: text for text in TEXTS},
    }
    text = strict_yaml.dump(content)
    assert strict_yaml.parse(text, "x") == content
    assert yaml.safe_load(text) == content


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(
            (word, word)
            for word in ("no", "Yes", "on", "OFF", "y", "1_000", "0b1", "-0x1", "=", "<<", "2026-01-31 10:00")
        ),
        *((word, True) for word in ("true", "True", "TRUE")),
        *((word, None) for word in ("", "~", "null", "Null", "NULL")),
        ("false", False),
        ("012", 12),
        ("-07", -7),
        ("0o14", 12),
        ("0x1F", 31),
        ("+1.", 1.0),
        (".5", 0.5),
        ("1.e3", 1000.0),
    ],
)
def test_plain_words_mean_what_the_core_schema_of_yaml_1_2_says(text, value):
    found = strict_yaml.parse(f"a: {text}", "x")["a"]
    assert (found, type(found)) == (value, type(value))


def test_quoted_text_is_text():
    assert strict_yaml.parse("a: 'null'\nb: \"12\"\nc: |\n  1.5\n", "x") == {"a": "null", "b": "12", "c": "1.5\n"}


def test_only_one_document_is_read():
    with pytest.raises(InvalidInput, match="x line 2: a second document begins, expected one"):
        strict_yaml.parse("a: 1\n---\nb: 2\n", "x")


def test_images_without_the_c_parser_read_the_same():
    code = (
        "import sys; sys.modules['_ruamel_yaml'] = None\n"
        "from slamhive.base import strict_yaml\n"
        "print(strict_yaml.parse_with_lines('a: 012\\nb:\\n  - \"no\"\\n  - {c: no}\\n', 'x'))\n"
        "try: strict_yaml.parse('a: 1\\na: [&x 1]\\n', 'x')\n"
        "except Exception as error: print(error)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    content, lines = {"a": 12, "b": ["no", {"c": "no"}]}, {("a",): 1, ("b",): 2, ("b", 0): 3, ("b", 1): 4}
    assert result.stdout == f"{(content, {**lines, ('b', 1, 'c'): 4})}\nx line 2: the key 'a' appears twice\n"


@pytest.mark.parametrize("text", ["1:5:1", "1:5:0.5", "12:30", "500:2500:250", "2026-01-31", "2026-99-99"])
def test_colons_and_dates_are_text(text):
    assert strict_yaml.parse(f"a: {text}", "x") == {"a": text}


def test_lines_are_told_for_keys_and_items():
    text = "a: 1\nb:\n  - x\n  - {c: 2,\n     d: 3}\n"
    content, lines = strict_yaml.parse_with_lines(text, "x")
    assert content == {"a": 1, "b": ["x", {"c": 2, "d": 3}]}
    assert lines == {("a",): 1, ("b",): 2, ("b", 0): 3, ("b", 1): 4, ("b", 1, "c"): 4, ("b", 1, "d"): 5}


@pytest.mark.parametrize("text", ["1e-9", "1E6", "-2e+3", "+5e0"])
def test_a_power_of_ten_needs_no_point_to_be_a_number(text):
    assert strict_yaml.parse(f"key: {text}", "f")["key"] == float(text)


@pytest.mark.parametrize("text", ["what?", "?0", ":0", ":", "a?b"])
def test_text_in_a_list_on_one_line_is_read_back(text):
    """The C parser takes question marks and leading colons there for signs."""
    assert strict_yaml.parse(strict_yaml.dump({"list": [text, "b"], "text": text}), "f") == {
        "list": [text, "b"],
        "text": text,
    }


def test_text_that_looks_like_a_power_of_ten_stays_text():
    assert strict_yaml.parse(strict_yaml.dump({"key": "1e5"}), "f") == {"key": "1e5"}


def test_what_only_begins_like_a_power_of_ten_is_text():
    assert strict_yaml.parse("a: 1e\nb: 1e5f\nc: 500:1e3\n", "f") == {"a": "1e", "b": "1e5f", "c": "500:1e3"}


def test_keys_are_text_whatever_they_read_like():
    text = "1: a\n2.5: b\nnull: c\ntrue: d\n.nan: e\n2026-01-31: f\n"
    assert list(strict_yaml.parse(text, "f")) == ["1", "2.5", "null", "true", ".nan", "2026-01-31"]


def test_ranges_stand_in_short_lists_as_they_always_did():
    assert strict_yaml.parse("a: {one: [1:3, x], two: 1:3}\nb: 2", "f") == {
        "a": {"one": ["1:3", "x"], "two": "1:3"},
        "b": 2,
    }
    with pytest.raises(InvalidInput, match="f line 2: "):
        strict_yaml.parse("a: [1:3, x]\nb: ]", "f")
