"""Challenges: secret ground truth, submissions, and rankings in which chance alone separates nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.challenges.checking import opened_files
    from slamhive.services.challenges.definition import sweep_challenges
    from slamhive.services.challenges.image_runs import ImageWork
    from slamhive.services.challenges.images import Installation
    from slamhive.services.challenges.judging import ChallengeJudge
    from slamhive.services.challenges.service import ChallengeService
    from slamhive.services.challenges.submitting import Entrant


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
