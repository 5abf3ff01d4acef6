"""Poses and masks that `capture` finds for staged photographs, against those that they were taken with.

    python -m benchmarks captures --meshes FOLDER --count 3 --json FILE

Every object stands on a table in a textured room and is photographed through a lens, with other exposures, blur and
noise for each picture. The poses that were found are brought into the true world by the similarity that fits the
cameras' centres best; masks are compared where the lens has been taken out. With --checkpoint, a model adapts to half
of the views, once with what was found and once with what is true, and the other half are compared with its renderings.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.reporting import Row, finish
from benchmarks.staged_photographs import Staged, stage, walk_around
from data_gen.meshes.find import find_meshes
from data_gen.meshes.mesh import load_mesh
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.capture import Settings, capture
from hyperplanes.capture.scene import straightened
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.data import read_task
from hyperplanes.data.formats.transforms_document import transforms_document
from hyperplanes.data.pictures.images import read_image
from hyperplanes.utilities.encoding import encode_png
from hyperplanes.utilities.metrics import psnr
from hyperplanes.utilities.writing import write_json, write_whole

__all__ = ["PoseErrors", "compare_poses", "main"]


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
    staged = stage(walk_around(options.views, index), size, seed=index, mesh=mesh)
    staged.save(folder / "photographs")
    started = time.perf_counter()
    captured = capture(folder / "photographs", folder / "scene", Settings(options.size, options.mask))
    seconds = time.perf_counter() - started
    model = SparseModel.load(folder / "scene" / "capture" / "poses" / "model.npz")
    errors = compare_poses(np.linalg.inv(model.camera_from_world), staged.world_from_camera[model.pictures])
    row: Row = {
        "name": "ellipsoid" if path is None else path.stem,
        "views": options.views,
        "posed": len(model),
        "within_half_degree_1_percent": errors.within(0.5, 1.0),
        "degrees_median": float(np.median(errors.degrees)),
        "percent_median": float(np.median(errors.percent)),
        "mask": captured.mask,
        "mask_iou": _mask_overlap(folder / "scene", model, staged),
        "seconds": seconds,
    }
    if options.checkpoint is not None:
        _write_true(folder / "true", staged)
        row["psnr"] = _quality(folder / "scene", options.checkpoint)
        row["psnr_true"] = _quality(folder / "true", options.checkpoint)
        row["psnr_loss"] = float(row["psnr_true"]) - float(row["psnr"])
    print(row, flush=True)
    return row


def _mask_overlap(scene: Path, model: SparseModel, staged: Staged) -> float:
    """Mean intersection over union of the masks of a scene with the true ones."""
    result = []
    for row, index in enumerate(model.pictures.tolist()):
        path = scene / "masks" / f"photo_{index:03d}.png"
        if not path.is_file():
            return float("nan")
        true = np.zeros((*staged.masks[index].shape, 4), np.uint8)
        true[...] = 255 * staged.masks[index][..., None].astype(np.uint8)
        straight = straightened(true, model.calibrations[row], model.lenses[row], opaque=True)[..., 0] > 127
        found = read_image(path)[0][..., 0] > 127
        result.append((found & straight).sum() / max(1, (found | straight).sum()))
    return float(np.mean(result))


def _write_true(folder: Path, staged: Staged) -> None:
    """The scene with true poses and masks."""
    names = []
    for index, (photograph, mask) in enumerate(zip(staged.photographs, staged.masks, strict=True)):
        rgba = np.concatenate([photograph, 255 * mask[..., None].astype(np.uint8)], -1)
        straight = straightened(rgba, staged.calibration, np.array(staged.lens), opaque=False)
        names.append(f"images/photo_{index:03d}.png")
        write_whole(folder / names[-1], encode_png(straight), durable=False)
    calibrations = np.tile(staged.calibration, (len(names), 1, 1))
    size = staged.photographs[0].shape[:2]
    sphere = (0.0, 0.0, 0.0), 1.0
    document = transforms_document(staged.world_from_camera, calibrations, size, names, sphere=sphere)
    write_json(folder / "transforms.json", document | {"up": "y"})


def _quality(scene: Path, checkpoint: str) -> float:
    """PSNR in dB of the views that were not shown."""
    task = read_task(scene, up="auto")
    pictures = HyperPlanes.from_pretrained(Path(checkpoint)).adapt(task.support).render(task.query.cameras).images
    return float(psnr(pictures.clamp(0, 1), task.query.images).mean())
