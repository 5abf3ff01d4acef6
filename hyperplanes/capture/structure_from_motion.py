"""Camera poses from images, by pycolmap: features, matches, incremental mapping.

Features and matches are written to COLMAP's database as they are computed, so that an interrupted run continues with
those that are missing.
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
from hyperplanes.utilities.files.writing import write_whole

__all__ = ["ATTEMPTS", "Features", "Picture", "find_poses", "pairs_to_match"]

Progress = Callable[[str, int, int, str], None]
"""Called with the name of the stage, the number of steps done, their total, and a short text."""

EXHAUSTIVE = 80
"""Largest number of images of which all pairs are matched by default."""

OVERLAP = 10  # images that follow an image in a sequence and are matched with it
CLOSING = 40  # evenly spaced images that are matched with each other to close loops
SMALLEST_MODEL = 3  # images
SEED = 0  # of the random numbers
FEATURES_AT_ONCE, PAIRS_AT_ONCE = 8, 150


@dataclass(frozen=True)
class Picture:
    """An image whose pose is wanted.

    Attributes:
        file: its name in the folder of images, without spaces.
        camera: number of its camera; images of one number share a calibration.
        size: (height, width).
        focal: focal length in pixels, or None if it is unknown.
    """

    file: str
    camera: int
    size: tuple[int, int]
    focal: float | None = None


@dataclass(frozen=True)
class Features:
    """Settings of feature extraction.

    All features have affine shapes, which adapt to the slant of the surface. A table that is seen at an elevation of 35
    degrees is 2.8 times as high in the image as at 12 degrees, so that without affine shapes the two images have almost
    no features in common. Of 36 photographs on circles at 12, 35 and 58 degrees, 24 get a pose without affine shapes,
    even with three times the features, and all 36 with them. For photographs of a bust, affine shapes give a quarter
    more matches and take half as long again.

    Attributes:
        name: of the settings, for messages.
        count: largest number of features in an image.
        peak: least contrast of a feature, relative to COLMAP's default.
        pooled: whether to use domain-size pooling, which averages descriptors over several scales of a feature.
        below: these settings are tried if a smaller share of the images is registered.
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
"""Settings that are tried in turn while too few images are registered.

Of 36 photographs of 480 x 360 pixels of a spacecraft with little texture, the first settings register 31. With 8,192
features of half the contrast, all are registered, each within 0.5 degrees and 1 % of the distance, in twice the time.
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
    """The largest model that structure from motion finds.

    Args:
        pictures: the images, in the order of the sequence if `sequential`.
        folder: that holds them.
        database: path of COLMAP's database. If it exists, it must be of the same images, and is continued.
        features: settings of feature extraction.
        sequential: match only the pairs of images that are described in `pairs_to_match`, instead of all.
        progress: called during the work.

    Returns:
        The model in COLMAP's world, or None if no model was found.
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
    """The pairs of images to match: all, or for a sequence those of neighbours and some that close loops.

    In a sequence, each image is matched with the next OVERLAP images and with those 16, 32, 64, ... after it. In
    addition, CLOSING evenly spaced images are matched with each other.

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
    """Write the cameras, and the features of images that the database lacks."""
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
    """COLMAP's camera with one focal length and two radial coefficients.

    Without a known focal length, the initial value is 1.2 times the longer side of the image.
    """
    height, width = picture.size
    focal = picture.focal or 1.2 * max(picture.size)
    camera = pycolmap.Camera.create_from_model_name(0, "RADIAL", focal, width, height)
    camera.has_prior_focal_length = picture.focal is not None
    return camera


def _match(pycolmap: Any, pictures: Sequence[Picture], database: Path, sequential: bool, progress: Progress) -> None:
    """Match the pairs of images that the database lacks."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = _threads()
    with _opened(pycolmap, database) as opened:
        number = {image.name: image.image_id for image in opened.read_all_images()}
        done = set(opened.read_all_matches()[0])
    pairs = [(pictures[i].file, pictures[j].file) for i, j in pairs_to_match(len(pictures), sequential)]
    left = [pair for pair in pairs if pycolmap.image_pair_to_pair_id(*(number[name] for name in pair)) not in done]
    listed = database.with_suffix(".pairs.txt")
    for start in range(0, len(left), PAIRS_AT_ONCE):
        progress("matches", len(pairs) - len(left) + start, len(pairs), "pairs of images")
        chunk = left[start : start + PAIRS_AT_ONCE]
        write_whole(listed, "\n".join(f"{first} {second}" for first, second in chunk).encode(), durable=False)
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(database, options, pairing, device=pycolmap.Device.cpu)
    listed.unlink(missing_ok=True)
    progress("matches", len(pairs), len(pairs), "pairs of images")


def _map(pycolmap: Any, count: int, folder: Path, database: Path, progress: Progress) -> list[Any]:
    """COLMAP's models by incremental mapping."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = _threads()
    options.random_seed = SEED
    options.min_model_size = SMALLEST_MODEL
    options.extract_colors = True
    registered = 0

    def start() -> None:
        nonlocal registered
        registered = 2
        progress("poses", registered, count, "images registered")

    def step() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("poses", registered, count, "images registered")

    out = database.with_suffix(".models")
    out.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        database, folder, out, options, initial_image_pair_callback=start, next_image_callback=step
    )
    return list(found.values())


def _sparse_model(model: Any, index: dict[str, int]) -> SparseModel:
    """A model of COLMAP, from the indices of images by their names; principal points get integer pixel centres."""
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
    observed = [(at[each.image_id], row) for row, point in enumerate(points) for each in point.track.elements]
    return SparseModel(
        np.array([index[image.name] for image in images], np.int64),
        poses,
        calibrations,
        lenses,
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.error for point in points], np.float64),
        np.array(observed, np.int64).reshape(-1, 2),
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
    """Keep COLMAP's log off standard error. Errors are raised, and callers report them."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _threads() -> int:
    """The number of threads for COLMAP: OMP_NUM_THREADS, otherwise -1, which means all cores."""
    return stated_threads() or -1
