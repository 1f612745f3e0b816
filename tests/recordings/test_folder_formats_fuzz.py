"""No damage to a folder makes an import fail otherwise than in one line, with nothing left behind."""

import random

import pytest

from slamhive.base.errors import SlamHiveError
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, perform
from tests.fuzzing import mutated
from tests.recordings.format_world import silent
from tests.recordings.test_folder_formats import ALL, made

pytestmark = pytest.mark.integration
MUTATIONS = 40


@pytest.mark.parametrize("name", ALL)
def test_a_damaged_folder_is_read_or_refused_in_one_line(tmp_path, name):
    source, options = made(name, tmp_path / "source")
    files = [source] if source.is_file() else sorted(path for path in source.rglob("*") if path.is_file())
    draw = random.Random(f"{name} 1")
    refusals = []
    for number in range(MUTATIONS):
        path = files[draw.randrange(len(files))]
        content = path.read_bytes()
        path.write_bytes(mutated(content, draw))
        folder = tmp_path / f"made{number}"
        try:
            perform(plan_import(source, ImportOptions(**options), name)[1], folder, silent)
        except SlamHiveError as error:
            refusals.append(str(error))
            assert not folder.exists()
        else:
            assert load_dataset(folder).sensors
        path.write_bytes(content)
    assert len(refusals) > MUTATIONS // 10
    assert not any("\n" in refusal for refusal in refusals)
