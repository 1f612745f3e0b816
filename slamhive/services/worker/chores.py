"""Work done between runs, pinned to one slot's cores, so that it disturbs no other slot."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from slamhive.services.analyses import AnalysisJobs
from slamhive.services.challenges import ChallengeJudge, ImageWork


@dataclass(frozen=True, slots=True)
class Chores:
    """The work between runs.

    Attributes:
        analyses: Computes analyses.
        images: Runs images that were submitted to challenges.
        judge: Evaluates submissions to challenges.
    """

    analyses: AnalysisJobs
    images: ImageWork
    judge: ChallengeJudge

    def work_once(self, owner: str, stopping: threading.Event, cores: tuple[int, ...] | None) -> bool:
        """Do at most one thing of each kind; returns whether there was any."""
        analysed = self.analyses.work_once(owner, stopping)
        ran = self.images.work_once(stopping, cores) > 0
        return self.judge.work_once(stopping, cores) > 0 or ran or analysed
