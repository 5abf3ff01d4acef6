"""Source of truth: the fractions of registered images below which `ATTEMPTS` tries other features."""

import types

import pytest

from hyperplanes.capture import Settings, pipeline
from hyperplanes.capture.stages import Stages
from hyperplanes.capture.structure_from_motion import Picture


class Model:
    """A stand-in for a sparse model that only has a number of images."""

    reprojection_error = 0.0

    def __init__(self, count):
        self.count = count

    def __len__(self):
        return self.count

    def save(self, path):
        path.touch()


def drawn(folder, count, content=b""):
    """Write image files as the preceding stage does."""
    (folder / "pictures").mkdir(exist_ok=True)
    for index in range(count):
        (folder / "pictures" / f"{index}.jpg").write_bytes(content)
    return [Picture(f"{index}.jpg", 0, (3, 4)) for index in range(count)]


@pytest.mark.parametrize(
    ("order", "is_video", "count", "sequential"),
    [
        ("auto", False, 80, False),
        ("auto", False, 81, True),
        ("auto", True, 20, True),
        ("any", True, 200, False),
        ("sequence", False, 20, True),
    ],
)
def test_all_pairs_are_matched_if_requested_or_if_there_are_few_photographs(
    order, is_video, count, sequential, tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **how: asked.append(how["sequential"]) or Model(count))
    work = types.SimpleNamespace(stages=Stages(tmp_path), settings=Settings(order=order), progress=print, notes=[])
    pipeline._poses(drawn(tmp_path, count), is_video, work)
    assert asked == [sequential]


def test_temporary_files_of_colmap_are_removed(tmp_path, monkeypatch):
    def find_poses(pictures, folder, database, **how):
        database.touch()
        database.with_suffix(".db-wal").touch()
        (database.with_suffix(".models") / "0").mkdir(parents=True)
        return Model(len(pictures))

    monkeypatch.setattr(pipeline, "find_poses", find_poses)
    work = types.SimpleNamespace(stages=Stages(tmp_path), settings=Settings(), progress=print, notes=[])
    pipeline._poses(drawn(tmp_path, 20), False, work)
    assert [path.name for path in sorted((tmp_path / "poses").iterdir())] == ["model.npz"]


@pytest.mark.parametrize(
    ("found", "kept", "advised"),
    [([19], 19, False), ([18, 16], 18, False), ([9, 20], 20, False), ([None, 8, 7], 8, True)],
)
def test_other_features_are_tried_if_too_few_images_are_registered(found, kept, advised, tmp_path, monkeypatch):
    models = iter([None if count is None else Model(count) for count in found])
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: next(models))
    work = types.SimpleNamespace(stages=Stages(tmp_path), settings=Settings(), progress=print, notes=[])
    model = pipeline._poses(drawn(tmp_path, 20), False, work)
    assert (len(model), list(models)) == (kept, [])
    assert len(work.notes) == len(found) - 1 + advised
    again = types.SimpleNamespace(stages=Stages(tmp_path), settings=Settings(), progress=print, notes=[])
    monkeypatch.setattr(pipeline.SparseModel, "load", lambda path: model)
    assert pipeline._poses(drawn(tmp_path, 20), False, again) is model
    assert again.notes == work.notes


def test_poses_are_searched_again_only_for_other_images(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: asked.append(1) or Model(20))
    monkeypatch.setattr(pipeline.SparseModel, "load", lambda path: Model(20))
    for content, searches in ((b"same", 1), (b"other", 2)):
        for mask in ("auto", "given", "network", "none"):
            work = types.SimpleNamespace(
                stages=Stages(tmp_path), settings=Settings(mask=mask), progress=print, notes=[]
            )
            pipeline._poses(drawn(tmp_path, 20, content), False, work)
        assert len(asked) == searches
