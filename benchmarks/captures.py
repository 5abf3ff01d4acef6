"""Compare the poses and masks that `capture` finds in simulated photographs with the true ones.

    python -m benchmarks captures --meshes MESH_OR_FOLDER ... --checkpoint small --json FILE

Each object stands on a table in a textured room. It is photographed through a lens with distortion, with a different
exposure, blur and noise for each photograph. The estimated poses are aligned to the true ones by the similarity
transform that fits the camera centres best. Masks are compared in undistorted images.

With --checkpoint, a model adapts to half of the views, and its renderings are compared with the other half, composited
over white by their true masks. This is done with the estimated poses and masks, with the true ones, with damaged masks
(all have soft borders; in a quarter of them a part of the object is missing, or something else is included), and
without masks, with and without a learned background.

Each scene is measured in parts, whose results are stored in the folder --keep. If the benchmark is interrupted, the
same command at the same commit continues from there. Rows of other scenes remain in FILE, with their own commits.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch.nn.functional import interpolate

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish, write_rows
from benchmarks.parts.staged_photographs import Staged, stage, walk_around
from data_gen.meshes.find import find_meshes
from data_gen.meshes.mesh import load_mesh
from hyperplanes.adaptation.base import Adapter
from hyperplanes.adaptation.baselines.nearest_view import NearestView
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.capture import Settings, capture
from hyperplanes.capture.masks import consistency
from hyperplanes.capture.masks.background import separate_background
from hyperplanes.capture.masks.consistency import agree
from hyperplanes.capture.pipeline import CARVING_RADII
from hyperplanes.capture.placement import object_points, object_sphere
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.capture.stages import Stages, fingerprint
from hyperplanes.data import read_task
from hyperplanes.data.formats.scenes.transforms_document import transforms_document
from hyperplanes.data.pictures.images import Pixels, composite_over_white, read_image
from hyperplanes.data.pictures.undistort import undistort
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.writing import write_json, write_whole
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.utilities.machine.environment import find_commit
from hyperplanes.views import Views

__all__ = ["PoseErrors", "compare_poses", "damaged_masks", "main"]

SHOWN, COMPARED = 320, 160  # pixels along the longer side of support views and of query views
HEIGHTS = (12.0, 35.0, 58.0)  # elevations of the camera, in degrees; 36 photographs are then 30 degrees apart
OCTAVES = 4  # octaves of the noise on table and walls; few, so that there are few image features
SOFT = 0.008  # standard deviation of the blur of a damaged mask, as a fraction of the longer side
PART = 0.25  # area that a damaged mask loses or gains, as a fraction of the object's area


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated camera poses.

    Attributes:
        degrees: angle between the estimated and the true rotation of each camera.
        percent: distance between the estimated and the true centre of each camera, in percent of the true distance
            from the origin, which the cameras look at.
    """

    degrees: Float[np.ndarray, " camera"]
    percent: Float[np.ndarray, " camera"]

    def within(self, degrees: float, percent: float) -> float:
        """The fraction of cameras whose errors are at most these."""
        return float(((self.degrees <= degrees) & (self.percent <= percent)).mean())


