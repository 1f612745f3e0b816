"""The database: an index of the run folders, and the queue. ``open_store`` is the way in; see ``docs/store.md``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.store.account_records import Account, Act, AuditLine, Credentials, Key, KeyKind, NewKey
    from slamhive.store.analysis_records import AnalysisRecord, AnalysisState
    from slamhive.store.configuration_records import (
        ConfigurationFilter,
        ConfigurationPage,
        ConfigurationRecord,
        ParameterCondition,
        StoredParameter,
    )
    from slamhive.store.leases import Lease
    from slamhive.store.records import (
        AlgorithmRecord,
        AlgorithmVersion,
        Count,
        DatasetRecord,
        EvaluationRecord,
        EvaluationState,
        LeaseLost,
        Page,
        ProtocolLabel,
        RunFields,
        RunRecord,
        RunRequest,
        RunSnapshot,
        RunSort,
        VersionRecord,
    )
    from slamhive.store.same_cpu import Machine
    from slamhive.store.store import AbsentStore, Store, open_store
    from slamhive.store.transaction import Transaction

__all__ = [
    "AbsentStore",
    "Account",
    "Act",
    "AlgorithmRecord",
    "AlgorithmVersion",
    "AnalysisRecord",
    "AnalysisState",
    "AuditLine",
    "ConfigurationFilter",
    "ConfigurationPage",
    "ConfigurationRecord",
    "Count",
    "Credentials",
    "DatasetRecord",
    "EvaluationRecord",
    "EvaluationState",
    "Key",
    "KeyKind",
    "Lease",
    "LeaseLost",
    "Machine",
    "NewKey",
    "Page",
    "ParameterCondition",
    "ProtocolLabel",
    "RunFields",
    "RunRecord",
    "RunRequest",
    "RunSnapshot",
    "RunSort",
    "Store",
    "StoredParameter",
    "Transaction",
    "VersionRecord",
    "open_store",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
