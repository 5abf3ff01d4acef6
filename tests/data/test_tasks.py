"""Source of truth: the pictures of conftest, and counts of reads from disk."""

import io
import json
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.data import DataError, Dataset, open_dataset
from hyperplanes.data.dataset import open_datasets
from hyperplanes.utilities.files.encoding import encode_npz, encode_png
from hyperplanes.utilities.files.reading import DATA_SET, read_json
from hyperplanes.utilities.files.writing import write_folder, write_whole


@pytest.fixture
def folder(scene, tmp_path):
    document = scene.document(scene_sphere={"centre": [0, 0, 0], "radius": 1})
    for name in ("a", "b", "c"):
        scene.write(tmp_path / name, document)
    splits = {"train": ["a", "b"], "val": [], "test": ["c"]}
    (tmp_path / "manifest.json").write_text(json.dumps({"format": DATA_SET, "version": 1, "splits": splits}))
    return tmp_path


def test_names_and_length(folder):
    data = Dataset(folder)
    assert (data.names("train"), data.names("val"), data.names("test")) == (["a", "b"], [], ["c"])
    assert data.names() == data.names("all") == ["a", "b", "c"]
    assert len(data) == 3
    assert [task.name for task in data] == ["a", "b", "c"]
    assert data.manifest["format"] == DATA_SET
    with pytest.raises(ValueError, match="split: expected one of train, val, test, all, got 'dev'"):
        data.names("dev")


def test_pictures_are_cached_and_callers_cannot_change_them(folder, scene):
    data = Dataset(folder)
    first = data.task("a")
    first.support.images.zero_()
    first.support.masks.zero_()
    shutil.rmtree(folder / "a")
    again = data.task("a")
    assert torch.allclose(again.support.images, scene.over_white()[::2], atol=1e-6)
    assert float(again.support.masks.max()) == 1.0


def test_several_data_sets_are_one_with_prefixed_names(tmp_path, folder):
    copies = [tmp_path / "copies" / name for name in ("a", "b")]
    for copy in copies:
        shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("copies"))
    both, one = open_datasets(copies), open_dataset(folder)
    for split in ("train", "test", "all"):
        assert both.names(split) == [f"{part}/{name}" for part in "ab" for name in one.names(split)]
    name = one.names("all")[0]
    task = both.task(f"b/{name}")
    assert task.name == f"b/{name}"
    assert torch.equal(task.support.images, one.task(name).support.images)
    for call in (both.task, both.class_of):
        with pytest.raises(DataError, match="one of the data sets a, b"):
            call(f"c/{name}")
    with pytest.raises(ValueError, match="data: expected folders of different names, got a, a"):
        open_datasets([copies[0], tmp_path / "a"])


def test_the_least_recently_used_objects_are_evicted_at_the_budget(folder):
    one = Dataset(folder).posed("a").nbytes
    data = Dataset(folder, budget=2 * one)
    for name in ("a", "b", "a", "c"):
        data.task(name)
    kept = [name for name in data.names() if data.posed(name) is data.posed(name)]
    assert kept == ["a", "b", "c"]
    for name in ("a", "b", "a", "c"):
        data.task(name)
    shutil.rmtree(folder / "a")
    assert data.task("a").name == "a", "used after b, so b went"
    shutil.rmtree(folder / "b")
    with pytest.raises(ValueError, match="expected transforms.json"):
        data.task("b")
    small = Dataset(folder, budget=one - 1)
    assert small.posed("c") is not small.posed("c")


def test_files_are_written_completely_or_not_at_all(tmp_path):
    path = tmp_path / "deep/file"
    write_whole(path, b"first")
    write_whole(path, b"second")
    assert path.read_bytes() == b"second"
    with pytest.raises(ValueError, match="deep/file: expected a folder to write into, found a file; name"):
        write_whole(path / "below", b"third")
    write_folder(tmp_path / "whole", {"a/b": b"1", "c": b"2"}, tmp_path)
    write_folder(tmp_path / "whole", {"a/b": b"3"}, tmp_path)
    assert [(tmp_path / "whole" / name).read_bytes() for name in ("a/b", "c")] == [b"3", b"2"]
    with pytest.raises(DataError, match="deep/file: expected a folder to write into, found a file"):
        write_folder(path / "below", {"a": b"1"}, tmp_path)
    assert not list(tmp_path.rglob("*.part"))
    assert [entry.name for entry in path.parent.iterdir()] == ["file"]


def test_encoding_is_deterministic(scene, monkeypatch):
    """Also later: archives have times in steps of two seconds."""
    arrays = {"depth": scene.matrix}

    def encoded():
        picture = scene.pictures[0].copy()
        return encode_png(picture), encode_png(picture, small=True), encode_npz(arrays)

    before, now = encoded(), time.time()
    with monkeypatch.context() as later:
        later.setattr(time, "time", lambda: now + 10**6)
        assert encoded() == before
    generator = np.random.default_rng(0)
    for shape, kind in (((3, 5), np.uint8), ((3, 5, 3), np.uint8), ((3, 5, 4), np.uint8), ((3, 5), np.uint16)):
        pixels = generator.integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(pixels)))), pixels)


def test_a_huge_json_file_is_refused_without_reading_it(tmp_path):
    path = tmp_path / "transforms.json"
    with open(path, "wb") as file:
        file.truncate(300 * 2**20)
    with pytest.raises(ValueError, match="expected at most 268435456 bytes, found 314572800"):
        read_json(path)


def test_writing_needs_no_torch():
    """Property: the generator and its workers start without torch, with a third of the time and memory."""
    modules = "hyperplanes.data.formats.scenes.transforms_document, data_gen.datasets.generate"
    code = f"import {modules}, sys; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
