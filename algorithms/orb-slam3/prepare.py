"""Run once when the image or environment is built: trains the small vocabulary that runs use by default."""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path

TRAINER = Path(__file__).with_name("vocabulary") / "train_vocabulary.py"

if __name__ == "__main__":
    sys.argv = [str(TRAINER), str(Path(os.environ["SLAMHIVE_PREPARE_DIR"]) / "small_vocabulary.txt")]
    runpy.run_path(str(TRAINER), run_name="__main__")
