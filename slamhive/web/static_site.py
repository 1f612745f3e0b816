"""A static site of runs: a table, a page per run, analysis, dataset, algorithm and experiment, all plain files."""

from __future__ import annotations

import json
import shutil
from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from jinja2 import Environment, Template

from slamhive import __version__
from slamhive.analysis.chart import RUN_COLOURS, colour_of, on_dark
from slamhive.analysis.report import Report
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.documents.catalogue import MatchDocument
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import check_name
from slamhive.domain.verdict import Outcome
from slamhive.run_folder.folder import RunFolder
from slamhive.services.accounts import published
from slamhive.services.analysis import report_content, report_environment, script_json
from slamhive.services.claims import badge_svg
from slamhive.services.hive import Hive
from slamhive.services.run_comparison import MOST_RUNS
from slamhive.services.runs import TrackFiles, run_series
from slamhive.services.stored_analyses import REPORT, AnalysisFolder
from slamhive.store.records import AnalysisRecord, AnalysisState, RunRecord
from slamhive.web.assets import PLOTLY_FILE
from slamhive.web.formatting import (
    display_unit,
    duration,
    exact_time,
    mean_text,
    plural,
    significant,
    size,
    thousands,
    value_text,
)
from slamhive.web.presenters import catalogue, rankings
from slamhive.web.presenters.catalogue import ground_truth_figures, match_of_configuration, match_of_run
from slamhive.web.presenters.runs import metric_rows, outcome, parameter_rows, wall_time_s
from slamhive.web.presenters.scenes import dataset_of, reference_of
from slamhive.web.site_runs import (
    FIGURES,
    KeptPages,
    SiteScenes,
    digest_of,
    drawing,
    metric_definitions,
    module_script,
    run_script,
    scene_name,
    stamps,
    table_row,
    table_script,
    thinned,
)

BATCH = 100
_MOST_ANALYSES = 1000
MARK = "site.json"
"""A folder with this file is a site of ours and may be replaced."""
LISTED_WITHOUT_SCRIPTS = 2000
"""Runs that the list names where scripts are off, since it then has neither pages nor a search."""
_RUN_PAGE = "../runs/{}.html"
_TEMPLATES = (
    "published/run.html",
    "published/base.html",
    "published/_view3d.html",
    "published/_drawing.html",
    "published/_views.html",
    "viewer.html",
)
"""Those of the page of a run."""
LOG_BYTES = 16_000
"""Of the end of the log of each run."""
_ASSETS = (
    *("tokens.css", "report.css", "print.css", "plots.js", "report.js", "site.css", "site-list.js", "site-plots.js"),
    *("site-groups.js", "site-protocols.js", "site-compare.js", "curves.js", "planes.js", "figures.css"),
    *("vendor/uplot/uPlot.iife.min.js", "vendor/uplot/uPlot.min.css"),
    *("viewer.css", "viewer.js", "site-load.js", "site-viewer.js"),
)
MODULES = "viewer-modules.js"
"""The asset that holds the modules of the 3D view."""

Progress = Callable[[int, int], None]
"""Receives the number of finished runs and the total."""


@dataclass(frozen=True, slots=True)
class SiteRequest:
    """A site to write: finished runs with these numbers (None: all). ``query`` describes the selection.

    ``unpublished``: also what is not public, if the installation has accounts. ``afresh``: write each page again, also
    of runs that have not changed since the site was written before.
    """

    folder: Path
    run_ids: Sequence[int] | None = None
    title: str = "SLAM Hive"
    query: str = ""
    unpublished: bool = False
    afresh: bool = False


