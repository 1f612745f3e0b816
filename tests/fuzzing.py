"""Values that break software, and mutations of files: the same for every seed, on every machine."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

HUGE_INTEGER = "9" * 4420
"""Python writes and reads no whole number of more than 4,300 digits."""

NASTY_TEXTS = (
    "", " ", "\t", "\n", "\r\n", "\x00", "a\x00b", "\x1b[31mred", "\x7f", "\x85", "\u2028", "\ufeff", "\ufffe",
    "\uffff", "\u202eabc", "é" * 300, "😀", "İ", "ß", "a" * 300, "a" * 70_000, "-1", "0", "1e400", "-1e400", "nan",
    "NaN", "inf", "-Infinity", "1e308", "1e-320", "0x10", "0x" + "f" * 3700, "1_000", "١٢٣", "²", "½", HUGE_INTEGER,
    "9" * 30, str(2**63), str(2**64), str(-(2**63) - 1), "9007199254740993", "true", "null", "None", "[]", "{}",
    "{" * 500, "[" * 2000, "(" * 2000, "'", '"', "\\", "\\ud800", '"\\ud800"', "'\\x00'", "`", "%", "%00", "%s%n",
    "{0.__class__}", "{{7*7}}", "${x}", "<script>alert(1)</script>", "</textarea>", "--", ";", "' OR 1=1 --", "*",
    "**", "?", "..", "../../etc/passwd", "/etc/passwd", "C:\\", ".", "~", "con", "a/b", "http://[::1", "//[",
    "http://a b/", "javascript:1", "2026-13-45", "2026-01-01T99:99", "0001-01-01", "9999-12-31T23:59:59+99:99",
    "1 and", "id >", "id in (", "and or not", "a=1;b=2", "a" * 64, "a" * 65, "=", "a=", "&a [*a]",
    "!!python/object:os.system x", "0.1,0.2", ",", ",,,", ":", "1:2:3", "1:1000000000:1", "0:1:1e-300", "1 | 2 | 3",
    "rate hz=1e400", "rate every=" + "9" * 30, "rate@ hz=", "@", "#", "@@@=",
)  # fmt: skip
"""Text that can be put into an address or a form. Halves of surrogate pairs cannot; JSON and YAML can escape them."""

NASTY_VALUES: tuple[Any, ...] = (
    *NASTY_TEXTS, "\ud800", "a\udfffb", None, True, False, 0, -1, 1.5, 1e300, 2**53, 2**63, 2**64 + 1, -(2**70),
    1e-320, [], {}, [[]], [None], {"": None}, {"\ud800": 1}, {"a": {"b": {"c": {}}}}, [1] * 3000, ["x"] * 3000,
)  # fmt: skip
"""What JSON can hold, as Python writes it; see :data:`NASTY_JSON` for what Python does not."""

NASTY_JSON = (
    HUGE_INTEGER, "-" + HUGE_INTEGER, "1e999", "-1e999", "NaN", "Infinity", "-Infinity", '"\\ud800"', '"\\u0000"',
    "[" * 100_000, '{"a":' * 100_000, "[" * 40 + "]" * 40, '"' + "x" * 200_000 + '"', "1" + "0" * 400, "1e-9999",
    "0." + "1" * 5000, '"\\x"', "", "tru", "[1,]", '{"a":1,"a":2}', '"\x00"', "'a'", "\ufeff1", "1 2",
)  # fmt: skip
"""JSON values as text, some of which are none."""

NASTY_BYTES = (
    b"\x00", b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b"\xed\xa0\x80", b"\xc3\x28", b"\x1b[31m", b"\r\n", b"\r",
    b"\n\n\n", b"\t", b"\x85", b"\xe2\x80\xa8", b"&a [*a]", b"*a", b"!!python/object/apply:os.system [id]",
    b"<<: {a: 1}", b"? x", b"%YAML 9.9", b"---\n", b"...", b"[" * 5000, b"{" * 5000, b"- " * 5000, b'"', b"'", b"|",
    b">", b"#", b": ", b"=", b".inf", b".nan", b"nan", b"inf", b"-1", b"0", b"1e999", b"-1e999", b"1e308", b"1e-320",
    b"9" * 30, HUGE_INTEGER.encode(), b"0x" + b"f" * 3700, b"\\ud800", b'"\\ud800"', b'"\\0"', b"null", b"true", b"[]",
    b"{}", b",", b",,,,", b" " * 5000, b"x" * 20_000, b"2001-01-01", b"2001-99-99", b"../../etc/passwd", b"/dev/zero",
    b"\x00" * 1000, "é😀".encode(),
)  # fmt: skip


def mutated(data: bytes, draw: random.Random) -> bytes:
    """``data`` after one to four small disasters."""
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        data = draw.choice(_DISASTERS)(data, draw)
    return data


def _flip(data: bytes, draw: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 3, 20))):
        if changed:
            changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def _cut(data: bytes, draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data) + 1)]


def _behead(data: bytes, draw: random.Random) -> bytes:
    return data[draw.randrange(len(data) + 1) :]


def _repeat(data: bytes, draw: random.Random) -> bytes:
    start = draw.randrange(len(data) + 1)
    end = min(len(data), start + draw.choice((1, 10, 100, 1000)))
    return data[:end] + data[start:end] * draw.choice((1, 2, 50)) + data[end:]


def _remove(data: bytes, draw: random.Random) -> bytes:
    start = draw.randrange(len(data) + 1)
    return data[:start] + data[start + draw.choice((1, 4, 30)) :]


def _insert(data: bytes, draw: random.Random) -> bytes:
    place = draw.randrange(len(data) + 1)
    return data[:place] + draw.choice(NASTY_BYTES) + data[place:]


def _replace_word(data: bytes, draw: random.Random) -> bytes:
    """One value, as text formats part them, becomes another: this reaches the checks behind the parser."""
    words = _words(data)
    if not words:
        return data
    place, word = draw.choice(words)
    return data[:place] + draw.choice(NASTY_BYTES) + data[place + len(word) :]


def _words(data: bytes) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    start: int | None = None
    for place, byte in enumerate(data[:20_000]):
        if byte in b" \t\r\n,:[]{}\"'=":
            if start is not None:
                found.append((start, data[start:place]))
            start = None
        elif start is None:
            start = place
    return found


def _other_line_ends(data: bytes, draw: random.Random) -> bytes:
    return data.replace(b"\n", draw.choice((b"\r\n", b"\r", b"\n\n", b"\x00\n", b"")))


def _other_encoding(data: bytes, draw: random.Random) -> bytes:
    return data.decode("latin-1").encode(draw.choice(("utf-16", "utf-32", "utf-8-sig")))


def _swap_lines(data: bytes, draw: random.Random) -> bytes:
    lines = data.split(b"\n")
    draw.shuffle(lines)
    return b"\n".join(lines)


def _duplicate_line(data: bytes, draw: random.Random) -> bytes:
    lines = data.split(b"\n")
    line = draw.randrange(len(lines))
    return b"\n".join([*lines[: line + 1], lines[line], *lines[line + 1 :]])


def _empty(_data: bytes, draw: random.Random) -> bytes:
    return draw.choice((b"", b"\n", b"\x00", b"[]", b"{}", b"null", b"0", b'""', b"PK\x05\x06" + bytes(18)))


_DISASTERS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip, _flip, _cut, _behead, _repeat, _remove, _insert, _insert, _replace_word, _replace_word, _replace_word,
    _replace_word, _other_line_ends, _other_encoding, _swap_lines, _duplicate_line, _empty,
)  # fmt: skip
