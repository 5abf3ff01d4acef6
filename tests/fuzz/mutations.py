"""Damage to the bytes of files, to numbers and values of texts, and to members of archives."""

import gzip
import io
import re
import zipfile
from pathlib import Path

import torch
from safetensors.torch import load, save

from hyperplanes.utilities.files.checkpoints import CHECKSUM, _checksum

NUMBERS = ["-1", "0", "1e309", "-1e-300", "NaN", "9223372036854775808", "4294967296", "1" * 400, "0.5", "2"]
VALUES = [*NUMBERS, "null", "true", '""', "[]", "{}", '"../../x"', '"\\u0000"', "[[[[1]]]]", '{"a": 1}']
TOKEN = re.compile(rb'-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|"(?:[^"\\]|\\.)*"|true|false|null')


def flip(data, draw):
    """Flip some bits."""
    data = bytearray(data)
    for _ in range(draw.choice([1, 1, 2, 8, 64])):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(data)


def overwrite(data, draw):
    """Overwrite a few bytes with extreme ones, which gives extreme lengths and counts in binary files."""
    at, size = draw.randrange(len(data)), draw.choice([1, 2, 4, 8])
    value = draw.choice([b"\x00", b"\xff", b"\x7f", b"\x80"]) * size
    return data[:at] + value + data[at + size :]


def cut(data, draw):
    """Remove the end, or a part in between."""
    first, second = sorted(draw.randrange(len(data) + 1) for _ in range(2))
    return data[:first] if draw.random() < 0.5 else data[:first] + data[second:]


def repeat(data, draw):
    """Repeat a part."""
    first, second = sorted(draw.randrange(len(data) + 1) for _ in range(2))
    return data[:second] + data[first:]


def empty(data, draw):
    """Replace all by nothing, by noise, or by one repeated byte."""
    return draw.choice([b"", draw.randbytes(len(data)), b"\0" * len(data), b"\xff\xfe", b"[" * 100_000])


def change_value(data, draw):
    """Replace one value of a text by another, often of another type."""
    tokens = list(TOKEN.finditer(data))
    if not tokens:
        return flip(data, draw) if data else data
    token = draw.choice(tokens)
    return data[: token.start()] + draw.choice(VALUES).encode() + data[token.end() :]


def change_number(data, draw):
    """Replace one number of a text by another."""
    tokens = [token for token in TOKEN.finditer(data) if token[0][:1] in b"-0123456789"]
    if not tokens:
        return overwrite(data, draw) if data else data
    token = draw.choice(tokens)
    return data[: token.start()] + draw.choice(NUMBERS).encode() + data[token.end() :]


def change_member(data, draw):
    """Damage one member of a ZIP archive, or mark it as encrypted or as compressed by an unknown method."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return change_value(data, draw)
    way = draw.randrange(3)
    if way:
        at = draw.choice([found.start() for found in re.finditer(rb"PK\x01\x02|PK\x03\x04", data)])
        offset = (8 if data[at + 2] == 1 else 6) + 2 * (way == 2)
        return data[: at + offset] + bytes([data[at + offset] ^ 1, data[at + offset + 1]]) + data[at + offset + 2 :]
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # damaged before
        return overwrite(data, draw)
    if not members:
        return data
    name = draw.choice(sorted(members))
    members[name] = draw.choice([flip, overwrite, cut, change_number])(members[name], draw)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    return out.getvalue()


def change_unpacked(data, draw):
    """Damage the content of a gzip file as a text."""
    try:
        content = gzip.decompress(data)
    except Exception:  # damaged before
        return flip(data, draw)
    return gzip.compress(draw.choice([change_value, change_number, cut, repeat])(content, draw)) if content else data


def change_tensor(data, draw):
    """Replace one tensor by one of other numbers, shape or type, with a correct checksum."""
    try:
        tensors = load(data)
    except Exception:  # damaged before
        return overwrite(data, draw)
    if not tensors:
        return data
    name = draw.choice(sorted(tensors))
    value = tensors[name]
    ways = [
        lambda: torch.full_like(value, draw.choice([0, 1, -1, 127])),
        lambda: value.double() * 1e30,
        lambda: value.flip(0) if value.ndim else value + 1,
        lambda: value.flatten(),
        lambda: value[:0] if value.ndim else value[None],
        lambda: value.half(),
        lambda: value.int() - 1,
        lambda: torch.full(value.shape, float("nan")),
    ]
    tensors[name] = draw.choice(ways)().contiguous()
    return save(tensors, {CHECKSUM: _checksum(tensors)})


TEXT = (flip, cut, repeat, empty, change_value, change_value, change_value, change_number, change_number)
BINARY = (flip, overwrite, overwrite, cut, repeat, empty, change_number, change_member, change_member)


TEXTS = (".json", ".txt", ".obj", ".off", ".mtl", ".ply", ".gltf", ".dae", ".lst", ".yaml")


def mutate(data, name, draw):
    """The content of a file after one to three kinds of damage that suit its type."""
    kinds = TEXT if name.endswith(TEXTS) else BINARY
    kinds += {".jgz": (change_unpacked,) * 6, ".safetensors": (change_tensor,) * 6}.get(Path(name).suffix, ())
    for _ in range(draw.choice([1, 1, 1, 2, 3])):
        if data:
            data = draw.choice(kinds)(data, draw)
    return data
