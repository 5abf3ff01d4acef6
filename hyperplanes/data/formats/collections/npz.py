"""The two layouts of the paper's data: learnit's folders (128 pixels) and the authors' .npz files (200 pixels)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.arrays import read_arrays
from hyperplanes.data.formats.catalogue import SPLITS, Catalogue, is_plain
from hyperplanes.data.formats.collections import AUTHORS_FOCAL
from hyperplanes.data.formats.scenes.transforms_document import opencv_from_opengl
from hyperplanes.data.formats.scenes.transforms_json import read_transforms, read_transforms_task
from hyperplanes.data.pictures.bounds import stated_bounds
from hyperplanes.data.pictures.frames import assemble
from hyperplanes.data.pictures.posed import Posed, PosedTask, check_pose, posed
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import MANIFEST, DataError, read_json

__all__ = ["LEGACY", "catalogue", "read_npz"]

LEGACY = ("learnit-128", "hyperplanes-200")
"""The layouts whose published code places principal points at W / 2 at integer pixel centres."""


def read_npz(
    path: str | Path, *, legacy: bool = False, bounds: Sphere | None = None, root: Path | None = None
) -> Posed:
    """The posed images of one object of the 200x200 data (HyperPlanes, MultiPlaneNeRF, points2nerf).

    The file holds `images` (view, height, width, 3 or 4), 8 bits or floats in [0, 1], and `cam_poses` or `poses` (view,
    4, 4), camera-to-world with OpenGL axes. Images of three channels are over white and have no masks. `rgba`, 8 bits
    with straight alpha, replaces `images` if it is present. The focal length is `focal` in pixels if it is present,
    otherwise 277.77 per 200 pixels of width.

    Args:
        path: the .npz file, which may not contain pickles.
        legacy: place the principal point at W / 2 at integer pixel centres, as the authors' code does, instead of at
            the middle of the image, (W - 1) / 2.
        bounds: of the scene; if None, they are estimated.
        root: as in `read_arrays`.

    Returns:
        The images in the order of the file.

    Raises:
        DataError: no such file, a file that is too large, or other content.
    """
    path = Path(path)
    arrays = read_arrays(path, {"images", "rgba", "cam_poses", "poses", "focal"}, root)
    poses = arrays.get("cam_poses", arrays.get("poses"))
    images = arrays.get("rgba", arrays.get("images"))
    if images is None or poses is None:
        raise DataError(path, "arrays images and cam_poses", ", ".join(arrays) or "none", "check the file")
    if images.ndim != 4 or images.shape[-1] not in (3, 4) or len(images) != len(poses) or 0 in images.shape:
        found = f"images {images.shape}, poses {poses.shape}"
        raise DataError(path, "images (view, height, width, 3 or 4), a pose each", found, "check the file")
    rgba, alpha = _rgba(images, path)
    checked = np.stack([check_pose(pose, path, str(index)) for index, pose in enumerate(poses)])
    height, width = images.shape[1:3]
    stated = arrays.get("focal", np.array([AUTHORS_FOCAL * width / 200]))
    if stated.size != 1 or not np.issubdtype(stated.dtype, np.number):
        raise DataError(path, "focal, one number of pixels", f"{stated.dtype} {stated.shape}", "check the file")
    focal = float(stated.reshape(-1)[0])
    shift = 0.0 if legacy else 0.5
    matrix = np.array([[focal, 0.0, width / 2 - shift], [0.0, focal, height / 2 - shift], [0.0, 0.0, 1.0]])
    return posed(
        list(rgba),
        opencv_from_opengl(checked),
        np.tile(matrix, (len(rgba), 1, 1)),
        has_alpha=alpha,
        bounds=bounds,
        names=tuple(f"{index:03d}" for index in range(len(rgba))),
        source=path,
    )


def catalogue(folder: Path, manifest: dict[str, Any], *, legacy: bool = False) -> Catalogue | None:
    """The catalogue of a folder in one of the two layouts.

    learnit's layout has CLASS_splits.json beside the folder of the class, and CLASSs/NAME/transforms.json with its
    images beside it. The authors' layout has CLASS/sampled/VIEWS_NAME.npz. Sorted by name, the first 80 % are the
    training split and the last 20 % the test split, unless a manifest states the splits. Objects that are listed but
    missing are skipped and counted. The first half of the views is the support and the rest the query, since learnit's
    notebook and the authors' code take 25 and 25 of 50. In data sets with a manifest, which `generate` wrote, views
    alternate between support and query.

    Args:
        folder: which may be in one of the two layouts.
        manifest: of the folder, empty without one.
        legacy: as in `read_npz`.

    Returns:
        The catalogue; None for another layout.
    """
    bounds = stated_bounds(manifest, folder / MANIFEST)
    archives = sorted(folder.glob("*/sampled/*.npz")) or sorted(folder.glob("sampled/*.npz"))
    if archives:
        return _authors(folder, archives, manifest, bounds, legacy)
    splits = sorted(folder.glob("*_splits.json"))
    return _learnit(folder, splits, manifest, bounds, legacy) if splits else None


def _authors(
    folder: Path, archives: list[Path], manifest: dict[str, Any], bounds: Sphere | None, legacy: bool
) -> Catalogue:
    """The catalogue of a folder in the authors' layout."""
    paths: dict[str, Path] = {}
    for path in archives:
        other = paths.setdefault(path.stem.rpartition("_")[2], path)
        if other != path:
            raise DataError(path, "a name that no other object has", f"that of {other}", "rename one of them")
    if isinstance(manifest.get("objects"), dict):  # their names may have underscores, those in file names have hyphens
        manifest = {**manifest, "objects": {k.replace("_", "-"): v for k, v in manifest["objects"].items()}}
    skipped: list[str] = []
    splits: dict[str, tuple[str, ...]] = {"train": (), "val": (), "test": ()}
    if isinstance(manifest.get("splits"), dict):
        for split in SPLITS:
            names = [str(name).replace("_", "-") for name in manifest["splits"].get(split, [])]
            splits[split] = tuple(name for name in names if name in paths)
            if missing := [name for name in names if name not in paths]:
                skipped.append(f"{folder / MANIFEST}: skipped {len(missing)} of {len(names)} objects of {split} "
                               f"without an archive, as {missing[0]}")  # fmt: skip
    else:
        for home in sorted({path.parent for path in archives}):
            names = sorted(name for name, path in paths.items() if path.parent == home)
            first, last = max(1, int(len(names) * 0.8)), max(1, int(len(names) * 0.2))
            splits["train"] += tuple(names[:first])
            splits["test"] += tuple(names[first:][-last:])
            if left := names[first:][:-last]:
                skipped.append(f"{home}: skipped {', '.join(left)}, neither of the first 80 % nor of the last 20 %")
    split = PosedTask.alternating if manifest else PosedTask.halves

    def read(name: str) -> PosedTask:
        return split(read_npz(paths[name], legacy=legacy, bounds=bounds, root=folder), name)

    return Catalogue(LEGACY[1], splits, read, manifest, tuple(skipped))