def compare_poses(found: Float[np.ndarray, "camera 4 4"], true: Float[np.ndarray, "camera 4 4"]) -> PoseErrors:
    """Errors of poses after a similarity transform that aligns their centres with the true ones (Umeyama, 1991).

    Args:
        found: estimated poses, world_from_camera.
        true: true poses, world_from_camera.
    """
    source, target = found[:, :3, 3], true[:, :3, 3]
    shifted, wanted = source - source.mean(0), target - target.mean(0)
    left, scales, right = np.linalg.svd(wanted.T @ shifted / len(source))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    scale = float((scales * np.diag(sign)).sum() / shifted.var(0).sum())
    centres = scale * shifted @ turn.T + target.mean(0)
    rotations = turn @ found[:, :3, :3]
    cosine = (np.einsum("cij,cij->c", rotations, true[:, :3, :3]) - 1) / 2
    distance = np.linalg.norm(target, axis=-1)
    return PoseErrors(
        np.rad2deg(np.arccos(cosine.clip(-1, 1))), 100 * np.linalg.norm(centres - target, axis=-1) / distance
    )


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks captures", description=__doc__)
    parser.add_argument("--meshes", type=Path, nargs="+", help="mesh files, or folders of them (default: ellipsoids)")
    parser.add_argument("--count", type=positive, default=3, help="number of objects per folder, or of ellipsoids")
    parser.add_argument("--views", type=positive, default=36, help="photographs per object (default: %(default)s)")
    parser.add_argument("--size", type=positive, default=560, help="pixels along the longer side")
    parser.add_argument("--mask", default="auto", help="as for `hyperplanes capture`")
    parser.add_argument("--checkpoint", help="a model whose new views are compared")
    parser.add_argument(
        "--parts", nargs="+", choices=list(PARTS), default=list(PARTS), help="what to measure (default: all)"
    )
    parser.add_argument(
        "--keep", type=Path, default=Path("runs/captures"), help="folder for scenes (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="one object, 24 small photographs; nothing is stored")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.quick:
        options.count, options.views, options.size = 1, 24, 400
    with tempfile.TemporaryDirectory() as scratch:
        if options.quick:
            options.keep = Path(scratch)
        scenes = _scenes(options)
        rows = _rows_of_others(options.json, {scene.name for scene in scenes})
        for scene in scenes:
            rows.append(scene.measure())
            if options.json is not None:
                write_rows("captures", rows, options.json)
    return finish("captures", rows, options.json)


def _scenes(options: argparse.Namespace) -> list[_Scene]:
    """One scene per mesh."""
    paths: dict[str, Path | None] = {}
    if options.meshes is None:
        paths = {f"ellipsoid_{index}": None for index in range(options.count)}
    for given in options.meshes or ():
        found = [given] if given.is_file() else [item.path for item in find_meshes(given).meshes]
        for path in found[:: max(1, len(found) // options.count)][: options.count]:
            if path.stem in paths:
                raise DataError(path, "meshes of different names", "two of one name", "rename one")
            paths[path.stem] = path
    return [_Scene(name, path, index, options) for index, (name, path) in enumerate(paths.items())]


def _rows_of_others(path: Path | None, names: set[str]) -> list[Row]:
    """The rows of a file except those of the named scenes, which are measured again."""
    if path is None or not path.is_file():
        return []
    return [row for row in json.loads(path.read_text(encoding="utf-8"))["rows"] if row["name"] not in names]


@dataclass(frozen=True)
class _Scene:
    """An object that is photographed, and the stored results of its measurement."""

    name: str
    path: Path | None
    seed: int
    options: argparse.Namespace
    key: str = field(init=False)

    def __post_init__(self) -> None:
        asked = [getattr(self.options, name) for name in ("views", "size", "mask", "checkpoint")]
        object.__setattr__(self, "key", fingerprint(find_commit(), self.path, self.seed, asked))

    @property
    def folder(self) -> Path:
        return self.options.keep / self.name

    def measure(self) -> Row:
        """The results of all parts; parts that are done already are read from the folder."""
        row: Row = {"name": self.name, "commit": find_commit(), "views": self.options.views}
        stages = Stages(self.folder)
        for part, measured in PARTS.items():
            if part == "capture" or (part in self.options.parts and self.options.checkpoint is not None):
                done = stages.begin(part, self.key)
                row |= stages.finish(part, self.key, measured(self)) if done is None else done
        print(row, flush=True)
        return row

    @cached_property
    def staged(self) -> Staged:
        size = 3 * self.options.size // 4, self.options.size
        mesh = None if self.path is None else load_mesh(self.path)
        poses = walk_around(self.options.views, self.seed, HEIGHTS)
        return stage(poses, size, seed=self.seed, mesh=mesh, octaves=OCTAVES)

    @property
    def scene(self) -> Path:
        """The folder that `capture` writes."""
        return self.folder / "capture" / "scene"

    @cached_property
    def model(self) -> SparseModel:
        """The result of structure from motion."""
        return SparseModel.load(self.scene / "capture" / "poses" / "model.npz")

    @cached_property
    def truth(self) -> dict[str, Pixels]:
        """The posed photographs with their true masks as alpha, undistorted by the estimated cameras."""
        found = zip(self.model.pictures.tolist(), self.model.calibrations, self.model.lenses, strict=True)
        return {_name(view): _straight(self.staged, view, calibration, lens) for view, calibration, lens in found}

    @cached_property
    def checkpoint(self) -> HyperPlanes:
        return HyperPlanes.from_pretrained(find_checkpoint(Path(self.options.checkpoint)))


def _captured(scene: _Scene) -> Row:
    """Errors of the estimated poses and masks."""
    photographs = scene.folder / "capture" / "photographs"
    if not photographs.is_dir():  # otherwise an interrupted capture continues
        scene.staged.save(photographs)
    captured = capture(photographs, scene.scene, Settings(scene.options.size, scene.options.mask))
    errors = compare_poses(np.linalg.inv(scene.model.camera_from_world), _true_poses(scene))
    return {
        "posed": len(scene.model),
        "within_half_degree_1_percent": errors.within(0.5, 1.0) * len(scene.model) / scene.options.views,
        "degrees_median": float(np.median(errors.degrees)),
        "percent_median": float(np.median(errors.percent)),
        "mask": captured.mask,
        "mask_iou": _overlap(_read_masks(scene.scene, scene.truth), scene.truth),
    }


def _true_poses(scene: _Scene) -> Float[np.ndarray, "camera 4 4"]:
    """The true poses of the posed photographs, world_from_camera."""
    return scene.staged.world_from_camera[scene.model.pictures]


def _new_views(scene: _Scene) -> Row:
    """PSNR of query views with the estimated and with the true poses and masks."""
    staged, folder = scene.staged, scene.folder / "views" / "true"
    true = {_name(view): _straight(staged, view, staged.calibration, staged.lens) for view in range(len(staged.masks))}
    _write_true(folder, staged, true)
    found = _quality(scene.scene, scene.checkpoint, scene.truth)
    best = _quality(folder, scene.checkpoint, true)
    nearest = _quality(folder, NearestView(), true)
    return {"psnr": found, "psnr_true": best, "psnr_loss": best - found, "psnr_nearest": nearest}


def _name(view: int) -> str:
    return f"photo_{view:03d}"


def _straight(staged: Staged, view: int, calibration: np.ndarray, lens: Sequence[float]) -> Pixels:
    """A photograph with its true mask as alpha, undistorted."""
    rgba = np.concatenate([staged.photographs[view], 255 * staged.masks[view][..., None].astype(np.uint8)], -1)
    return undistort(rgba, calibration, (*lens, *(0.0,) * 6))


def _read_masks(scene: Path, names: Iterable[str]) -> list[np.ndarray]:
    """The masks of a scene, opacity in [0, 1]."""
    return [read_image(scene / "masks" / f"{name}.png")[0][..., 0] / 255 for name in names]


def _overlap(masks: Sequence[np.ndarray], truth: Mapping[str, Pixels]) -> float:
    """Mean intersection over union of masks and true masks."""
    result = []
    for mask, picture in zip(masks, truth.values(), strict=True):
        found, true = mask > 0.5, picture[..., 3] > 127
        result.append((found & true).sum() / max(1, (found | true).sum()))
    return float(np.mean(result))


def _write_true(folder: Path, staged: Staged, pictures: Mapping[str, Pixels]) -> None:
    """Write the scene with its true poses and masks."""
    for name, picture in pictures.items():
        write_whole(folder / "images" / f"{name}.png", encode_png(picture), durable=False)
    calibrations = np.tile(staged.calibration, (len(pictures), 1, 1))
    sphere = (0.0, 0.0, 0.0), 1.0
    size, names = staged.photographs[0].shape[:2], [f"images/{name}.png" for name in pictures]
    document = transforms_document(staged.world_from_camera, calibrations, size, names, sphere=sphere)
    write_json(folder / "transforms.json", document | {"up": "y"})


def _quality(
    scene: Path, method: Adapter, truth: Mapping[str, Pixels], prepare: Callable[[Views], Views] | None = None
) -> float:
    """PSNR in dB of the query views, compared with the photographs composited over white by their true masks.

    Args:
        scene: folder of a scene.
        method: the method that adapts to half of the scene's views.
        truth: the photographs with their true masks as alpha, by name.
        prepare: a function applied to the support views first.

    Returns:
        The mean PSNR; NaN if the visual hull is empty.
    """
    task = read_task(scene, up="auto")
    shown = (task.support if prepare is None else prepare(task.support)).resized(SHOWN)
    cameras = task.query.resized(COMPARED).cameras
    try:
        pictures = method.adapt(shown).render(cameras).images.clamp(0, 1)
    except ValueError:  # the visual hull is empty
        return float("nan")
    wanted = np.stack([truth[Path(name).stem] for name in task.query.names]).transpose(0, 3, 1, 2)
    true, _ = composite_over_white(torch.from_numpy(np.ascontiguousarray(wanted)))
    true = interpolate(true, pictures.shape[2:], mode="area")
    return float(psnr(pictures, true).mean())


def _damaged(scene: _Scene) -> Row:
    """Quality with damaged masks: as they are, and corrected with hulls from which one or several masks remove a point.

    Several masks are what `capture` requires.
    """
    truth, model = scene.truth, scene.model
    masks = damaged_masks([picture[..., 3] / 255 for picture in truth.values()], scene.seed)
    around = object_sphere(model, object_points(model, masks))
    room = Sphere(around.centre, CARVING_RADII * around.radius)
    pictures = [read_image(scene.scene / "images" / f"{name}.jpg")[0][..., :3] for name in truth]
    ways = {"damaged": masks}
    for way, most in (("one_word", 0.0), ("vote", consistency.MOST_VOTES)):
        with patch.object(consistency, "MOST_VOTES", most):
            ways[f"damaged_{way}"] = agree(masks, model, room, pictures).masks
    result: Row = {}
    for way, found in ways.items():
        folder = scene.folder / "damaged" / way
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(scene.scene, folder, ignore=shutil.ignore_patterns("capture"))
        for name, mask in zip(truth, found, strict=True):
            pixels = (mask * 255).round().astype(np.uint8)
            write_whole(folder / "masks" / f"{name}.png", encode_png(pixels), durable=False)
        result[f"mask_iou_{way}"] = _overlap(found, truth)
        result[f"psnr_{way}"] = _quality(folder, scene.checkpoint, truth)
    return result


def damaged_masks(masks: Sequence[np.ndarray], seed: int) -> list[np.ndarray]:
    """Masks with soft borders; a random quarter of them loses or gains a disc at the border of the object.

    Args:
        masks: opacity in [0, 1].
        seed: of the random choices.
    """
    generator = np.random.default_rng(seed)
    result = [ndimage.gaussian_filter(mask.astype(float), SOFT * max(mask.shape)) for mask in masks]
    for number, index in enumerate(generator.permutation(len(masks))[: len(masks) // 4].tolist()):
        inside = masks[index] > 0.5
        edge = np.argwhere(np.greater(inside, ndimage.binary_erosion(inside)))
        row, column = edge[generator.integers(len(edge))]
        rows, columns = np.mgrid[: inside.shape[0], : inside.shape[1]]
        disc = (rows - row) ** 2 + (columns - column) ** 2 < PART * inside.sum() / np.pi
        result[index][disc] = float(number % 2)
    return result


def _without_masks(scene: _Scene) -> Row:
    """Quality without masks, with the same poses: as the images are, and with a learned background."""

    def bare(views: Views) -> Views:
        pictures = np.stack([scene.truth[Path(name).stem][..., :3] for name in views.names]).transpose(0, 3, 1, 2)
        return replace(views, images=torch.from_numpy(np.ascontiguousarray(pictures)).float() / 255, masks=None)

    def learned(views: Views) -> Views:
        views = bare(views)
        return separate_background(views).cut_out(views)

    ways = {"no_masks": bare, "learned_background": learned}
    return {f"psnr_{way}": _quality(scene.scene, scene.checkpoint, scene.truth, made) for way, made in ways.items()}


PARTS: dict[str, Callable[[_Scene], Row]] = {
    "capture": _captured,
    "views": _new_views,
    "damaged": _damaged,
    "without_masks": _without_masks,
}
"""The parts of a measurement, in order; all but the first need a model."""
