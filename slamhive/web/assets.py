"""Styles and scripts, served locally at addresses that change with their content."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

import plotly
from flask import Blueprint, Response, current_app, send_file, url_for
from plotly.offline import get_plotlyjs_version

from slamhive.base.errors import NotFound

blueprint = Blueprint("assets", __name__)

PLOTLY_FILE = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
YEAR_S = 365 * 86_400


def asset_url(name: str) -> str:
    """Address of a file in ``static/``. It contains a hash of the content, so browsers can cache the file for long."""
    folder = current_app.static_folder or ""
    path = Path(folder) / name
    return url_for("static", filename=name, v=_content_hash(path, path.stat().st_mtime_ns))


@blueprint.app_context_processor
def _plotly_address() -> dict[str, Any]:
    address = url_for("assets.plotly_js", version=get_plotlyjs_version())
    return {"plotly_url": address, "plotly_style_ids": _plotly_style_ids}


@cache
def _plotly_style_ids() -> tuple[str, ...]:
    """Ids of the style elements that Plotly adds unless they are there: rules for maps, which our pages refuse."""
    return tuple(re.findall(r'getElementById\("([0-9a-f]{64})"\)', PLOTLY_FILE.read_text(encoding="utf-8")))


@blueprint.get("/assets/plotly-<version>.min.js")
def plotly_js(version: str) -> Response:
    """Plotly.js from the installed package."""
    if version != get_plotlyjs_version():
        raise NotFound(f"plotly.js {version} is not installed", "reload the page")
    response = send_file(PLOTLY_FILE, mimetype="text/javascript", max_age=YEAR_S)
    response.cache_control.immutable = True
    return response


@cache
def _content_hash(path: Path, _modified_ns: int) -> str:
    """Hash of the content; the modification time makes an edited file a new cache entry."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
