"""Checks the English of the project by the Vale style in ``tools/vale``.

No package registry carries the Vale program, so the kinds of rules that the style uses are implemented here.

    python tools/prose.py             check every file; part of "make test TIERS=lint"
    python tools/prose.py FILE ...    check these

A docstring opens with a verb or a noun. ``STIFF`` names words that are neither.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from prose_text import Passage, opening_words, passages

ROOT = Path(__file__).resolve().parent.parent
STYLE = ROOT / "tools" / "vale" / "SlamHive"
STIFF = frozenset({"As", "How", "See", "That", "What", "When", "Whether", "Which", "Who"})
"""Words that no docstring opens with."""
CHECKED = ("*.md", "templates/*.html", "*.py", "*/algorithm.yaml")
GENERATED = ("cli", "settings", "analysis-forms", "variant-steps")
LEFT_OUT = ("docs/glossary.md", *(f"docs/{name}.md" for name in GENERATED), "tests/", "algorithms/*/README.md")
"""The glossary names what it retires; generated pages come from code, which is checked."""
_SENTENCE_END = re.compile(r"(?<=[.!?;])[)\"”]*\s+(?=[^a-z])")


@dataclass(frozen=True)
class Problem:
    """A fault in a passage, and its line."""

    line: int
    message: str


@dataclass(frozen=True)
class Rule:
    """One style file. ``patterns`` maps what must not stand to what should, "" where the style names nothing."""

    message: str
    patterns: Mapping[re.Pattern[str], str]
    most: int | None = None

    @classmethod
    def read(cls, path: Path) -> Rule:
        """A rule from a Vale style file; raises ValueError for a kind that is not implemented."""
        entries: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
        flags = re.IGNORECASE if entries.get("ignorecase") else re.NOFLAG
        match entries["extends"]:
            case "existence":
                swaps = dict.fromkeys(entries["tokens"], "")
            case "substitution":
                swaps = entries["swap"]
            case "occurrence":
                return cls(entries["message"], {re.compile(entries["token"], flags): ""}, entries["max"])
            case kind:
                raise ValueError(f"{path.name}: rules of the kind {kind!r} are not implemented")
        return cls(entries["message"], {re.compile(rf"\b(?:{key})\b", flags): swaps[key] for key in swaps})

    def problems(self, passage: Passage) -> Iterator[Problem]:
        """Find the faults of a passage."""
        if self.most is not None:
            yield from self._long_sentences(passage)
            return
        for pattern, better in self.patterns.items():
            for found in pattern.finditer(passage.text):
                names = (better, found[0]) if better else (found[0],)
                line = passage.line + passage.text.count("\n", 0, found.start())
                yield Problem(line, self.message % names[: self.message.count("%s")])

    def _long_sentences(self, passage: Passage) -> Iterator[Problem]:
        (token,) = self.patterns
        for sentence in _SENTENCE_END.split(passage.text):
            if len(token.findall(sentence)) > (self.most or 0):
                yield Problem(passage.line, f"{self.message} {' '.join(sentence.split())[:60]} ...")


def stiff_openings(path: Path) -> list[Problem]:
    """Find the docstrings of a Python file that open with one of ``STIFF``."""
    if path.suffix != ".py":
        return []
    return [
        Problem(entry.line, f"Open a docstring with a verb or a noun, and not with '{entry.text}'.")
        for entry in opening_words(path.read_text(encoding="utf-8"))
        if entry.text in STIFF
    ]


def main(arguments: Sequence[str]) -> int:
    """Check the named files or all; returns the exit code."""
    rules = [Rule.read(path) for path in sorted(STYLE.glob("*.yml"))]
    unknown = next((name for name in arguments if not (ROOT / name).is_file()), None)
    if unknown is not None:
        print(f"there is no file {unknown}; usage: prose.py [FILE ...]", file=sys.stderr)
        return 2
    names = arguments or tracked_files()
    print(f"prose: {len(names)} files")
    return report({name: [*check(ROOT / name, rules), *stiff_openings(ROOT / name)] for name in names})


def tracked_files() -> list[str]:
    """The files under version control that hold English."""
    command = ("git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *CHECKED)
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [name for name in names if (ROOT / name).is_file() and not any(left_out(name, entry) for entry in LEFT_OUT)]


def left_out(name: str, entry: str) -> bool:
    """Return whether an entry of ``LEFT_OUT`` names this file."""
    return name.startswith(entry) if entry.endswith("/") else Path(name).match(entry)


def check(path: Path, rules: Sequence[Rule]) -> list[Problem]:
    """All problems of a file, by line."""
    found = [problem for entry in passages(path) for rule in rules for problem in rule.problems(entry)]
    return sorted(found, key=lambda problem: problem.line)


def report(problems: Mapping[str, Sequence[Problem]]) -> int:
    """Print what was found; returns the exit code."""
    for name, entries in problems.items():
        for entry in entries:
            print(f"{name}:{entry.line}: {entry.message}")
    return 1 if any(problems.values()) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
