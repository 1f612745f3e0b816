"""Algorithms, metrics and protocols: what runs can be made of, and what is measured."""

from __future__ import annotations

from flask import Response, request, url_for

from slamhive import __version__
from slamhive.base.errors import NotFound
from slamhive.base.settings import Mode
from slamhive.documents.api import (
    Algorithms,
    BackgroundWork,
    ConfigurationChanges,
    ConfigurationPageDocument,
    ConfigurationRequest,
    ConfigurationYaml,
    Datasets,
    DatasetWork,
    GroupRequest,
    LabelRequest,
    MetricDocument,
    Metrics,
    NodeRequest,
    PackageVersions,
    PublicDatasets,
    Removal,
    Server,
    StoredConfiguration,
    VariantRequest,
    VariantsDocument,
)
from slamhive.documents.catalogue import (
    AlgorithmDocument,
    CachedVariant,
    ConfigurationDocument,
    DatasetCheck,
    DatasetDocument,
    TruthTrialDocument,
    Version,
)
from slamhive.documents.plain import OverviewDocument
from slamhive.documents.protocol import ProtocolsDocument
from slamhive.documents.run import SweepDocument
from slamhive.domain.metrics import CATALOGUE
from slamhive.services.configurations import ConfigurationChange, Label, Stored, configuration_document
from slamhive.services.datasets import dataset_document
from slamhive.services.evaluations import protocols_document
from slamhive.web.api.operation import CONFIGURATION_ARGUMENTS, PUBLIC_ARGUMENTS, TABLE, TIME_ARGUMENTS, Section
from slamhive.web.context import dataset_checker, hive, truth_judge, variant_maker
from slamhive.web.long_work import LongWork
from slamhive.web.queries import ConfigurationQuery
from slamhive.web.views.catalogue import asked_time_s, frame_answer


@TABLE.get(Section.CATALOGUE, "/algorithms", Algorithms)
def algorithms() -> Algorithms:
    """All algorithms."""
    return Algorithms(algorithms=tuple(map(AlgorithmDocument.of, hive().catalogue.algorithms())))


@TABLE.get(Section.CATALOGUE, "/algorithms/{name}", AlgorithmDocument)
def algorithm(name: str) -> AlgorithmDocument:
    """One algorithm: what it needs, and its parameters."""
    return AlgorithmDocument.of(hive().catalogue.algorithm(name))


@TABLE.get(Section.CATALOGUE, "/algorithms/{name}/versions", PackageVersions)
def algorithm_versions(name: str) -> PackageVersions:
    """The versions of the package of one algorithm, with their number of runs."""
    return PackageVersions(versions=tuple(map(Version.of, hive().versions.reports(name))))


@TABLE.get(Section.CATALOGUE, "/metrics", Metrics)
def metrics() -> Metrics:
    """Every metric that a run can have."""
    return Metrics(metrics=tuple(map(MetricDocument.of, CATALOGUE.values())))


@TABLE.get(Section.CATALOGUE, "/protocols", ProtocolsDocument)
def protocols() -> ProtocolsDocument:
    """The protocols that are known by name, and those in use."""
    return protocols_document(hive().protocols.used())


# -- datasets, their checks and their variants -------------------------------------------------------------------------


@TABLE.get(Section.DATASETS, "/datasets", Datasets)
def datasets() -> Datasets:
    """All datasets."""
    return Datasets(datasets=tuple(map(dataset_document, hive().catalogue.datasets())))


@TABLE.get(Section.DATASETS, "/datasets/{name}", DatasetDocument)
def dataset(name: str) -> DatasetDocument:
    """One dataset."""
    return dataset_document(hive().catalogue.dataset(name))


@TABLE.get(Section.DATASETS, "/datasets/{name}/frames/{sensor}", ("image/jpeg",), TIME_ARGUMENTS)
def dataset_frame(name: str, sensor: str) -> Response:
    """The frame of a camera at a time of the recording, or the next one; `X-Frame-Time` says when it was received."""
    return frame_answer(hive().catalogue.dataset(name), sensor)


