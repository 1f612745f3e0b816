"""Pages of other packages, in the entry-point group ``slamhive.pages``.

The application factory registers their blueprints after its own. Every rule for requests therefore applies to them:
hosts and origins, CSRF tokens, limits of input, security headers, and who may look at pages and change something.
"""

from __future__ import annotations

from dataclasses import dataclass

from flask import Blueprint, Flask

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.registry import Registry, instances_of
from slamhive.web.access import PLUGIN_PAGES


@dataclass(frozen=True, slots=True)
class PluginPage:
    """A group of pages with one entry in the menu.

    Attributes:
        title: The entry in the menu.
        blueprint: Its name and ``url_prefix`` are its own; its view ``index`` is what the menu leads to.
    """

    title: str
    blueprint: Blueprint


PAGES: Registry[PluginPage] = Registry("web page", "slamhive.pages", instances_of(PluginPage))


def register_pages(app: Flask) -> None:
    """Register the pages of plug-ins; one that does not fit is left out, and named in the log."""
    menu: list[tuple[str, str]] = []
    known = set(app.blueprints)
    for name, page in PAGES:
        try:
            menu.append((_register(app, page.blueprint), page.title))
        except Exception as error:  # noqa: BLE001 - a plug-in can raise anything; the others must go on
            PAGES.drop(name, error)
    app.jinja_env.globals["plugin_menu"] = menu
    app.extensions[PLUGIN_PAGES] = frozenset(app.blueprints) - known


def _register(app: Flask, blueprint: Blueprint) -> str:
    """Register a blueprint unless it would hide pages that are there; the endpoint of its first page."""
    prefix = (blueprint.url_prefix or "").rstrip("/")
    if not prefix.startswith("/"):
        raise InvalidInput(f"its blueprint has the url_prefix {blueprint.url_prefix!r}", "use one such as '/my-page'")
    if blueprint.name in app.blueprints:
        raise Conflict(f"there is a blueprint {blueprint.name!r} already", "give it another name")
    for rule in app.url_map.iter_rules():
        if f"{rule.rule}/".startswith(f"{prefix}/"):
            raise Conflict(f"there are pages below {prefix} already", "use another url_prefix")
    app.register_blueprint(blueprint)
    index = f"{blueprint.name}.index"
    if index not in app.view_functions:
        raise InvalidInput(f"its blueprint has no view {index!r}", "call the view of its first page index")
    return index
