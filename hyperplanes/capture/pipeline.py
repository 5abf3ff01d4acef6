"""Make a scene, which all other commands read, from photographs. An interrupted run can be continued."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from hyperplanes.capture.masks.choice import check_mask, choose_masker
from hyperplanes.capture.masks.consistency import agree
from hyperplanes.capture.packages import is_installed, require
from hyperplanes.capture.photographs import (
    MIN_PHOTOGRAPHS,
    Photograph,
    find_photographs,
    list_photographs,
    read_upright,
    without_copies,
)
from hyperplanes.capture.placement import Placement, find_up, object_points, object_sphere
from hyperplanes.capture.scene import Captured, straightened, write_scene
from hyperplanes.capture.scene_record import SceneRecord, checksums
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.capture.stages import Stages, fingerprint
from hyperplanes.capture.structure_from_motion import ATTEMPTS, EXHAUSTIVE, Picture, Progress, find_poses
from hyperplanes.capture.video import take_frames
from hyperplanes.data.pictures.images import VIDEO_SUFFIXES, Pixels, read_image
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.encoding import encode_jpeg, encode_png, sha256
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import checked_fields
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.utilities.messages.formatting import counted

__all__ = ["Captured", "Progress", "Settings", "capture"]

WORK = "capture"
"""The folder in the scene that holds the results of the stages."""

CARVING_RADII = 1.5
"""Radii of the sphere around the object's sparse points: the sphere in which its hull is carved. It is larger than the
points' sphere because smooth parts of the object have no points."""

MIN_POSED_SHARE = 0.8  # of the photographs: if fewer get a pose, a note gives advice
JPEG_QUALITY = 96  # of JPEG, without chroma subsampling

ADVICE = (
    "walk around the object in small steps, 20 degrees or less, so that neighbouring photographs show mostly the same, "
    "also from one height to the next; keep the light and the object still; leave something with texture around it, "
    "such as a newspaper under it"
)

VIDEO_FRAMES = 60
"""Frames that are taken from a video."""


@checked_fields
@dataclass(frozen=True)
class Settings:
    """Settings of a capture.

    Attributes:
        max_size: pixels along the longer side at which poses are found and images are written; at least 64.
        mask: auto, given, colour, network, grabcut, none, or a command that contains {image} and {mask}.
        frames: number of frames extracted from a video; at least 3.
        order: "sequence" matches neighbouring photographs, "any" all pairs. "auto" is "sequence" for a video and for
            more than 80 photographs.
    """

    max_size: Annotated[int, range(64, 1 << 16)] = 1000
    mask: str = "auto"
    frames: Annotated[int, range(3, 1 << 16)] = VIDEO_FRAMES
    order: Literal["auto", "sequence", "any"] = "auto"


@dataclass
class _Work:
    """The settings and results that all stages share."""

    stages: Stages
    settings: Settings
    progress: Progress
    sources: list[str] = field(default_factory=list)
    """The checksums of the photographs, or that of the video."""
    notes: list[str] = field(default_factory=list)
    originals: dict[str, str] = field(default_factory=dict)
    """The name of the photograph from which each file of the stage `pictures` was made; the progress names it."""

    @property
    def record(self) -> SceneRecord:
        """The record of the scene, in the folder of the stages."""
        return SceneRecord(self.stages.folder.parent, self.stages.folder / "scene.json")


def capture(
    source: str | Path, out: str | Path, settings: Settings | None = None, progress: Progress | None = None
) -> Captured:
    """Find poses and masks of photographs, and write them as a scene.

    Args:
        source: a folder of photographs, which may contain masks/, or a video.
        out: the folder of the scene. The results of stages are kept in its folder capture/, so that the same call
            continues an interrupted one. No photograph may lie in its folders images/, masks/ and capture/, in which
            files are replaced. Masks in it that were changed by hand are kept. A scene of other photographs is refused.
        settings: of the capture.
        progress: called during the work.

    Returns:
        A summary of the scene, with notes for the user. Raises ValueError for too few photographs, photographs without
        common features, or a masking method that cannot work.
    """
    source, out, settings = Path(source), Path(out), settings or Settings()
    check_mask(settings.mask)
    _refuse_inside(out, source)
    originals = dict[str, str]()

    def named(stage: str, done: int, total: int, text: str) -> None:
        if progress is not None:
            progress(stage, done, total, originals.get(text, text))

    work = _Work(Stages(out / WORK), settings, named, originals=originals)
    photographs, is_video = _photographs(source, work)
    if not is_video:
        _refuse_inside(out, *(path for one in photographs for path in (one.path, one.mask) if path is not None))
    photographs, pictures, opacities = _pictures(photographs, work)
    model = _poses(pictures, is_video, work)
    kept = [photographs[index] for index in model.pictures]
    if len(kept) < len(photographs):
        rest = [one.name for index, one in enumerate(photographs) if index not in set(model.pictures.tolist())]
        work.notes.append(f"{counted(len(rest), 'photograph')} without a pose, left out: {listed(rest)}")
    straight, given = _straight(model, pictures, opacities, work)
    masks, how = _masks(model, straight, given, [one.name for one in kept], work)
    placement, masks = _placed(model, kept, straight, masks, given, work)
    return _written(model, kept, straight, masks, how, placement, work)


