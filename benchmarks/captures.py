"""Poses and masks that `capture` finds for staged photographs, against those that they were taken with.

    python -m benchmarks captures --meshes FOLDER --count 3 --json FILE

Every object stands on a table in a textured room and is photographed through a lens, with other exposures, blur and
noise for each picture. The poses that were found are brought into the true world by the similarity that fits the
cameras' centres best; masks are compared where the lens has been taken out. With --checkpoint, a model adapts to half
of the views, and the other half, over white by their true masks, are compared with its renderings: with what was found,
with what is true, with masks that are damaged on purpose (every fourth lacks a part, or has one too many, and all are
soft), and without masks, with a learned background and without.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch.nn.functional import interpolate

from benchmarks.reporting import Row, finish
from benchmarks.staged_photographs import Staged, stage, walk_around
from data_gen.meshes.find import find_meshes
from data_gen.meshes.mesh import load_mesh
from hyperplanes.adaptation.background import separate_background
from hyperplanes.adaptation.base import Adapter
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.nearest_view import NearestView
from hyperplanes.capture import Settings, capture
from hyperplanes.capture.masks import consistency
from hyperplanes.capture.masks.consistency import agree
from hyperplanes.capture.pipeline import ROOM
from hyperplanes.capture.placement import object_points, object_sphere
from hyperplanes.capture.scene import straightened
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.data import read_task
from hyperplanes.data.formats.transforms_document import transforms_document
from hyperplanes.data.pictures.images import Pixels, composite_over_white, read_image
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.encoding import encode_png
from hyperplanes.utilities.metrics import psnr
from hyperplanes.utilities.writing import write_json, write_whole
from hyperplanes.views import Views

__all__ = ["PoseErrors", "compare_poses", "damaged_masks", "main"]

SHOWN, COMPARED = 320, 160  # pixels along the longer side of the views that are shown, and of those compared
HEIGHTS = (15.0, 45.0)  # of the rounds, in degrees: with 36 photographs a step of 20 degrees
SOFT = 0.008  # of the longer side: deviation of the blur of a damaged mask
PART = 0.25  # of the area of the object, that is lost or added


@dataclass(frozen=True)
class PoseErrors:
    """How far poses are from true ones.

    Attributes:
        degrees: between the rotations, for each camera.
        percent: between the centres, of the true distance from the middle of what they look at.
    """

    degrees: Float[np.ndarray, " camera"]
    percent: Float[np.ndarray, " camera"]

    def within(self, degrees: float, percent: float) -> float:
        """The fraction of cameras that are right to so much."""
        return float(((self.degrees <= degrees) & (self.percent <= percent)).mean())


def compare_poses(
    found: Float[np.ndarray, "camera 4 4"], true: Float[np.ndarray, "camera 4 4"], middle: tuple[float, ...] = (0, 0, 0)
) -> PoseErrors:
    """Errors after the similarity that brings the found centres nearest to the true ones (Umeyama, 1991).

    Args:
        found: world_from_camera.
        true: likewise, in the true world.
        middle: what distances count from, in the true world.
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
    distance = np.linalg.norm(target - np.array(middle), axis=-1)
    return PoseErrors(
        np.rad2deg(np.arccos(cosine.clip(-1, 1))), 100 * np.linalg.norm(centres - target, axis=-1) / distance
    )