class StaticSite:
    """Writes one site; an existing folder must be an older site or empty."""

    def __init__(self, hive: Hive, request: SiteRequest) -> None:
        self._hive = hive
        self._request = request
        self._algorithms = {algorithm.name: algorithm for algorithm in hive.catalogue.algorithms()}
        self._matches: dict[int, MatchDocument | None] = {}
        self._root = hive.catalogue.project_root
        self._scenes = SiteScenes(hive, list(self._algorithms))
        self._pages = KeptPages(request.folder.absolute() / "runs", afresh=request.afresh)
        templates = [(self._root / "templates" / name).read_text(encoding="utf-8") for name in _TEMPLATES]
        self._of_all = digest_of([request.title, templates, [*self._algorithms]])

    @property
    def kept(self) -> int:
        """The number of pages of runs that were taken over from the site that was there before."""
        return self._pages.kept

    def write(self, progress: Progress) -> int:
        """Write the site to a temporary folder and move it into place; returns its number of runs.

        Raises Conflict if the folder contains something else, InvalidInput if there is no run, or Unavailable.
        """
        folder = self._request.folder.absolute()
        if folder.exists() and not (folder / MARK).is_file() and (not folder.is_dir() or any(folder.iterdir())):
            raise Conflict(f"{folder} is not empty and not a published site", "choose an empty or a new folder")
        with published(self._hive.store, unpublished=self._request.unpublished):
            run_ids = self._run_ids()
            if not run_ids:
                public = "" if self._hive.store.viewer is None else "public "
                raise InvalidInput(f"there are no finished {public}runs to publish", "list runs with: slamhive runs")
            aside = folder.with_name(f".{folder.name}.partial")
            try:
                shutil.rmtree(aside, ignore_errors=True)
                self._write(aside, run_ids, progress)
                if folder.exists():
                    shutil.rmtree(folder)
                aside.rename(folder)
            except OSError as error:
                reason = f"{folder} cannot be written: {error.strerror}"
                raise Unavailable(reason, "check space and permissions") from None
            finally:
                shutil.rmtree(aside, ignore_errors=True)
            return len(run_ids)

    def _run_ids(self) -> list[int]:
        asked = self._request.run_ids
        if asked is None:
            return self._hive.store.read(lambda t: t.archive.ended())
        return self._hive.store.read(lambda t: t.archive.ended_among(asked))

    def _write(self, folder: Path, run_ids: list[int], progress: Progress) -> None:
        for part in ("assets", "runs"):
            (folder / part).mkdir(parents=True)
        shutil.copyfile(PLOTLY_FILE, folder / "assets" / "plotly.min.js")
        for name in _ASSETS:
            shutil.copyfile(self._root / "static" / name, folder / "assets" / Path(name).name)
        (folder / "assets" / MODULES).write_text(module_script(self._root / "static"), encoding="utf-8")
        site = {
            "title": self._request.title,
            "query": self._request.query,
            "runs": len(run_ids),
            "made_at": exact_time(utc_now()),
            "software": __version__,
        }
        environment = _environment(self._root)
        page = environment.get_template("published/run.html")
        rows: list[dict[str, Any]] = []
        measured: set[str] = set()
        for done, run in enumerate(self._runs(run_ids), start=1):
            self._put_run(folder / "runs", page, site, run)
            rows.append(table_row(run))
            measured |= {row.metric.key for needs in (True, False) for row in metric_rows(run, needs_protocol=needs)}
            progress(done, len(run_ids))
        self._pages.write(folder / "runs")
        (folder / "assets" / "runs.js").write_text(table_script(rows), encoding="utf-8")
        whole = self._request.run_ids is None
        CataloguePages(self._hive, environment, site, self._scenes, whole=whole).write(folder, rows)

        # A page and a badge for each file of claims if all runs are published.
        claims = [answer for answer in self._hive.claims.all() if answer.claims] if whole else []
        for answer in claims:
            (folder / "claims").mkdir(exist_ok=True)
            badge = badge_svg(claim.state for claim in answer.claims)
            shown = f"data:image/svg+xml;base64,{b64encode(badge.encode()).decode()}"  # pages load no pictures
            template = environment.get_template("published/claims.html")
            text = template.render(site=site, root="../", answer=answer, run_url=_RUN_PAGE.format, badge=shown)
            (folder / "claims" / f"{answer.name}.html").write_text(text, encoding="utf-8")
            (folder / "claims" / f"{answer.name}.svg").write_text(badge, encoding="utf-8")

        content: dict[str, Any] = {
            "analyses": self._analyses(folder, environment.get_template("published/analysis.html"), site),
            "claims": claims,
            "parts": _parts(rows),
            "rows": rows[:LISTED_WITHOUT_SCRIPTS],
            "most_runs": MOST_RUNS,
            "figures": FIGURES,
            "compared": script_json(_compared(measured)),
        }
        for name in ("index", "compare"):
            text = environment.get_template(f"published/{name}.html").render(site=site, root="", **content)
            (folder / f"{name}.html").write_text(text, encoding="utf-8")
        (folder / MARK).write_text(json.dumps(site, indent=1) + "\n", encoding="utf-8")

    def _analyses(self, folder: Path, page: Template, site: dict[str, Any]) -> list[AnalysisRecord]:
        """Write a page for each listed, finished analysis if all runs are published; returns those analyses."""
        if self._request.run_ids is not None:
            return []
        listed = self._hive.store.read(lambda t: t.analyses.listed(_MOST_ANALYSES))
        done = [record for record in listed if record.state is AnalysisState.DONE]
        for record in done:
            stored = AnalysisFolder(self._hive.settings.analyses_folder / record.token)
            report = Report.stored(stored.read_result(REPORT))
            (folder / "analyses").mkdir(exist_ok=True)
            text = page.render(site=site, root="../", run_url=_RUN_PAGE.format, **report_content(report))
            (folder / "analyses" / f"{record.token}.html").write_text(text, encoding="utf-8")
        return done

    def _runs(self, run_ids: list[int]) -> Iterator[RunRecord]:
        for start in range(0, len(run_ids), BATCH):
            part = run_ids[start : start + BATCH]
            yield from self._hive.store.read(lambda t: t.runs.get_many(part, with_metrics=True))  # noqa: B023

    def _put_run(self, folder: Path, page: Template, site: dict[str, Any], run: RunRecord) -> None:
        """Take over the page of a run, or write it and the script with what it draws."""
        files = RunFolder(self._hive.settings.runs_folder / str(run.id))
        evaluation = [] if run.protocol is None else [files.evaluation(run.protocol.fingerprint)]
        dataset = dataset_of(self._hive, run.dataset)
        reference = reference_of(dataset)
        read = [files.record, files.log, files.profiling, files.frames, files.map, *evaluation]
        parts = [self._of_all, run, self._algorithms.get(run.algorithm), dataset]
        digest = digest_of([*parts, stamps([*read, *([] if reference is None else [reference])])])
        if not self._pages.take(run.id, digest, folder):
            record = self._hive.runs.record(run.id)
            tracks = TrackFiles()
            series = thinned(run_series(run, self._hive.runs.folder(run.id), files=tracks))
            drawn = drawing(run, series, colour_of(run.algorithm, self._algorithms))
            algorithm = self._algorithms.get(run.algorithm)
            has_scene = self._scenes.write_run(folder, run, tracks)
            text = page.render(
                site=site,
                root="../",
                run=run,
                outcome=outcome(run),
                drawn=drawn,
                titles=FIGURES,
                metrics=[
                    ("Accuracy", metric_rows(run, needs_protocol=True)),
                    ("Measured during the run", metric_rows(run, needs_protocol=False)),
                ],
                parameters=parameter_rows(run, algorithm, self._match(run, record)),
                facts=_facts(run, algorithm),
                log=self._hive.runs.log_of(run, LOG_BYTES),
                scene=scene_name(run.id) if has_scene else None,
            )
            (folder / f"{run.id}.html").write_text(text, encoding="utf-8")
            (folder / f"{run.id}.js").write_text(run_script(run, record, drawn, scene=has_scene), encoding="utf-8")

    def _match(self, run: RunRecord, record: dict[str, Any]) -> MatchDocument | None:
        """Like :func:`match_of_run`, but asks only once for each configuration."""
        if "match" in record:
            return match_of_run(self._hive, record, run.configuration_id)
        if run.configuration_id not in self._matches:
            self._matches[run.configuration_id] = match_of_configuration(self._hive, run.configuration_id)
        return self._matches[run.configuration_id]


