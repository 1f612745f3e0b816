"""Import trajectories of other tools as runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.imports.request import (
        DEFAULT_GROUND_TRUTH,
        DEFAULT_IMAGE_TIMES,
        DEFAULT_PATTERN,
        DEFAULT_RELATIONS,
        DEFAULT_TIMES,
        UNPACKED,
        ImportReport,
        ImportRequest,
        Reading,
        one_import,
        sweep_imports,
    )
    from slamhive.services.imports.service import Imports
    from slamhive.services.imports.sources import parse_setup
    from slamhive.trajectory.pose_file import TrajectoryFormat


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
