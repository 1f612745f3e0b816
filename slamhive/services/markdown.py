"""Markdown in both directions: untrusted text to safe HTML, and tables to Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

from markdown_it import MarkdownIt

from slamhive.analysis.report import ResultTable
from slamhive.domain.names import printable

_WITH_IMAGES = MarkdownIt("commonmark", {"html": False, "linkify": False}).enable("table")
_MARKDOWN = MarkdownIt("commonmark", {"html": False, "linkify": False}).enable("table").disable("image")
_NO_SLUG = re.compile(r"[^\w\- ]")


def markdown_html(text: str, link: Callable[[str], str] | None = None) -> str:
    """Convert Markdown to HTML: tags are shown as text, and script links are refused.

    Args:
        text: The Markdown.
        link: Maps the target of each link and image to the one in the page; headings then get an ``id``.
            Without it, images are left out.
    """
    markdown = _MARKDOWN if link is None else _WITH_IMAGES
    tokens = markdown.parse(text)
    if link is not None:
        for token, inside in zip(tokens, [*tokens[1:], None], strict=True):
            if token.type == "heading_open" and inside is not None:
                token.attrSet("id", slug(inside.content))
            for child in token.children or ():
                if child.type == "link_open":
                    child.attrSet("href", link(str(child.attrGet("href") or "")))
                elif child.type == "image":
                    child.attrSet("src", link(str(child.attrGet("src") or "")))
                    child.attrSet("loading", "lazy")
    html = str(markdown.renderer.render(tokens, markdown.options, {}))
    return html.replace("<pre>", '<pre tabindex="0">')  # text is escaped; wide code is scrolled by keyboard


def slug(heading: str) -> str:
    """The anchor of a heading, as on the documentation site: ``what-protects-it`` for ``What protects it``."""
    return re.sub(r"[\s-]+", "-", _NO_SLUG.sub("", heading).strip().lower())


_RANKS: Mapping[int | None, str] = {1: "**%s**", 2: "<ins>%s</ins>"}


def table_markdown(table: ResultTable) -> str:
    """A table of GitHub's Markdown with escaped text, numbers with four significant digits, and the caption below."""
    rules = ["---:" if number else "---" for number in numeric_columns(table)]
    rows = [[escaped(column.heading) for column in table.columns], rules]
    for place, row in enumerate(table.rows):
        cells = []
        for at, cell in enumerate(row):
            text = "–" if cell is None else f"{cell:.4g}" if isinstance(cell, float) else str(cell)
            cells.append(ranked(escaped(text), table.rank(place, at), _RANKS))
        rows.append(cells)
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([*lines, *(["", escaped(table.caption)] if table.caption else []), ""])


def numeric_columns(table: ResultTable) -> list[bool]:
    """Find the columns that hold numbers, or texts that are numbers."""
    return [table.is_number(place) for place in range(len(table.columns))]


def ranked(text: str, rank: int | None, styles: Mapping[int | None, str]) -> str:
    """``text`` as values of this rank are printed; ``styles`` contains ``%s`` for the text."""
    return styles[rank] % text if rank in styles else text


def escaped(text: str) -> str:
    """Text escaped for Markdown: neither HTML nor a new cell, line or link."""
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", printable(text))
