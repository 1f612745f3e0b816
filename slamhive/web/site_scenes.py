"""The 3D views of a static site: scenes, maps and the modules that show them, as scripts.

A page in a folder can neither fetch a file nor load a module. So a script puts data into ``slamhiveData`` under its own
name, and another one holds the text of the modules, which ``site-viewer.js`` makes modules of.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from slamhive.domain.dataset import Dataset
from slamhive.errors import NotFound, SlamHiveError
from slamhive.runs.point_cloud import PointCloud
from slamhive.services.hive import Hive
from slamhive.services.reports import script_json
from slamhive.services.runs import RunScene, path_of
from slamhive.store.records import RunRecord
from slamhive.trajectory.alignment import IDENTITY, Similarity
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

    def write_run(self, folder: Path, run: RunRecord) -> bool:
        """Write the scene of a run, and its map; whether there is anything to show."""
        scene = self._hive.runs.scene(run.id)
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

    def _cloud(self, run: RunRecord, scene: RunScene, dataset: Dataset | None) -> tuple[PointCloud | None, list[str]]:
        """The map of a run, with its error where there is a reference map; None, and why, if it cannot be shown."""
        to_scene, views = scene.to_scene, self._hive.map_views
        if to_scene is None:
            return None, []
        path, reference = self._hive.runs.folder(run.id).map, reference_of(dataset) if scene.aligned else None
        if reference is None:
            return _read(lambda: views.thinned(path, path.name))
        compared, _ = _read(lambda: views.compared(path, path.name, reference, to_scene))
        return (compared, []) if compared is not None else _read(lambda: views.thinned(path, path.name))


def _read(read: Callable[[], PointCloud]) -> tuple[PointCloud | None, list[str]]:
    """A map; None without one, with the reason if there is one that cannot be shown."""
    try:
        return read(), []
    except NotFound:
        return None, []
    except SlamHiveError as error:
        return None, [f"The map is not shown: {error}."]


def _thinned(paths: Sequence[ShownPath]) -> list[ShownPath]:
    return [ShownPath(shown.name, shown.colour, shown.path.thinned(POSES)) for shown in paths]


def _write_map(folder: Path, key: object, cloud: PointCloud, to_scene: Similarity) -> ShownMap:
    some = cloud.some(MAP_POINTS)
    text = base64.b64encode(cloud_bytes(some, to_scene)).decode("ascii")
    (folder / map_name(key)).write_text(_script(map_name(key), text), encoding="utf-8")
    # The page loads more only if a map has more points than it shows, and this script is all that there is.
    return ShownMap(map_name(key), len(some.positions_m), some.errors_m is not None)


def _write(folder: Path, key: object, content: Mapping[str, Any]) -> None:
    (folder / scene_name(key)).write_text(_script(scene_name(key), content), encoding="utf-8")


def _script(name: str, content: Any) -> str:
    return f"(window.slamhiveData ??= {{}})[{script_json(name)}] = {script_json(content)};\n"
