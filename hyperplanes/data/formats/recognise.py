"""Find the layout of a path, and read it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hyperplanes.data.formats.apps import metashape, polycam, realitycapture, record3d
from hyperplanes.data.formats.catalogue import Catalogue, native, refuse_unfinished
from hyperplanes.data.formats.collections import co3d, nmr, npz, objaverse, srn
from hyperplanes.data.formats.scenes import colmap, idr, llff, nsvf
from hyperplanes.data.formats.scenes.transforms_json import find_transforms, read_transforms, read_transforms_task
from hyperplanes.data.formats.unposed import refuse_unposed
from hyperplanes.data.packaged import remedy_for
from hyperplanes.data.pictures.frames import Listing, assemble
from hyperplanes.data.pictures.posed import Posed, PosedTask
from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.files.reading import DATA_SET, MANIFEST, DataError, read_json

__all__ = [
    "LAYOUTS",
    "Layout",
    "find_catalogue",
    "find_layouts",
    "is_scene",
    "read_posed",
    "read_posed_task",
    "scene_name",
]


@dataclass(frozen=True)
class Layout:
    """A layout of one posed scene.

    Attributes:
        found: called with a folder; its result is true if the folder is in this layout.
        read: returns all images; called with a folder, the factor to scale down by, and the root that no file may lie
            outside, symbolic links followed.
        read_task: returns support and query, for a layout with splits of its own; called with a folder, the name of the
            task, the factor and the root. If None, views alternate between support and query.
    """

    found: Callable[[Path], object]
    read: Callable[[Path, int | None, Path], Posed]
    read_task: Callable[[Path, str, int | None, Path], PosedTask] | None = None

    def task(self, folder: Path, name: str, downscale: int | None, root: Path) -> PosedTask:
        """Support and query of the scene in a folder."""
        if self.read_task is not None:
            return self.read_task(folder, name, downscale, root)
        return PosedTask.alternating(self.read(folder, downscale, root), name)


def _layout(
    found: Callable[[Path], object],
    read: Callable[[Path, Path], Listing],
    read_task: Callable[[Path, str, int | None, Path], PosedTask] | None = None,
) -> Layout:
    """A layout whose files list images. `read` is called with a folder and the root that no file may lie outside."""
    return Layout(found, lambda folder, downscale, root: assemble(read(folder, root), downscale)[0], read_task)


LAYOUTS = (
    _layout(
        find_transforms,
        lambda folder, root: read_transforms(find_transforms(folder), root=root),
        lambda folder, name, downscale, root: read_transforms_task(folder, name, downscale=downscale, root=root),
    ),
    _layout(nsvf.is_nsvf, nsvf.read_nsvf, nsvf.read_nsvf_task),
    Layout(srn.is_srn, lambda folder, downscale, root: srn.read_srn(folder, root).downscaled(downscale)),
    _layout(colmap.find_model, colmap.read_colmap),
    _layout(llff.is_llff, llff.read_llff),
    _layout(nmr.is_nmr, nmr.read_nmr),
    _layout(idr.camera_file, idr.read_idr),
    Layout(objaverse.is_omniobject, objaverse.read_omniobject),
    _layout(objaverse.is_rendered, objaverse.read_rendered),
    _layout(co3d.is_sequence, co3d.read_sequence),
    _layout(polycam.is_polycam, polycam.read_polycam),
    _layout(record3d.is_record3d, record3d.read_record3d),
    _layout(metashape.find_cameras_files, metashape.read_metashape),
    _layout(realitycapture.find_tables, realitycapture.read_realitycapture),
)


def find_layouts() -> tuple[Layout, ...]:
    """The layouts of this package, followed by those of entry points in the group `hyperplanes.layouts`."""
    return (*LAYOUTS, *load_entries("hyperplanes.layouts").values())


def find_catalogue(path: str | Path, *, legacy: bool = False) -> Catalogue:
    """The catalogue of the data set at a path.

    The layout is native if manifest.json says so. Otherwise it is recognised from the folder's content: SRN's,
    learnit's, the HyperPlanes authors', NMR's, CO3D's, Objaverse's or OmniObject3D's layout, a posed scene (one object,
    in the test split), or a folder of posed scenes (all in the test split).

    Args:
        path: a folder, a transforms file, or the .npz file of one object.
        legacy: for learnit's and the authors' layouts, as in `npz.read_npz`.

    Returns:
        The catalogue. No image has been read yet.

    Raises:
        DataError: no known layout, a data set that `generate` has not finished, or `legacy` with another layout than
            these two.
    """
    path = Path(path)
    found = _find_catalogue(path, legacy)
    if legacy and path.suffix != ".npz" and found.layout not in npz.LEGACY:
        wanted = f"the layout {' or '.join(npz.LEGACY)} with legacy"
        raise DataError(path, wanted, f"the layout {found.layout}", "leave legacy out")
    return found


def _find_catalogue(path: Path, legacy: bool) -> Catalogue:
    if path.is_file() and path.suffix in (".json", ".npz"):
        return _one_scene(path, legacy)
    if not path.is_dir():
        refuse_unposed(path)
        what = "a file" if path.exists() else "nothing"
        remedy = remedy_for(path, "check the path, or run hyperplanes generate")
        raise DataError(path, "the folder of a data set", what, remedy)
    refuse_unfinished(path)
    manifest = read_json(path / MANIFEST) if (path / MANIFEST).is_file() else {}
    if manifest.get("format") == DATA_SET and manifest.get("layout", "native") == "native":
        return native(path, manifest)
    if nsvf.is_nsvf(path):
        return _one_scene(path)
    found = srn.catalogue(path, manifest) or npz.catalogue(path, manifest, legacy=legacy)
    if found is not None:
        return found
    if _find_format(path) is not None:
        return _one_scene(path)
    for published in (nmr.catalogue, co3d.catalogue, objaverse.objaverse, objaverse.omniobject):
        if (found := published(path)) is not None:
            return found
    children = {child.name: child for child in sorted(path.iterdir()) if child.is_dir() and _find_format(child)}
    if children:
        splits = {"train": (), "val": (), "test": tuple(children)}
        return Catalogue("posed", splits, lambda name: _read_child(path, name))
    refuse_unposed(path)
    found_names = ", ".join(sorted(child.name for child in path.iterdir())[:5]) or "an empty folder"
    raise DataError(path, "a data set or posed images", found_names, "generate one with hyperplanes generate")


def read_posed(path: str | Path, downscale: int | None = None) -> Posed:
    """All posed images of one scene.

    Args:
        path: a transforms*.json, the .npz file of one object, or the folder of a scene in any layout.
        downscale: as in `frames.assemble`.

    Returns:
        The images in the order of the files. Raises DataError if a file is missing or malformed.
    """
    path = Path(path)
    if path.is_file() and path.suffix == ".npz":
        return npz.read_npz(path).downscaled(downscale)
    if path.is_file() and path.suffix == ".json":
        return assemble(read_transforms(path), downscale)[0]
    return _format(path).read(path, downscale, path)


def read_posed_task(path: str | Path, downscale: int | None = None, *, legacy: bool = False) -> PosedTask:
    """Support and query of one scene, split as its files state, otherwise alternately.

    Args:
        path: as in `read_posed`. If it is transforms_train.json, _val or _test, the others beside it are read too.
        downscale: as in `frames.assemble`.
        legacy: for an .npz file, as in `npz.read_npz`.

    Returns:
        The task, named as by `scene_name`. Raises DataError if a file is missing or malformed.
    """
    path = Path(path)
    folder, name = path, scene_name(path)
    if path.is_file() and path.suffix == ".npz":
        return PosedTask.alternating(npz.read_npz(path, legacy=legacy), name).downscaled(downscale)
    if path.is_file() and path.suffix == ".json":
        folder = path.parent
        if path not in find_transforms(folder):
            return read_transforms_task(path, name, downscale=downscale)
    return _format(folder).task(folder, name, downscale, folder)


def scene_name(path: Path) -> str:
    """The name of a scene: that of its .npz file, otherwise that of its folder."""
    if path.is_file() and path.suffix == ".npz":
        return path.stem
    return (path.parent if path.is_file() else path).resolve().name


def _one_scene(path: Path, legacy: bool = False) -> Catalogue:
    """One posed scene as a data set of one test object."""
    splits = {"train": (), "val": (), "test": (scene_name(path),)}
    return Catalogue("posed", splits, lambda _: read_posed_task(path, legacy=legacy))


def _read_child(root: Path, name: str) -> PosedTask:
    """A scene in a folder of scenes. Its symbolic links may lead anywhere in the folder of scenes."""
    return _format(root / name).task(root / name, name, None, root)


def is_scene(folder: str | Path) -> bool:
    """Whether a folder holds one posed scene in a known layout."""
    return _find_format(Path(folder)) is not None


def _find_format(folder: Path) -> Layout | None:
    """The layout of a folder, None if it is unknown."""
    return next((each for each in find_layouts() if each.found(folder)), None)


def _format(folder: Path) -> Layout:
    """The layout of a folder.

    Raises:
        DataError: the layout is unknown.
    """
    found = _find_format(folder) if folder.is_dir() else None
    if found is not None:
        return found
    refuse_unposed(folder)
    if not folder.is_dir():
        found = "a file of another kind" if folder.exists() else "nothing"
        raise DataError(folder, "a transforms*.json or the folder of a scene", found, remedy_for(folder))
    names = ", ".join(sorted(child.name for child in folder.iterdir())[:5]) or "an empty folder"
    raise DataError(folder, "transforms.json or another layout of one scene", names, "give one object's folder")