def main(arguments: list[str]) -> int:
    """Measure, print, and write the rows where asked.

    Args:
        arguments: see --help.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks captures", description=__doc__)
    parser.add_argument("--meshes", type=Path, help="a folder of meshes; an ellipsoid where it is not given")
    parser.add_argument("--count", type=int, default=3, help="objects")
    parser.add_argument("--views", type=int, default=45)
    parser.add_argument("--size", type=int, default=640, help="pixels along the longer side")
    parser.add_argument("--mask", default="auto", help="as of `hyperplanes capture`")
    parser.add_argument("--checkpoint", help="a model to compare new views with")
    parser.add_argument("--keep", type=Path, help="a folder for the photographs and the scenes")
    parser.add_argument("--quick", action="store_true", help="one object, 24 small pictures")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.quick:
        options.count, options.views, options.size = 1, 24, 400
    paths: list[Path | None] = [None] * options.count
    if options.meshes is not None:
        found = [item.path for item in find_meshes(options.meshes)]
        paths = list(found[:: max(1, len(found) // options.count)][: options.count])
    with tempfile.TemporaryDirectory() as scratch:
        home = options.keep or Path(scratch)
        rows = [_measured(path, index, home / f"{index:02d}", options) for index, path in enumerate(paths)]
    return finish("captures", rows, options.json)


def _measured(path: Path | None, index: int, folder: Path, options: argparse.Namespace) -> Row:
    size = 3 * options.size // 4, options.size
    mesh = None if path is None else load_mesh(path)
    staged = stage(walk_around(options.views, index, HEIGHTS), size, seed=index, mesh=mesh)
    staged.save(folder / "photographs")
    captured = capture(folder / "photographs", folder / "scene", Settings(options.size, options.mask))
    model = SparseModel.load(folder / "scene" / "capture" / "poses" / "model.npz")
    errors = compare_poses(np.linalg.inv(model.camera_from_world), staged.world_from_camera[model.pictures])
    truth = {
        _name(view): _straight(staged, view, model.calibrations[row], model.lenses[row])
        for row, view in enumerate(model.pictures.tolist())
    }
    row: Row = {
        "name": "ellipsoid" if path is None else path.stem,
        "views": options.views,
        "posed": len(model),
        "within_half_degree_1_percent": errors.within(0.5, 1.0),
        "degrees_median": float(np.median(errors.degrees)),
        "percent_median": float(np.median(errors.percent)),
        "mask": captured.mask,
        "mask_iou": _overlap(_read_masks(folder / "scene", truth), truth),
    }
    if options.checkpoint is not None:
        checkpoint = HyperPlanes.from_pretrained(Path(options.checkpoint))
        true = {
            _name(view): _straight(staged, view, staged.calibration, staged.lens) for view in range(len(staged.masks))
        }
        _write_true(folder / "true", staged, true)
        row["psnr"] = _quality(folder / "scene", checkpoint, truth)
        row["psnr_true"] = _quality(folder / "true", checkpoint, true)
        row["psnr_loss"] = float(row["psnr_true"]) - float(row["psnr"])
        row["psnr_nearest"] = _quality(folder / "true", NearestView(), true)
        row |= _damaged(folder, model, truth, checkpoint, index)
        row |= _without_masks(folder / "scene", truth, checkpoint)
    print(row, flush=True)
    return row


def _name(view: int) -> str:
    return f"photo_{view:03d}"


def _straight(staged: Staged, view: int, calibration: np.ndarray, lens: Sequence[float]) -> Pixels:
    """A photograph with its true mask as alpha, without its lens."""
    rgba = np.concatenate([staged.photographs[view], 255 * staged.masks[view][..., None].astype(np.uint8)], -1)
    return straightened(rgba, calibration, np.array(lens), opaque=False)


def _read_masks(scene: Path, names: Iterable[str]) -> list[np.ndarray]:
    """The masks of a scene, opacity in [0, 1]."""
    return [read_image(scene / "masks" / f"{name}.png")[0][..., 0] / 255 for name in names]


def _overlap(masks: Sequence[np.ndarray], truth: Mapping[str, Pixels]) -> float:
    """Mean intersection over union of masks with the true ones."""
    result = []
    for mask, picture in zip(masks, truth.values(), strict=True):
        found, true = mask > 0.5, picture[..., 3] > 127
        result.append((found & true).sum() / max(1, (found | true).sum()))
    return float(np.mean(result))


def _write_true(folder: Path, staged: Staged, pictures: Mapping[str, Pixels]) -> None:
    """The scene with true poses and masks."""
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
    """PSNR in dB of the views that were not shown, against the photographs over white by their true masks.

    Args:
        scene: what is read.
        method: what adapts to half of it.
        truth: the photographs.
        prepare: what is done with the support views before.
    """
    task = read_task(scene, up="auto")
    shown = (task.support if prepare is None else prepare(task.support)).resized(SHOWN)
    cameras = task.query.resized(COMPARED).cameras
    pictures = method.adapt(shown).render(cameras).images.clamp(0, 1)
    wanted = np.stack([truth[Path(name).stem] for name in task.query.names]).transpose(0, 3, 1, 2)
    true, _ = composite_over_white(torch.from_numpy(np.ascontiguousarray(wanted)))
    true = interpolate(true, pictures.shape[2:], mode="area")
    return float(psnr(pictures, true).mean())


def _damaged(folder: Path, model: SparseModel, truth: Mapping[str, Pixels], checkpoint: HyperPlanes, seed: int) -> Row:
    """What masks that are wrong on purpose do: as they are, mended by one mask's word, and by the vote of all."""
    masks = damaged_masks([picture[..., 3] / 255 for picture in truth.values()], seed)
    around = object_sphere(model, object_points(model, masks))
    room = Sphere(around.centre, ROOM * around.radius)
    ways = {"damaged": masks}
    for way, most in (("one_word", 0.0), ("vote", consistency.MOST_VOTES)):
        with patch.object(consistency, "MOST_VOTES", most):
            ways[f"damaged_{way}"] = agree(masks, model, room).masks
    result: Row = {}
    for way, found in ways.items():
        scene = folder / way
        shutil.rmtree(scene, ignore_errors=True)
        shutil.copytree(folder / "scene", scene, ignore=shutil.ignore_patterns("capture"))
        for name, mask in zip(truth, found, strict=True):
            pixels = (mask * 255).round().astype(np.uint8)
            write_whole(scene / "masks" / f"{name}.png", encode_png(pixels), durable=False)
        result[f"mask_iou_{way}"] = _overlap(found, truth)
        try:
            result[f"psnr_{way}"] = _quality(scene, checkpoint, truth)
        except ValueError:  # a hull that is carved to nothing
            result[f"psnr_{way}"] = float("nan")
    return result


