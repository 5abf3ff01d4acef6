"""Source of truth: the operating system, with pipes, locks and signals made here."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from data_gen.datasets.generate import Procedural, generate
from hyperplanes.cli import main
from hyperplanes.data import open_dataset
from hyperplanes.data.formats.collections.npz import read_npz
from hyperplanes.data.pictures.images import read_image
from hyperplanes.utilities.files.checkpoints import load_tensors
from hyperplanes.utilities.files.reading import DataError, folder_checksum, inside, malformed, read_bytes, read_json
from hyperplanes.utilities.files.writing import one_writer

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("read", [read_json, read_bytes, read_image, read_npz, load_tensors])
def test_a_pipe_is_refused_without_waiting(tmp_path, read):
    path = tmp_path / "file"
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"file: expected a regular file, found a pipe; copy"):
        read(path)


def test_devices_and_too_large_files_are_refused_unread(tmp_path):
    with pytest.raises(DataError, match="expected a regular file, found a device"):
        read_bytes("/dev/zero")
    large = tmp_path / "model.json"
    with open(large, "wb") as file:
        file.truncate(2**40)  # a sparse file, which takes no disk space
    with pytest.raises(DataError, match=rf"expected at most 268435456 bytes, found {2**40}"):
        read_json(large)
    with pytest.raises(DataError, match="expected at most"):
        read_bytes(large)


@pytest.mark.parametrize("number", ["9223372036854775808", "-9223372036854775809", "1" * 5000])
def test_whole_numbers_beyond_64_bits_are_refused(tmp_path, number):
    path = tmp_path / "transforms.json"
    path.write_text(f'{{"w": {number}}}')
    with pytest.raises(DataError, match="expected valid JSON, found a whole number of"):
        read_json(path)


def test_unexpected_errors_of_parsers_become_one_line_about_the_file():
    for error in (KeyError("a"), TypeError("b"), OverflowError("c"), RuntimeError("d\nd"), IndexError()):
        with pytest.raises(DataError, match=r"^x: expected a thing, found something else: \w+.*; write") as caught:
            with malformed("x", "a thing"):
                raise error
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="^the first one$"), malformed("x", "a thing"):
        raise DataError("the first one")
    with pytest.raises(PermissionError), malformed("x", "a thing"):
        raise PermissionError


def test_a_folder_has_one_writer(tmp_path):
    """Property: of many concurrent writers, only one works at a time, and no files remain."""
    folder, working, most, refused = tmp_path / "out", [], [], []

    def work():
        try:
            with one_writer(folder):
                working.append(1)
                most.append(len(working))
                threading.Event().wait(0.002)
                working.pop()
        except DataError as error:
            refused.append(str(error))

    for _ in range(10):
        threads = [threading.Thread(target=work) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert max(most) == 1
    assert len(most) + len(refused) == 80
    assert refused[0].endswith("another hyperplanes at work there; wait for it, or name another folder")
    assert list(folder.iterdir()) == []


def test_every_verb_that_writes_locks_its_folder_and_refuses_a_file(tmp_path, capsys):
    out, scene = tmp_path / "out", str(tmp_path)
    (tmp_path / "file").write_text("")
    verbs = {
        "train": ["--data", scene],
        "adapt": ["--checkpoint", scene, "--views", scene],
        "render": ["--checkpoint", scene, "--views", scene],
        "export": ["--checkpoint", scene, "--views", scene],
        "demo": [],
        "reproduce": ["target"],
    }
    with one_writer(out):
        for verb, options in verbs.items():
            assert main([verb, *options, "--out", str(out)]) == 2
            assert "found another hyperplanes at work there" in capsys.readouterr().err
        # bake writes one complete file, so that others may write to the same folder
        bake = ["bake", *verbs["render"], "--out"]
        assert main([*bake, str(out / "car.safetensors")]) == 2
        assert f"{tmp_path}: expected a checkpoint" in capsys.readouterr().err
    assert main([*bake, str(tmp_path / "file/car.safetensors")]) == 2
    assert "--out: expected a file in a folder, got" in capsys.readouterr().err
    for verb, options in verbs.items():
        assert main([verb, *options, "--out", str(tmp_path / "file")]) == 2
        assert "file: expected a folder to write into, found a file; name another one" in capsys.readouterr().err


def test_a_lock_ends_with_its_process(tmp_path):
    locked = f"with writing.one_writer({str(tmp_path)!r}): os.abort()"
    code = f"import os; from hyperplanes.utilities.files import writing\n{locked}"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, stderr=subprocess.DEVNULL)
    assert done.returncode == -signal.SIGABRT
    assert (tmp_path / ".lock").exists()
    with one_writer(tmp_path):
        pass


def test_an_unreadable_folder_inside_does_not_prevent_writing(tmp_path):
    """As lost+found on a disk. Paths are relative, because the other user may not access the parent folders."""
    (tmp_path / "lost+found").mkdir(mode=0o700)
    tmp_path.chmod(0o777)
    code = (
        "import fcntl, os, sys; from hyperplanes.utilities.files import writing\nos.chdir(sys.argv[1])\n"
        "os.setuid(65534) if os.getuid() == 0 else os.chmod('lost+found', 0)\n"
        "with writing.one_writer('.'): writing.write_whole('a', b'whole')"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path], cwd=ROOT, check=True)
    assert (tmp_path / "a").read_bytes() == b"whole"


def test_too_long_file_names_are_refused(tmp_path):
    assert inside(tmp_path, "a" * 255, "images.bin") == tmp_path / ("a" * 255)
    with pytest.raises(DataError, match="images.bin: expected file names of at most 255 bytes"):
        inside(tmp_path, "images/" + "1" * 252 + ".png", "images.bin")


def test_an_absurd_count_is_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="count: expected at most 1000000 objects, got 1000000000"):
        generate(Procedural("car", 10**9), tmp_path / "x")


def test_an_object_in_two_splits_is_refused(tmp_path):
    manifest = '{"format": "hyperplanes-dataset", "version": 1, "splits": {"train": ["a", "b"], "test": ["b"]}}'
    (tmp_path / "manifest.json").write_text(manifest)
    with pytest.raises(DataError, match="expected every object in one split, found b in train and in test; take"):
        open_dataset(tmp_path)
    (tmp_path / "manifest.json").write_text(manifest.replace('"a", "b"', '"a", "a"'))
    with pytest.raises(DataError, match="found a twice in train"):
        open_dataset(tmp_path)


def test_an_array_with_a_too_large_stated_size_is_refused(tmp_path):
    import zipfile

    path = tmp_path / "50_car.npz"
    with zipfile.ZipFile(path, "w") as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n"
        archive.writestr("images.npy", np.lib.format.magic(1, 0) + len(header).to_bytes(2, "little") + header)
    with pytest.raises(DataError, match="expected at most 2147483648 bytes of arrays, found 8000000000000"):
        read_npz(path)


def test_the_checksum_of_a_folder_depends_on_its_files(tmp_path):
    """Property: it changes only with names, sizes and times of files, including those behind a link."""
    held, elsewhere = tmp_path / "held", tmp_path / "elsewhere"
    for folder in (held / "a", held / "runs", elsewhere):
        folder.mkdir(parents=True)
    (held / "link").symlink_to(elsewhere)
    (elsewhere / "back").symlink_to(held)
    picture, linked = held / "a" / "picture.png", elsewhere / "mesh.obj"
    picture.write_bytes(b"12")
    found = [folder_checksum(held, held / "runs")]
    (held / "runs" / "page.html").write_bytes(b"1")
    (held / ".lock").write_bytes(b"")
    assert folder_checksum(held, held / "runs") == found[0]
    for change in (
        lambda: picture.write_bytes(b"123"),
        lambda: os.utime(picture, ns=(0, 1)),
        lambda: picture.rename(held / "b.png"),
        lambda: linked.write_bytes(b"1"),
    ):
        change()
        found.append(folder_checksum(held, held / "runs"))
    assert len(set(found)) == len(found)


def test_the_checksum_of_a_data_set_depends_on_its_manifest_not_on_file_times(tmp_path):
    """Property: other file times do not change it; another manifest or a file of another size does."""
    manifest, picture = tmp_path / "manifest.json", tmp_path / "picture.png"
    manifest.write_bytes(b"1")
    picture.write_bytes(b"12")
    found = folder_checksum(tmp_path)
    for path in (manifest, picture):
        os.utime(path, ns=(0, 1))
    assert folder_checksum(tmp_path) == found
    manifest.write_bytes(b"2")
    other = folder_checksum(tmp_path)
    picture.write_bytes(b"123")
    assert len({found, other, folder_checksum(tmp_path)}) == 3
