"""``tools/prose.py``: what it finds in Markdown, templates and Python, and its list of unclean files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import prose  # noqa: E402

RULES = [prose.Rule.read(path) for path in sorted(prose.STYLE.glob("*.yml"))]
LONG = " ".join(["word"] * 31) + "."


def problems(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return [(entry.line, entry.message) for entry in prose.check(path, RULES)]


@pytest.mark.parametrize(
    ("sentence", "better"),
    [
        ("The figures are wrong.", "metric (a number) or plot (a picture)"),
        ("Each pose has a stamp.", "timestamp"),
        ("Those that are ticked are deleted.", "select"),
        ("The rate of turning is too high.", "angular rate"),
        ("Whether it was is told by the page.", "says"),
    ],
)
def test_a_retired_word_is_found_everywhere_with_its_replacement(tmp_path, sentence, better):
    for name, text in {
        "page.md": f"# Title\n\n{sentence}\n",
        "page.html": f"<h1>Title</h1>\n\n<p>{sentence}</p>",
        "code.py": f"import os\n\nraise OSError('{sentence}')\n",
        "docstring.py": f'import os\n\n"""{sentence}"""\n',
        "comment.py": f"import os\n\n# {sentence}\n",
    }.items():
        ((line, message),) = problems(tmp_path, name, text)
        assert line == 3
        assert better in message


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("page.md", "Use `figures.json`.\n\n```\nthe figures are told\n```\n"),
        ("page.html", "<p class='figure'>{{ figure(a, b) }}</p> <code>the figures</code>{% set figures = 1 %}"),
        ("code.py", 'figures = {"figures": "a/stamp"}\n'),
        ("page.md", "They can be told apart.\n"),
    ],
)
def test_code_is_not_english(tmp_path, name, text):
    assert not problems(tmp_path, name, text)


def test_long_sentences_are_found_and_short_ones_in_a_long_paragraph_are_not(tmp_path):
    assert len(problems(tmp_path, "page.md", f"Short.\n\n{LONG}\n")) == 1
    assert not problems(tmp_path, "page.md", "One two three. " * 30)
    assert not problems(tmp_path, "page.md", "- five words in an item\n" * 30)
    assert not problems(tmp_path, "page.md", "| five words in a cell |\n" * 30)


def test_a_message_of_several_pieces_is_one_sentence(tmp_path):
    ((line, _),) = problems(tmp_path, "code.py", f'x = 1\ny = f"{{x}} {LONG[:80]}" f"{LONG[80:]} {{x}}"\n')
    assert line == 2


def test_a_rule_of_an_unknown_kind_is_refused(tmp_path):
    (tmp_path / "Odd.yml").write_text("extends: spelling\nmessage: no\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"Odd\.yml: rules of the kind 'spelling'"):
        prose.Rule.read(tmp_path / "Odd.yml")


def test_a_clean_file_must_leave_the_list(tmp_path, monkeypatch, capsys):
    (tmp_path / "clean.md").write_text("All is well.\n", encoding="utf-8")
    (tmp_path / "unclean.md").write_text("A stamp.\n", encoding="utf-8")
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    monkeypatch.setattr(prose, "UNCLEAN", tmp_path / "unclean.txt")
    monkeypatch.setattr(prose, "tracked_files", lambda: ["clean.md", "unclean.md"])
    assert prose.main([]) == 1
    assert "unclean.md:1: Use 'timestamp' instead of 'stamp'" in capsys.readouterr().out
    assert prose.main(["--update"]) == 0
    assert (tmp_path / "unclean.txt").read_text() == "unclean.md\n"
    assert prose.main([]) == 0
    (tmp_path / "unclean.txt").write_text("clean.md\nunclean.md\n")
    assert prose.main([]) == 1
    assert "clean.md is clean or gone" in capsys.readouterr().out
