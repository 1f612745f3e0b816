"""The ground truth of a dataset as plots."""

from __future__ import annotations

from typing import Any

from slamhive.analysis.colours import OKABE_ITO
from slamhive.domain.dataset import Dataset
from slamhive.services.datasets import ground_truth_motion
from slamhive.services.runs import read_dataset_path
from slamhive.trajectory.motion import WINDOW_S
from slamhive.web.figures import best_plane, motion_figures, path_figures
from slamhive.web.formatting import plural

_COLOUR = OKABE_ITO[0]


def ground_truth_figures(dataset: Dataset, most_points: int | None = None) -> dict[str, Any] | None:
    """The path in all planes and in 3D, speed and angular rate, with captions and the reasons for missing plots.

    ``most_points`` thins the path. None for a dataset without a ground truth that can be read.
    """
    track, motion = read_dataset_path(dataset), ground_truth_motion(dataset)
    if track is None or motion is None or dataset.groundtruth is None:
        return None
    positions_only = dataset.groundtruth.positions_only
    unknown = "The ground truth has no orientations." if positions_only else "The poses are too far apart in time."
    path = track if most_points is None else track.thinned(most_points)
    return {
        "figures": path_figures(path, None) | motion_figures(motion, _COLOUR, positions_only=positions_only),
        "captions": {
            "path": f"Ground truth, {plural(track.poses, 'pose')}.",
            "speed": f"Mean over {WINDOW_S:g} s.",
            "angular_rate": "" if positions_only else f"Mean over {WINDOW_S:g} s.",
        },
        "reasons": {"speed": "The poses are too far apart in time.", "angular_rate": unknown},
        "best_plane": best_plane(track),
    }
