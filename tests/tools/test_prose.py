"""``tools/prose.py``: what it finds in Markdown, templates, Python and YAML."""

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


def test_what_users_read_of_a_yaml_file_is_english(tmp_path):
    text = "parameters:\n  stamps:\n    help: >-\n      The stamps\n      of a scan.\n  other:\n    unit: stamps\n"
    assert [line for line, _ in problems(tmp_path, "algorithm.yaml", text)] == [3]
    assert problems(tmp_path, "algorithm.yaml", "modes: [{title: One stamp}]")
    assert not problems(tmp_path, "algorithm.yaml", "")


def test_an_option_is_code_and_a_setting_in_a_comment_stands_alone(tmp_path):
    assert not problems(tmp_path, "page.md", "Use --figures or --all-unevaluated.\n")
    words = " ".join(["word"] * 15)
    assert not problems(tmp_path, "code.py", f"# MODE = 'a'  # {words}\n# DATA = 'b'  # {words} word\n")
    assert problems(tmp_path, "code.py", f"# {words}\n# {words} word\n")


def test_one_unclean_file_fails_the_check(tmp_path, monkeypatch, capsys):
    (tmp_path / "clean.md").write_text("All is well.\n", encoding="utf-8")
    (tmp_path / "unclean.md").write_text("A stamp.\n", encoding="utf-8")
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    monkeypatch.setattr(prose, "tracked_files", lambda: ["clean.md", "unclean.md"])
    assert prose.main([]) == 1
    assert "unclean.md:1: Use 'timestamp' instead of 'stamp'" in capsys.readouterr().out
    assert prose.main(["clean.md"]) == 0


def openings(tmp_path, text, name="code.py"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return [(entry.line, entry.message) for entry in prose.stiff_openings(path)]


@pytest.mark.parametrize("word", ["As", "How", "See", "Which", "What", "Whether"])
def test_a_docstring_opens_with_a_verb_or_a_noun(tmp_path, word):
    for text in (
        f'"""{word} it was."""\n',
        f'def f():\n    """{word} it was.\n\n    More.\n    """\n',
        f'class C:\n    """Good."""\n\n    async def f(self):\n        """{word} it was."""\n',
    ):
        ((line, message),) = openings(tmp_path, text)
        assert text.splitlines()[line - 1].strip().startswith(f'"""{word}')
        assert f"not with '{word}'" in message


def test_other_openings_and_texts_that_are_no_docstrings_are_left_alone(tmp_path):
    assert not openings(tmp_path, '"""Whatever is left, see below: what a run is."""\nx = "What a run is."\n')
    assert not openings(tmp_path, "What a run is.\n", "page.md")


def test_a_stiff_opening_fails_the_check(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    monkeypatch.setattr(prose, "tracked_files", lambda: ["a.py", "b.py"])
    (tmp_path / "a.py").write_text('def f():\n    """The run."""\n', encoding="utf-8")
    (tmp_path / "b.py").write_text("", encoding="utf-8")
    assert prose.main([]) == 0
    (tmp_path / "b.py").write_text('def f():\n    """What a run is."""\n', encoding="utf-8")
    assert prose.main([]) == 1
    assert prose.main(["a.py"]) == 0
    assert "b.py:2: Open a docstring with a verb or a noun" in capsys.readouterr().out
