"""Load the table of an analysis from the store: facts, parameters, variants and the required metrics."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from slamhive.analysis.analysis_file import Analysis
from slamhive.analysis.plot_types import RunLatency, RunTrack, RunUsage
from slamhive.analysis.table import FACTS, UNDISTURBED, RunTable, make_table
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.model import load
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import ATTRIBUTE_KINDS, Dataset
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import SensorKind
from slamhive.domain.trust import DisturbanceKind
from slamhive.domain.verdict import EVIDENCE, FailureRule
from slamhive.experiments.binding import seen_dataset
from slamhive.filters.fields import VARIANT_PREFIX, Vocabulary
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.played_frames import first_frame_s, read_played_frames
from slamhive.run_folder.untrusted import read_numeric_columns
from slamhive.services.runs import LIMIT_BYTES, gap_of, latency_of, read_track
from slamhive.store import Store
from slamhive.store.records import EvaluationState

# Files of run folders: evaluated trajectories and sampled resource usage.


class StoredRunFiles:
    """Reads the folders of runs; see :class:`slamhive.analysis.plot_types.base.RunFiles`.

    Args:
        runs_folder: Where run folders lie.
        protocols: The fingerprint of the evaluation that each run is shown with.
    """

    def __init__(self, runs_folder: Path, protocols: Mapping[int, str]) -> None:
        self._runs_folder = runs_folder
        self._protocols = protocols

    def track(self, run_id: int) -> RunTrack | None:
        """The evaluated trajectory of a run; None if its evaluation wrote no files."""
        fingerprint = self._protocols.get(run_id)
        if fingerprint is None:
            return None
        evaluation = self._folder(run_id).evaluation(fingerprint)
        estimate = read_track(evaluation / "traj.tum", gap_of(evaluation))
        reference = read_track(evaluation / "groundtruth.tum")
        if estimate is None or reference is None:
            return None
        errors = read_numeric_columns(evaluation / "errors.csv", ("timestamp", "ape_m"), LIMIT_BYTES)
        errors = errors[np.isfinite(errors).all(axis=1)]
        errors_m = np.full(len(estimate.times_s), np.nan)
        if len(errors):
            errors_m = np.interp(estimate.times_s, errors[:, 0], errors[:, 1])
        return RunTrack(
            run_id=run_id,
            stamps_s=estimate.times_s,
            positions_m=estimate.positions_m,
            errors_m=errors_m,
            pieces=estimate.pieces,
            reference_stamps_s=reference.times_s,
            reference_positions_m=reference.positions_m,
        )

    def usage(self, run_id: int, startup_s: float | None) -> RunUsage | None:
        """The sampled usage of a run; None if it was not sampled."""
        folder = self._folder(run_id)
        rows = read_numeric_columns(folder.profiling, ("time", "cpu_usage", "memory_usage"), LIMIT_BYTES)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) == 0:
            return None
        frames = None if startup_s is None else read_played_frames(folder.frames)
        clock = None if frames is None else frames.clock(startup_s)
        return RunUsage(run_id, rows[:, 0], rows[:, 1], rows[:, 2], clock)

    def latency(self, run_id: int) -> RunLatency | None:
        """The latency of each frame; None if the algorithm does not report when it finishes one."""
        frames = read_played_frames(self._folder(run_id).frames)
        found = None if frames is None else latency_of(frames, 0.0)
        return None if found is None else RunLatency(run_id, found.times_s, found.values)

    def first_frame_s(self, run_id: int) -> float | None:
        """The timestamp of the first frame that was played; None if the run does not say."""
        return first_frame_s(self._folder(run_id).frames)

    def _folder(self, run_id: int) -> RunFolder:
        return RunFolder(self._runs_folder / str(run_id))


# Images and IMU messages as a run saw them: the sensors of its dataset, as its variant leaves them.

COLUMNS = ("image_width", "image_height", "image_rate_hz", "imu_rate_hz")
Seen = tuple[float | None, ...]
"""The values of :data:`COLUMNS`; None where the dataset has no such sensor or does not state the property."""
_UNKNOWN: Seen = (None,) * len(COLUMNS)


def seen_columns(
    names: Sequence[str], variants: Sequence[Any], datasets: Mapping[str, Dataset]
) -> dict[str, list[float | None]]:
    """The columns of :data:`COLUMNS`, for runs on datasets with these names and stored variants.

    They describe the first camera and the first IMU. Values are None for datasets that are not here any more.
    """

    @cache
    def seen(name: str, variant: str) -> Seen:
        dataset = datasets.get(name)
        if dataset is None:
            return _UNKNOWN
        try:
            return _values(seen_dataset(RegisteredSteps(), dataset, load(Variant, json.loads(variant))))
        except SlamHiveError:
            return _UNKNOWN  # the dataset was edited since, so that its old variants fit it no longer

    rows = [seen(name, json.dumps(variant or [])) for name, variant in zip(names, variants, strict=True)]
    return {column: [row[place] for row in rows] for place, column in enumerate(COLUMNS)}


def _values(dataset: Dataset) -> Seen:
    camera, imu = (next(iter(dataset.of_kind(kind)), None) for kind in (SensorKind.CAMERA, SensorKind.IMU))
    size = [None if camera is None else camera.calibration.get(key) for key in ("width", "height")]
    return (
        *(float(value) if isinstance(value, int | float) else None for value in size),
        None if camera is None else camera.rate_hz,
        None if imu is None else imu.rate_hz,
    )


Columns = dict[str, list[Any]]
ById = dict[str, dict[int, Any]]

_ENDINGS = {"hz": "Hz", "s": "s", "m": "m", "px": "px", "rad": "rad"}


@dataclass(frozen=True, slots=True)
class TableRequest:
    """Selection of runs and metrics; ``protocol`` is a fingerprint, None for each run's current protocol."""

    run_ids: Sequence[int]
    keys: Collection[str]
    protocol: str | None
    rule: FailureRule
    exclude_disturbed: bool = False