def damaged_masks(masks: Sequence[np.ndarray], seed: int) -> list[np.ndarray]:
    """Masks with soft borders, of which every fourth has lost a part of the object, or holds something beside it.

    Args:
        masks: opacity in [0, 1].
        seed: of where.
    """
    generator, result = np.random.default_rng(seed), []
    for index, mask in enumerate(masks):
        soft = ndimage.gaussian_filter(mask.astype(float), SOFT * max(mask.shape))
        if index % 4 == 1:
            edge = np.argwhere(np.greater(mask > 0.5, ndimage.binary_erosion(mask > 0.5)))
            row, column = edge[generator.integers(len(edge))]
            rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
            disc = (rows - row) ** 2 + (columns - column) ** 2 < PART * (mask > 0.5).sum() / np.pi
            soft[disc] = float(index % 8 == 5)
        result.append(soft)
    return result


def _without_masks(scene: Path, truth: Mapping[str, Pixels], checkpoint: HyperPlanes) -> Row:
    """The same poses without masks: as the model takes them, with a learned background, and fitted without a room."""

    def bare(views: Views) -> Views:
        pictures = np.stack([truth[Path(name).stem][..., :3] for name in views.names]).transpose(0, 3, 1, 2)
        return replace(views, images=torch.from_numpy(np.ascontiguousarray(pictures)).float() / 255, masks=None)

    def learned(views: Views, *, room: bool) -> Views:
        views = bare(views)
        return separate_background(views, room=room).cut_out(views)

    found: Row = {"psnr_no_masks": _quality(scene, checkpoint, truth, bare)}
    for name, room in (("learned_background", True), ("no_room", False)):
        try:
            found[f"psnr_{name}"] = _quality(
                scene, checkpoint, truth, lambda views, room=room: learned(views, room=room)
            )
        except ValueError:  # masks that leave nothing
            found[f"psnr_{name}"] = float("nan")
    return found
