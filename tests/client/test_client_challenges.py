"""The Python client submits images to challenges, to a data root and through a server."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.client import Hive
from slamhive.services.hive import open_hive
from tests.services.image_world import image_challenge
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.serving import serving
from tests.web.test_web_challenges import image_archive

pytestmark = pytest.mark.integration


def submit(hive: Hive, archive: Path, team: str) -> None:
    """What both backends do alike."""
    sent = hive.submit_image("rooms", archive, team=team, phase="public", progress=False)
    assert (sent.team, sent.state, sent.image) == (team, "queued", "team-x")
    assert sent.id in [entry.id for entry in hive.challenge_submissions("rooms")]
    with pytest.raises(InvalidInput, match="either a file or a package"):
        hive.submit_image("rooms", team=team)
    with pytest.raises(NotFound, match="nothing"):
        hive.submit_image("rooms", package="nothing", team=team, phase="public")
    with pytest.raises(NotFound, match="unknown challenge"):
        hive.challenge_submissions("room")


def test_images_are_submitted_alike_with_and_without_a_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data", "room")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    image_archive(tmp_path)
    with closing(open_hive({"data": str(tmp_path / "data")})) as opened:
        opened.challenges.create(image_challenge(tmp_path / "organiser"))
        with serving(opened) as address, Hive.connect(address) as hive:
            submit(hive, tmp_path / "image.tar", "a")
        assert opened.uploads.listed("") == []
    with Hive.open(tmp_path / "data", writable=True) as hive:
        submit(hive, tmp_path / "image.tar", "b")
