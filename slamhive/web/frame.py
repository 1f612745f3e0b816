"""The frame around every page: the sections of the rail, and what the menu *New* offers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from slamhive.domain.accounts import Action, Caller


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
CHALLENGES = Section("challenges.index", "Challenges")
MACHINES = Section("nodes.index", "Machines", key="m")
SECTIONS = (
    Section("dashboard.index", "Home", key="h"),
    Section("experiments.index", "Experiments", key="e", blueprints=("experiment_builder",)),
    Section(
        "runs.index",
        "Runs",
        key="r",
        blueprints=("start", "compare", "trash", "search_actions", "selected_runs", "searches"),
    ),
    Section("analyses.index", "Reports", key="a"),
    Section("datasets.index", "Datasets", LIBRARY, "d", ("public_datasets",)),
    Section("algorithms.index", "Algorithms", LIBRARY, "l"),
    Section("configurations.index", "Configurations", LIBRARY, "c"),
    CHALLENGES,
    MACHINES,
)


def sections(caller: Caller, *, challenges: bool) -> Iterator[Section]:
    """The sections that ``caller`` sees. Visitors of a view-only server see no machines."""
    visitor = caller.role is None and Action.CHANGE not in caller.may
    for section in SECTIONS:
        if (section is CHALLENGES and not challenges) or (section is MACHINES and visitor):
            continue
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
