from dataclasses import replace

import pytest

from slamhive.run_folder.folder import RunFolder
from slamhive.services.evaluations.service import evaluation_files
from tests.services.tiny_project import make_dataset

pytestmark = pytest.mark.quick


def test_what_is_there_is_named_and_links_are_left_out(tmp_path):
    dataset = replace(make_dataset(tmp_path), reference_map="room.pcd", relations="gone.relations")
    (dataset.folder / "room.pcd").write_text("x")
    folder = RunFolder(tmp_path / "7")
    folder.create()
    assert evaluation_files(folder, dataset) == {"reference_map": dataset.folder / "room.pcd"}
    folder.map.write_text("x")
    folder.covariances.symlink_to("/etc/passwd")
    assert evaluation_files(folder, dataset) == {"reference_map": dataset.folder / "room.pcd", "map": folder.map}
