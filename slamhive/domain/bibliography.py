"""Works to cite, as BibTeX. Algorithms, datasets and collections state them as text, as a list of references has it."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Container, Iterable
from dataclasses import dataclass
from itertools import chain, count

# Text escaped for LaTeX.


_ESCAPED = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "²": r"\textsuperscript{2}", "°": r"\textdegree{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "±": r"$\pm$", '"': "''", "×": r"$\times$",
    "–": "--", "…": r"\ldots{}", "≤": r"$\leq$", "≥": r"$\geq$", "→": r"$\to$", "µ": r"$\mu$", "ω": r"$\omega$",
    "Δ": r"$\Delta$", "·": r"$\cdot$", "★": r"$\star$",
}  # fmt: skip
"""No entry needs a package."""


def latex(text: str) -> str:
    """``text`` as LaTeX prints it: in one line, without commands."""
    return "".join(_ESCAPED.get(letter, letter) if letter.isprintable() else " " for letter in text)


@dataclass(frozen=True, slots=True)
class Reference:
    """Works to cite for an algorithm, a dataset or a tool.

    Attributes:
        names: What it is about, for example the modes of an algorithm or the sequences of a dataset.
        text: One or more works such as ``A. Author, B. Author. Title. Venue, 2020.``, or BibTeX; empty if unknown.
    """

    names: tuple[str, ...]
    text: str


TOOLS = (
    Reference(
        ("SLAM Hive",),
        "X. Liu, Y. Yang, B. Xu, D. Feng, S. Schwertfeger. Benchmarking SLAM Algorithms in the Cloud: The SLAM Hive "
        "Benchmarking Suite. arXiv:2406.17586, 2024.",
    ),
    Reference(
        ("evo",),
        "M. Grupp. evo: Python package for the evaluation of odometry and SLAM. "
        "https://github.com/MichaelGrupp/evo, 2017.",
    ),
)
"""What every result was made with. ``CITATION.cff`` names the same work; a test compares them."""

_NEXT_WORK = re.compile(r"(?<=\b(?:19|20)\d\d)[.;] |(?<=>)[.;] ")
"""After the year of a work, or the DOI that follows it."""
_PREFIX = re.compile(r"^[\w -]{1,40}: (?=[A-Z]\.)")
_INITIALS = r"(?:[^\W\d_a-z]\.[ -]?)+"
_NAMES = rf"{_INITIALS}[^\d:.,]+(?:, {_INITIALS}[^\d:.,]+)*"
_END = r"(?:(?P<venue>[^.].*?)(?:,? ))??(?P<year>(?:19|20)\d\d)\.?$"
_WORKS = (
    re.compile(rf"^(?P<authors>{_NAMES})\. (?P<title>.+[^.])\. {_END}"),
    re.compile(rf"^(?P<authors>[^.:,\d]+(?:(?:, [^.:,\d]+)+| et al\.)): (?P<title>.+[^.])\. {_END}"),
)
"""Authors with initials and a full stop, and last names with a colon."""
_JOURNAL = re.compile(r"Transactions|Letters|Journal|Magazine|\bIJRR\b|\bRA-L\b|\bJMLR\b", re.IGNORECASE)
_SHORT_WORD = 3
_ARXIV = re.compile(r"^arXiv:(\d{4}\.\d{4,5})$")
_DOI = re.compile(r"[.,;]? ?(?:doi:|https?://doi\.org/)(10\.[^\s,;]*[^\s,;.])", re.IGNORECASE)
_MARKED_DOI = re.compile(r" <(10\.[^>]+)>")


def cited(works: Iterable[tuple[str, str]]) -> tuple[Reference, ...]:
    """The references behind (name, citation) pairs, in their order; names with one citation are together."""
    found: dict[str, list[str]] = {}
    for name, text in works:
        found.setdefault(" ".join(text.split()) if not _is_bibtex(text) else text.strip(), []).append(name)
    return tuple(Reference(tuple(dict.fromkeys(names)), text) for text, names in found.items() if text) + tuple(
        Reference(tuple(dict.fromkeys(names)), "") for text, names in found.items() if not text
    )


def bibtex(references: Iterable[Reference]) -> str:
    """A ``.bib`` file with each work once. Comments say what a work is about, and of what no citation is known."""
    taken: dict[str, str] = {}
    parts = []
    for reference in references:
        names = ", ".join(" ".join(name.split()) for name in reference.names)
        if not reference.text:
            parts.append(f"% no citation is known for {names}\n")
        elif _is_bibtex(reference.text):
            parts.append(f"% {names}\n{reference.text}\n")
        else:
            entries = (
                _entry(_PREFIX.sub("", work.strip()), reference.names[0], taken)
                for work in _NEXT_WORK.split(_DOI.sub(r" <\1>", reference.text))
            )
            parts.append(f"% {names}\n" + "".join(filter(None, entries)))
    return "\n".join(parts)


def _is_bibtex(text: str) -> bool:
    return text.lstrip().startswith("@")


def _entry(work: str, name: str, taken: dict[str, str]) -> str:
    """The entry of one work; empty if ``taken``, the works by key, has it already."""
    doi = _MARKED_DOI.search(work)
    plain = _MARKED_DOI.sub("", work)
    found = next(filter(None, (pattern.match(plain) for pattern in _WORKS)), None)
    if found is None:
        years = re.findall(r"\b(?:19|20)\d\d\b", plain)
        fields = {"title": f"{{{latex(name)}}}", "howpublished": latex(plain)}
        kind, key, fields = "misc", _letters(name), fields | ({"year": years[-1]} if years else {})
    else:
        listed = re.sub(r",? et al\.?$", ", others", found["authors"]).replace(" and ", ", ")
        authors = [name for name in listed.split(", ") if name]
        kind, venue = _venue(found["venue"])
        fields = {"author": latex(" and ".join(authors)), "title": f"{{{latex(found['title'])}}}"}
        fields |= venue | {"year": found["year"]}
        key = f"{_letters(authors[0].split()[-1])}{found['year']}{_first_word(found['title'])}"
    fields |= {"doi": doi[1]} if doi else {}
    content = "".join(f"  {field} = {{{value}}},\n" for field, value in fields.items())
    same = f"{fields['title']} {fields.get('author')} {fields.get('year')}"
    if same in taken.values():
        return ""
    key = _free(key, taken)
    taken[key] = same
    return f"@{kind}{{{key},\n{content}}}\n"


def _first_word(title: str) -> str:
    words = re.split(r"[ :]", title)
    return _letters(next((word for word in words if len(word) > _SHORT_WORD), words[0]))


def _venue(text: str | None) -> tuple[str, dict[str, str]]:
    """The kind of entry, and the fields that say where the work appeared."""
    if text is None:
        return "misc", {}
    preprint = _ARXIV.match(text)
    if preprint:
        number = preprint[1]
        return "misc", {"eprint": number, "archiveprefix": "arXiv", "doi": f"10.48550/arXiv.{number}"}
    if text.startswith("http") or " http" in text:
        return "misc", {"howpublished": latex(text)}
    return (
        ("article", {"journal": latex(text)})
        if _JOURNAL.search(text)
        else ("inproceedings", {"booktitle": latex(text)})
    )


def _letters(text: str) -> str:
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9]", "", plain).lower() or "work"


def _free(key: str, taken: Container[str]) -> str:
    """``key``, with a number if another work has it."""
    return next(name for name in chain([key], (f"{key}-{number}" for number in count(2))) if name not in taken)