def _refuse_inside(out: Path, *sources: Path) -> None:
    """Check that no source lies in the folders to write, since the files of the scene would replace it.

    Raises:
        DataError: a source is the scene's own folder, or lies in a folder that is written.
    """
    home = out.resolve()
    written = [home / name for name in ("images", "masks", WORK)]
    for source in sources:
        place = source.resolve()
        if place == home or any(place == folder or folder in place.parents for folder in written):
            raise DataError(source, "photographs outside of the scene", f"{out} as --out", "give another --out")


def _photographs(source: Path, work: _Work) -> tuple[list[Photograph], bool]:
    """The photographs, and whether they are the frames of a video."""
    is_video = source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES
    if is_video:
        _begin_scene(work, [source], [f"frame_{index:04d}" for index in range(work.settings.frames)])
        stamp = source.stat()
        key = fingerprint(str(source.resolve()), stamp.st_size, stamp.st_mtime, work.settings.frames)
        if work.stages.begin("frames", key) is None:
            taken = take_frames(source, work.stages.folder / "frames", work.settings.frames, work.progress)
            work.stages.finish("frames", key, {"count": taken})
        home, paths = None, sorted((work.stages.folder / "frames").glob("*.jpg"))
    else:
        if not source.is_dir():
            found = "a file of another kind" if source.exists() else "nothing"
            raise DataError(source, "a folder of photographs, or a video", found, "check the path")
        paths = find_photographs(source)
        home = next((place for place in (source / "masks", paths[0].parent / "masks") if place.is_dir()), None)
    masked = work.settings.mask in ("auto", "given")
    photographs, notes = list_photographs(paths, home if masked else None)
    photographs, copies = without_copies(photographs)
    notes += copies
    work.notes += notes
    if len(photographs) < MIN_PHOTOGRAPHS:
        found = f"{len(photographs)} of {len(paths)}"
        found += f" ({'; '.join(notes)})" if notes else ""
        wanted = f"at least {MIN_PHOTOGRAPHS} different photographs that can be read"
        raise DataError(source, wanted, found, "add photographs from other viewpoints")
    if not is_video:
        _begin_scene(work, [one.path for one in photographs], [one.name for one in photographs])
    return photographs, is_video


def _begin_scene(work: _Work, paths: Sequence[Path], names: Sequence[str]) -> None:
    """Note the checksums of the photographs or the video, before anything in the scene is replaced.

    Raises:
        DataError: there is a scene of other photographs, or one with masks that were changed by hand and now none.
    """
    work.sources += checksums(paths)
    work.record.check_photographs(work.sources, names)
    if work.settings.mask == "none" and (kept := work.record.changed({})):
        raise DataError(
            "--mask none",
            f"a scene without masks in {work.record.folder}, or only those that capture wrote",
            f"{len(kept)} that {'was' if len(kept) == 1 else 'were'} changed by hand",
            "name another folder, or delete masks/",
        )


