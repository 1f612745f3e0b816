"""Trains a small ORB vocabulary by hierarchical k-majority, in the text format of DBoW2 that ORB-SLAM2 and 3 read.

A program of its own: ``python3 -m slamhive.recordings.room.orb_vocabulary OUTPUT --images FOLDER`` (any images), or
without ``--images`` on rendered rooms. Images of algorithms run it while they are built.

It makes a vocabulary tree (Nister and Stewenius, CVPR 2006) of binary descriptors (Galvez-Lopez and Tardos, T-RO
2012). The descriptors of each node are split into ``branching`` clusters, down to ``levels``. The clusters come from
k-majority (Grana et al., ICPR 2013): k-means in Hamming space, with the bit-wise majority as centre. The weight of a
word is its inverse document frequency.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slamhive.recordings.room.camera import Renderer
from slamhive.recordings.room.sensors import make_rig
from slamhive.recordings.room.world import motion_at

Bits = NDArray[np.uint8]

BRANCHING = 10
LEVELS = 4
NOMINAL_LEVELS = 6
"""What the file says: ORB-SLAM3 compares features whose words share an ancestor at this level - 4, the second."""
IMAGES = 60
FEATURES_PER_IMAGE = 1200
ITERATIONS = 6
LEAST_TO_SPLIT = 3
SCORING_L1 = 0
WEIGHTING_TF_IDF = 0


@dataclass(frozen=True, eq=False)
class VocabularyNode:
    """A node of the tree: id of its parent, 32 descriptor bytes, and which training descriptors it holds."""

    parent: int
    descriptor: Bits
    members: NDArray[np.int64]
    leaf: bool


def describe(images: list[NDArray[np.uint8]]) -> tuple[Bits, NDArray[np.int64]]:
    """ORB descriptors of all images (n, 32) and the image each comes from (n,)."""
    orb = cv2.ORB.create(nfeatures=FEATURES_PER_IMAGE, scaleFactor=1.2, nlevels=8, fastThreshold=12)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    usable = [(number, rows) for number, rows in enumerate(found) if rows is not None]
    if not usable:
        raise SystemExit("error: no ORB feature was found in the training images")
    descriptors = np.concatenate([rows for _, rows in usable])
    sources = np.concatenate([np.full(len(rows), number) for number, rows in usable])
    return descriptors, sources


def grow(descriptors: Bits, branching: int, levels: int, rng: np.random.Generator) -> list[VocabularyNode]:
    """The nodes in the order of their ids (the root, id 0, left out), parents before children."""
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    nodes: list[VocabularyNode] = []
    pending = [(0, np.arange(len(descriptors)), 1)]
    while pending:
        parent, members, level = pending.pop(0)
        # The first two levels are always split: ORB-SLAM3 compares words by their ancestors two levels up.
        for group in _split(bits, members, branching, rng):
            splits = level < levels and (len(group) >= LEAST_TO_SPLIT or level < 2)
            nodes.append(VocabularyNode(parent, np.packbits(bits[group].mean(axis=0) > 0.5), group, leaf=not splits))
            if splits:
                pending.append((len(nodes), group, level + 1))
    return nodes


def write(path: Path, nodes: list[VocabularyNode], sources: NDArray[np.int64], branching: int) -> int:
    """Write the vocabulary; returns the number of words."""
    images = int(sources.max()) + 1
    lines = [f"{branching} {NOMINAL_LEVELS} {SCORING_L1} {WEIGHTING_TF_IDF}"]
    for node in nodes:
        weight = np.log(images / len(np.unique(sources[node.members]))) if node.leaf else 0.0
        numbers = " ".join(str(byte) for byte in node.descriptor.tolist())
        lines.append(f"{node.parent} {int(node.leaf)} {numbers} {weight:.6f}")
    aside = path.with_name(f".{path.name}")
    aside.write_text("\n".join(lines), encoding="ascii")
    os.replace(aside, path)  # noqa: PTH105
    return sum(node.leaf for node in nodes)


def render_images(count: int) -> list[NDArray[np.uint8]]:
    """Views of rendered rooms of three seeds from random places."""
    rig = make_rig(640, 480, 10.0)
    images = []
    seeds = (101, 102, 103)
    for seed in seeds:
        renderer = Renderer(seed)
        share = count // len(seeds)
        for moment_s in np.linspace(0.0, 60.0, share, endpoint=False):
            T_world_body = motion_at(np.array([moment_s]), 60.0).T_world_body(0)
            view = renderer.view(T_world_body @ rig.T_body_left, rig.camera)
            images.append(np.clip(np.rint(view.grey), 0, 255).astype(np.uint8))
        _say(f"rendered {len(images)}/{count} training images")
    return images


def read_images(folder: Path, count: int) -> list[NDArray[np.uint8]]:
    """At most ``count`` images of ``folder``, evenly spread, as grey."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in {".png", ".jpg", ".jpeg"})
    if not paths:
        raise SystemExit(f"error: {folder} holds no .png or .jpg images")
    chosen = [paths[index] for index in np.unique(np.linspace(0, len(paths) - 1, min(count, len(paths))).astype(int))]
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in chosen]
    return [image.astype(np.uint8) for image in images if image is not None]


def prepare() -> None:
    """The program of a package's ``prepare.py``: its small vocabulary, in ``SLAMHIVE_PREPARE_DIR``."""
    main([str(Path(os.environ["SLAMHIVE_PREPARE_DIR"]) / "small_vocabulary.txt")])


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("output", type=Path)
    parser.add_argument("--images", type=Path, help="folder with training images; rendered rooms if not given")
    parser.add_argument("--count", type=int, default=IMAGES, help="number of images")
    parser.add_argument("--branching", type=int, default=BRANCHING)
    parser.add_argument("--levels", type=int, default=LEVELS)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    images = read_images(options.images, options.count) if options.images else render_images(options.count)
    descriptors, sources = describe(images)
    _say(f"training on {len(descriptors)} descriptors of {len(images)} images")
    nodes = grow(descriptors, options.branching, options.levels, np.random.default_rng(options.seed))
    words = write(options.output, nodes, sources, options.branching)
    _say(f"wrote {options.output.name}: {words} words, {options.output.stat().st_size / 1e6:.1f} MB")
    return 0


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - the program's own output


def _split(
    bits: NDArray[np.float32], members: NDArray[np.int64], branching: int, rng: np.random.Generator
) -> list[NDArray[np.int64]]:
    """At most ``branching`` groups of ``members``, none empty."""
    if len(members) <= branching:
        return [members[index : index + 1] for index in range(len(members))]
    own = bits[members]
    centres = own[rng.choice(len(members), branching, replace=False)]
    labels = np.full(len(members), -1)
    for _ in range(ITERATIONS):
        # Hamming distance |a - b| = |a| + |b| - 2 a.b; |a| is the same for all centres.
        distances = centres.sum(axis=1)[None, :] - own @ (2 * centres).T
        before, labels = labels, distances.argmin(axis=1)
        if np.array_equal(labels, before):
            break
        for number in range(branching):
            if np.any(labels == number):
                centres[number] = own[labels == number].mean(axis=0) > 0.5
    return [members[labels == number] for number in range(branching) if np.any(labels == number)]


if __name__ == "__main__":
    sys.exit(main())
