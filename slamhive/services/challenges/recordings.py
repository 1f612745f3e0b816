"""The recordings of a challenge, which images run on: copied once, and linked into the installation of each image."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

from slamhive.bags.staging import seal
from slamhive.catalogue.dataset_file import load_dataset
from slamhive.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.files import held_folder, remedy_of


def keep_recording(source: Path, name: str, target: Path) -> None:
    """Copy the recording of the dataset in ``source`` to ``target`` as the dataset ``name``, without ground truth.

    Raises InvalidInput if it is no dataset with a recording; OSError if the disk refuses.
    """
    try:
        dataset = load_dataset(source)
        bag = dataset.bag_path
    except SlamHiveError as error:
        raise InvalidInput(
            f"the recording of sequence {name} cannot be used: {error}",
            "name the folder of a dataset, such as data/datasets/NAME",
        ) from None
    if not bag.exists():
        raise InvalidInput(f"the recording of sequence {name} lacks {bag}", "import it again")
    target.mkdir(parents=True)
    if bag.is_dir():
        shutil.copytree(bag, target / dataset.bag)
    else:
        shutil.copyfile(bag, target / dataset.bag)
    seal(target, replace(dataset, name=name, folder=target, groundtruth=None, relations=None, reference_map=None))


def link_folder(source: Path, target: Path) -> None:
    """Let ``target`` have the files of ``source``, without a copy. Does nothing if it is there. Raises Unavailable."""
    if target.exists():
        return
    aside = target.with_name(f".{target.name}")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        with held_folder(aside):
            shutil.copytree(source, aside, copy_function=os.link, dirs_exist_ok=True)
            aside.rename(target)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)
        raise Unavailable(f"{target} cannot be made: {error.strerror or error}", remedy_of(error)) from None
