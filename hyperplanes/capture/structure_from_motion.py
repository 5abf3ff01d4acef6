"""Camera poses from pictures, by pycolmap: features, matches, incremental mapping.

Features and matches are kept in COLMAP's database as they are computed, so that an interrupted run goes on with those
that are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from hyperplanes.capture.packages import require, stated_threads
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.utilities.writing import write_whole

__all__ = ["ATTEMPTS", "Features", "Picture", "find_poses", "pairs_to_match"]

Progress = Callable[[str, int, int, str], None]
"""Called with what is done, how far, of how much, and a few words."""

EXHAUSTIVE = 80
"""Pictures up to which all pairs are matched."""

OVERLAP = 10  # neighbours of a picture in a sequence that it is matched with
CLOSING = 40  # pictures, evenly spread, that are matched with each other to close loops
SMALLEST_MODEL = 3  # pictures
SEED = 0  # of the random choices
FEATURES_AT_ONCE, PAIRS_AT_ONCE = 8, 150


@dataclass(frozen=True)
class Picture:
    """A picture that poses are searched for.

    Attributes:
        file: its name in the folder of pictures, without blanks.
        camera: which pictures share a camera.
        size: (height, width).
        focal: focal length in pixels, or None where nothing is known.
    """

    file: str
    camera: int
    size: tuple[int, int]
    focal: float | None = None


@dataclass(frozen=True)
class Features:
    """How features are extracted.

    Each is adapted to the slant of the surface that it lies on (affine shapes). Without that, a table seen at 12
    degrees has next to no features in common with the same table at 35 degrees, where it is 2.8 times as high in the
    picture: of 36 photographs in rounds at 12, 35 and 58 degrees 24 are posed without, even with three times the
    features, and all with affine shapes. Photographs of a bust have a quarter more matches by them, and take half as
    long again.

    Attributes:
        name: of the attempt, for messages.
        count: in a picture, at most.
        peak: contrast that a feature must have, relative to COLMAP's default.
        pooled: whether descriptors are pooled over several sizes of a feature.
        below: share of the pictures that are registered, below which it is tried.
    """

    name: str
    count: int = 4096
    peak: float = 1.0
    pooled: bool = False
    below: float = 1.0


ATTEMPTS = (
    Features("SIFT with affine shapes"),
    Features("more and weaker features", 12288, 0.4, below=0.95),
    Features("more and weaker features, and domain-size pooling", 12288, 0.4, True, below=0.8),
)
"""What is tried in turn while too few pictures are registered.

Of 36 photographs of 480 x 360 pixels of a plain spacecraft the first registers 31; with 8,192 features of half the
contrast all are, each within 0.5 degrees and 1 % of the distance, in twice the time.
"""


def find_poses(
    pictures: Sequence[Picture],
    folder: Path,
    database: Path,
    *,
    features: Features,
    sequential: bool,
    progress: Progress,
) -> SparseModel | None:
    """The poses of pictures: the largest of the models that structure from motion arrives at.

    Args:
        pictures: the order is that of a sequence, where they are one.
        folder: what holds them.
        database: COLMAP's, continued where it is there; the pictures are those it was made for.
        features: how features are extracted.
        sequential: match neighbours in the sequence, and some pictures from all of it, rather than all pairs.
        progress: called as it goes on.

    Returns:
        The model in COLMAP's world, or None where no two pictures could be registered.
    """
    pycolmap = require("pycolmap", "finds camera poses")
    with _quiet(pycolmap):
        pycolmap.set_random_seed(SEED)
        _extract(pycolmap, pictures, folder, database, features, progress)
        _match(pycolmap, pictures, database, sequential, progress)
        found = _map(pycolmap, len(pictures), folder, database, progress)
    if not found:
        return None
    largest = max(found, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    return _sparse_model(largest, {picture.file: index for index, picture in enumerate(pictures)})


def pairs_to_match(count: int, sequential: bool) -> list[tuple[int, int]]:
    """Which pictures are matched: all pairs, or neighbours in a sequence and what closes its loops.

    In a sequence each picture is matched with the next OVERLAP, with those 16, 32, 64, ... after it, and CLOSING
    pictures, evenly spread, with each other.

    >>> pairs_to_match(3, sequential=False)
    [(0, 1), (0, 2), (1, 2)]
    """
    if not sequential:
        return list(combinations(range(count), 2))
    steps = [*range(1, OVERLAP + 1), *(2**power for power in range(4, max(4, count.bit_length())))]
    near = {(first, first + step) for step in steps for first in range(count - step)}
    spread = sorted({round(index) for index in np.linspace(0, count - 1, min(count, CLOSING))})
    return sorted(near | set(combinations(spread, 2)))


def _extract(
    pycolmap: Any, pictures: Sequence[Picture], folder: Path, database: Path, features: Features, progress: Progress
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = _threads()
    options.sift.max_num_features = features.count
    options.sift.peak_threshold *= features.peak
    options.sift.estimate_affine_shape, options.sift.domain_size_pooling = True, features.pooled
    with _opened(pycolmap, database) as opened:
        known = {one.camera_id: one for one in opened.read_all_cameras()}
        done = {image.name for image in opened.read_all_images() if opened.exists_descriptors(image.image_id)}
        for number in sorted({picture.camera for picture in pictures}):
            if number + 1 not in known:
                opened.write_camera(_camera(pycolmap, next(p for p in pictures if p.camera == number)))
    left = [picture for picture in pictures if picture.file not in done]
    for number in sorted({picture.camera for picture in left}):
        reader = pycolmap.ImageReaderOptions()
        reader.existing_camera_id = number + 1
        names = [picture.file for picture in left if picture.camera == number]
        for start in range(0, len(names), FEATURES_AT_ONCE):
            chunk = names[start : start + FEATURES_AT_ONCE]
            progress("features", len(done), len(pictures), chunk[0])
            pycolmap.extract_features(
                database, folder, chunk, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
            )
            done.update(chunk)
    progress("features", len(pictures), len(pictures), features.name)


def _camera(pycolmap: Any, picture: Picture) -> Any:
    """COLMAP's camera of one focal length and two radial coefficients."""
    height, width = picture.size
    focal = picture.focal or 1.2 * max(picture.size)
    camera = pycolmap.Camera.create_from_model_name(0, "RADIAL", focal, width, height)
    camera.has_prior_focal_length = picture.focal is not None
    return camera


