"""Start an experiment, complete an interrupted start, or add repeats: check first, then store."""

from __future__ import annotations

import uuid
from dataclasses import replace

from slamhive.clock import utc_now
from slamhive.domain.visibility import Sharing, Visibility
from slamhive.errors import Conflict, InvalidInput
from slamhive.schema.submission import MAX_REPEATS
from slamhive.services.experiments.changing import changing, write_record
from slamhive.services.experiments.checks import disk_space_problems, find_disk_space, pair_problems
from slamhive.services.experiments.context import ExperimentContext, Progress
from slamhive.services.experiments.folder import ExperimentFolder, StoredExperiment
from slamhive.services.experiments.storing import fill, put_experiment
from slamhive.services.experiments.views import ExperimentSource
from slamhive.store.experiment_records import ExperimentRecord, ExperimentState
from slamhive.sweep.expand import Expansion
from slamhive.sweep.experiment import Experiment
from slamhive.sweep.experiment_file import parse_experiment


def start(
    context: ExperimentContext,
    source: ExperimentSource,
    executor: str | None,
    progress: Progress,
    visibility: Visibility | None = None,
) -> str:
    """Store all runs of ``source`` that are not stored yet; returns the name of the experiment."""
    source = context.with_datasets(source)
    experiment = parse_experiment(source.text, source.name)
    context.store.read(lambda t: t.experiments.check_free(experiment.name))
    record = context.store.read(lambda t: t.experiments.find(experiment.name))
    if record is not None:
        check_same(context, record, experiment, executor)
        if record.complete:
            return record.name
    folder = context.folder(experiment.name)
    known = folder.read() if record is None else StoredExperiment.of(record)
    if known is None:
        chosen = context.executors.choose(executor or experiment.executor)
        maker = context.store.maker
        known = _new(experiment, chosen, Sharing(maker.owner, visibility or maker.visibility))
    elif not experiment.has_hash(known.content_hash):
        raise Conflict(
            f"{folder.root} holds another experiment of this name, which the database does not know",
            "slamhive reindex files it; or choose another name",
        )
    repeated = replace(experiment, repeats=known.repeats)
    expansion = _checked(context, repeated, known.executor)
    with folder.locked():
        known = _settled(folder, known, source)
        size = expansion.size
        stored = put_experiment(context, known, source.text, repeated, cells=size.configurations, runs=size.runs)
        fill(context, stored, repeated, expansion, progress)
    return experiment.name


def check_same(
    context: ExperimentContext, record: ExperimentRecord, experiment: Experiment, executor: str | None
) -> None:
    """Raise Conflict unless the stored experiment has the same content as the file and was not cancelled."""
    if not experiment.has_hash(record.content_hash):
        raise Conflict(
            f"{experiment.place}: an experiment called {record.name} is there already and states something else",
            "choose another name; add-repeats runs the same one more often",
        )
    if record.state is ExperimentState.CANCELLED:
        raise Conflict(f"experiment {record.name} was cancelled", "give the file another name to run it again")
    if executor is not None and context.executors.choose(executor) != record.executor:
        raise Conflict(
            f"experiment {record.name} runs with executor {record.executor}, not {executor}",
            "choose another name to run it there",
        )


def add_repeats(context: ExperimentContext, name: str, count: int, progress: Progress) -> None:
    """Add ``count`` repeats to each cell and seed, as if the file had requested them from the start."""
    with changing(context, name) as record:
        if not record.complete:
            raise Conflict(f"experiment {name} is not stored completely", "start its file again first")
        if not 1 <= count <= MAX_REPEATS - record.repeats:
            raise InvalidInput(
                f"{count} more repeats are not allowed, {name} has {record.repeats}", f"at most {MAX_REPEATS} in all"
            )
        experiment = parse_experiment(record.source, f"experiment {name}")
        experiment = replace(experiment, repeats=record.repeats + count)
        expansion = _checked(context, experiment, record.executor)
        grown = replace(record, repeats=experiment.repeats, runs=expansion.size.runs, complete=False)
        write_record(context, grown)
        values = {"repeats": grown.repeats, "runs": grown.runs, "complete": False}
        context.store.write(lambda t: t.experiments.change(record.id, **values))
        fill(context, grown, experiment, expansion, progress)


def _checked(context: ExperimentContext, experiment: Experiment, executor: str) -> Expansion:
    """Expand the experiment; raises the first problem that would keep it from running."""
    expansion = context.expand(experiment)
    for error in disk_space_problems(context, experiment, find_disk_space(context, expansion, executor)):
        raise error
    for error in pair_problems(context, experiment, expansion, executor):
        raise error
    return expansion


def _new(experiment: Experiment, executor: str, maker: Sharing) -> StoredExperiment:
    return StoredExperiment(
        uid=uuid.uuid4().hex,
        name=experiment.name,
        content_hash=experiment.content_hash,
        state=ExperimentState.ACTIVE,
        executor=executor,
        repeats=experiment.repeats,
        created_at=utc_now(),
        owner=maker.owner,
        visibility=maker.visibility,
    )


def _settled(folder: ExperimentFolder, known: StoredExperiment, source: ExperimentSource) -> StoredExperiment:
    """What is on disk, if another process has stored the same experiment first; else stores ``known``."""
    found = folder.read()
    if found is not None and found.content_hash == known.content_hash:
        return found
    folder.write(known, source.text)
    return known
