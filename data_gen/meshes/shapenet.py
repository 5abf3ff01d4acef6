"""ShapeNetCore on disk: its classes, the models of a tree (versions 1 and 2), and their splits."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

from data_gen.meshes.files import MeshError
from hyperplanes.utilities.files.reading import DataError, read_bytes

__all__ = [
    "SYNSETS",
    "ShapeNetModel",
    "class_of_synset",
    "find_models",
    "is_shapenet",
    "paper_split",
    "read_split_file",
]

_TABLE = """
    02691156 plane  02747177 trash_bin  02773838 bag  02801938 basket  02808440 bathtub  02818832 bed
    02828884 bench  02843684 birdhouse  02871439 bookshelf  02876657 bottle  02880940 bowl  02924116 bus
    02933112 cabinet  02942699 camera  02946921 can  02954340 cap  02958343 car  02992529 cellphone
    03001627 chair  03046257 clock  03085013 keyboard  03207941 dishwasher  03211117 display
    03261776 earphone  03325088 faucet  03337140 file_cabinet  03467517 guitar  03513137 helmet  03593526 jar
    03624134 knife  03636649 lamp  03642806 laptop  03691459 loudspeaker  03710193 mailbox
    03759954 microphone  03761084 microwave  03790512 motorbike  03797390 mug  03928116 piano  03938244 pillow
    03948459 pistol  03991062 pot  04004475 printer  04074963 remote  04090263 rifle  04099429 rocket
    04225987 skateboard  04256520 sofa  04330267 stove  04379243 table  04401088 telephone  04460130 tower
    04468005 train  04530566 watercraft  04554684 washer
"""

SYNSETS: dict[str, str] = dict(zip(_TABLE.split()[::2], _TABLE.split()[1::2], strict=True))
"""The 55 classes of ShapeNetCore: synset number to name without spaces."""

_V1, _V2 = Path("model.obj"), Path("models/model_normalized.obj")
_LARGEST_SPLIT = 64 * 2**20  # bytes; the official file has 3.5 million
_SPLITS = {"train": "train", "val": "val", "validation": "val", "test": "test"}
_TRAIN_SHARE = 0.8


@dataclass(frozen=True)
class ShapeNetModel:
    """One model of a tree.

    Attributes:
        synset: number of its class, 8 digits.
        model_id: its name in the tree, unique in its class.
        path: its OBJ file.
        folder: the folder of the model and its textures.
    """

    synset: str
    model_id: str
    path: Path
    folder: Path


def class_of_synset(synset: str) -> str:
    """Name of a synset; the number itself if it is not in ShapeNetCore.

    >>> class_of_synset("02958343")
    'car'
    """
    return SYNSETS.get(synset.zfill(8), synset)


def is_shapenet(folder: Path) -> bool:
    """Whether a folder is a ShapeNetCore tree, or one class of it."""
    return bool(_synset_folders(folder))


def find_models(folder: Path) -> list[ShapeNetModel]:
    """List the models of a tree, or of one class of it.

    Args:
        folder: the folder with the synsets, or that of one synset.

    Returns:
        The models, sorted by synset and name. Folders without a model file are skipped.
    """
    models = []
    for synset in _synset_folders(folder):
        for entry in sorted(synset.iterdir()):
            path = next((entry / name for name in (_V2, _V1) if (entry / name).is_file()), None)
            if path is not None:
                models.append(ShapeNetModel(synset.resolve().name, entry.name, path, entry))
    return models


def paper_split(models: list[ShapeNetModel]) -> dict[tuple[str, str], str]:
    """The split of the paper's 200 x 200 data, as in AtlasNet: the first 80 % of a class by name train, the rest test.

    Returns:
        `train` or `test` by synset and model.
    """
    split = {}
    for synset in sorted({model.synset for model in models}):
        names = sorted(model.model_id for model in models if model.synset == synset)
        border = int(_TRAIN_SHARE * len(names))
        for index, name in enumerate(names):
            split[synset, name] = "train" if index < border else "test"
    return split


def read_split_file(path: Path) -> dict[tuple[str, str], str]:
    """Read ShapeNet's official split, `all.csv` with `id,synsetId,subSynsetId,modelId,split`.

    Returns:
        `train`, `val` or `test` by synset and model.

    Raises:
        MeshError: if it cannot be read, a column is missing or a split is unknown.
    """
    split = {}
    try:
        with io.StringIO(read_bytes(path, _LARGEST_SPLIT).decode("utf-8-sig"), newline="") as file:
            rows = csv.DictReader(file)
            missing = {"synsetId", "modelId", "split"} - set(rows.fieldnames or [])
            if missing:
                raise MeshError(
                    f"{path}: expected the columns id,synsetId,subSynsetId,modelId,split, found "
                    f"{','.join(rows.fieldnames or []) or 'none'}; fetch the official split file"
                )
            for row in rows:
                name = (row["split"] or "").strip().lower()
                if name not in _SPLITS:
                    raise MeshError(
                        f"{path}: line {rows.line_num}: expected train, val or test, found {name!r}; correct the line"
                    )
                split[(row["synsetId"] or "").strip().zfill(8), (row["modelId"] or "").strip()] = _SPLITS[name]
    except DataError as error:
        raise MeshError(str(error)) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MeshError(f"{path}: expected a readable split file, found {error}") from error
    return split


def _synset_folders(folder: Path) -> list[Path]:
    if _is_synset(folder):
        return [folder]
    return sorted(entry for entry in folder.iterdir() if entry.is_dir() and _is_synset(entry))


def _is_synset(folder: Path) -> bool:
    """Whether a folder holds models and has the name of a class of ShapeNetCore, or of another one in version 2."""
    number = folder.resolve().name
    if re.fullmatch(r"\d{8}", number) is None:  # dates match, too
        return False
    kinds = (_V2, _V1) if number in SYNSETS else (_V2,)
    return any((entry / name).is_file() for entry in folder.iterdir() for name in kinds)