def _pictures(photographs: list[Photograph], work: _Work) -> tuple[list[Photograph], list[Picture], dict[int, Path]]:
    """Write the photographs upright and scaled.

    Returns:
        The photographs that can be read, their written images, and the files of given masks by the index of the image.

    Raises:
        DataError: a given mask that does not fit its photograph, or no mask at all with `--mask given`.
    """
    max_size = work.settings.max_size
    masked = work.settings.mask in ("auto", "given")
    key = fingerprint([(_stamp(one.path), one.mask and _stamp(one.mask)) for one in photographs], max_size, masked)
    folder = work.stages.folder / "pictures"
    done = work.stages.begin("pictures", key)
    if done is None:
        require("pycolmap", "finds camera poses")  # for `_poses`, but checked before minutes of scaling
        done = {"sizes": [], "masked": [], "broken": {}}
        with_alpha, transparent = list[int](), False
        for index, one in enumerate(photographs):
            work.progress("photographs", index, len(photographs), one.path.name)
            try:
                picture, opacity = read_upright(one, max_size)
            except DataError as error:
                if one.mask is not None and str(one.mask) in str(error):
                    raise
                done["broken"][str(index)] = f"left out: {error}"
                done["sizes"].append(None)
                continue
            write_whole(folder / f"{index:05d}.jpg", encode_jpeg(picture, JPEG_QUALITY), durable=False)
            done["sizes"].append(list(picture.shape[:2]))
            if masked and opacity is not None:
                write_whole(folder / f"{index:05d}.mask.png", encode_png(opacity), durable=False)
                (with_alpha if one.mask is None else done["masked"]).append(index)
                transparent |= one.mask is None and bool((opacity < 255).any())
        done["masked"] += with_alpha if transparent else []  # alpha that is opaque in all images is no mask
        work.stages.finish("pictures", key, done)
        work.progress("photographs", len(photographs), len(photographs), "upright and scaled")
    if work.settings.mask == "given" and not done["masked"]:
        raise DataError(
            "--mask given", "photographs with alpha, or a folder masks/ beside them", "neither", "leave --mask out"
        )
    work.notes += done["broken"].values()
    readable = [index for index in range(len(photographs)) if str(index) not in done["broken"]]
    cameras: dict[tuple[str, tuple[int, ...]], int] = {}
    pictures = []
    for index in readable:
        size, one = tuple(done["sizes"][index]), photographs[index]
        camera = cameras.setdefault((one.camera, size), len(cameras))
        focal = None if one.focal is None else one.focal * max(size)
        pictures.append(Picture(f"{index:05d}.jpg", camera, size, focal))
        work.originals[pictures[-1].file] = one.path.name
    opacities = {row: folder / f"{index:05d}.mask.png" for row, index in enumerate(readable) if index in done["masked"]}
    return [photographs[index] for index in readable], pictures, opacities


def _stamp(path: Path) -> tuple[str, float, int]:
    """Path, time of modification and size of a file, which change when the file does."""
    return str(path.resolve()), path.stat().st_mtime, path.stat().st_size


def _poses(pictures: list[Picture], is_video: bool, work: _Work) -> SparseModel:
    """The largest model. While it has few of the images, other settings of features are tried. Masks are not used."""
    shown = work.stages.folder / "pictures"
    order = work.settings.order
    sequential = order == "sequence" or (order == "auto" and (is_video or len(pictures) > EXHAUSTIVE))
    how = [asdict(features) for features in ATTEMPTS]
    what = [(asdict(picture), sha256((shown / picture.file).read_bytes())) for picture in pictures]
    key = fingerprint(what, sequential, how)
    folder = work.stages.folder / "poses"
    done = work.stages.begin("poses", key)
    if done is not None:
        work.notes += done.get("notes", [])
        return SparseModel.load(folder / "model.npz")
    notes = list[str]()
    best: SparseModel | None = None
    for number, features in enumerate(ATTEMPTS):
        count = 0 if best is None else len(best)
        if number and count >= features.below * len(pictures):
            break
        if number:
            notes.append(f"{count} of {len(pictures)} photographs posed: tried again with {features.name}")
        found = find_poses(
            pictures,
            shown,
            folder / f"{number}.db",
            features=features,
            sequential=sequential,
            progress=work.progress,
        )
        if found is not None and (best is None or len(found) > len(best)):
            best = found
    if best is None or len(best) < MIN_PHOTOGRAPHS:
        found = f"{len(pictures)} of which none can" if best is None else f"only {len(best)} of {len(pictures)}"
        raise DataError(
            work.stages.folder.parent,
            f"photographs of which at least {MIN_PHOTOGRAPHS} can be posed together",
            "; ".join([found, *work.notes]),
            ADVICE,
        )
    if len(best) < MIN_POSED_SHARE * len(pictures):
        notes.append(f"few photographs could be posed; for the next time: {ADVICE}")
    best.save(folder / "model.npz")
    for database in folder.glob("*.db*"):
        database.unlink()
    for models in folder.glob("*.models"):
        shutil.rmtree(models)
    work.stages.finish("poses", key, {"count": len(best), "error": best.reprojection_error, "notes": notes})
    work.notes += notes
    return best


def _straight(
    model: SparseModel, pictures: Sequence[Picture], opacities: dict[int, Path], work: _Work
) -> tuple[list[Pixels], list[Pixels | None]]:
    """The undistorted images (height, width, 3) that have a pose, and their given masks."""
    straight, given = list[Pixels](), list[Pixels | None]()
    for row, index in enumerate(model.pictures.tolist()):
        path = work.stages.folder / "pictures" / pictures[index].file
        work.progress("lens", row, len(model), path.name)
        picture, opacity = straightened(
            read_image(path)[0][..., :3],
            read_image(opacities[index])[0][..., 0] if index in opacities else None,
            model.calibrations[row],
            model.lenses[row],
        )
        straight.append(picture)
        given.append(opacity)
    work.progress("lens", len(model), len(model), "distortion removed")
    return straight, given


