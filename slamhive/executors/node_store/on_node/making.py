"""Has the variant of a dataset made on this node, from the recording in its cache.

A process with an installation of SLAM Hive makes it (:mod:`slamhive.executors.node_store.controller`). So its libraries
take no memory while the run goes on, and it can be ended at any time. What it says: a line for each step forwards, and
at last why it has failed.
"""

from __future__ import annotations

import json
import subprocess
from hashlib import sha256
from pathlib import Path
from typing import Any, Callable, Dict, List

from slamhive.executors.node_store.on_node.cache import MADE, Cache, Fetch, Held, Item
from slamhive.executors.node_store.on_node.run import WrongNode

MADE_FILE = "made.json"
"""What has been made, beside the recording of the variant."""
VARIANT_FILE = "made-variant.json"
"""The same as a node reports it of a run."""
CHECKSUM, BAG = "checksum", "bag"
FRACTION, PROBLEM = "fraction", "problem"
_MODULE = "slamhive.executors.node_store.controller"

MadeProgress = Callable[[float], None]
"""Gets the fraction of the variant that is there."""


def item_of(order: Dict[str, Any]) -> Item:
    """The variant of an order, as JSON, as an item of the cache: equal orders have the same name."""
    name = sha256("variant {}".format(order["key"]).encode()).hexdigest()
    return Item(name, int(order["room_bytes"]), MADE, 0, words_of(order))


def words_of(order: Dict[str, Any]) -> str:
    """The name for messages."""
    return "the variant {} of {}".format(order["key"][:12], order["dataset"])


def hold_variant(
    cache: Cache, order: Dict[str, Any], source: Item, fetch: Fetch, python: str, progress: MadeProgress
) -> Held:
    """The variant in the cache, made unless it is there. Only who makes it needs the recording.

    Args:
        cache: The cache of this node.
        order: A ``VariantOrder`` as JSON.
        source: The recording of the dataset.
        fetch: Brings it.
        python: The program of a Python that has SLAM Hive.
        progress: Called while it is being made.

    Raises:
        WrongNode: The node cannot make it, or would make other bytes.
        CacheFull, OSError: There is no room.
    """

    def make(_item: Item, folder: Path) -> None:
        recording = cache.hold(source, fetch)
        try:
            make_apart([python, "-m", _MODULE], order, recording.path, folder, progress)
        finally:
            recording.release()

    return cache.hold(item_of(order), make)


def read_made(folder: Path) -> Dict[str, str]:
    """Of a variant in the cache: the checksum of its recording, and where that lies in the folder."""
    made = json.loads((folder / MADE_FILE).read_text(encoding="utf-8"))
    return {name: str(made[name]) for name in (CHECKSUM, BAG)}


def make_apart(
    program: List[str], order: Dict[str, Any], recording: Path, folder: Path, progress: MadeProgress
) -> None:
    """Make the variant in ``folder``, which is empty, by another process. Raises WrongNode, OSError.

    If ``progress`` raises, or a signal ends the wait, the process is ended.
    """
    command = [*program, str(recording), str(folder)]
    problem = ""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, universal_newlines=True) as process:
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps(order))
            process.stdin.close()
            for line in process.stdout:
                try:
                    said = json.loads(line)
                except ValueError:
                    continue  # one of its libraries has printed it
                if isinstance(said, dict):
                    problem = said.get(PROBLEM, problem)
                    if FRACTION in said:
                        progress(said[FRACTION])
        except BrokenPipeError:
            problem = "{} cannot make variants".format(" ".join(program))
        except BaseException:
            process.kill()
            raise
    if problem or process.returncode:
        why = problem or "the process that makes it ended with code {}".format(process.returncode)
        raise WrongNode("{} cannot be made on its node: {}".format(words_of(order), why))
