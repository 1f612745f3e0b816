"""The database: an index of the run folders, and the queue. ``open_store`` is the way in; see ``docs/store.md``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.store.accounts import Account, AccountCredentials, AuditAct, Key, KeyKind, NewKey
    from slamhive.store.configuration_listing import (
        ConfigurationFilter,
        ConfigurationPage,
        ConfigurationRecord,
        ParameterCondition,
        StoredParameter,
    )
    from slamhive.store.durations import MeasuredMachine
    from slamhive.store.leases import Lease
    from slamhive.store.records import (
        AlgorithmRecord,
        AlgorithmVersion,
        AnalysisRecord,
        AnalysisState,
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
    from slamhive.store.store import AbsentStore, Store, open_store
    from slamhive.store.transaction import Transaction


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