def _masks(
    model: SparseModel,
    straight: list[Pixels],
    given: Sequence[Pixels | None],
    names: Sequence[str],
    work: _Work,
) -> tuple[list[np.ndarray] | None, str]:
    """One mask per camera, opacity in [0, 1], and the name of the method; None and "none" without masks."""
    if work.settings.mask == "none":
        return None, "none"
    bare = [name for name, opacity in zip(names, given, strict=True) if opacity is None]
    if not bare:
        return [opacity / 255.0 for opacity in given if opacity is not None], "given"
    masker, how = choose_masker(work.settings.mask, model, straight)
    if len(bare) < len(given):
        work.notes.append(f"{counted(len(bare), 'photograph')} without a mask, which is made by {how}: {listed(bare)}")
    key = fingerprint(work.stages.key("poses"), how)
    work.stages.begin("masks", key)
    folder = work.stages.folder / "masks"
    masks = []
    for row, (picture, opacity) in enumerate(zip(straight, given, strict=True)):
        path = folder / f"{row:05d}.png"
        if opacity is not None:
            masks.append(opacity / 255.0)
            continue
        if not path.is_file():
            work.progress("masks", row, len(straight), how)
            found = masker(picture, row)
            write_whole(path, encode_png((found * 255).round().astype(np.uint8)), durable=False)
        masks.append(read_image(path)[0][..., 0] / 255.0)
    work.progress("masks", len(straight), len(straight), how)
    if not any(mask.any() for mask in masks):
        raise DataError(
            "--mask", "an object in the photographs", f"none in any of {len(masks)}", "give --mask none or masks/"
        )
    return masks, how


def _placed(
    model: SparseModel,
    photographs: Sequence[Photograph],
    straight: Sequence[Pixels],
    masks: list[np.ndarray] | None,
    given: Sequence[Pixels | None],
    work: _Work,
) -> tuple[Placement, list[np.ndarray] | None]:
    """The position of the object, and the masks after they were compared with each other. Given masks do not change."""
    chosen = object_points(model, masks)
    sphere = object_sphere(model, chosen)
    if masks is not None:
        work.progress("agreement", 0, 1, "of the masks with each other")
        own = [opacity is not None for opacity in given]
        pictures = None if all(own) or not is_installed("cv2") else straight
        found = agree(masks, model, Sphere(sphere.centre, CARVING_RADII * sphere.radius), pictures)
        for kept, done in ((True, "to be checked"), (False, "corrected by what the others show")):
            if names := [photographs[row].name for row in found.wrong if own[row] == kept]:
                work.notes.append(
                    f"{counted(len(names), 'mask')} in contradiction to the others, {done}: {listed(names)}"
                )
        work.progress("agreement", 1, 1, f"{1 - float(found.disagreement.mean()):.1%} of their area")
        masks = [mask if kept else other for mask, other, kept in zip(masks, found.masks, own, strict=True)]
        if names := [one.name for one, mask in zip(photographs, masks, strict=True) if not mask.any()]:
            # models refuse such views
            work.notes.append(f"{counted(len(names), 'empty mask')}, to be corrected or left out: {listed(names)}")
        sphere = found.sphere or sphere
    up, source = find_up(model, np.array([one.up_in_camera for one in photographs]), sphere, chosen)
    return Placement(sphere, up, source), masks


def _written(
    model: SparseModel,
    photographs: Sequence[Photograph],
    straight: list[Pixels],
    masks: list[np.ndarray] | None,
    how: str,
    placement: Placement,
    work: _Work,
) -> Captured:
    """Write the scene."""
    moved = model.moved(placement.z_up_from_world())
    files = {}
    for row, (one, picture) in enumerate(zip(photographs, straight, strict=True)):
        work.progress("writing", row, len(straight), one.name)
        files[f"images/{one.name}.jpg"] = encode_jpeg(picture, JPEG_QUALITY)
        if masks is not None:
            files[f"masks/{one.name}.png"] = encode_png((masks[row] * 255).round().astype(np.uint8))
    captured = write_scene(
        work.record,
        work.sources,
        moved,
        [one.name for one in photographs],
        [picture.shape[:2] for picture in straight],
        files,
    )
    work.progress("writing", len(straight), len(straight), "scene")
    return replace(captured, mask=how, up_from=placement.up_from, notes=(*work.notes, *captured.notes))
