"""Challenges: what they ask for, rankings, and submissions."""

from __future__ import annotations

from typing import IO

from flask import request

from slamhive.schema.challenge import (
    Challenge,
    ChallengeRanking,
    Challenges,
    ChallengeSubmission,
    ChallengeSubmissions,
)
from slamhive.schema.challenge_requests import ImageEntry
from slamhive.web import challenge_files
from slamhive.web.api.arguments import ENTRY_ARGUMENTS, PHASE_ARGUMENTS
from slamhive.web.api.operation import Bytes, Section
from slamhive.web.api.table import TABLE
from slamhive.web.challenge_files import MOST_SENT_BYTES
from slamhive.web.context import hive


@TABLE.get(Section.CHALLENGES, "/challenges", Challenges)
def challenges() -> Challenges:
    """All challenges."""
    return Challenges(challenges=tuple(hive().challenges.briefs()))


@TABLE.get(Section.CHALLENGES, "/challenges/{name}", Challenge)
def challenge(name: str) -> Challenge:
    """What a challenge asks for, how it counts, and its phases."""
    return hive().challenges.get(name)


@TABLE.get(Section.CHALLENGES, "/challenges/{name}/ranking", ChallengeRanking, PHASE_ARGUMENTS)
def challenge_ranking(name: str) -> ChallengeRanking:
    """The ranking of a phase; without teams while its scores are hidden."""
    return hive().challenges.ranking(name, request.args.get("phase") or None)


@TABLE.get(Section.CHALLENGES, "/challenges/{name}/submissions", ChallengeSubmissions)
def challenge_submissions(name: str) -> ChallengeSubmissions:
    """The submissions of the caller, the newest first."""
    return ChallengeSubmissions(submissions=tuple(challenge_files.own_submissions(name)))


@TABLE.post(
    Section.CHALLENGES,
    "/challenges/{name}/submissions",
    ChallengeSubmission,
    arguments=ENTRY_ARGUMENTS,
    body=Bytes(MOST_SENT_BYTES),
    status=202,
)
def submit_to_challenge(name: str, body: IO[bytes]) -> ChallengeSubmission:
    """Submit a zip archive of trajectories, each named after its sequence.

    The same files sent again on the same day are the same submission, and count once.
    """
    return challenge_files.send_body(name, request.args.get("team", ""), request.args.get("phase", ""), body)


@TABLE.post(Section.CHALLENGES, "/challenges/{name}/images", ChallengeSubmission, body=ImageEntry, status=202)
def submit_image_to_challenge(name: str, body: ImageEntry) -> ChallengeSubmission:
    """Submit an image, which runs on the recordings of the challenge.

    The answer comes when the upload has been checked. That takes about ten seconds for each GB.
    """
    return challenge_files.send_image(name, body)


@TABLE.post(Section.CHALLENGES, "/challenges/{name}/submissions/{submission}/cancel", ChallengeSubmission)
def cancel_challenge_submission(name: str, submission: str) -> ChallengeSubmission:
    """Cancel a submission whose result is not shown yet. It still counts for its day."""
    return challenge_files.cancel(name, submission)
