"""Algorithms, metrics and protocols: what runs can be made of, and what is measured."""

from __future__ import annotations

from slamhive.domain.metrics import CATALOGUE
from slamhive.schema.api_answers import Algorithms, Metric, Metrics, PackageVersions
from slamhive.schema.catalogue import Algorithm, Version
from slamhive.schema.protocol import Protocols
from slamhive.services.evaluations import protocols_document
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive


@TABLE.get(Section.CATALOGUE, "/algorithms", Algorithms)
def algorithms() -> Algorithms:
    """All algorithms."""
    return Algorithms(algorithms=tuple(map(Algorithm.of, hive().catalogue.algorithms())))


@TABLE.get(Section.CATALOGUE, "/algorithms/{name}", Algorithm)
def algorithm(name: str) -> Algorithm:
    """One algorithm: what it needs, and its parameters."""
    return Algorithm.of(hive().catalogue.algorithm(name))


@TABLE.get(Section.CATALOGUE, "/algorithms/{name}/versions", PackageVersions)
def algorithm_versions(name: str) -> PackageVersions:
    """The versions of the package of one algorithm, with their number of runs."""
    return PackageVersions(versions=tuple(map(Version.of, hive().versions.reports(name))))


@TABLE.get(Section.CATALOGUE, "/metrics", Metrics)
def metrics() -> Metrics:
    """Every metric that a run can have."""
    return Metrics(metrics=tuple(map(Metric.of, CATALOGUE.values())))


@TABLE.get(Section.CATALOGUE, "/protocols", Protocols)
def protocols() -> Protocols:
    """The protocols that are known by name, and those in use."""
    return protocols_document(hive().protocols.used())