@TABLE.get(Section.DATASETS, "/datasets/{name}/sweeps/{sensor}", SweepDocument, TIME_ARGUMENTS)
def dataset_sweep(name: str, sensor: str) -> SweepDocument:
    """The sweep of a LiDAR at a time of the recording, or the next one."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    view = services.dataset_views.sweep(dataset, sensor, asked_time_s(dataset))
    return SweepDocument.of(view, positions_m=view.positions_m.round(4).tolist())


@TABLE.get(Section.DATASETS, "/datasets/{name}/check", DatasetCheck)
def dataset_check(name: str) -> DatasetCheck:
    """The last report of the checks of one dataset."""
    report = hive().dataset_checks.stored(hive().catalogue.dataset(name))
    if report is None:
        raise NotFound(f"dataset {name} has not been checked, or has changed since", f"slamhive dataset check {name}")
    return report


@TABLE.post(Section.DATASETS, "/datasets/{name}/check", DatasetWork, status=202)
def check_dataset(name: str) -> DatasetWork:
    """Start checking one dataset."""
    dataset_checker().start(name)
    return _work(name)


@TABLE.get(Section.DATASETS, "/datasets/{name}/trial", TruthTrialDocument)
def dataset_trial(name: str) -> TruthTrialDocument:
    """The last trial of the ground truth of one dataset."""
    found = hive().truth_trials.stored(hive().catalogue.dataset(name))
    if found is None:
        raise NotFound(
            f"the ground truth of {name} has not been judged, or has changed", f"slamhive dataset trial {name}"
        )
    return found


@TABLE.post(Section.DATASETS, "/datasets/{name}/trial", DatasetWork, status=202)
def judge_dataset(name: str) -> DatasetWork:
    """Start judging the ground truth of one dataset."""
    truth_judge().start(name)
    return _work(name)


@TABLE.get(Section.DATASETS, "/datasets/{name}/work", DatasetWork)
def dataset_work(name: str) -> DatasetWork:
    """The check or the variant of one dataset that is being made now, or that failed."""
    hive().catalogue.dataset(name)
    return _work(name)


@TABLE.get(Section.DATASETS, "/datasets/{name}/variants", VariantsDocument)
def variants(name: str) -> VariantsDocument:
    """The variants of one dataset in the cache."""
    services = hive()
    services.catalogue.dataset(name)
    return VariantsDocument(variants=tuple(map(CachedVariant.of, services.variants.entries(name))))


@TABLE.post(Section.DATASETS, "/datasets/{name}/variants", DatasetWork, body=VariantRequest, status=202)
def make_variant(name: str, body: VariantRequest) -> DatasetWork:
    """Start making a variant of one dataset."""
    variant_maker().start(name, body.steps)
    return _work(name)


@TABLE.post(Section.DATASETS, "/datasets/{name}/variants/{key}/drop", Removal)
def remove_variant(name: str, key: str) -> Removal:
    """Remove a variant that nothing uses; runs that need it make it again."""
    return Removal(removed=variant_maker().drop(name, key))


@TABLE.get(Section.DATASETS, "/public-datasets", PublicDatasets, PUBLIC_ARGUMENTS)
def public_datasets() -> PublicDatasets:
    """Public sequences that `slamhive dataset fetch` makes datasets of."""
    words = request.args.get("words", "").split()
    return PublicDatasets(sequences=tuple(hive().fetching.search(words)))


def _work(name: str) -> DatasetWork:
    return DatasetWork(
        check=_shown(dataset_checker().latest(name)),
        variant=_shown(variant_maker().latest(name)),
        trial=_shown(truth_judge().latest(name)),
    )


def _shown(work: LongWork | None) -> BackgroundWork | None:
    return None if work is None else BackgroundWork.of(work)


# -- configurations: what runs execute ---------------------------------------------------------------------------------

SOURCE = "the text"


@TABLE.get(Section.CONFIGURATIONS, "/configurations", ConfigurationPageDocument, CONFIGURATION_ARGUMENTS)
def configurations() -> ConfigurationPageDocument:
    """A page of configurations, the newest first."""
    query = ConfigurationQuery.from_args(request.args)
    page = hive().configurations.page(query.filter, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.configurations", **query.at(page.next_key).args())
    found = tuple(map(configuration_document, page.records))
    return ConfigurationPageDocument(configurations=found, total=page.total, next=following)


@TABLE.get(Section.CONFIGURATIONS, "/configurations/{configuration_id}", ConfigurationDocument)
def configuration(configuration_id: int) -> ConfigurationDocument:
    """One configuration."""
    return configuration_document(hive().configurations.get(configuration_id))


@TABLE.get(Section.CONFIGURATIONS, "/configurations/{configuration_id}/yaml", ("application/yaml",))
def configuration_yaml(configuration_id: int) -> Response:
    """One configuration as YAML that the import takes."""
    return Response(hive().configurations.export_yaml(configuration_id), mimetype="application/yaml")


@TABLE.post(Section.CONFIGURATIONS, "/configurations", StoredConfiguration, body=ConfigurationRequest, status=201)
def create_configuration(body: ConfigurationRequest) -> StoredConfiguration:
    """Store a configuration, or find the identical one."""
    return _stored(hive().configurations.create(body.submission, Label(body.name, body.note, body.group)))


@TABLE.post(Section.CONFIGURATIONS, "/configurations/import", StoredConfiguration, body=ConfigurationYaml, status=201)
def import_configuration(body: ConfigurationYaml) -> StoredConfiguration:
    """Store the configuration in YAML, or find the identical one."""
    label = Label(body.name, body.note, body.group)
    return _stored(hive().configurations.import_yaml(body.yaml, SOURCE, label))


@TABLE.post(
    Section.CONFIGURATIONS, "/configurations/{configuration_id}/modify", StoredConfiguration, body=ConfigurationChanges
)
def modify_configuration(configuration_id: int, body: ConfigurationChanges) -> StoredConfiguration:
    """Replace one configuration by one with changes.

    If runs or an experiment depend on it, it stays, and the changed one is stored beside it.
    """
    changes = ConfigurationChange(
        algorithm=body.algorithm,
        dataset=body.dataset,
        parameters=body.parameters,
        variant=body.variant,
        sensors=body.sensors,
        playback_mode=body.playback_mode,
        playback_rate=body.playback_rate,
        map=body.map,
    )
    return _stored(hive().configurations.modify(configuration_id, changes, Label(body.name, body.note)))


@TABLE.post(
    Section.CONFIGURATIONS, "/configurations/{configuration_id}/describe", ConfigurationDocument, body=LabelRequest
)
def describe_configuration(configuration_id: int, body: LabelRequest) -> ConfigurationDocument:
    """Set name and note of one configuration."""
    return configuration_document(hive().configurations.describe(configuration_id, Label(body.name, body.note)))


@TABLE.post(
    Section.CONFIGURATIONS, "/configurations/{configuration_id}/group", ConfigurationDocument, body=GroupRequest
)
def group_configuration(configuration_id: int, body: GroupRequest) -> ConfigurationDocument:
    """Add one configuration to a group, or remove it."""
    services = hive().configurations
    services.group(body.group, [configuration_id], remove=body.remove)
    return configuration_document(services.get(configuration_id))


@TABLE.post(Section.CONFIGURATIONS, "/configurations/{configuration_id}/delete", Removal)
def delete_configuration(configuration_id: int) -> Removal:
    """Delete one configuration that nothing depends on."""
    hive().configurations.delete([configuration_id])
    return Removal(removed=str(configuration_id))


def _stored(stored: Stored) -> StoredConfiguration:
    document = configuration_document(stored.record)
    return StoredConfiguration.of(document, created=stored.created, notes=stored.notes)


# -- the machines that execute runs ------------------------------------------------------------------------------------


@TABLE.get(Section.SERVER, "/nodes", OverviewDocument)
def nodes() -> OverviewDocument:
    """The machines that execute runs, what runs there, throughput and disturbance."""
    return hive().nodes.overview()


@TABLE.post(Section.SERVER, "/nodes/drain", OverviewDocument, body=NodeRequest)
def drain_node(body: NodeRequest) -> OverviewDocument:
    """Let no further run start on a node; active runs go on."""
    hive().nodes.drain(body.executor, body.node, drained=True)
    return hive().nodes.overview()


@TABLE.post(Section.SERVER, "/nodes/undrain", OverviewDocument, body=NodeRequest)
def undrain_node(body: NodeRequest) -> OverviewDocument:
    """Let runs start on a node again."""
    hive().nodes.drain(body.executor, body.node, drained=False)
    return hive().nodes.overview()


# -- this server -------------------------------------------------------------------------------------------------------


@TABLE.get(Section.SERVER, "/server", Server)
def server() -> Server:
    """The version of this server, and whether it changes anything."""
    services = hive()
    mode = services.settings.mode
    changes = mode is not Mode.VIEW_ONLY
    return Server(software=__version__, mode=mode, changes=changes, worker=services.worker_alive())
