"""The runs of a static site as scripts: pages that are opened from a folder cannot fetch other files.

``runs/<number>.js`` has what the page of a run draws, and what ``compare.html`` puts side by side. ``assets/runs.js``
has the rows of the list.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive import __version__
from slamhive.base.bounds import parse_json_object
from slamhive.base.errors import NotFound, SlamHiveError
from slamhive.domain.dataset import Dataset
from slamhive.domain.metrics import CATALOGUE, Metric, with_unknown
from slamhive.domain.side_by_side import ProtocolUse
from slamhive.domain.verdict import Outcome, outcome_words
from slamhive.run_folder.point_cloud import MapCloud
from slamhive.services.analysis import script_json
from slamhive.services.hive import Hive
from slamhive.services.run_comparison import RunColumn, settings_of
from slamhive.services.runs import RunScene, RunSeries, TrackFiles, path_of
from slamhive.store.records import RunRecord, protocol_uses
from slamhive.trajectory.alignment import IDENTITY, Similarity
from slamhive.web.figures import best_plane, captions, run_figures
from slamhive.web.formatting import display_unit
from slamhive.web.presenters.runs import metric_rows
from slamhive.web.presenters.scenes import (
    TRUTH,
    ShownMap,
    ShownPath,
    cloud_bytes,
    dataset_of,
    is_z_up,
    reference_of,
    run_paths,
    scene_json,
    truth_path,
    truth_paths,
)

POINTS = 600
"""Points per path and per error over time."""
POINTS_OF_USE = 300
"""Points of CPU, memory and latency over time. All that a site has of a run then stays below 100 kB."""
FIGURES = (
    ("path", "Trajectory"),
    ("error", "Position error over time"),
    ("latency", "Latency per frame"),
    ("cpu", "CPU over time"),
    ("memory", "Memory over time"),
)
"""The plots of a run, with their titles."""
_METRICS = ("ate.rmse", "ate.max", "rpe.trans_rmse", "tracked_fraction", "cpu.mean", "ram.max", "duration")
"""First metrics in the table, if any run has them. The pages of runs show all others."""


def thinned(series: RunSeries) -> RunSeries:
    """The part of ``series`` that a site shows."""
    most = {"estimate": POINTS, "groundtruth": POINTS, "error": POINTS}
    most |= dict.fromkeys(("cpu", "memory", "latency"), POINTS_OF_USE)
    known = {name: getattr(series, name) for name in most}
    fewer = {name: entry.thinned(most[name]) for name, entry in known.items() if entry is not None}
    return replace(series, **fewer, dropped_s=series.dropped_s[:: max(1, len(series.dropped_s) // POINTS_OF_USE)])


def drawing(run: RunRecord, series: RunSeries, colour: str) -> dict[str, Any]:
    """The plots of a run, their captions, and why others are missing; planes of the path are made from that in 3D."""
    figures = run_figures(series, run.algorithm, colour, in_space=True)
    shown = series.groundtruth or series.estimate
    texts = captions(series, None if run.protocol is None else run.protocol.label)
    reasons = {"path" if key == "estimate" else key: text for key, text in series.reasons.items()}
    kept = {key: figures[key] for key, _ in FIGURES if key in figures}
    return {
        "figures": kept,
        "plane": None if shown is None else best_plane(shown),
        "captions": texts,
        "reasons": {key: reasons.get(key, "No data for this plot.") for key, _ in FIGURES if key not in kept},
    }


def run_script(run: RunRecord, record: Mapping[str, Any], drawn: Mapping[str, Any], *, scene: bool) -> str:
    """A run as a script: what was measured and set, and its plots.

    Args:
        run: With its metrics.
        record: The content of its ``run.json``.
        drawn: As :func:`drawing` returns it.
        scene: Whether the site has a 3D view of it.
    """
    rows = [row for needs in (True, False) for row in metric_rows(run, needs_protocol=needs)]
    figures = run.metrics or {}
    failed = run.outcome is Outcome.FAILED
    content = {
        "id": run.id,
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "configuration": run.configuration_id,
        "state": state_words(run),
        "failed": failed,
        "rival": RunColumn((run,), (run.id,) if failed else ()).can_be_better,
        "cpu": None if run.host is None else run.host.cpu_model,
        "use": next(map(protocol_use, protocol_uses([run])), None),
        "metrics": {row.metric.key: [figures[row.metric.key], row.cell.text, row.cell.exact] for row in rows},
        "settings": settings_of(run, record),
        "scene": scene,
        **drawn,
    }
    return f"window.slamhiveRun({script_json(content)});\n"


def protocol_use(use: ProtocolUse) -> list[str | None]:
    """A protocol as ``site-protocols.js`` takes it."""
    return [use.fingerprint, use.full_label, None if use.trajectory is None else use.trajectory.value]


def metric_definitions(keys: Sequence[str]) -> list[dict[str, Any]]:
    """Descriptions of the metrics with these keys for a comparison, in the order of the catalogue."""
    return [_definition(metric) for metric in with_unknown(keys)]


def _definition(metric: Metric) -> dict[str, Any]:
    return {
        "key": metric.key,
        "label": metric.label,
        "unit": display_unit(metric).unit,
        "factor": display_unit(metric).factor,
        "better": metric.direction.value,
        "group": metric.group.value if metric.needs_protocol else "measured during the run",
        "accuracy": metric.needs_protocol,
        "definition": metric.definition,
    }


def state_words(run: RunRecord) -> str:
    """The state of a run with its reason."""
    return run.state.value if run.reason is None else f"{run.state.value}: {run.reason.value}"


def table_row(run: RunRecord) -> dict[str, Any]:
    """A row of the list; metrics in their display unit."""
    figures = run.metrics or {}
    return {
        "id": run.id,
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "outcome": outcome_words(run),
        "doubt": None if run.trust is None or not run.trust.doubt else f"{run.trust.doubt}: {run.trust.words}",
        "state": state_words(run),
        "experiment": run.experiment,
        "parameters": ", ".join(f"{key} {value}" for key, value in run.parameters.items()),
        "protocol": None if run.protocol is None else run.protocol.label,
        "use": next(map(protocol_use, protocol_uses([run])), None),
        **{key: figures[key] * display_unit(CATALOGUE[key]).factor for key in _METRICS if key in figures},
    }


def table_script(rows: Sequence[Mapping[str, Any]]) -> str:
    """The list as a script."""
    present = {key for row in rows for key, value in row.items() if value is not None}
    first = ("id", "algorithm", "dataset", "outcome", "doubt")
    last = ("experiment", "parameters", "protocol", "state")
    columns = [
        {"key": key, "label": CATALOGUE[key].label, "unit": display_unit(CATALOGUE[key]).unit}
        if key in CATALOGUE
        else {"key": key, "label": "Run" if key == "id" else key.capitalize(), "unit": ""}
        for key in (*first, *_METRICS, *last)
        if key in present
    ]
    uses = [row["use"] for row in rows]
    known: list[list[str | None]] = []
    for use in uses:
        if use is not None and use not in known:
            known.append(use)
    content = {
        "columns": columns,
        "rows": [[row.get(column["key"]) for column in columns] for row in rows],
        "uses": known,
        "used": [None if use is None else known.index(use) for use in uses],
    }
    return f"window.slamhiveRuns = {script_json(content)};\n"


# -- the 3D views of a static site: scenes, maps and the modules that show them, as scripts ----------------------------

# A page in a folder can neither fetch a file nor load a module. So a script puts data into ``slamhiveData`` under its
# own name, and another one holds the text of the modules, which ``site-viewer.js`` makes modules of.


POSES = 600
"""Of each path, as in the plots of a site."""
MAP_POINTS = 20_000
"""Of each map. The scripts of a run stay below 0.5 MB."""
ENTRY = "viewer/main.js"
_IMPORT = re.compile(r"""from\s*((["'])(\.{1,2}/[^"']+)\2)""")


def scene_name(key: object) -> str:
    """The file of a scene; ``key`` is the number of a run or the name of a dataset."""
    return f"{key}.scene.js"


def map_name(key: object) -> str:
    """The file of the points of a map."""
    return f"{key}.map.js"


def module_script(static: Path) -> str:
    """All modules of the 3D view: name, text and imports of each, after those that it imports.

    Args:
        static: The project's folder of scripts.
    """
    found: dict[str, tuple[str, dict[str, str]]] = {}

    def read(name: str) -> None:
        text = (static / name).read_text(encoding="utf-8")
        imports = {}
        for quoted, _, relative in _IMPORT.findall(text):
            other = (static / name).parent.joinpath(relative).resolve().relative_to(static.resolve()).as_posix()
            imports[quoted] = other
            if other not in found:
                read(other)
        found[name] = (text, imports)

    read(ENTRY)
    modules = [(name, text, imports) for name, (text, imports) in found.items()]
    return f"window.slamhiveModules = {script_json(modules)};\n"


class SiteScenes:
    """Writes the scripts of scenes and maps.

    Args:
        hive: Its store shows only what is published.
        algorithms: The names of all algorithms, on which colours depend.
    """

    def __init__(self, hive: Hive, algorithms: Sequence[str]) -> None:
        self._hive = hive
        self._algorithms = algorithms

    def write_run(self, folder: Path, run: RunRecord, tracks: TrackFiles) -> bool:
        """Write the scene of a run, and its map; whether there is anything to show."""
        scene = self._hive.runs.scene(run, tracks=tracks)
        paths = [*run_paths(run.algorithm, scene, self._algorithms), *truth_paths(scene)]
        dataset = dataset_of(self._hive, run.dataset)
        cloud, why_not = self._cloud(run, scene, dataset)
        if not paths and cloud is None and not why_not:
            return False
        shown = None if cloud is None else _write_map(folder, run.id, cloud, scene.to_scene or IDENTITY)
        z_up, notes = scene.aligned and is_z_up(dataset), [*scene.reasons, *why_not]
        _write(folder, run.id, scene_json(f"Run {run.id}", _thinned(paths), shown, notes, z_up=z_up))
        return True

    def write_dataset(self, folder: Path, dataset: Dataset) -> bool:
        """Write the ground truth of a dataset, and its reference map; whether there is a ground truth."""
        path = None if dataset.groundtruth_path is None else path_of(TRUTH, dataset.groundtruth_path)
        if path is None:
            return False
        reference, views = reference_of(dataset), self._hive.map_views
        cloud, why_not = (None, []) if reference is None else _read(lambda: views.thinned(reference, reference.name))
        shown = None if cloud is None else _write_map(folder, dataset.name, cloud, IDENTITY)
        paths, z_up = _thinned([truth_path(path)]), is_z_up(dataset)
        _write(folder, dataset.name, scene_json(f"Dataset {dataset.name}", paths, shown, why_not, z_up=z_up))
        return True

    def _cloud(self, run: RunRecord, scene: RunScene, dataset: Dataset | None) -> tuple[MapCloud | None, list[str]]:
        """The map of a run, with its error where there is a reference map; None, and why, if it cannot be shown."""
        to_scene, views = scene.to_scene, self._hive.map_views
        if to_scene is None:
            return None, []
        path, reference = self._hive.runs.folder(run.id).map, reference_of(dataset) if scene.aligned else None
        if reference is None:
            return _read(lambda: views.thinned(path, path.name))
        compared, _ = _read(lambda: views.compared(path, path.name, reference, to_scene))
        return (compared, []) if compared is not None else _read(lambda: views.thinned(path, path.name))


def _read(read: Callable[[], MapCloud]) -> tuple[MapCloud | None, list[str]]:
    """A map; None without one, with the reason if there is one that cannot be shown."""
    try:
        return read(), []
    except NotFound:
        return None, []
    except SlamHiveError as error:
        return None, [f"The map is not shown: {error}."]


def _thinned(paths: Sequence[ShownPath]) -> list[ShownPath]:
    return [ShownPath(shown.name, shown.colour, shown.path.thinned(POSES)) for shown in paths]


def _write_map(folder: Path, key: object, cloud: MapCloud, to_scene: Similarity) -> ShownMap:
    some = cloud.some(MAP_POINTS)
    text = base64.b64encode(cloud_bytes(some, to_scene)).decode("ascii")
    (folder / map_name(key)).write_text(_script(map_name(key), text), encoding="utf-8")
    # The page loads more only if a map has more points than it shows, and this script is all that there is.
    return ShownMap(map_name(key), len(some.positions_m), some.errors_m is not None)


def _write(folder: Path, key: object, content: Mapping[str, Any]) -> None:
    (folder / scene_name(key)).write_text(_script(scene_name(key), content), encoding="utf-8")


def _script(name: str, content: Any) -> str:
    return f"(window.slamhiveData ??= {{}})[{script_json(name)}] = {script_json(content)};\n"


# -- pages that an older site has already: those of runs that have not changed are taken over --------------------------

PAGES = "pages.json"
"""The file beside the pages that says of what each was made."""
LAYOUT = 3
"""Counts up when pages of runs of this version have another content than those of the commits before."""
_MOST_BYTES = 500_000_000
_DIGITS = 32


def digest_of(parts: Iterable[object]) -> str:
    """A digest of all parts."""
    text = "\0".join([__version__, str(LAYOUT), *map(str, parts)])
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def stamps(paths: Iterable[Path]) -> Sequence[tuple[int, int]]:
    """Modification time (ns) and size (bytes) of each file, which change with it; zeros for one that is not there."""
    found = []
    for path in paths:
        try:
            status = path.stat()
        except OSError:
            found.append((0, 0))
        else:
            found.append((status.st_mtime_ns, status.st_size))
    return found


class KeptPages:
    """The pages of runs of an older site.

    Args:
        folder: With the pages; it need not exist.
        afresh: Take over none of them.
    """

    def __init__(self, folder: Path, *, afresh: bool) -> None:
        self._folder = folder
        self._known: Mapping[str, object] = {}
        # An older site without digests that can be read has no page to take over.
        with suppress(OSError, SlamHiveError):
            if not afresh and (folder / PAGES).stat().st_size <= _MOST_BYTES:
                self._known = parse_json_object((folder / PAGES).read_bytes(), PAGES)
        self._digests: dict[str, str] = {}
        self.kept = 0

    def take(self, run_id: int, digest: str, target: Path) -> bool:
        """Put the page of a run into ``target`` if it was made of the same; whether it was."""
        self._digests[str(run_id)] = digest
        if self._known.get(str(run_id)) != digest:
            return False
        for name in (f"{run_id}.html", f"{run_id}.js", scene_name(run_id), map_name(run_id)):
            if (self._folder / name).is_file():
                _link(self._folder / name, target / name)
        taken = (target / f"{run_id}.html").is_file()
        self.kept += taken
        return taken

    def write(self, target: Path) -> None:
        """Say of what each page was made."""
        (target / PAGES).write_text(json.dumps(self._digests) + "\n", encoding="utf-8")


def _link(source: Path, target: Path) -> None:
    """The same file twice; a copy where a file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
