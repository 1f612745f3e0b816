"""Runs: submit, retry and cancel them; their records, progress, series and files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.runs.downloads import list_downloads, open_download
    from slamhive.services.runs.filing import (
        FolderRun,
        FoundEvaluation,
        current_protocol,
        dataset_of,
        file_runs,
        found_evaluations,
        found_notes,
        found_sharing,
        put_configurations,
        read_filed,
    )
    from slamhive.services.runs.maps import MapViews
    from slamhive.services.runs.moments import FrameFate, Moment
    from slamhive.services.runs.notes import Notes
    from slamhive.services.runs.progress import RunProgress, untracked_s
    from slamhive.services.runs.record import (
        begin_record,
        events_to_json,
        handle_from_json,
        handle_to_json,
        snapshot_of,
        spec_from_json,
        spec_to_json,
    )
    from slamhive.services.runs.record_keeper import RecordKeeper
    from slamhive.services.runs.retrying import repeat_if_disturbed, retry_request, run_uid
    from slamhive.services.runs.scene import RunScene, ScenePath, path_of, run_scene
    from slamhive.services.runs.series import (
        LIMIT_BYTES,
        Array,
        Places,
        RunSeries,
        Samples,
        Track,
        gap_of,
        latency_of,
        read_dataset_path,
        read_track,
        run_series,
        samples_of,
    )
    from slamhive.services.runs.service import Runs
    from slamhive.services.runs.specification import (
        Job,
        RunLimits,
        build_spec,
        check_dataset_files,
        check_disk,
        check_executor,
        check_gpu,
        check_recorded,
        provenance,
        recorded_topics,
        with_made_variant,
        write_config,
    )
    from slamhive.services.runs.stored import StoredRuns

__all__ = [
    "LIMIT_BYTES",
    "Array",
    "FolderRun",
    "FoundEvaluation",
    "FrameFate",
    "Job",
    "MapViews",
    "Moment",
    "Notes",
    "Places",
    "RecordKeeper",
    "RunLimits",
    "RunProgress",
    "RunScene",
    "RunSeries",
    "Runs",
    "Samples",
    "ScenePath",
    "StoredRuns",
    "Track",
    "begin_record",
    "build_spec",
    "check_dataset_files",
    "check_disk",
    "check_executor",
    "check_gpu",
    "check_recorded",
    "current_protocol",
    "dataset_of",
    "events_to_json",
    "file_runs",
    "found_evaluations",
    "found_notes",
    "found_sharing",
    "gap_of",
    "handle_from_json",
    "handle_to_json",
    "latency_of",
    "list_downloads",
    "open_download",
    "path_of",
    "provenance",
    "put_configurations",
    "read_dataset_path",
    "read_filed",
    "read_track",
    "recorded_topics",
    "repeat_if_disturbed",
    "retry_request",
    "run_scene",
    "run_series",
    "run_uid",
    "samples_of",
    "snapshot_of",
    "spec_from_json",
    "spec_to_json",
    "untracked_s",
    "with_made_variant",
    "write_config",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
