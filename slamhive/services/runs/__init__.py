"""Runs: submit, retry and cancel them; their records, progress, series and files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.runs.files import MapViews, RunProgress, list_downloads, open_download, untracked_s
    from slamhive.services.runs.record import (
        FolderRun,
        FoundEvaluation,
        RecordKeeper,
        begin_record,
        current_protocol,
        dataset_of,
        events_to_json,
        file_runs,
        found_evaluations,
        found_notes,
        found_sharing,
        handle_from_json,
        handle_to_json,
        put_configurations,
        read_filed,
        snapshot_of,
        spec_from_json,
        spec_to_json,
    )
    from slamhive.services.runs.scene import FrameFate, Moment, RunScene, ScenePath, path_of, run_scene
    from slamhive.services.runs.series import (
        LIMIT_BYTES,
        Array,
        PathSeries,
        Places,
        RunSeries,
        Samples,
        TrackFiles,
        gap_of,
        latency_of,
        read_dataset_path,
        read_track,
        run_series,
        samples_of,
    )
    from slamhive.services.runs.service import Notes, RunService, repeat_if_disturbed, retry_request, run_uid
    from slamhive.services.runs.specification import (
        Job,
        build_spec,
        check_dataset_files,
        check_disk,
        check_executor,
        check_gpu,
        check_recorded,
        check_slow_down,
        provenance,
        recorded_topics,
        with_made_variant,
        write_config,
    )
    from slamhive.services.runs.stored import StoredRuns


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
