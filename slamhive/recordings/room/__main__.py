"""Write pictures of the room as PNG: ``python -m slamhive.recordings.room FOLDER --count 60 --seed 1``."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from slamhive.recordings.room.sensors import sample_views


def main() -> None:
    """Parse the arguments and write the pictures."""
    parser = argparse.ArgumentParser(prog="python -m slamhive.recordings.room", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(sample_views(arguments.count, arguments.seed)):
        path = arguments.folder / f"{number:04d}.png"
        if not cv2.imwrite(str(path), image):
            parser.error(f"{path} cannot be written")


if __name__ == "__main__":
    main()