def _environment(project_root: Path) -> Environment:
    environment = report_environment(project_root)
    words = (plural, duration, exact_time, mean_text, significant, size, thousands, value_text)
    environment.filters |= {function.__name__: function for function in words}
    return environment


def _compared(measured: set[str]) -> dict[str, Any]:
    """The data besides the runs for a comparison in the browser; each colour with the one for dark pages."""
    from slamhive.analysis.statistics import student_factors  # noqa: PLC0415 - scipy takes half a second to load

    return {
        "most": MOST_RUNS,
        "colours": [(colour, on_dark(colour)) for colour in RUN_COLOURS],
        "metrics": metric_definitions(sorted(measured)),
        "students": student_factors(2 * MOST_RUNS),
    }


def _parts(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str, list[tuple[str, int]]]]:
    """Folder and title of the pages, and the number of runs of each experiment, algorithm and dataset."""
    counts = {key: Counter(str(row[key]) for row in rows if row[key] is not None) for key in FOLDERS}
    return [
        (folder, folder.capitalize(), sorted(counts[key].items())) for key, folder in FOLDERS.items() if counts[key]
    ]


def _facts(run: RunRecord, algorithm: Algorithm | None) -> list[tuple[str, object]]:
    """Facts about a run besides metrics and parameters; unknown ones are left out."""
    facts: list[tuple[str, object]] = [
        ("Run", run.uid),
        ("Algorithm", run.algorithm if algorithm is None else f"{run.algorithm}: {algorithm.title}"),
        ("Dataset", run.dataset),
        ("Dataset checksum", run.dataset_checksum),
        ("Pre-processing", "; ".join(map(str, run.variant)) or None),
        ("Experiment", run.experiment),
        ("Repeats run", run.retry_of),
        ("State", run.state.value),
        ("Reason", None if run.reason is None else run.reason.value),
        ("Created", exact_time(run.created_at)),
        ("Started", None if run.started_at is None else exact_time(run.started_at)),
        ("Ended", None if run.ended_at is None else exact_time(run.ended_at)),
        ("Wall time", None if wall_time_s(run) is None else duration(wall_time_s(run))),
        ("Executor", run.executor),
        ("Playback", f"{run.playback.mode.value} × {run.playback.rate:g}"),
        ("Seed", run.seed),
        ("Exit code", run.exit_code),
        ("Version", None if run.version is None else f"{run.version.version} ({run.version.identity})"),
        ("Tags", ", ".join(run.tags) or None),
        ("Note", run.note),
        ("Machine", None if run.host is None else f"{run.host.cpu_model}, {run.host.cpu_count} CPUs, {run.host.os}"),
    ]
    return [(name, value) for name, value in facts if value is not None]


