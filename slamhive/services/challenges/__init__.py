"""Challenges: secret ground truth, submissions, and rankings in which chance alone separates nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.challenges.folder import sweep_challenges
    from slamhive.services.challenges.image_loading import Installation
    from slamhive.services.challenges.image_work import ImageWork
    from slamhive.services.challenges.judging import ChallengeJudge
    from slamhive.services.challenges.reading import opened_files
    from slamhive.services.challenges.service import Challenges
    from slamhive.services.challenges.submitting import Entrant

__all__ = [
    "ChallengeJudge",
    "Challenges",
    "Entrant",
    "ImageWork",
    "Installation",
    "opened_files",
    "sweep_challenges",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
