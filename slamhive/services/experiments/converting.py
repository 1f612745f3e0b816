"""Combination files of the published SLAM Hive as experiments of this installation."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.algorithm import Algorithm
from slamhive.experiments.file import parse_experiment
from slamhive.packages.published.combination import Combination, read_combinations
from slamhive.packages.published.experiment import Converted, convert, other_text
from slamhive.packages.published.knowledge import HERE
from slamhive.services.datasets import Catalogue
from slamhive.services.experiments.views import ExperimentSource


def convert_published(
    catalogue: Catalogue, source: ExperimentSource, meanings: Mapping[str, str]
) -> tuple[Converted, ...]:
    """The combinations in ``source``, each as an experiment that the parser of experiments accepts.

    Args:
        catalogue: The algorithms and datasets of this installation.
        source: The published file.
        meanings: What names and numbers of the file mean here, where it is not known.

    Raises:
        InvalidInput: with the line.
        NotFound: for an algorithm that is not here, or a meaning that is not.
    """
    combinations, before = read_combinations(source.text, source.name)
    algorithms = {algorithm.name: algorithm for algorithm in catalogue.algorithms()}
    datasets = [dataset.name for dataset in catalogue.datasets()]
    made: list[Converted] = []
    for combination in combinations:
        notes = [] if made else list(other_text(before))
        algorithm = _algorithm(combination, algorithms, meanings, notes)
        dataset = _dataset(combination, datasets, meanings, notes)
        numbers = {key: name for key, name in meanings.items() if key.isdigit()}
        converted = convert(combination, algorithm, dataset, numbers, notes)
        # Files hold several combinations of one title.
        same = sum(entry.name == converted.name or entry.name.startswith(f"{converted.name[:60]}-") for entry in made)
        if same:
            name = f"{converted.name[:60]}-{same + 1}"
            text = converted.text.replace(f"\nname: {converted.name}\n", f"\nname: {name}\n", 1)
            converted = replace(converted, name=name, text=text)
        parse_experiment(converted.text, f"the experiment made of {combination.title}")
        made.append(converted)
    # A meaning of something that no combination names is a typing mistake.
    named: set[str] = set()
    for entry in combinations:
        named |= {entry.algorithm, entry.dataset, *entry.changes, *(number for tie in entry.tied for number in tie)}
        named |= {number for factors in entry.changes.values() for values in factors.values() for number in values}
    for key in meanings:
        if key not in named and key != HERE:
            raise InvalidInput(
                f"--id {key}={meanings[key]}: the file does not name {key}", f"it names {', '.join(sorted(named))}"
            )
    return tuple(made)


def _algorithm(
    combination: Combination, algorithms: Mapping[str, Algorithm], meanings: Mapping[str, str], notes: list[str]
) -> Algorithm:
    """Find the published algorithm here: as the user says, by its own name, or by the name of the package here.

    The packages here are called ``orb-slam3-stereo`` for ``orb-slam3-ros-stereo``, ``vins-fusion-mono-inertial`` for
    ``vins-fusion-mono-imu``.
    """
    published = combination.algorithm
    name = meanings.get(published) or (
        published if published in algorithms else published.replace("-ros", "").replace("-imu", "-inertial")
    )
    if name in algorithms:
        if name != published and published not in meanings:
            notes.append(f"the algorithm {published} is {name} here; another one: --id {published}=NAME")
        return algorithms[name]
    raise unknown(
        "algorithm",
        meanings.get(published, published),
        list(algorithms),
        f"say which it is here: --id {published}=NAME, or import its folder: slamhive algorithm import FOLDER",
    )


def _dataset(combination: Combination, datasets: Collection[str], meanings: Mapping[str, str], notes: list[str]) -> str:
    """Return the name of the dataset here; its own name if it is not here yet."""
    published = combination.dataset
    name = meanings.get(published, published)
    if name in datasets:
        return name
    fetched = [known for known in datasets if known.endswith(f"_{name}")]
    if len(fetched) == 1 and published not in meanings:
        notes.append(f"the dataset {published} is {fetched[0]} here; another one: --id {published}=NAME")
        return fetched[0]
    notes.append(f"there is no dataset {name} here yet; fetch or import it under this name, or --id {published}=NAME")
    return name
