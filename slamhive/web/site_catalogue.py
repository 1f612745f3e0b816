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

from slamhive.analysis.colours import OKABE_ITO
from slamhive.domain.dataset import Dataset
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import check_name
from slamhive.errors import NotFound, SlamHiveError
from slamhive.services.datasets import ground_truth_motion
from slamhive.services.experiments import ExperimentStatus
from slamhive.services.hive import Hive
from slamhive.services.reports import script_json
from slamhive.services.runs import read_dataset_path
from slamhive.web.figures import best_plane, motion_figures, path_figures
from slamhive.web.formatting import display_unit, significant
from slamhive.web.presenters import catalogue, rankings
from slamhive.web.presenters.experiments import varying

FOLDERS = {"experiment": "experiments", "algorithm": "algorithms", "dataset": "datasets"}
"""Where the pages lie, by the column of the list that names them."""
ERROR = "ate.rmse"
_LARGEST_EXPERIMENT = 5000
_POINTS = 600

Row = Mapping[str, Any]
"""A row of the list of runs, see :func:`slamhive.web.site_runs.table_row`."""


@dataclass(frozen=True, slots=True)
class Share:
    """The runs of one algorithm on one dataset; ``name`` is the one that the page is not about.

    ``error`` is the median error of the succeeded runs as text, or why there is none.
    """

    name: str
    runs: int
    succeeded: int
    error: str


class CataloguePages:
    """Writes the pages of one site.

    Args:
        hive: Catalogue and experiments; its store shows only what is published.
        environment: Templates.
        site: What each page says of the site.
        whole: All runs are published. Rankings use every run of an experiment, so a part of them has none.
    """

    def __init__(self, hive: Hive, environment: Environment, site: Mapping[str, Any], *, whole: bool) -> None:
        self._hive = hive
        self._environment = environment
        self._site = site
        self._whole = whole

    def write(self, folder: Path, rows: Sequence[Row]) -> None:
        """Write a page for each dataset, algorithm and experiment that a run names."""
        makers = {"dataset": self._dataset, "algorithm": self._algorithm, "experiment": self._experiment}
        for column, make in makers.items():
            by_name: dict[str, list[Row]] = defaultdict(list)
            for row in rows:
                if row[column] is not None:
                    by_name[row[column]].append(row)
            for name, its_rows in by_name.items():
                (folder / FOLDERS[column]).mkdir(exist_ok=True)
                make(folder / FOLDERS[column] / check_name(column, name), name, its_rows)

    def _dataset(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        dataset = None
        with suppress(SlamHiveError):  # runs of an archive may have none
            dataset = self._hive.catalogue.dataset(name)
        drawn = None if dataset is None else _drawing(dataset)
        if drawn is not None:
            script = f"window.slamhiveDraw({script_json(drawn)});\n"
            place.with_name(f"{place.name}.js").write_text(script, encoding="utf-8")
        self._render("dataset", place, name=name, dataset=dataset, shares=_shares(rows, "algorithm"), drawn=drawn)

    def _algorithm(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        algorithm = None
        with suppress(SlamHiveError):  # imported runs, or an archive
            algorithm = self._hive.catalogue.algorithm(name)
        self._render("algorithm", place, name=name, algorithm=algorithm, shares=_shares(rows, "dataset"))

    def _experiment(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        status = None
        if self._whole:
            with suppress(NotFound):  # public runs of an experiment that is not
                status = self._hive.experiments.status(name)
        datasets = dict.fromkeys(sorted(row["dataset"] for row in rows))
        shares = {name: _shares([row for row in rows if row["dataset"] == name], "algorithm") for name in datasets}
        self._render(
            "experiment",
            place,
            name=name,
            status=status,
            rankings=[] if status is None else self._rankings(status),
            title=None if status is None else rankings.title(status),
            columns=rankings.columns(),
            shares=shares,
        )

    def _rankings(self, status: ExperimentStatus) -> list[rankings.RankingView]:
        """As on the page of the experiment; none for one that is too large."""
        if status.cells > _LARGEST_EXPERIMENT:
            return []
        experiments = self._hive.experiments
        counts = {axis: len(values) for axis, values in experiments.axes(status.name).items()}
        shown = [axis for axis in counts if axis in {"algorithm", "dataset", *varying(counts)}]
        installed = [algorithm.name for algorithm in self._hive.catalogue.algorithms()]
        return rankings.views(experiments.rankings(status.name), shown, installed)

    def _render(self, kind: str, place: Path, **content: Any) -> None:
        template = self._environment.get_template(f"published/{kind}.html")
        unit = display_unit(CATALOGUE[ERROR]).unit
        text = template.render(site=self._site, root="../", catalogue=catalogue, error_unit=unit, **content)
        place.with_name(f"{place.name}.html").write_text(text, encoding="utf-8")


def _drawing(dataset: Dataset) -> dict[str, Any] | None:
    """The path of the ground truth, its speed and angular rate; None without one that can be read."""
    track = read_dataset_path(dataset)
    if dataset.groundtruth is None or track is None:
        return None
    motion = ground_truth_motion(dataset)
    positions_only = dataset.groundtruth.positions_only
    moving = {} if motion is None else motion_figures(motion, OKABE_ITO[0], positions_only=positions_only)
    path = path_figures(track.thinned(_POINTS), None)["path_3d"]
    reasons = dict.fromkeys(("speed", "angular_rate"), "The ground truth does not say.")
    return {"figures": {"path": path, **moving}, "plane": best_plane(track), "reasons": reasons}


def _shares(rows: Sequence[Row], column: str) -> list[Share]:
    """The runs by the name in ``column``."""
    by_name: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        by_name[row[column]].append(row)
    return [_share(name, found) for name, found in sorted(by_name.items())]


def _share(name: str, rows: Sequence[Row]) -> Share:
    measured = [row for row in rows if row["state"] == "succeeded" and row.get(ERROR) is not None]
    protocols = {row["protocol"] for row in measured}
    if len(protocols) > 1:
        error = "several protocols"
    else:
        error = significant(median(row[ERROR] for row in measured)) if measured else "–"
    return Share(name, len(rows), sum(row["state"] == "succeeded" for row in rows), error)
