"""Pages of a static site about datasets, algorithms and experiments, for all that its runs name."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from jinja2 import Environment

from slamhive.base.errors import NotFound, SlamHiveError
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import check_name
from slamhive.domain.outcome import Outcome
from slamhive.services.analysis import script_json
from slamhive.services.hive import Hive
from slamhive.web.formatting import display_unit, significant
from slamhive.web.presenters import catalogue, rankings
from slamhive.web.presenters.catalogue import ground_truth_figures
from slamhive.web.site_runs import SiteScenes, scene_name

FOLDERS = {"experiment": "experiments", "algorithm": "algorithms", "dataset": "datasets"}
"""Where the pages lie, by the column of the list that names them."""
ERROR = "ate.rmse"
_POINTS = 600

Row = Mapping[str, Any]
"""A row of the list of runs, see :func:`slamhive.web.site_runs.table_row`."""


@dataclass(frozen=True, slots=True)
class Share:
    """The runs of one algorithm on one dataset; ``name`` is the one that the page is not about.

    ``error`` is the median error of the good runs as text, or why there is none.
    """

    name: str
    runs: int
    good: int
    error: str


class CataloguePages:
    """Writes the pages of one site.

    Args:
        hive: Catalogue and experiments; its store shows only what is published.
        environment: Templates.
        site: What each page says of the site.
        scenes: Writes what 3D views show.
        whole: All runs are published. Rankings use every run of an experiment, so a part of them has none.
    """

    def __init__(
        self, hive: Hive, environment: Environment, site: Mapping[str, Any], scenes: SiteScenes, *, whole: bool
    ) -> None:
        self._hive = hive
        self._scenes = scenes
        self._environment = environment
        self._site = site
        self._whole = whole

    def write(self, folder: Path, rows: Sequence[Row]) -> None:
        """Write a page for each dataset, algorithm and experiment that a run names."""
        makers = {"dataset": self._dataset, "algorithm": self._algorithm, "experiment": self._experiment}
        for column, make in makers.items():
            for name, its_rows in _by(rows, column).items():
                (folder / FOLDERS[column]).mkdir(exist_ok=True)
                make(folder / FOLDERS[column] / check_name(column, name), name, its_rows)

    def _dataset(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        dataset = None
        with suppress(SlamHiveError):  # runs of an archive may have none
            dataset = self._hive.catalogue.dataset(name)
        found = None if dataset is None else ground_truth_figures(dataset, most_points=_POINTS, in_space=True)
        drawn = None
        if found is not None:
            # The path is stored once, in 3D; the page makes its planes.
            drawn = {"figures": found["figures"], "plane": found["best_plane"], "reasons": found["reasons"]}
            script = f"window.slamhiveDraw({script_json(drawn)});\n"
            place.with_name(f"{place.name}.js").write_text(script, encoding="utf-8")
        scene = scene_name(name) if dataset is not None and self._scenes.write_dataset(place.parent, dataset) else None
        self._render(
            "dataset", place, name=name, dataset=dataset, shares=_shares(rows, "algorithm"), drawn=drawn, scene=scene
        )

    def _algorithm(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        algorithm = None
        with suppress(SlamHiveError):  # imported runs, or an archive
            algorithm = self._hive.catalogue.algorithm(name)
        self._render("algorithm", place, name=name, algorithm=algorithm, shares=_shares(rows, "dataset"))

    def _experiment(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        status, ranked = None, []
        if self._whole:
            with suppress(NotFound):  # public runs of an experiment that is not
                status = self._hive.experiments.status(name)
        if status is not None:
            counts = {axis: len(values) for axis, values in self._hive.experiments.axes(name).items()}
            ranked = rankings.of_experiment(self._hive, status, rankings.naming_axes(counts), by_algorithm=False)
        shares = {dataset: _shares(found, "algorithm") for dataset, found in sorted(_by(rows, "dataset").items())}
        self._render(
            "experiment",
            place,
            name=name,
            status=status,
            rankings=ranked,
            title=None if status is None else rankings.title(status),
            columns=rankings.columns(),
            shares=shares,
        )

    def _render(self, kind: str, place: Path, **content: Any) -> None:
        template = self._environment.get_template(f"published/{kind}.html")
        unit = display_unit(CATALOGUE[ERROR]).unit
        text = template.render(site=self._site, root="../", catalogue=catalogue, error_unit=unit, **content)
        place.with_name(f"{place.name}.html").write_text(text, encoding="utf-8")


def _shares(rows: Sequence[Row], column: str) -> list[Share]:
    """The runs by the name in ``column``. Algorithms stand side by side, so one protocol must hold for all of them."""
    protocols = {row["protocol"] for row in rows if _is_good(row)}
    mixed = column == "algorithm" and len(protocols) > 1
    return [_share(name, found, mixed=mixed) for name, found in sorted(_by(rows, column).items())]


def _is_good(row: Row) -> bool:
    return row["outcome"] == Outcome.GOOD.label and row.get(ERROR) is not None


def _by(rows: Sequence[Row], column: str) -> dict[str, list[Row]]:
    """{value in ``column``: its rows}, without rows that have none."""
    found: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row[column] is not None:
            found[row[column]].append(row)
    return found


def _share(name: str, rows: Sequence[Row], *, mixed: bool) -> Share:
    measured = [row for row in rows if _is_good(row)]
    protocols = {row["protocol"] for row in measured}
    if measured and (mixed or len(protocols) > 1):
        error = "several protocols"
    else:
        error = significant(median(row[ERROR] for row in measured)) if measured else "–"
    return Share(name, len(rows), sum(row["outcome"] == Outcome.GOOD.label for row in rows), error)
