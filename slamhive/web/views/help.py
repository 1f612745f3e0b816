"""The documentation in ``docs/``, rendered as pages that work offline."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from html import unescape
from pathlib import Path

from flask import Blueprint, Response, render_template, send_file
from flask import url_for as address
from markupsafe import Markup

from slamhive.base.errors import Unavailable, unknown
from slamhive.domain.finding import Found, FoundKind
from slamhive.services.markdown import markdown_html
from slamhive.web.context import hive

blueprint = Blueprint("help", __name__, url_prefix="/help")

FIRST = "index"
OF_PAGE = {
    "dashboard": "web",
    "experiments": "experiments",
    "experiment_builder": "experiments",
    "questions": "deciding",
    "runs": "search",
    "search_actions": "search",
    "selected_runs": "search",
    "trash": "web",
    "imports": "importing-runs",
    "nodes": "web",
    "challenges": "challenges",
    "claims": "claims",
    "searches": "search",
    "start": "web",
    "configurations": "configurations",
    "algorithms": "add-an-algorithm",
    "datasets": "dataset-format",
    "analyses": "analysis",
    "api_docs": "api",
}
"""The help page for each blueprint."""

EXTEND = "extend"
"""The page about plug-ins, which has a folder of its own for its examples."""

_ADDRESS = re.compile(r"(?:\.\./|extend/)?(?P<name>[\w-]+)\.md(?P<part>#.*)?")
_HEADING = re.compile(r"<h[23][^>]*>(.*?)</h[23]>", re.DOTALL)
_TAG = re.compile(r"<[^>]*>|`|\s*\{#[\w-]+\}")
"""What is no text: tags, and Markdown in titles and headings."""
_IMAGE = re.compile(r"images/(?P<name>[\w-]+\.(?:png|svg))")
_PICTURES = {".png": "image/png", ".svg": "image/svg+xml"}
_EXAMPLE = re.compile(r"[\w-]+\.py|algorithm/algorithm\.yaml")


@blueprint.get("/")
@blueprint.get("/<name>")
def page(name: str = FIRST) -> str:
    """Show one page of the documentation."""
    known = _pages(hive().catalogue.project_root)
    if name not in known:
        raise unknown("help page", name[:100], list(known))
    path = known[name]
    title, html = _rendered(path, path.stat().st_mtime_ns)
    titles = [(entry, _rendered(file, file.stat().st_mtime_ns)[0]) for entry, file in sorted(known.items())]
    return render_template("help/page.html", name=name, title=title, content=Markup(html), titles=titles)  # noqa: S704


@blueprint.get(f"/{EXTEND}/<path:name>")
def example(name: str) -> Response:
    """One file of an example of a plug-in, as text."""
    folder = hive().catalogue.project_root / "docs" / EXTEND
    known = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.suffix in {".py", ".yaml"}}
    if name not in known:
        raise unknown("example", name[:100], list(known))
    return Response(known[name].read_text(encoding="utf-8"), mimetype="text/plain")


@blueprint.get("/images/<name>")
def image(name: str) -> Response:
    """One picture of the documentation."""
    folder = hive().catalogue.project_root / "docs" / "images"
    known = {path.name: path for path in folder.iterdir() if path.suffix in _PICTURES}
    if name not in known:
        raise unknown("picture", name[:100], list(known))
    return send_file(known[name], mimetype=_PICTURES[known[name].suffix], conditional=True)


def entries() -> Iterator[Found]:
    """All pages with their headings and text, for the search over everything."""
    for name, path in sorted(_pages(hive().catalogue.project_root).items()):
        yield _entry(name, path, path.stat().st_mtime_ns)


@lru_cache(maxsize=100)
def _entry(name: str, path: Path, modified_ns: int) -> Found:
    title, html = _rendered(path, modified_ns)
    headings = [_plain(text) for text in _HEADING.findall(html)]
    return Found(FoundKind.HELP, name, _plain(title), " · ".join(headings), _plain(html))


def _plain(html: str) -> str:
    return unescape(_TAG.sub("", html))


def _pages(root: Path) -> dict[str, Path]:
    """Path of every page by name. A name from an address is looked up here, never joined to a path."""
    docs = (root / "docs").resolve()  # what is rendered is kept for one path
    pages = {path.stem: path for path in docs.glob("*.md") if path.is_file()}
    extending = {EXTEND if path.stem == "index" else path.stem: path for path in docs.glob(f"{EXTEND}/*.md")}
    return pages | extending


@lru_cache(maxsize=100)
def _rendered(path: Path, _modified_ns: int) -> tuple[str, str]:
    """Title and HTML of a page; the modification time makes a changed file a new cache entry."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{path.name} cannot be read: {error.strerror}") from None
    heading = next((line for line in text.splitlines() if line.startswith("# ")), f"# {path.stem}")
    return heading[2:].strip().replace("`", ""), markdown_html(text, _link)


def _link(target: str) -> str:
    """Turn links between documentation files into links between help pages; pictures and examples get addresses."""
    found = _ADDRESS.fullmatch(target)
    if found:
        name = EXTEND if target.startswith(f"{EXTEND}/index") else found["name"]
        return address("help.page", name=name) + (found["part"] or "")
    picture = _IMAGE.fullmatch(target)
    if picture:
        return address("help.image", name=picture["name"])
    return address("help.example", name=target) if _EXAMPLE.fullmatch(target) else target