def _match(pycolmap: Any, pictures: Sequence[Picture], database: Path, sequential: bool, progress: Progress) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = _threads()
    with _opened(pycolmap, database) as opened:
        number = {image.name: image.image_id for image in opened.read_all_images()}
        done = set(opened.read_all_matches()[0])
    pairs = [(pictures[i].file, pictures[j].file) for i, j in pairs_to_match(len(pictures), sequential)]
    left = [pair for pair in pairs if pycolmap.image_pair_to_pair_id(*(number[name] for name in pair)) not in done]
    listed = database.with_suffix(".pairs.txt")
    for start in range(0, len(left), PAIRS_AT_ONCE):
        progress("matches", len(pairs) - len(left) + start, len(pairs), "pairs of pictures")
        chunk = left[start : start + PAIRS_AT_ONCE]
        write_whole(listed, "\n".join(f"{first} {second}" for first, second in chunk).encode(), durable=False)
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(database, options, pairing, device=pycolmap.Device.cpu)
    listed.unlink(missing_ok=True)
    progress("matches", len(pairs), len(pairs), "pairs of pictures")


def _map(pycolmap: Any, count: int, folder: Path, database: Path, progress: Progress) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = _threads()
    options.random_seed = SEED
    options.min_model_size = SMALLEST_MODEL
    options.extract_colors = True
    registered = 0

    def start() -> None:
        nonlocal registered
        registered = 2
        progress("poses", registered, count, "pictures registered")

    def step() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("poses", registered, count, "pictures registered")

    out = database.with_suffix(".models")
    out.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        database, folder, out, options, initial_image_pair_callback=start, next_image_callback=step
    )
    return list(found.values())


def _sparse_model(model: Any, index: dict[str, int]) -> SparseModel:
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: index[image.name])
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    calibrations = np.tile(np.eye(3), (len(images), 1, 1))
    lenses = np.zeros((len(images), 2))
    at = {}
    for row, image in enumerate(images):
        at[image.image_id] = row
        poses[row, :3] = image.cam_from_world().matrix()
        focal, x, y, *lenses[row] = model.cameras[image.camera_id].params
        calibrations[row] = [[focal, 0, x - 0.5], [0, focal, y - 0.5], [0, 0, 1]]
    points = list(model.points3D.values())
    observed, pixels = [], []
    for row, point in enumerate(points):
        for element in point.track.elements:
            observed.append((at[element.image_id], row))
            pixels.append(model.images[element.image_id].points2D[element.point2D_idx].xy - 0.5)
    return SparseModel(
        np.array([index[image.name] for image in images], np.int64),
        poses,
        calibrations,
        lenses,
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.error for point in points], np.float64),
        np.array(observed, np.int64).reshape(-1, 2),
        np.array(pixels, np.float64).reshape(-1, 2),
    )


@contextmanager
def _opened(pycolmap: Any, path: Path) -> Generator[Any]:
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


@contextmanager
def _quiet(pycolmap: Any) -> Generator[None]:
    """Nothing of COLMAP's log on standard error: what went wrong is raised, or said by who called."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _threads() -> int:
    """Threads for COLMAP: as many as OMP_NUM_THREADS allows, otherwise all cores."""
    return stated_threads() or -1
