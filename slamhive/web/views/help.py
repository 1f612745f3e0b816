"""The documentation in ``docs/``, rendered as pages that work offline."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from flask import Blueprint, render_template
from flask import url_for as address
from markupsafe import Markup

from slamhive.errors import Unavailable, unknown
from slamhive.services.markdown import markdown_html
from slamhive.web.context import hive

blueprint = Blueprint("help", __name__, url_prefix="/help")

FIRST = "index"
OF_PAGE = {
    "dashboard": "web",
    "experiments": "experiments",
    "experiment_builder": "experiments",
    "runs": "search",
    "searches": "search",
    "start": "web",
    "configurations": "configurations",
    "algorithms": "add-an-algorithm",
    "datasets": "dataset-format",
    "analyses": "analysis",
}
"""The help page for each blueprint."""

_ADDRESS = re.compile(r"(?P<name>[\w-]+)\.md(?P<part>#.*)?")


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


def _pages(root: Path) -> dict[str, Path]:
    """Path of every page by name. A name from an address is looked up here, never joined to a path."""
    return {path.stem: path for path in (root / "docs").glob("*.md") if path.is_file()}


@lru_cache(maxsize=100)
def _rendered(path: Path, _modified_ns: int) -> tuple[str, str]:
    """Title and HTML of a page; the modification time makes a changed file a new cache entry."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{path.name} cannot be read: {error.strerror}") from None
    heading = next((line for line in text.splitlines() if line.startswith("# ")), f"# {path.stem}")
    return heading[2:].strip().strip("`"), markdown_html(text, _link)


def _link(target: str) -> str:
    """Turn links between documentation files into links between help pages."""
    found = _ADDRESS.fullmatch(target)
    return address("help.page", name=found["name"]) + (found["part"] or "") if found else target