def load_table(
    store: Store, request: TableRequest, sensors: Mapping[str, str], datasets: Mapping[str, Dataset]
) -> RunTable:
    """The table of the requested runs.

    Args:
        store: The database.
        request: Which runs and metrics.
        sensors: The sensor setup of each installed algorithm, by name.
        datasets: The datasets that are here, by name.

    Raises:
        NotFound: no run was evaluated under the protocol.
        InvalidInput: none of the runs has been evaluated.
    """
    metrics = sorted({key for key in request.keys if key in CATALOGUE} | set(EVIDENCE))

    def work(transaction: Any) -> tuple[Columns, ById, ById, ById, dict[str, str]]:
        source = transaction.run_table
        facts = source.facts(request.run_ids)
        figures = {key: source.metric(key, facts["run_id"], request.protocol) for key in metrics}
        facts = _evaluated(source, facts, figures["ate.rmse"], request.protocol)
        parameters = source.parameters(facts["configuration_id"])
        return facts, parameters, source.axes(facts["run_id"]), figures, source.units()

    facts, parameters, axes, figures, units = store.read(work)
    not_evaluated = len(set(request.run_ids)) - len(facts["run_id"])
    # The column for searches holds what disturbed a run; None if that is unknown.
    facts["disturbed"] = [
        None if kinds is None else ", ".join(DisturbanceKind(kind).label for kind in kinds.split()) or UNDISTURBED
        for kinds in facts.pop("disturbed_by")
    ]
    selected = len(facts["run_id"])
    if request.exclude_disturbed:
        kept = [words is None or words == UNDISTURBED for words in facts["disturbed"]]
        if not any(kept) and kept:
            raise InvalidInput(
                f"all {len(kept)} runs were measured on a disturbed machine",
                "leave out exclude_disturbed, or repeat them",
            )
        facts = {name: list(compress(column, kept)) for name, column in facts.items()}
    variants = facts.pop("variant")
    facts["variant"] = ["; ".join(map(str, load(Variant, entry))) if entry else None for entry in variants]
    facts |= seen_columns(facts["dataset"], variants, datasets)
    facts["sensors"] = [sensors.get(name) for name in facts["algorithm"]]
    own = {name: values for name, values in parameters.items() if name not in COLUMNS}  # what sensors gave is known
    columns = _by_id(own, facts["configuration_id"]) | _variant_columns(variants)
    new = {name: values for name, values in axes.items() if name not in columns and name not in facts}
    columns |= _by_id(new, facts["run_id"])
    known = {name: _unit(name, units) for name in columns if name not in new}
    known |= {name: known.get(_source(columns[name], columns, known), "") for name in new}
    words = [datasets[name].attributes if name in datasets else () for name in facts["dataset"]]
    values = _by_id(figures, facts["run_id"])
    table = make_table(facts, columns, values, request.rule, installed=sensors, attributes=words)
    # Leave out the step options if all runs with steps come from experiments: their axes show the same.
    named = {run_id for values_of_axis in new.values() for run_id in values_of_axis}
    covered = all(run_id in named for run_id, entry in zip(facts["run_id"], variants, strict=True) if entry)
    repeated = set(_variant_columns(variants)) if covered else set()
    left_out = selected - len(facts["run_id"]) if request.exclude_disturbed else None
    fingerprints = {entry for entry in facts["protocol"] if entry is not None}
    return replace(
        table.described(known, repeated),
        not_evaluated=not_evaluated,
        without_disturbed=left_out,
        definitions=store.read(lambda t: t.evaluations.definitions(fingerprints)) if len(fingerprints) > 1 else {},
    )


