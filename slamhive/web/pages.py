"""The frame around every page, and the pages of other packages, in the entry-point group ``slamhive.pages``.

The application factory registers their blueprints after its own. Every rule for requests therefore applies to them:
hosts and origins, CSRF tokens, limits of input, security headers, and who may look at pages and change something.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from flask import Blueprint, Flask

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.accounts import Action, Caller
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


# -- the frame around every page: the sections of the rail, and what the menu *New* offers -----------------------------


@dataclass(frozen=True, slots=True)
class Section:
    """A group of pages with an entry in the rail.

    Attributes:
        endpoint: Its first page.
        title: The words of the entry.
        group: The heading above the entry; empty for none.
        key: The letter that leads there after ``g``; empty for none.
        blueprints: Those whose pages belong to it, besides that of its first page.
    """

    endpoint: str
    title: str
    group: str = ""
    key: str = ""
    blueprints: tuple[str, ...] = ()

    @property
    def icon(self) -> str:
        """The name of its picture."""
        return self.endpoint.partition(".")[0]

    def holds(self, endpoint: str | None) -> bool:
        """Tell if the page of ``endpoint`` belongs to it."""
        blueprint = (endpoint or "").rpartition(".")[0]
        return blueprint in (self.icon, *self.blueprints)


LIBRARY = "Library"
CLAIMS = Section("claims.index", "Claims")
CHALLENGES = Section("challenges.index", "Challenges")
MACHINES = Section("nodes.index", "Machines", key="m")
SECTIONS = (
    Section("dashboard.index", "Home", key="h"),
    Section("experiments.index", "Experiments", key="e", blueprints=("experiment_builder", "questions")),
    Section(
        "runs.index",
        "Runs",
        key="r",
        blueprints=("start", "compare", "trash", "search_actions", "selected_runs", "searches"),
    ),
    Section("analyses.index", "Reports", key="a"),
    CLAIMS,
    Section("datasets.index", "Datasets", LIBRARY, "d", ("public_datasets",)),
    Section("algorithms.index", "Algorithms", LIBRARY, "l"),
    Section("configurations.index", "Configurations", LIBRARY, "c"),
    CHALLENGES,
    MACHINES,
)


def sections(caller: Caller, *, challenges: bool, claims: bool) -> Iterator[Section]:
    """The sections that ``caller`` sees. Visitors of a view-only server see no machines.

    Args:
        caller: Who looks.
        challenges: Whether there are challenges.
        claims: Whether claims have been checked.
    """
    visitor = caller.role is None and Action.CHANGE not in caller.may
    left_out = {CHALLENGES: not challenges, CLAIMS: not claims, MACHINES: visitor}
    for section in SECTIONS:
        if not left_out.get(section, False):
            yield section


def section_of(endpoint: str | None) -> Section | None:
    """The section that a page belongs to; None for pages such as help, and those of plug-ins."""
    return next((section for section in SECTIONS if section.holds(endpoint)), None)


@dataclass(frozen=True, slots=True)
class NewThing:
    """One entry of the menu *New*: the page that makes it, its name, and what it is."""

    endpoint: str
    title: str
    words: str
    needs: Action = Action.CHANGE


NEW_THINGS = (
    NewThing("start.form", "Run", "one algorithm on one dataset"),
    NewThing("experiment_builder.new", "Experiment", "algorithms × datasets × values"),
    NewThing("analyses.new", "Report", "plots and tables of runs", Action.ANALYSE),
    NewThing("imports.index", "Import", "datasets, algorithms, trajectories"),
)


def new_things(caller: Caller) -> list[NewThing]:
    """Things that ``caller`` may make."""
    return [entry for entry in NEW_THINGS if entry.needs in caller.may]
