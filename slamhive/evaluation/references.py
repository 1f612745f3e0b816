"""Ground truths, each read once for all runs that are compared with it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slamhive.domain.sensors import Matrix4
from slamhive.errors import InvalidInput, NotFound
from slamhive.evaluation.job import EvaluationTask
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import move_sensor, rigid_transform
from slamhive.trajectory.tum import parse_tum


class References:
    """Ground truths by file and by the sensor frame they are moved into, read when first asked for."""

    def __init__(self) -> None:
        self._bodies: dict[Path, Trajectory | InvalidInput] = {}
        self._moved: dict[tuple[Path, Matrix4], Trajectory] = {}

    def preload(self, tasks: Iterable[EvaluationTask]) -> None:
        """Read what ``tasks`` need. A malformed ground truth raises when its task asks for it."""
        for task in tasks:
            with contextlib.suppress(InvalidInput):
                self.of(task)

    def of(self, task: EvaluationTask) -> Trajectory:
        """The ground truth of ``task`` in its estimate's frame; raises InvalidInput that says why there is none."""
        key = (task.reference, task.T_body_sensor)
        if key not in self._moved:
            body = self._body(task.reference)
            if isinstance(body, InvalidInput):
                raise body
            transform = rigid_transform(task.T_body_sensor, "T_body_sensor")
            self._moved[key] = body if np.array_equal(transform, np.eye(4)) else move_sensor(body, transform)
        return self._moved[key]

    def _body(self, path: Path) -> Trajectory | InvalidInput:
        if path not in self._bodies:
            try:
                self._bodies[path] = parse_tum(read_bounded(path), f"ground truth {path.name}")
            except NotFound:
                self._bodies[path] = InvalidInput(f"there is no ground truth: {path.name} does not exist")
            except InvalidInput as error:
                self._bodies[path] = error
        return self._bodies[path]