def _evaluated(source: Any, facts: Columns, errors_m: Mapping[int, float], protocol: str | None) -> Columns:
    """The facts of runs with a known result, the outcomes of their evaluations, and their protocols.

    Runs that were not evaluated, were cancelled or lost, or have not ended are left out: they have not failed.
    """
    ended_well = [state == RunState.SUCCEEDED for state in facts["state"]]
    pairs = list(zip(facts["run_id"], ended_well, strict=True))
    lacking = [run_id for run_id, well in pairs if well and run_id not in errors_m]
    evaluations = dict.fromkeys(errors_m, EvaluationState.SUCCEEDED) | source.evaluated(lacking, protocol)
    kept = [
        run_id in evaluations if well else state == RunState.FAILED and reason != FailureReason.LOST
        for (run_id, well), state, reason in zip(pairs, facts["state"], facts["reason"], strict=True)
    ]
    if not any(kept) and kept:
        under = "" if protocol is None else f" under protocol {source.protocol_label(protocol)} ({protocol})"
        raise InvalidInput(f"none of the {len(kept)} runs has been evaluated{under}", "evaluate them first")
    chosen = {name: list(compress(values, kept)) for name, values in facts.items()}
    chosen["evaluation"] = [evaluations.get(run_id) for run_id in chosen["run_id"]]
    if protocol is not None:
        label = source.protocol_label(protocol)
        there = [state == EvaluationState.SUCCEEDED for state in chosen["evaluation"]]
        chosen["protocol"] = [protocol if known else None for known in there]
        chosen["protocol_label"] = [label if known else None for known in there]
    return chosen


def load_every_protocol(store: Store, keys: Collection[str], run_ids: Sequence[int]) -> pd.DataFrame:
    """Long form: run_id, protocol, protocol_label, metric, value."""
    wanted = {key for key in keys if key in CATALOGUE and CATALOGUE[key].needs_protocol}
    values = store.read(lambda t: t.run_table.every_protocol(wanted, run_ids)) if wanted else []
    names = ["run_id", "protocol", "protocol_label", "metric", "value"]
    rows = [(entry.run_id, entry.fingerprint, entry.label, entry.metric, entry.value) for entry in values]
    return pd.DataFrame(rows, columns=names)


def check_size(run_ids: Sequence[int], limit: int) -> None:
    """Raise InvalidInput if there are more runs than an analysis may have."""
    if len(run_ids) > limit:
        raise InvalidInput(f"the selection has {len(run_ids)} runs, {limit} are allowed", "narrow it")


def _unit(name: str, units: Mapping[str, str]) -> str:
    """The unit of a parameter, or of a step option according to the suffix of its name."""
    if not name.startswith(VARIANT_PREFIX):
        return units.get(name, "")
    return _ENDINGS.get(name.rpartition(".")[2].rpartition("_")[2], "")


def _source(axis: list[Any], columns: Columns, known: Collection[str]) -> str:
    """The parameter or option that an axis of an experiment sets; empty if unknown."""
    for name in known:
        pairs = [pair for pair in zip(axis, columns[name], strict=True) if None not in pair]
        if pairs and all(own == other for own, other in pairs) and len(set(axis)) > 1:
            return name
    return ""


def _by_id(values: Mapping[str, Mapping[int, Any]], ids: Sequence[int]) -> Columns:
    return {key: [entries.get(entry) for entry in ids] for key, entries in values.items()}


def _variant_columns(variants: Sequence[Any]) -> dict[str, list[Any]]:
    """One column for each option of each kind of step, named as in filters; None if a run has no such step."""
    names = {
        f"{VARIANT_PREFIX}{step['kind']}.{option}"
        for variant in variants
        for step in variant or ()
        for option in step["options"]
    }
    columns: dict[str, list[Any]] = {name: [None] * len(variants) for name in sorted(names)}
    for row, variant in enumerate(variants):
        for step in variant or ():
            for option, value in step["options"].items():
                columns[f"{VARIANT_PREFIX}{step['kind']}.{option}"][row] = value
    return columns


# Columns of an analysis file are checked before anything is computed.


def check_columns(analysis: Analysis, vocabulary: Vocabulary, is_axis: Callable[[str], bool]) -> None:
    """Refuse names that no run can have a column for.

    Args:
        analysis: The file.
        vocabulary: The parameters and options of this installation.
        is_axis: Whether an experiment may have an axis of this name.

    Raises:
        InvalidInput: with the place in the file and the nearest name.
    """
    facts = {column.key for column in FACTS} | {kind.name for kind in ATTRIBUTE_KINDS}
    known = facts.union(CATALOGUE, vocabulary.parameters)
    for plot in analysis.plots:
        for key in sorted(plot.plot_type.needs(plot.options)):
            if key not in known and not key.startswith(VARIANT_PREFIX) and not is_axis(key):
                raise InvalidInput(f"{plot.place}: unknown name {key[:80]!r}", vocabulary.nearest(key[:80]))
