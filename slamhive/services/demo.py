"""The demo: the synthetic room, and a first experiment on it with the algorithms that can be run here."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from slamhive.base import strict_yaml
from slamhive.base.errors import NotFound
from slamhive.domain.sensors import SensorKind
from slamhive.executors.base import ImageMissing
from slamhive.experiments.file import parse_experiment
from slamhive.recordings.room import RoomOptions
from slamhive.services.experiments import ExperimentSource

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

FILE = "docs/examples/room-demo.yaml"
DATASET = "room"
SEED = 1
SECONDS = 15.0
"""Length of the recording, where nobody asks for another."""

Progress = Callable[[float, str], None]


def demo_algorithms(hive: Hive) -> list[str]:
    """The algorithms of the demo, whether they can be run here or not."""
    text = (hive.catalogue.project_root / FILE).read_text(encoding="utf-8")
    return [str(name) for name in parse_experiment(text, FILE).algorithms.values]


def is_rendered(hive: Hive, seconds: float) -> bool:
    """Tell if the room is there, and as long as it is to be."""
    try:
        return abs(hive.catalogue.dataset(DATASET).duration_s - seconds) < 0.5
    except NotFound:
        return False


def render(hive: Hive, seconds: float, progress: Progress) -> None:
    """Render the room in place of the one that is there."""
    hive.catalogue.render_room(RoomOptions(name=DATASET, duration_s=seconds, seed=SEED), progress, replace=True)


def demo_source(hive: Hive, algorithms: Sequence[str], executor: str) -> ExperimentSource:
    """The experiment with ``algorithms``, under a name that goes with them, with the file and with the data."""
    content = strict_yaml.parse((hive.catalogue.project_root / FILE).read_text(encoding="utf-8"), FILE)
    heard = {entry.kind for name in algorithms for entry in hive.catalogue.algorithm(name).inputs}
    left_out = () if SensorKind.CAMERA in heard else ("steps", "linked", "where")
    kept = {key: value for key, value in content.items() if key not in left_out}
    parts = [hive.catalogue.dataset(DATASET).checksum, executor, *algorithms, strict_yaml.dump(kept)]
    name = f"{content['name']}-{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:6]}"
    return ExperimentSource(strict_yaml.dump({**kept, "name": name, "algorithms": list(algorithms)}), FILE)


def start_demo(hive: Hive, progress: Progress) -> str:
    """Build what the demo needs, render the room and start the experiment; its name. A worker does the runs.

    Raises ImageMissing if none of its algorithms can be run here.
    """
    hive.check_writable()
    executor, _ = hive.executors.default()
    chosen = hive.executors.get(executor)
    asked = demo_algorithms(hive)
    packages = {algorithm: hive.catalogue.algorithm(algorithm).package.name for algorithm in asked}
    names = list(dict.fromkeys(packages.values()))
    steps = len(names) + 2
    refusals: dict[str, ImageMissing] = {}
    for place, name in enumerate(names):
        package = hive.catalogue.package(name)

        def line(text: str, done: float = place / steps, name: str = name) -> None:
            progress(done, f"building {name}: {text[:80]}")

        line("begins")
        try:
            hive.versions.register(chosen, package, chosen.build(package, line))
        except ImageMissing as error:
            refusals[name] = error
    algorithms = [algorithm for algorithm in asked if packages[algorithm] not in refusals]
    if not algorithms:
        why = "; ".join(f"{name}: {error.message}" for name, error in refusals.items())
        raise ImageMissing(f"none of the demo's algorithms can be run on this machine ({why})", "slamhive doctor helps")
    hive.evaluations.prepare(lambda text: progress(len(names) / steps, f"building the evaluation: {text[:80]}"))
    if not is_rendered(hive, SECONDS):
        began = (len(names) + 1) / steps
        render(hive, SECONDS, lambda done, text: progress(began + done / steps, f"rendering the room: {text}"))
    return hive.experiments.start(demo_source(hive, algorithms, executor), executor).name
