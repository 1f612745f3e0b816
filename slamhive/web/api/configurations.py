"""Configurations: what runs execute."""

from __future__ import annotations

from flask import Response, request, url_for

from slamhive.schema.api_answers import ConfigurationPage, Removal, StoredConfiguration
from slamhive.schema.api_requests import (
    ConfigurationChanges,
    ConfigurationRequest,
    ConfigurationYaml,
    GroupRequest,
    LabelRequest,
)
from slamhive.schema.catalogue import Configuration
from slamhive.services.configurations import Changes, Label, Stored, configuration_document
from slamhive.web.api.arguments import CONFIGURATION_ARGUMENTS
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.configuration_query import ConfigurationQuery
from slamhive.web.context import hive

SOURCE = "the text"


@TABLE.get(Section.CONFIGURATIONS, "/configurations", ConfigurationPage, CONFIGURATION_ARGUMENTS)
def configurations() -> ConfigurationPage:
    """A page of configurations, the newest first."""
    query = ConfigurationQuery.from_args(request.args)
    page = hive().configurations.page(query.filter, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.configurations", **query.at(page.next_key).args())
    found = tuple(map(configuration_document, page.records))
    return ConfigurationPage(configurations=found, total=page.total, next=following)


@TABLE.get(Section.CONFIGURATIONS, "/configurations/{configuration_id}", Configuration)
def configuration(configuration_id: int) -> Configuration:
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
    changes = Changes(
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


@TABLE.post(Section.CONFIGURATIONS, "/configurations/{configuration_id}/describe", Configuration, body=LabelRequest)
def describe_configuration(configuration_id: int, body: LabelRequest) -> Configuration:
    """Set name and note of one configuration."""
    return configuration_document(hive().configurations.describe(configuration_id, Label(body.name, body.note)))


@TABLE.post(Section.CONFIGURATIONS, "/configurations/{configuration_id}/group", Configuration, body=GroupRequest)
def group_configuration(configuration_id: int, body: GroupRequest) -> Configuration:
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
