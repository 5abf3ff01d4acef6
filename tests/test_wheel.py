"""Source of truth: a wheel that is built from a copy of the repository."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("hyperplanes", "data_gen")
PACKAGED = ("hyperplanes/pretrained/tiny/model.json", "hyperplanes/pretrained/tiny/model.safetensors")


def copy_without_weights(source, target):
    """Copy a file; weights become empty files, because compressing them takes half of the time."""
    if source.endswith(".safetensors"):
        Path(target).touch()
    else:
        shutil.copy2(source, target)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for package in PACKAGES:
        leave_out = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, tree / package, ignore=leave_out, copy_function=copy_without_weights)
    for name in ("pyproject.toml", "setup.cfg", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    for name in PACKAGED:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).touch()
    (tree / "tests").mkdir()
    (tree / "tests" / "__init__.py").touch()
    build = "import setuptools.build_meta as backend, sys; backend.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(out)], cwd=tree, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_contains_the_packages_and_nothing_else(wheel):
    found = {name for name in wheel.namelist() if ".dist-info/" not in name}
    there = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.suffix == ".py" and (path.parent / "__init__.py").exists()
    }
    models = {str(path.relative_to(ROOT)) for path in (ROOT / "hyperplanes/pretrained").glob("*/*.*")}
    examples = {str(path.relative_to(ROOT)) for path in (ROOT / "hyperplanes/examples").rglob("*.*")}
    page = {"hyperplanes/experiments/page/style.css", "hyperplanes/experiments/page/report.html"}
    page.add("hyperplanes/export/viewer.js")
    assert found == there | page | {*PACKAGED} | models | examples


def test_the_example_is_complete_and_small(wheel):
    """The first example of README.md needs 50 views, which take less than 300 KiB."""
    files = [entry for entry in wheel.infolist() if entry.filename.startswith("hyperplanes/examples/example-car/")]
    assert sum(entry.filename.endswith(".png") for entry in files) == 50
    assert sum(entry.file_size for entry in files) < 300 * 2**10


def test_metadata_of_the_wheel(wheel):
    name = next(name for name in wheel.namelist() if name.endswith("METADATA"))
    metadata = wheel.read(name).decode()
    assert "License-Expression: Apache-2.0" in metadata
    assert "Requires-Python: >=3.11" in metadata
    scripts = next(name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "hyperplanes = hyperplanes.cli:main" in wheel.read(scripts).decode()
    assert "generate = data_gen.commands:GENERATE" in wheel.read(scripts).decode()
    assert any(name.endswith("licenses/LICENSE") for name in wheel.namelist())
