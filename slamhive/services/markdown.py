"""Convert untrusted Markdown to safe HTML."""

from __future__ import annotations

import re
from collections.abc import Callable

from markdown_it import MarkdownIt

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
