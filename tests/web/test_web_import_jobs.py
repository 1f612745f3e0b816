"""Imports of datasets and algorithms in the browser: looked at, imported in the background, cancelled, refused."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import pytest
from werkzeug.datastructures import MultiDict
from werkzeug.test import TestResponse

from slamhive.base.errors import InvalidInput
from slamhive.base.settings import Mode
from slamhive.documents.imports import AlgorithmOnServer, DatasetOnServer
from slamhive.domain.accounts import Role
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ImageMissing, ImageTools
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.services.executors import Executors
from slamhive.web.context import IMPORTS_EXTENSION
from slamhive.web.views.imports import import_fields, read_import, typed, without_flags
from tests.foreign import folders
from tests.recordings.format_world import make_euroc
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.account_world import AccountWeb, account_web, token_of
from tests.web.test_web_uploads import create, send, tar_of, upload
from tests.web.web_world import Web, make_web

DATASETS_HERE, ALGORITHMS_HERE = "/import/server/datasets", "/import/server/algorithms/here"


def post(web: Web, address: str, **fields: Any) -> TestResponse:
    token = token_of(web.client, "/import")
    return web.client.post(address, data={"csrf_token": token, **fields})


def page_of(web: Web, answer: TestResponse) -> str:
    """The page of an import, once no thread works on it."""
    assert answer.status_code == 303, answer.text
    address = answer.headers["Location"]
    jobs = web.app.extensions[IMPORTS_EXTENSION]
    eventually(lambda: jobs.latest(address.rpartition("/")[2]) is None or jobs.latest(address.rpartition("/")[2]).done,
               "the import")  # fmt: skip
    return web.client.get(address).text


def action(page: str, name: str) -> str:
    found = re.search(rf'action="(/import/(?:server/)?jobs/[0-9a-f]+/{name})"', page)
    assert found, page
    return found[1]


def words(page: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page.partition("<main")[2].partition("</main")[0]))


# -- the web form ------------------------------------------------------------------------------------------------------


def test_fields_of_the_form_are_those_of_the_request() -> None:
    fields = {field.name: field for field in import_fields(DatasetOnServer)}
    assert fields.keys() == DatasetOnServer.model_fields.keys()
    assert fields["frame_rate_hz"].label == "Frame rate [Hz]"
    assert (fields["accept_loss"].kind, fields["topics"].kind, fields["calibration"].kind) == (
        "switch",
        "table",
        "lines",
    )
    assert "rgbd" in {field.name: field for field in import_fields(AlgorithmOnServer)}["setup"].choices


def test_a_form_makes_a_request_and_a_request_fills_the_form() -> None:
    form = MultiDict({
        "path": "/a b/walk", "topics": "cam0=/left\r\nimu0=none\r\n", "frame_rate_hz": "7.5", "accept_loss": "yes",
        "calibration": "/k/camchain.yaml\n/k/imu.yaml", "name": " ",
    })  # fmt: skip
    made = read_import(DatasetOnServer, form)
    assert made == DatasetOnServer(
        path="/a b/walk", topics={"cam0": "/left", "imu0": "none"}, frame_rate_hz=7.5, accept_loss=True,
        calibration=("/k/camchain.yaml", "/k/imu.yaml"),
    )  # fmt: skip
    assert read_import(DatasetOnServer, MultiDict(typed(made))) == made


@pytest.mark.parametrize(
    ("fields", "said"),
    [({}, "nothing is chosen to import"),
     ({"path": "/a", "frame_rate_hz": "fast"}, "Frame rate .* 'fast' is not a number"),
     ({"path": "/a", "frame_rate_hz": "-1"}, "frame_rate_hz"),
     ({"path": "/a", "topics": "cam0"}, "'cam0' is not SENSOR=TOPIC"),
     ({"path": "/a", "name": "x" * 70}, "name")],
)  # fmt: skip
def test_a_wrong_field_is_named(fields: dict[str, str], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        read_import(DatasetOnServer, MultiDict(fields))


def test_messages_name_fields_and_not_options_of_the_command_line() -> None:
    assert without_flags("choose another --name, or --groundtruth-topic") == (
        "choose another name, or “Topic of the ground truth”"
    )
    assert without_flags("--accept-loss imports the rest; --topic a; --odd") == (
        "“Accept losses” imports the rest; “Topics of sensors” a; --odd"
    )


# -- datasets ----------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_recording_on_the_server_is_looked_at_then_imported(empty: Web, tmp_path: Path) -> None:
    source = make_euroc(tmp_path / "desk")
    page = page_of(empty, post(empty, DATASETS_HERE, path=str(source), name="walk"))
    shown = words(page)
    assert "nothing is stored yet" in shown
    assert "Format euroc" in shown
    assert "cam0" in shown
    assert "Ground truth" in shown
    assert "Left out, assumed or unusual" in shown
    assert empty.hive.catalogue.datasets() == ()
    done = words(page_of(empty, post(empty, action(page, "store"))))
    assert "walk is here" in done
    assert "computing the checksum" in done
    assert [entry.name for entry in empty.hive.catalogue.datasets()] == ["walk"]
    assert source.is_dir()


@pytest.mark.integration
def test_an_upload_is_looked_at_then_imported_and_its_bytes_go(empty: Web, tmp_path: Path) -> None:
    token = upload(empty, tar_of(make_euroc(tmp_path / "desk")), "desk.tar")
    page = page_of(empty, post(empty, "/import/datasets", upload=token))
    assert "Format euroc" in words(page)
    assert empty.hive.catalogue.datasets() == ()
    assert "desk is here" in words(page_of(empty, post(empty, action(page, "store"))))
    assert empty.hive.uploads.get(token, "").imported is not None
    assert not empty.hive.uploads.folder(token, "").content.exists()


@pytest.mark.integration
def test_what_is_refused_says_why_and_can_be_looked_at_again(empty: Web, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    page = page_of(empty, post(empty, DATASETS_HERE, path=str(tmp_path / "empty")))
    assert "is in no format that can be imported" in words(page)
    assert "Say more, and look again" in page
    assert f'<input type="hidden" name="path" value="{tmp_path / "empty"}">' in page
    assert "Build and import" not in page
    page = page_of(empty, post(empty, action(page, "discard").replace("/discard", "/cancel")))
    post(empty, action(page, "discard"))
    assert empty.client.get(action(page, "discard").removesuffix("/discard")).status_code == 404


@pytest.mark.quick
@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("walk", "is not an absolute path"),
        ("/nowhere/at/all", "does not exist on this server"),
        ("", "nothing is chosen"),
    ],
)
def test_a_path_that_cannot_be_read_is_one_line(empty: Web, path: str, said: str) -> None:
    answer = post(empty, DATASETS_HERE, path=path, name="keeps")
    assert answer.status_code == 400
    assert said in answer.text
    assert 'value="keeps"' in answer.text
    assert answer.text.count('role="alert"') == 1


@pytest.mark.quick
def test_an_upload_that_is_not_complete_is_not_looked_at(empty: Web) -> None:
    token = create(empty, b"1234", "walk.bag").get_json()["token"]
    send(empty, token, b"12")
    answer = post(empty, "/import/datasets", upload=token)
    assert (answer.status_code, "2 of 4 bytes of walk.bag have arrived" in answer.text) == (409, True)


@pytest.mark.integration
def test_an_import_that_is_cancelled_leaves_nothing_and_can_be_tried_again(
    empty: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, began, go_on = make_euroc(tmp_path / "desk"), threading.Event(), threading.Event()
    real: Callable[..., Any] = type(empty.hive.catalogue).import_dataset

    def slow(catalogue: Any, planned: Any, progress: Callable[[float, str], None]) -> Any:
        def told(fraction: float, text: str) -> None:
            began.set()
            go_on.wait(30)
            progress(fraction, text)

        return real(catalogue, planned, told)

    monkeypatch.setattr(type(empty.hive.catalogue), "import_dataset", slow)
    page = page_of(empty, post(empty, DATASETS_HERE, path=str(source)))
    answer = post(empty, action(page, "store"))
    assert began.wait(30)
    page = empty.client.get(answer.headers["Location"]).text
    assert "data-refresh" in page
    assert 'role="progressbar"' in page
    refused = post(empty, action(page, "cancel").replace("/cancel", "/discard"))
    assert refused.status_code == 409
    threading.Timer(0.2, go_on.set).start()
    page = page_of(empty, post(empty, action(page, "cancel")))
    assert "The import was cancelled" in words(page)
    assert list(empty.hive.settings.datasets_folder.glob("*")) == []
    assert "desk is here" in words(page_of(empty, post(empty, action(page, "store"))))


# -- algorithms --------------------------------------------------------------------------------------------------------


@pytest.fixture
def package(web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package under a name that is free, outside of the project."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    folder = tmp_path / "new-slam"
    shutil.copytree(web.hive.catalogue.project_root / "algorithms" / "beam-odometry", folder)
    file = folder / "algorithm.yaml"
    file.write_text(file.read_text().replace("package: beam-odometry", "package: new-slam"))
    return folder


@pytest.mark.integration
def test_a_package_is_looked_at_then_built_with_its_log(
    web: Web, package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(_executor: object, built: AlgorithmPackage, progress: Callable[[str], None]) -> str:
        progress(f"Step 1/2 : of {built.name}")
        progress("Step 2/2 : the end")
        return "identity"

    monkeypatch.setattr(ProcessExecutor, "build", build)
    page = page_of(web, post(web, ALGORITHMS_HERE, path=str(package)))
    assert "a package with 1 algorithm: new-slam" in words(page)
    assert "The build executes the steps of this package" in words(page)
    assert "algorithm.yaml , as it is" in words(page)
    with pytest.raises(Exception, match="new-slam"):
        web.hive.catalogue.algorithm("new-slam")
    page = page_of(web, post(web, action(page, "store")))
    assert "new-slam is here" in words(page)
    assert re.search(r"\d s  Step 1/2 : of new-slam\n", page)
    assert "Step 2/2 : the end" in page
    assert web.hive.catalogue.algorithm("new-slam").package.folder.parent == web.hive.settings.algorithms_folder


@pytest.mark.integration
def test_a_build_that_fails_leads_with_the_reason_and_the_last_lines(
    web: Web, package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(_executor: object, _built: object, progress: Callable[[str], None]) -> str:
        for number in range(40):
            progress(f"line <{number}>")
        raise ImageMissing("building new-slam failed at Step 2/2: no compiler")

    monkeypatch.setattr(ProcessExecutor, "build", build)
    token = upload(web, tar_of(package), "new-slam.tar")
    page = page_of(web, post(web, "/import/server/algorithms", upload=token))
    page = page_of(web, post(web, action(page, "store")))
    shown = words(page)
    assert shown.index("building new-slam failed at Step 2/2: no compiler.") < shown.index("The last lines")
    last = page.partition('aria-label="The last lines of the log">')[2].partition("</pre>")[0].splitlines()
    assert len(last) == 12
    assert last[-1].endswith("line &lt;39&gt;")
    assert "Log, 42 lines" in shown  # the checksum and the bytes that were unpacked have a line each
    assert not (web.hive.settings.algorithms_folder / "new-slam").exists()
    assert "Try again" in shown


@pytest.mark.integration
def test_an_archive_that_leads_out_of_its_folder_is_refused(web: Web, package: Path) -> None:
    (package / "evil").symlink_to("/etc")
    token = upload(web, tar_of(package), "new-slam.tar")
    page = page_of(web, post(web, "/import/server/algorithms", upload=token))
    assert "new-slam.tar is not unpacked: it holds 'new-slam/evil', which is a link" in words(page).replace(
        "&#39;", "'"
    )


@pytest.mark.integration
def test_a_published_folder_remembers_the_file_that_was_sent(
    web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither its ``algorithm.yaml`` nor its page names the folder in which it was unpacked."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: "docker")
    monkeypatch.setattr(DockerExecutor, "image_tools", lambda _executor: create_autospec(ImageTools))
    path = folders.loam(tmp_path)
    (path / "Dockerfile").write_text("FROM scratch\nCOPY slamhive /slamhive\n")
    page = page_of(web, post(web, "/import/server/algorithms", upload=upload(web, tar_of(path), "mine.tar")))
    assert "a folder of the published SLAM Hive" in words(page)
    assert "algorithm.yaml , as drafted from its files" in words(page)
    assert "source: &#34;an upload of loam&#34;" in page
    assert ".slamhive-" not in page


# -- who may -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def accounts(filled: Path, tmp_path: Path) -> Any:
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    with account_web(tmp_path) as made:
        yield made


@pytest.mark.integration
def test_only_admins_import_from_the_server_and_nobody_sees_the_imports_of_others(
    accounts: AccountWeb, tmp_path: Path
) -> None:
    source = make_euroc(tmp_path / "desk")
    admin, member = accounts.of(Role.ADMIN), accounts.of(Role.MEMBER)
    page = member.get("/import").text
    assert "From a path on the server" not in page
    assert "Only admins import algorithms" in page
    for address in (DATASETS_HERE, ALGORITHMS_HERE, "/import/server/algorithms"):
        answer = member.post(address, data={"csrf_token": token_of(member, "/import"), "path": str(source)})
        assert answer.status_code == 403
    answer = admin.post(DATASETS_HERE, data={"csrf_token": token_of(admin, "/import"), "path": str(source)})
    assert answer.status_code == 303, answer.text
    address = answer.headers["Location"]
    assert admin.get(address).status_code == 200
    assert member.get(address).status_code == 403
    assert member.get(address.replace("/server", "")).status_code == 404
    assert any(f"path {source}" in line.subject for line in accounts.web.hive.accounts.audit(50, None, None))


@pytest.mark.quick
def test_a_view_only_server_imports_nothing(filled: Path, tmp_path: Path) -> None:
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    assert web.client.get("/import").status_code == 403
    for address in (DATASETS_HERE, ALGORITHMS_HERE, "/import/datasets", "/import/server/algorithms"):
        assert web.client.post(address, data={"path": "/"}).status_code in (400, 403)
    web.hive.close()


@pytest.mark.quick
def test_the_token_of_a_form_is_needed(empty: Web) -> None:
    assert empty.client.post(DATASETS_HERE, data={"path": "/"}).status_code == 400