def _learnit(
    folder: Path, files: list[Path], manifest: dict[str, Any], bounds: Sphere | None, legacy: bool
) -> Catalogue:
    """The catalogue of a folder in learnit's layout."""
    homes: dict[str, Path] = {}
    skipped: list[str] = []
    splits: dict[str, tuple[str, ...]] = {"train": (), "val": (), "test": ()}
    for file in files:
        document = read_json(file)
        for split in SPLITS:
            names = document.get(split, [])
            if not isinstance(names, list) or not all(isinstance(name, str) and is_plain(name) for name in names):
                raise DataError(file, f"plain names in {split}", repr(names)[:60], "correct the file")
            found = {name: home for name in names if (home := _home(folder, name, file)) is not None}
            splits[split] += tuple(found)
            homes |= found
            if missing := [name for name in names if name not in found]:
                skipped.append(f"{file}: skipped {len(missing)} of {len(names)} objects of {split} without a folder, "
                               f"as {missing[0]}")  # fmt: skip
    if not homes:
        raise DataError(folder, "the objects that its splits name", "none of their folders", "download them again")

    def read(name: str) -> PosedTask:
        if manifest:
            return read_transforms_task(homes[name], name, legacy=legacy, bounds=bounds, complete=True)
        file = homes[name] / "transforms.json"
        scene, _ = assemble(read_transforms(file, legacy=legacy, bounds=bounds), complete=True)
        return PosedTask.halves(scene, name)

    return Catalogue(LEGACY[0], splits, read, manifest, tuple(skipped))


def _home(folder: Path, name: str, file: Path) -> Path | None:
    """The folder of an object, None if there is none."""
    singular = file.name.removesuffix("_splits.json")
    candidates = [folder / f"{singular}s" / name, folder / singular / name, folder / name]
    candidates += [child / name for child in sorted(folder.iterdir()) if child.is_dir()]
    return next((path for path in candidates if (path / "transforms.json").is_file()), None)


def _rgba(images: npt.NDArray[Any], path: Path) -> tuple[npt.NDArray[np.uint8], bool]:
    """The images as RGBA with 8 bits, and whether they have an alpha channel."""
    if images.dtype != np.uint8:
        if not np.issubdtype(images.dtype, np.floating) or not np.isfinite(images).all():
            raise DataError(path, "images of 8 bits or finite floats", f"{images.dtype}", "check the file")
        if images.min() < 0 or images.max() > 1:
            found = f"{images.min():g} to {images.max():g}"
            raise DataError(path, "floating-point images in [0, 1]", found, "check the file")
        images = np.rint(images * 255).astype(np.uint8)
    if images.shape[-1] == 4:
        return images, True
    return np.concatenate([images, np.full_like(images[..., :1], 255)], -1), False
