"""A small world of runs in a store, the same as plain values, and a filter over them that is too simple to be wrong."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from typing import Any

from slamhive.domain.parameters import Value
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.filters.fields import FieldKind, ParameterKind, Vocabulary, vocabulary_of
from slamhive.store import Lease, Store
from slamhive.store.models import EvaluationRow
from tests.store.store_samples import SE3, SIM3, WORKER, Samples, result

BEGIN = datetime(2026, 5, 1, tzinfo=UTC)
VOCABULARY = vocabulary_of(
    [
        ParameterKind("nFeatures", FieldKind.NUMBER),
        ParameterKind("deskew", FieldKind.FLAG),
        ParameterKind("matcher", FieldKind.TEXT),
    ],
    sensors={"stereo": ("orb-slam3-stereo",), "lidar": ("kiss-icp",)},
    protocols={SE3.fingerprint: "a", SIM3.fingerprint: "b"},
    attributes={"indoor": ("room", "MH_01", "mh_01"), "dark": ("MH_01",), "easy": ("room", "MH%01"), "gone": ("lost",)},
)
ALGORITHMS = ("orb-slam3-stereo", "kiss-icp", "<b>odd")
DATASETS = ("room", "MH_01", "MH%01", "mh_01")
MATCHERS = ("orb", "Orb", "a*b", "50%", "x_y", "[b]", "'; DROP TABLE runs --", "größe")


@dataclass(frozen=True)
class Known:
    """What a run is known to be: its columns, parameters, and figures by protocol."""

    id: int
    columns: dict[str, Any]
    parameters: dict[str, Value]
    figures: dict[str | None, dict[str, float]]
    current: str | None

    def value(self, name: str, protocol: str | None) -> Any:
        """The value of a name, None if it has none."""
        if name in self.columns:
            return self.columns[name]
        if name in VOCABULARY.parameters:
            return self.parameters.get(name)
        own = self.figures.get(protocol or self.current, {})
        return {**self.figures[None], **own}.get(name)


def fill(store: Store, count: int = 60, seed: int = 3) -> list[Known]:
    """Runs that differ in everything a filter can name."""
    chance = random.Random(seed)
    samples = Samples(store, BEGIN)
    return [_one(store, samples, chance, place) for place in range(count)]


def _one(store: Store, samples: Samples, chance: random.Random, place: int) -> Known:
    algorithm, dataset = chance.choice(ALGORITHMS), chance.choice(DATASETS)
    parameters: dict[str, Value] = {"nFeatures": chance.choice([1000, 2000, 3000])}
    if chance.random() < 0.6:
        parameters |= {"matcher": chance.choice(MATCHERS), "deskew": chance.random() < 0.5}
    configuration = samples.configuration(parameters, algorithm, dataset)
    samples.now = BEGIN + timedelta(hours=7 * place)
    state = chance.choice([RunState.SUCCEEDED] * 4 + [RunState.FAILED, RunState.CANCELLED])
    executor, seed = chance.choice(["docker", "process"]), chance.randrange(4)
    run_id = samples.run_in(state, configuration_id=configuration, executor=executor, seed=seed)
    measured = {"cpu.mean": round(chance.uniform(0.5, 4), 2)} if chance.random() < 0.8 else {}
    store.write(lambda tx: tx.metrics.put(run_id, None, measured))
    figures: dict[str | None, dict[str, float]] = {None: measured}
    current = None
    if state is RunState.SUCCEEDED:
        for protocol in chance.sample([SE3, SIM3], chance.randrange(3)):
            error = round(chance.uniform(0.01, 0.3), 2)
            _evaluate(store, run_id, protocol, error, samples.now)
            figures[protocol.fingerprint] = {"ate.rmse": error}
            current = current or protocol.fingerprint
    known = chance.choice([None, (), (DisturbanceKind.OTHERS,), (DisturbanceKind.STEAL, DisturbanceKind.IO_PRESSURE)])
    if known is not None:
        reasons = tuple(DisturbanceReason(kind, "in words") for kind in known)
        store.write(lambda tx: tx.runs.update(run_id, disturbance=Disturbance(known=True, reasons=reasons)))
    columns = {
        "disturbed": None if known is None else bool(known),
        "disturbed_by": frozenset(map(str, known)) if known else None,
        "id": run_id,
        "algorithm": algorithm,
        "package": "orb-slam3",
        "dataset": dataset,
        "state": state.value,
        "reason": FailureReason.TIMEOUT.value if state is RunState.FAILED else None,
        "executor": executor,
        "configuration": configuration,
        "seed": seed,
        "playback": "realtime",
        "rate": 1.0,
        "created_at": samples.now,
        "evaluated": current is not None,
        "sensor": {"orb-slam3-stereo": "stereo", "kiss-icp": "lidar"}.get(algorithm),
    }
    return Known(run_id, columns, parameters, figures, current)


def _evaluate(store: Store, run_id: int, protocol: Any, error: float, now: datetime) -> None:
    (evaluation_id,) = store.write(lambda tx: tx.evaluations.queue([run_id], protocol, now))
    store.write(lambda tx: tx.evaluations.claim(Lease(WORKER, now, 30.0)))
    store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result(protocol, ate_rmse=error), now))
    assert EvaluationRow.__tablename__ == "evaluations"


def disturbed_by(sign: str, kind: str) -> Probe:
    """Of several kinds that disturbed a run, one is enough for ``=`` and too many for ``!=``."""

    def fits(run: Known, protocol: str | None) -> bool:
        found = run.value("disturbed_by", protocol)
        return found is not None and (kind in found) is (sign == "=")

    return Probe(f"disturbed_by {sign} {kind}", fits)


_SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "=": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "~": lambda a, b: fnmatchcase(a, b.replace("[", "[[]")),
    "!~": lambda a, b: not fnmatchcase(a, b.replace("[", "[[]")),
}


@dataclass(frozen=True)
class Probe:
    """A comparison as text, and whether a run fits it."""

    text: str
    fits: Callable[[Known, str | None], bool]


def compare(name: str, sign: str, value: Any) -> Probe:
    """``name sign value``; a run without the value never fits."""
    shown = (
        str(value).lower() if isinstance(value, bool) else value.isoformat() if isinstance(value, datetime) else value
    )
    written = '"' + str(shown).replace('"', '""') + '"'

    def fits(run: Known, protocol: str | None) -> bool:
        found = run.value(name, protocol)
        return found is not None and _SIGNS[sign](found, value)

    return Probe(f"{name} {sign} {written}", fits)


def among(name: str, values: list[Any], *, negated: bool) -> Probe:
    """``name [not] in (values)``."""
    listed = ", ".join('"' + str(value) + '"' for value in values)

    def fits(run: Known, protocol: str | None) -> bool:
        found = run.value(name, protocol)
        return found is not None and (found in values) is not negated

    return Probe(f"{name} {'not ' if negated else ''}in ({listed})", fits)


def presence(name: str, *, there: bool) -> Probe:
    """``has name`` or ``missing name``."""
    word = "has" if there else "missing"
    return Probe(f"{word} {name}", lambda run, protocol: (run.value(name, protocol) is not None) is there)


def joined(word: str, parts: list[Probe]) -> Probe:
    """``and`` and ``or``."""
    every = all if word == "and" else any
    text = f" {word} ".join(f"({part.text})" for part in parts)
    return Probe(text, lambda run, protocol: every(part.fits(run, protocol) for part in parts))


def negated(part: Probe) -> Probe:
    """``not``: every other run."""
    return Probe(f"not ({part.text})", lambda run, protocol: not part.fits(run, protocol))


def vocabulary() -> Vocabulary:
    """The names of the world."""
    return VOCABULARY