# -- pages about datasets, algorithms and experiments, for all that the runs name --------------------------------------

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
            "dataset",
            place,
            name=name,
            dataset=dataset,
            shares=_shares(rows, "algorithm"),
            mixed=self._hive.current_protocols.mixed(row["id"] for row in rows),
            drawn=drawn,
            scene=scene,
        )

    def _algorithm(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        algorithm = None
        with suppress(SlamHiveError):  # imported runs, or an archive
            algorithm = self._hive.catalogue.algorithm(name)
        self._render("algorithm", place, name=name, algorithm=algorithm, shares=_shares(rows, "dataset"))

    def _experiment(self, place: Path, name: str, rows: Sequence[Row]) -> None:
        status, ranked, answer = None, [], None
        if self._whole:
            with suppress(NotFound):  # public runs of an experiment that is not
                status = self._hive.experiments.status(name)
        if status is not None:
            counts = {axis: len(values) for axis, values in self._hive.experiments.axes(name).items()}
            ranked = rankings.of_experiment(self._hive, status, rankings.naming_axes(counts), by_algorithm=False)
            answer = self._hive.experiments.answer(name) if ranked else None
        shares = {dataset: _shares(found, "algorithm") for dataset, found in sorted(_by(rows, "dataset").items())}
        self._render(
            "experiment",
            place,
            name=name,
            status=status,
            answer=answer,
            rankings=ranked,
            title=None if status is None else rankings.title(status),
            columns=rankings.columns(),
            shares=shares,
            mixed=self._hive.current_protocols.mixed(row["id"] for row in rows),
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
