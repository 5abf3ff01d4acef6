"""Dangerous files in data sets of others: pipes, devices, links, and pictures that start other programs.

Source of truth: a reader opens only regular files inside the given folder.
"""

import os
import re

import numpy as np
import pytest
from PIL import Image

from hyperplanes.configuration.settings_file import read_experiment
from hyperplanes.data import DataError, read_views
from hyperplanes.data.pictures.images import read_image
from hyperplanes.utilities.files.reading import read_json
from tests.fuzz.campaign import time_limit
from tests.fuzz.corpus import CORPUS

LAYOUTS = ("posed", "COLMAP text", "COLMAP binary", "SRN", "NSVF", "LLFF", "NeuS", "data set")
LAYOUTS += ("Polycam", "Record3D", "RealityCapture", "Metashape")
SECRET = b"\nroot:x:0:0\n"


def made(kind, home):
    make, _, read = CORPUS[kind]
    folder = home / "scene"
    make(folder)
    read(folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json")
    return folder, {path.relative_to(folder).parts[0] + path.suffix: path for path in files}.values(), read


@pytest.mark.parametrize("kind", LAYOUTS)
@pytest.mark.parametrize("instead", ["a pipe", "a device", "a link out of the folder"])
def test_only_regular_files_inside_the_folder_are_opened(tmp_path, kind, instead):
    """One file of each kind of the layout in turn. Links lead to one with a line that readers of text would quote."""
    folder, files, read = made(kind, tmp_path)
    for path in files:
        content, secret = path.read_bytes(), tmp_path / f"secret{path.suffix}"
        secret.write_bytes(content + SECRET)
        path.unlink()
        if instead == "a pipe":
            os.mkfifo(path)
        else:
            path.symlink_to("/dev/zero" if instead == "a device" else secret)
        with time_limit(), pytest.raises(DataError) as caught:
            read(folder)
        if instead == "a link out of the folder":
            assert SECRET.decode().strip() not in str(caught.value), path
            assert re.search(r"a symbolic link to .*secret", str(caught.value)), path
        path.unlink()
        path.write_bytes(content)
    read(folder)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_links_inside_the_folder_are_followed(tmp_path, kind):
    folder, files, read = made(kind, tmp_path)
    (folder / "elsewhere").mkdir()
    for index, path in enumerate(files):
        target = folder / "elsewhere" / f"{index}{path.suffix}"
        path.rename(target)
        path.symlink_to(target)
    read(folder)


def test_a_picture_starts_no_other_program(tmp_path, monkeypatch):
    """Pillow starts Ghostscript to render PostScript, for any name of the file."""
    started = []
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", lambda *arguments, **options: started.append(arguments))
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    with pytest.raises(DataError, match=r"a\.png: expected an image, found something else"):
        read_image(tmp_path / "a.png")
    assert not started


@pytest.mark.parametrize("read", [read_experiment, read_json])
@pytest.mark.parametrize("instead", ["/dev/zero", None])
def test_settings_have_to_be_regular_files(tmp_path, read, instead):
    path = tmp_path / "config.yaml"
    if instead is None:
        os.mkfifo(path)
    else:
        path.symlink_to(instead)
    with time_limit(), pytest.raises(DataError, match="expected a regular file, found a (pipe|device)"):
        read(path)


def test_the_message_says_that_it_is_a_link(tmp_path):
    folder, _, _ = made("posed", tmp_path)
    (folder / "images").rename(tmp_path / "pictures")
    (folder / "images").symlink_to(tmp_path / "pictures")
    with pytest.raises(DataError, match=r"found 'images/0\.png', a symbolic link to .*pictures/0.png; copy the files"):
        read_views(folder)
