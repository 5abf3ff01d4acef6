"""Sources of truth: the written values, and files that are damaged here."""

import errno
import io
import json
import os
from pathlib import Path

import pytest
import torch

from hyperplanes.utilities.files.checkpoints import (
    CheckpointError,
    load_tensors,
    read_json,
    save_tensors,
)
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.writing import write_json, write_whole

TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "count": torch.tensor(7), "b": torch.ones(3, 2).T}


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "model.safetensors"
    save_tensors(path, TENSORS)
    return path


def error_line(path, call):
    """The message of the error, which must be one line that starts with the file."""
    with pytest.raises(DataError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: expected ")
    assert ", found " in message
    assert "; " in message or message.endswith("found list")
    return message


def test_tensors_are_read_back_unchanged(weights):
    found = load_tensors(weights, TENSORS)
    assert set(found) == set(TENSORS)
    for name, value in TENSORS.items():
        assert torch.equal(found[name], value)
        assert found[name].dtype == value.dtype
    assert os.listdir(weights.parent) == [weights.name]


def test_json_is_read_back_unchanged(tmp_path):
    value = {"steps": 3, "nested": {"layers": ["colour", "density"]}, "none": None}
    write_json(tmp_path / "deep" / "model.json", value)
    assert read_json(tmp_path / "deep" / "model.json") == value


def test_a_missing_file_names_the_command_that_makes_one(tmp_path):
    for name, call in (("x.safetensors", load_tensors), ("x.json", read_json)):
        path = tmp_path / name
        assert "`hyperplanes train` writes" in error_line(path, lambda call=call, path=path: call(path))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.99])
def test_a_truncated_file_is_refused(weights, share):
    content = weights.read_bytes()
    weights.write_bytes(content[: int(len(content) * share)])
    assert "copy it again" in error_line(weights, lambda: load_tensors(weights))


@pytest.mark.parametrize("content", [b"glTF\x02\0\0\0\x10\0\0\0", b"a note about this model"])
def test_a_file_of_another_kind_is_no_damaged_checkpoint(weights, content):
    weights.write_bytes(content)
    message = error_line(weights, lambda: load_tensors(weights))
    assert message.endswith("found a file of another kind, which is no checkpoint; check the path")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"c": torch.ones(1)}, "expected a tensor 'c', found none"),
        ({"b": torch.ones(3, 3)}, r"expected b of shape (3, 3), found (2, 3)"),
        ({"b": None}, "expected 2 tensors, found 1 more, as 'b'"),
    ],
)
def test_weights_of_another_architecture(weights, change, words):
    expected = {name: value for name, value in {**TENSORS, **change}.items() if value is not None}
    message = error_line(weights, lambda: load_tensors(weights, expected))
    assert words in message
    assert "the configuration is of another model" in message


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe\x00", b"[1, 2]", b"nonsense", b"[" * 100_000], ids=lambda c: repr(c[:8])
)
def test_invalid_json_is_refused(tmp_path, content):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    error_line(path, lambda: read_json(path))


def test_folders_are_refused_as_files(tmp_path):
    error_line(tmp_path, lambda: read_json(tmp_path))
    error_line(tmp_path, lambda: load_tensors(tmp_path))


class Poison:
    """Unpickling this creates a file."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


@pytest.mark.parametrize("legacy", [False, True])
def test_a_pickle_is_refused_and_never_run(tmp_path, legacy):
    path, trace = tmp_path / "model.safetensors", tmp_path / "trace"
    torch.save({"a": Poison(trace)}, path, _use_new_zipfile_serialization=not legacy)
    error_line(path, lambda: load_tensors(path))
    assert not trace.exists()
    torch.load(io.BytesIO(path.read_bytes()), weights_only=False)
    assert trace.exists()  # unpickling it creates the file


@pytest.fixture
def full_disk(monkeypatch):
    """A disk that is full when `fsync` is called."""

    def fail(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)


@pytest.mark.parametrize("existing", [False, True])
def test_a_full_disk_leaves_the_old_file_or_none(tmp_path, full_disk, existing):
    path = tmp_path / "model.json"
    if existing:
        path.write_text('{"old": 1}')
    for write in (lambda: write_json(path, {"new": 1}), lambda: save_tensors(path, TENSORS)):
        with pytest.raises(OSError, match="No space left on device"):
            write()
        assert os.listdir(tmp_path) == (["model.json"] if existing else [])
    if existing:
        assert json.loads(path.read_text()) == {"old": 1}


def test_a_rename_that_fails_leaves_no_partial_file(tmp_path, monkeypatch):
    def fail(source, target):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="Input/output error"):
        write_whole(tmp_path / "file", b"content")
    assert os.listdir(tmp_path) == []


def test_values_that_json_cannot_represent_leave_no_file(tmp_path):
    with pytest.raises(TypeError):
        write_json(tmp_path / "model.json", {"tensor": torch.ones(1)})
    assert os.listdir(tmp_path) == []


def test_infinity_and_nan_are_written_as_null(tmp_path):
    # Source of truth: RFC 8259, section 6: "Infinity and NaN are not permitted"
    path = tmp_path / "metrics.json"
    write_json(path, {"psnr": float("inf"), "rows": [(float("nan"), 1.5)], "down": -float("inf")})
    text = path.read_text()
    assert "Infinity" not in text
    assert "NaN" not in text
    assert read_json(path) == {"psnr": None, "rows": [[None, 1.5]], "down": None}


def test_a_changed_bit_is_detected(weights):
    """Property: if a bit of any byte of the content is flipped, the file is refused."""
    content = weights.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    for at in range(start, len(content)):
        weights.write_bytes(content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :])
        assert "has changed since it was written" in error_line(weights, lambda: load_tensors(weights))


def test_a_file_without_a_checksum_is_read(weights):
    from safetensors.torch import save_file

    save_file({"a": torch.ones(2)}, weights)
    assert torch.equal(load_tensors(weights)["a"], torch.ones(2))


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_neither_written_nor_read(weights, number):
    from safetensors.torch import save_file

    before = weights.read_bytes()
    broken = {"whole": torch.ones(2), "layers.3.bias": torch.tensor([0.0, number], dtype=torch.bfloat16)}
    message = error_line(weights, lambda: save_tensors(weights, broken))
    assert "NaN or infinity in layers.3.bias; nothing was written" in message
    assert weights.read_bytes() == before
    save_file(broken, weights)
    assert "NaN or infinity in layers.3.bias" in error_line(weights, lambda: load_tensors(weights))


@pytest.mark.parametrize("radius", [-1.0, 0.0])
def test_a_baked_sphere_without_a_positive_radius_is_refused(tmp_path, radius):
    from safetensors.torch import load_file

    from hyperplanes.fields.baked import BakedField
    from hyperplanes.geometry import Sphere

    path = tmp_path / "baked.safetensors"
    index = torch.full((8, 8, 8), -1, dtype=torch.int32)
    BakedField(index, torch.zeros(0, 28), Sphere()).save(path)
    assert BakedField.load(path).side == 8
    save_tensors(path, load_file(path) | {"sphere": torch.tensor([0.0, 0.0, 0.0, radius])})
    with pytest.raises(CheckpointError, match=r"expected a sphere of positive radius, found -?[01]; bake again"):
        BakedField.load(path)
