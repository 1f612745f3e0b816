"""What can run on what: the catalogue of algorithms and datasets, and the variants of datasets."""

from __future__ import annotations

from slamhive.services.datasets.as_json import algorithm_to_json, dataset_to_json
from slamhive.services.datasets.catalogue import Catalogue, check_writable
from slamhive.services.datasets.external import algorithm_here_or_elsewhere, choose_algorithm, imported_algorithms
from slamhive.services.datasets.variants import IDENTITY, UsedVariant, Variants, variant_key

__all__ = [
    "IDENTITY",
    "Catalogue",
    "UsedVariant",
    "Variants",
    "algorithm_here_or_elsewhere",
    "algorithm_to_json",
    "check_writable",
    "choose_algorithm",
    "dataset_to_json",
    "imported_algorithms",
    "variant_key",
]
