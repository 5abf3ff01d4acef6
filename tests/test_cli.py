"""Tests of the command line: exit codes, one line per mistake, and the files that are written."""

import csv
import errno
import io
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import tyro
from PIL import Image
from rendered_here import rendered_here
from small_demo import demo_folder, demo_preset, first_object, small_demo
from small_packaged import small_packaged

from data_gen.rendering.renderers import RendererError
from hyperplanes.adaptation import HullBlend, HyperPlanes, NearestView, ResidualField
from hyperplanes.adaptation.checkpoints import find_checkpoint, find_checkpoints
from hyperplanes.adaptation.correction import residuals
from hyperplanes.cli import main
from hyperplanes.commands import adapt, find_verb, find_verbs, parsing, render, split_settings
from hyperplanes.commands.inputs.scene import read_scene
from hyperplanes.commands.output.console import Console
from hyperplanes.configuration.fine_tuning import MANY_VIEWS, FineTuning
from hyperplanes.configuration.presets import PRESETS
from hyperplanes.data import DataError, open_dataset, read_task
from hyperplanes.data.packaged import locate_scene
from hyperplanes.data.support import FewerQueries, SupportByPosition, WithSupport
from hyperplanes.evaluation import evaluate, suitability
from hyperplanes.export.baking import BakedScene
from hyperplanes.export.images import to_pixels
from hyperplanes.fields.baked import BakedField
from hyperplanes.rendering.renderer import Hierarchical
from hyperplanes.training import Trainer
from hyperplanes.utilities.files.writing import one_writer
from hyperplanes.utilities.images.metrics import psnr

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"


def tiny_preset():
    """The preset "quick" with small networks and few gradient steps."""
    quick = PRESETS["quick"]
    network = replace(quick.model.network, depth=2, width=16, planes=6)
    initialisation = replace(quick.initialisation, inner_steps=1, steps=2, test_rays=32)
    return replace(quick, model=replace(quick.model, network=network), initialisation=initialisation)


def error_line(capsys):
    """The single line on standard error."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image).astype(int)


def first_views(scene, folder, *, support, query):
    """A copy of a scene with only its first support and query views."""
    shutil.copytree(scene, folder)
    document = json.loads((folder / "transforms.json").read_text())
    kept = {"train_filenames": support, "test_filenames": query}
    document |= {name: document[name][:count] for name, count in kept.items()}
    names = sum((document[name] for name in kept), [])
    document["frames"] = [frame for frame in document["frames"] if frame["file_path"] in names]
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


@contextmanager
def unread_pipe():
    """The writing end of a pipe whose reading end is closed."""
    read, write = os.pipe()
    os.close(read)
    pipe = os.fdopen(write, "w")
    try:
        yield pipe
    finally:
        with suppress(BrokenPipeError):
            pipe.close()


@pytest.fixture
def compiled(monkeypatch):
    """Skip compiling kernels in a demonstration."""
    monkeypatch.setattr("hyperplanes.experiments.demonstration.steps.compile_kernels", lambda device: None)


def refuse_to_find_a_renderer(monkeypatch):
    """Fail if a command looks for a renderer."""
    monkeypatch.setattr("data_gen.rendering.renderers.find_renderer", lambda _: pytest.fail("looked for a renderer"))


def test_help_loads_nothing_heavy():
    script = (
        "import sys; from hyperplanes.cli import main; main(['--help']); "
        "print([name for name in ('torch', 'kornia', 'trimesh', 'numba', 'tyro') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == "[]"
    assert all(verb in done.stdout for verb in find_verbs())


@pytest.mark.parametrize("asked", ["--help", "--version"])
def test_the_module_is_the_command_and_a_closed_pipe_is_no_error(asked):
    command = [sys.executable, "-m", "hyperplanes", asked]
    whole = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert "hyperplanes" in whole.stdout
    with unread_pipe() as pipe:
        left = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT)
    assert (left.returncode, left.stderr) == (0, "")


def test_a_pipe_that_is_closed_during_a_table_is_no_error(monkeypatch, capsys):
    """In this process, because a new one takes seconds to import the configurations."""
    with unread_pipe() as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert main(["presets"]) == 0
        assert sys.stdout is None, "standard output must not be flushed again at exit"
        monkeypatch.undo()
    assert capsys.readouterr().err == ""


def test_every_verb_has_help_with_an_example_and_no_torch():
    script = """
import sys
from hyperplanes.cli import main
for verb in sys.argv[1:]:
    try:
        main([verb, "--help"])
    except SystemExit as end:
        print("END", verb, end.code, "torch" in sys.modules)
"""
    verbs = find_verbs()
    done = subprocess.run([sys.executable, "-c", script, *verbs], capture_output=True, text=True, check=True, cwd=ROOT)
    start = 0
    for verb in verbs:
        shown, found, _ = done.stdout[start:].partition(f"END {verb} 0 False\n")
        assert found, done.stdout[start:]
        start += len(shown) + len(found)
        assert f"    hyperplanes {verb}" in shown
        if verb in ("render", "export", "bake", "adapt", "evaluate"):
            text = " ".join(shown.replace("│", " ").split())
            assert "or a packaged model: small, small-paper, cars-64" in text


WRONG_PATHS = {
    "evaluate --data none": "the folder of a data set, found nothing; check the path, or run hyperplanes generate",
    "evaluate --data example-car --lpips none": "a safetensors file of weights of LPIPS, found nothing",
    "train --data example-car none --out out": "the folder of a data set, found nothing; check the path, or run hyper",
    "train --data example-car --config none --out out": "a YAML file of settings, found nothing; check the path",
    **{
        f"{line} --checkpoint small": "a transforms*.json or the folder of a scene, found nothing; check the path"
        for line in (
            *("render --views none --out out", "export --views none --out out", "bake --views none --out out"),
            *("adapt --views none --out out", "view none"),
        )
    },
    "render --checkpoint small --views example-car --out out --camera-path none": "a JSON file with a camera path",
    "render --checkpoint small --views example-car --out out --dataparser-transforms none": "nerfstudio's dataparser_",
    "capture none --out out": "a folder of photographs, or a video, found nothing; check the path",
    "demo --meshes none --out out": "a folder of mesh files, found nothing; check the path",
    "generate --meshes none --out out": "a folder of meshes, found nothing; give the folder",
    "generate --meshes . --split-file none --out out": "ShapeNet's official all.csv, found nothing; check the path",
}
"""Command lines with the path `none`, at which nothing exists, and what is expected there."""


def test_a_wrong_path_is_refused_in_one_line_before_torch_is_imported(tmp_path):
    script = (
        "import sys; from hyperplanes.cli import main\n"
        "for line in sys.argv[1:]: print(main(line.split()), sorted({'torch', 'kornia', 'OpenGL'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", script, *WRONG_PATHS]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, env=environment)
    assert done.stdout.splitlines() == ["2 []"] * len(WRONG_PATHS)
    for (line, expected), error in zip(WRONG_PATHS.items(), done.stderr.splitlines(), strict=True):
        assert error.startswith(f"hyperplanes {line.split()[0]}: none: expected {expected}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "line",
    [
        "evaluate --data example-car",
        "train --data example-car --out out",
        "render --checkpoint small --views example-car --out out",
        "view example-car",
    ],
)
def test_the_name_of_a_packaged_scene_is_a_path_that_exists(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = []
    monkeypatch.setattr(f"hyperplanes.commands.{line.split()[0]}.run", lambda arguments: runs.append(arguments) or 0)
    assert main(line.split()) == 0
    assert len(runs) == 1


def test_a_path_with_a_file_or_a_link_to_nothing_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refuse_to_find_a_renderer(monkeypatch)
    Path("file").touch()
    Path("link").symlink_to("none")
    for path, found in (("file", "a file"), ("link", "a link to nothing"), ("example-car", "nothing")):
        assert main(["generate", "--meshes", path, "--out", "out"]) == 2
        assert error_line(capsys).endswith(f": {path}: expected a folder of meshes, found {found}; give the folder")


def test_a_misspelt_packaged_scene_is_answered_with_a_suggestion(capsys):
    assert main(["view", "example-cars"]) == 2
    assert error_line(capsys).endswith(
        "expected a transforms*.json or the folder of a scene, found nothing; did you mean example-car?"
    )


def test_an_unknown_verb_is_answered_with_a_suggestion(capsys):
    for given, meant in (("trian", "train"), ("--verson", "--version")):
        assert main([given]) == 2
        assert error_line(capsys).endswith(f"did you mean {meant}?")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --dat x", "no option --dat; did you mean --data?"),
        ("train --zzz", "no option --zzz; see hyperplanes train --help"),
        ("render", "missing --checkpoint, --views, --out; see hyperplanes render --help"),
        ("render small", "expected an option, got small; see hyperplanes render --help"),
        ("render --checkpoint", "--checkpoint: expected a value, got none"),
        ("render --out=", "--out: expected a value, got an empty one"),
        ("render --checkpoint a b", "--checkpoint: expected one value, got a b"),
        ("render --all-views yes", "--all-views: expected no value, got yes"),
        ("render --orbit 1.5", "--orbit: expected a whole number, got 1.5"),
        ("render --steps=some", "--steps: expected a whole number or auto, got some"),
        ("export --what mesh pge", "--what: expected one of images, turntable, mesh, page, splats, points, got pge"),
        ("evaluate --steps 1 b", "--steps: expected a whole number, got b"),
        ("generate --distance far", "--distance: expected a number, got far"),
        ("generate --held-out far", "--held-out: expected a number, got far"),
        ("demo --hepl", "no option --hepl; did you mean --help?"),
        ("demo --class bus", "--class: expected one of car, chair, plane, lamp, got bus"),
        ("capture --out x", "missing PHOTOGRAPHS; see hyperplanes capture --help"),
        ("capture a b --out x", "PHOTOGRAPHS: expected one value, got a b"),
        ("capture --out x none", "none: expected a folder of photographs, or a video, found nothing; check the path"),
        ("view --refine-poses none", "none: expected a transforms*.json or the folder of a scene, found nothing"),
    ],
)
def test_options_that_cannot_be_parsed_are_refused_in_one_line(line, message, capsys):
    verb, *_ = line.split()
    assert main(line.split()) == 2
    assert error_line(capsys).startswith(f"hyperplanes {verb}: {message}")


@pytest.mark.parametrize("verb", find_verbs())
def test_the_examples_in_the_help_have_options_that_exist(verb):
    module = find_verb(verb).load()
    examples = re.findall(rf"^    hyperplanes {verb}\b(.*)$", module.__doc__, re.MULTILINE)
    assert examples
    for example in examples:
        words = split_settings(shlex.split(example.partition(" > ")[0], comments=True))[0]
        parsing._check_words(verb, module.Arguments, words)


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("export --what images --what mesh", "--what"),
        ("export --fit=3 --fit 4", "--fit"),
        ("export --page-voxels 32 --page_voxels 64", "--page-voxels"),
        ("export --all-views --all-views", "--all-views"),
        ("train --model.network.depth 3 --model.network.depth=4", "--model.network.depth"),
        ("train --training.learning_rate 1 --training.learning-rate 2", "--training.learning-rate"),
    ],
)
def test_an_option_that_is_given_twice_is_refused(line, option, capsys):
    """The parser would silently use the last value."""
    assert main([*line.split(), "--out", "unused"]) == 2
    assert f"{option}: expected once, got it twice" in error_line(capsys)


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("hyperplanes 0")


RENDER = ["render", "--checkpoint", "OUT/not-looked-at", "--views", "OUT", "--out", "OUT/run"]  # OUT has no views
BAKE = ["bake", "--checkpoint", "OUT/not-looked-at", "--views", "OUT", "--out"]


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["generate", "--out", "OUT"], ["--class", "--meshes"]),
        (
            ["generate", "--meshes", "OUT/none", "--out", "OUT"],
            ["OUT/none: expected a folder of meshes, found nothing"],
        ),
        (["generate", "--class", "caar", "--out", "OUT"], ["class: expected one of car, chair", "did you mean car?"]),
        (
            ["generate", "--class", "car", "--layout", "srm", "--out", "OUT"],
            ["expected one of native, ", "mean srn?"],
        ),
        (["generate", "--class", "car", "--rig", "orbits", "--out", "OUT"], ["expected one of fixed", "mean orbit?"]),
        (["reproduce", "targets", "--out", "OUT"], ["expected one of shapenet, ", "did you mean target?"]),
        (["generate", "--class", "car", "--count", "0", "--out", "OUT"], ["at least 1 object", "0"]),
        (["generate", "--class", "car", "--split-file", "OUT", "--out", "OUT"], ["--split-file", "--meshes"]),
        (["train", "--data", "OUT/none", "--out", "OUT/run"], ["OUT/none", "hyperplanes generate"]),
        (
            ["train", "--data", "example-car", "--out", "OUT/run"],
            ["found none in its train split and 1 object in the others"],
        ),
        (["train", "--data", "DATA", "--preset", "huge", "--out", "OUT/run"], ["quick", "huge"]),
        (["train", "--data", "DATA", "--field", "voxels", "--out", "OUT/run"], ["image_based", "voxels"]),
        (["train", "--data", "DATA", "--steps", "0", "--out", "OUT/run"], ["steps", "0"]),
        (
            ["train", "--data", "DATA", "--support", "0", "--out", "OUT/run"],
            ["--support: planes: expected a whole number"],
        ),
        (["train", "--data", "DATA", "--device", "abacus", "--out", "OUT/run"], ["device", "abacus"]),
        *(
            (["train", "--data", "DATA", "--out", "OUT/run", *options.split()], ["expected one of the two, got both"])
            for options in (
                "--training.steps 5 --steps 6",
                "--training.epochs 5 --epochs 6",
                "--training.epochs 5 --steps 6",
                "--training.steps 5 --training.epochs 2",
                "--seed 1 --training.seed 2",
                "--cache-size 1 --training.memory 5",
                "--support 4 --model.network.planes 3",
                "--protocol paper --model.protocol ray_marching",
                "--field nerf --model.target multiplane",
            )
        ),
        (
            ["train", "--data", "DATA", "--method", "nerf", "--model.initialisation.steps", "3", "--out", "OUT/run"],
            ["--method nerf: expected --model settings of this method, got those of mv_meta"],
        ),
        (
            ["evaluate", "--data", "DATA", "--method", "nearest_view", "--json", "OUT/a.json", "--csv", "OUT/a.json"],
            ["--csv, --json: expected a file each, got", "twice"],
        ),
        (
            ["reproduce", "target", "--scale", "smoke", "--data", "car=OUT/none", "--out", "OUT/rep"],
            ["--data car=OUT/none: expected the folder of a data set, found nothing"],
        ),
        (
            ["reproduce", "target", "--scale", "smoke", "--legacy", "--out", "OUT/rep"],
            ["--legacy: expected --data as well, got none"],
        ),
        (["demo", "--preset", "huge", "--out", "OUT/demo"], ["preset: expected one of quick, small", "'huge'"]),
        (["demo", "--steps", "0", "--out", "OUT/demo"], ["--steps: expected a whole number from 1"]),
        (["train", "--data", "DATA", "--preset", "small", "--support", "5", "--out", "OUT/run"], ["--training.views"]),
        (["evaluate", "--data", "DATA", "--method", "magic"], ["nearest_view", "magic"]),
        (
            ["evaluate", "--data", "DATA", "--method", "nearest_view", "--preset", "huge"],
            ["preset: expected one of", "huge"],
        ),
        (["capture", "OUT", "--frames", "5", "--out", "OUT/scene"], ["--frames: expected a video, got the folder"]),
        (["inspect", "small", "--checksums"], ["--checksums: expected a data set, got small"]),
        (["evaluate", "--data", "DATA", "--method", "nearest_view", "--boxes", "OUT/a.gfi"], ["OUT/a.gfi", "png"]),
        (["evaluate", "--data", "DATA", "--method", "hyperplanes"], ["checkpoint", "hyperplanes train"]),
        (
            ["evaluate", "--data", "DATA", "--checkpoint", "RUN", "cars-64", "--method", "nearest_view"],
            ["RUN and ", "cars-64, which are both hyperplanes"],
        ),
        (
            ["render", "--checkpoint", "OUT/none", "--views", "DATA", "--out", "OUT"],
            ["OUT/none", "hyperplanes train"],
        ),
        (["export", "--checkpoint", "RUN", "--views", "OUT/none", "--out", "OUT/x"], ["OUT/none", "nothing"]),
        (["demo", "--held-out", "500", "--out", "OUT/demo"], ["--held-out", "500"]),
        (["inspect", "smal"], ["smal: expected a data set, posed images", "small-paper, cars-64, example"]),
        (
            ["demo", "--first-only", "--meshes", "OUT/none", "--out", "OUT/demo"],
            ["OUT/none: expected a folder of mesh files, found nothing; check the path"],
        ),
        ([*RENDER, "--orbit", "0"], ["--orbit: expected 1 to 10000 frames, got 0"]),
        ([*RENDER, "--orbit", "100000000"], ["--orbit: expected 1 to 10000 frames, got 100000000"]),
        ([*RENDER, "--size", "32"], ["--size: expected --orbit or --camera-path as well, got 32 alone"]),
        ([*RENDER, "--orbit", "2", "--size", "0"], ["--size: expected at least 1 pixel, got 0"]),
        ([*BAKE, "OUT/bk"], ["--out: expected a name that ends in .safetensors, got OUT/bk"]),
        (
            ["train", "--data", "DATA", "--out", "DATA"],
            ["--out: expected a folder of its own, got DATA, which is --data"],
        ),
        (
            ["train", "--data", "DATA", "--steps", "3", "--epochs", "1", "--out", "OUT/run"],
            ["--steps, --epochs: expected one of the two, got both"],
        ),
        (
            [
                *["train", "--data", "DATA", "--method", "autoencoder", "--devices", "2"],
                *["--training.reference-objects", "3", "--out", "OUT/run"],
            ],
            ["reference_objects: expected a multiple of the 2 processes, got 3; give --training.reference-objects 4"],
        ),
        (["evaluate", "--data", "DATA", "--method"], ["--method: expected at least one, got none"]),
        (
            ["evaluate", "--data", "DATA", "--method", "nearest_view", "scratch", "--steps", "0"],
            ["--steps: expected a number of at least 1 for scratch, got 0"],
        ),
        (["evaluate", "--data", "DATA", "--steps", "2", "-1"], ["--steps: expected 0 or more, got -1"]),
        (["train", "--data", "DATA", "--epochs", "0", "--out", "OUT/run"], ["--epochs: expected at least 1, got 0"]),
        (["generate", "--class", "car", "--workers", "0", "--out", "OUT/run"], ["workers: expected at least 1, got 0"]),
        (["train", "--data", "--out", "OUT/run"], ["data: expected at least one folder, got none"]),
        ([*RENDER, "--rendered-output-names"], ["--rendered-output-names: expected at least one"]),
        ([*RENDER, "--turntable", "gif"], ["--turntable: expected --orbit or --camera-path"]),
        ([*BAKE, "OUT/b.safetensors", "--turntable", "gif"], ["--turntable: expected --orbit as well, got gif alone"]),
        (
            ["evaluate", "--data", "DATA", "--method", "nearest_view", "--fine-tune", "hypernetwork"],
            ["--fine-tune: expected --steps as well, got hypernetwork alone"],
        ),
        (
            ["adapt", *RENDER[1:], "--fine-tune", "hypernetwork"],
            ["--fine-tune: expected --steps as well, got hyper"],
        ),
        (
            ["train", "--data", "DATA", "--training.steps", "3", "--epochs", "1", "--out", "OUT/run"],
            ["--epochs, --training.steps: expected one of the two, got both"],
        ),
        *(
            (["train", "--data", "DATA", "--cache-size", size, "--out", "OUT/run"], ["--cache-size: expected GiB"])
            for size in ("inf", "nan", "-1")
        ),
        (
            ["evaluate", "--data", "DATA", "--method", "nearest_view", "--objects", "0"],
            ["--objects: expected at least 1"],
        ),
        (
            ["export", "--checkpoint", "RUN", "--views", "DATA", "--out", "OUT/x", "--level", "-3"],
            ["--level: expected a density above 0, got -3"],
        ),
        ([*BAKE, "OUT/bk.safetensors", "--voxels", "0"], ["--voxels: expected a multiple of 2 from 8 to 512"]),
        (
            ["render", "--checkpoint", "RUN", "--views", "pyproject.toml", "--out", "OUT/x"],
            ["pyproject.toml", "found a file of another kind"],
        ),
        (["export", *RENDER[1:], "--texture", "-1"], ["--texture: expected a whole number from 16 to 8192, got -1"]),
        (["export", *RENDER[1:], "--what", "points", "--points", "0"], ["--points: expected a whole number from 1 to"]),
        (
            [*RENDER, "--orbit", "2", "--camera-path", "OUT"],
            ["--camera-path, --orbit: expected one of them, got both"],
        ),
        ([*RENDER, "--dataparser-transforms", "OUT"], ["--dataparser-transforms: expected --camera-path"]),
        ([*BAKE, "OUT/bk.safetensors", "--orbit", "0"], ["--orbit: expected 1 to 10000 frames, got 0"]),
        (["export", *RENDER[1:], "--size", "0"], ["--size: expected at least 1 pixel, got 0"]),
        (["export", *RENDER[1:], "--what", "mesh", "--size", "64"], ["--size: expected --what turntable as well, got"]),
        *(
            (["export", *RENDER[1:], *more.split()], [f"{more.split()[-2]}: expected {wanted} as well, got"])
            for more, wanted in (
                ("--what mesh --frames 7", "--what turntable"),
                ("--what mesh --turntable gif", "--what turntable"),
                ("--what page --mesh-format ply", "--what mesh"),
                ("--what page --voxels 64", "--what mesh"),
                ("--what page --level 5", "--what mesh"),
                ("--what mesh --mesh-format ply --faces 500", "--what mesh --mesh-format glb"),
                ("--what mesh --mesh-format obj --texture 64", "--what mesh --mesh-format glb"),
                ("--what mesh --page-voxels 64", "--what page or --what splats"),
                ("--what mesh --fit 3", "--what turntable or --what page or --what splats"),
                ("--points 5", "--what points"),
                ("--what page --splat-format splat", "--what splats"),
            )
        ),
        (["export", *RENDER[1:], "--what"], ["--what: expected at least one of images, turntable, mesh, page"]),
        (
            ["demo", "--quick-check", "--objects", "9", "--out", "OUT/demo"],
            ["--objects: expected none with --quick-check, which sets its own"],
        ),
        *(
            (
                [*command, "--legacy"],
                [f"expected the layout learnit-128 or hyperplanes-200 with legacy, found {layout}"],
            )
            for command, layout in (
                (["train", "--data", "DATA", "--out", "OUT/run"], "the layout native"),
                (["evaluate", "--data", "DATA", "--method", "nearest_view"], "the layout native"),
                (["evaluate", "--data", "example-car", "--method", "nearest_view"], "the layout posed"),
            )
        ),
        *(
            (["capture", "DATA", "--out", "OUT/x", *option.split()], [f"{option.split()[0]}: expected a whole number"])
            for option in ("--size 63", "--size 100000", "--frames 2")
        ),
        (["inspect", "OUT/none"], ["OUT/none: expected a data set, posed images, a checkpoint", "found nothing"]),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(arguments, parts, tmp_path, capsys):
    demo = demo_folder()
    capsys.readouterr()
    places = {"OUT": str(tmp_path), "DATA": str(demo / "data"), "RUN": str(demo / "hyperplanes")}

    def placed(text):
        for name, place in places.items():
            text = text.replace(name, place)
        return text

    assert main([placed(argument) for argument in arguments]) == 2
    line = error_line(capsys)
    assert all(placed(part) in line for part in parts), line
    assert not list(tmp_path.iterdir()), "a refused command leaves no files"


def test_a_training_does_not_write_among_files_of_others(tmp_path, capsys):
    (tmp_path / "notes.txt").touch()
    assert main(["train", "--data", str(demo_folder() / "data"), "--out", str(tmp_path)]) == 2
    assert f"{tmp_path}: expected an empty folder or that of a training, found notes.txt" in error_line(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("verb", "out", "more"),
    [
        ("render", "photos/images", []),
        ("export", "photos", ["--what", "images"]),
        ("bake", "photos/images/car.safetensors", ["--orbit", "2"]),
    ],
)
def test_pictures_do_not_overwrite_the_images_that_are_read(verb, out, more, tmp_path, monkeypatch, capsys):
    shutil.copytree(locate_scene("example-car"), tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in (tmp_path / "photos").rglob("*") if path.is_file()}
    arguments = [verb, "--checkpoint", str(demo_folder() / "hyperplanes"), "--views", "photos", "--out", out, *more]
    assert main(arguments) == 2
    assert "--out: expected a folder that no images or poses are read from, got photos/images" in error_line(capsys)
    assert {path: path.read_bytes() for path in (tmp_path / "photos").rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--class car --rig orbits", "--rig: expected one of"),
        ("--class car --layout srm", "--layout: expected one of"),
        ("--class car --layout srn --distance 9", "--distance: expected "),
        ("--class car --count 0", "--count, --seed: expected at least 1 object"),
        ("--class car --count 3 --held-out 4", "--held-out: expected"),
        ("--class car --resolution 0", "--resolution: expected at least 1 pixel"),
        ("--meshes . --class-name a/b", "--class-name: expected letters"),
        ("--meshes none", "none: expected a folder of meshes"),
    ],
)
def test_what_generate_refuses_by_name_or_number_needs_no_renderer(line, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refuse_to_find_a_renderer(monkeypatch)
    assert main(["generate", *line.split(), "--out", "out"]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith(f"hyperplanes generate: {expected}")
    assert shown.err.count("\n") == 1


def test_a_traceback_is_shown_when_asked_for():
    with pytest.raises(ValueError, match="--class"):
        main(["generate", "--out", "nowhere", "--traceback"])


def test_a_full_disk_is_one_line(monkeypatch, capsys):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/x.png")

    monkeypatch.setattr("hyperplanes.commands.presets.run", full)
    assert main(["presets"]) == 2
    line = error_line(capsys)
    assert "/data/x.png" in line
    assert "full disk" in line


def test_presets_and_inspect(capsys, tmp_path):
    assert main(["presets"]) == 0
    shown = capsys.readouterr().out
    assert "paper-128" in shown
    assert re.search(r"^small +128 .* volume +all views ", shown, re.MULTILINE)
    assert main(["inspect", "small"]) == 0
    assert "hypernetwork: volume reads all views, update of the grid" in capsys.readouterr().out
    runs, parts = tmp_path / "runs", ("hyperplanes", "point_multiplane", "data")
    for part in parts:
        shutil.copytree(demo_folder() / part, runs / part)
    assert main(["inspect", str(runs / "hyperplanes")]) == 0
    assert "10 of 10 steps" in capsys.readouterr().out
    with small_packaged():
        assert main(["inspect", str(runs), "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert all(f"{runs / part}:" in shown for part in parts)
    assert "10 of 10 steps" in shown
    assert "4 (2 train, 2 test)" in shown
    assert (tmp_path / "out" / "data" / "contact_sheet.png").exists()


def test_without_any_renderer_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    def nothing(_):
        raise RendererError("no renderer works here; apt-get install -y libegl1 libgl1")

    monkeypatch.setattr("data_gen.rendering.renderers.find_renderer", nothing)
    assert main(["generate", "--class", "car", "--out", str(tmp_path)]) == 2
    assert "apt-get install -y libegl1 libgl1" in error_line(capsys)


def test_generate_takes_any_distance_and_field_of_view(tmp_path):
    command = ["generate", "--class", "car", "--count", "1", "--views", "2", "--resolution", "16", "--held-out", "0"]
    lens = ["--distance", "6", "--field-of-view", "30"]
    with rendered_here():
        assert main([*command, *lens, "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "car_00000" / "transforms.json").read_text())
    assert document["fl_x"] == pytest.approx(8 / np.tan(np.radians(15)))
    pose = np.array(document["frames"][0]["transform_matrix"])
    assert np.linalg.norm(pose[:3, 3]) == pytest.approx(6)


def test_generate_verifies_and_repairs_if_asked(tmp_path, capsys):
    command = ["generate", "--class", "lamp", "--count", "2", "--views", "2", "--resolution", "16", "--workers", "1"]
    with rendered_here():
        assert main([*command, "--rig", "paper-128", "--verify", "--out", str(tmp_path)]) == 0
    assert "files as they were written" in capsys.readouterr().out
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.png")}
    next(iter(before)).write_bytes(b"worm")
    with rendered_here():
        assert main([*command, "--rig", "paper-128", "--verify", "--out", str(tmp_path)]) == 0
    assert "1 of them from before" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.png")} == before


def test_inspect_compares_checksums_if_asked(tmp_path, capsys):
    data = tmp_path / "data"
    shutil.copytree(demo_folder() / "data", data)
    command = ["inspect", str(data), "--out", str(tmp_path / "out"), "--checksums"]
    assert main(command) == 0
    assert "files as they were written" in capsys.readouterr().out
    assert (tmp_path / "out" / "contact_sheet.png").exists()
    changed = next(data.rglob("images/003.png"))
    changed.write_bytes((changed.parent / "004.png").read_bytes())
    assert main(command) == 1
    assert f"{changed.relative_to(data)} has changed" in capsys.readouterr().out


def test_evaluate_writes_all_methods_to_one_table(tmp_path, capsys):
    demo = demo_folder()
    table = tmp_path / "table.json"
    methods = ["nearest_view", "point_multiplane", "hyperplanes"]
    arguments = ["--data", str(demo / "data"), "--checkpoint", str(demo), "--json", str(table)]
    assert main(["evaluate", "--method", *methods, *arguments]) == 0
    written = json.loads(table.read_text())
    assert list(written) == sorted(methods)
    before = json.loads((demo / "metrics.json").read_text())
    shown = capsys.readouterr().out
    for name in methods:
        assert written[name]["psnr"] == pytest.approx(before[name]["psnr"], abs=1e-3)
        assert f"{written[name]['psnr']:.2f} dB" in shown


def test_query_views_that_are_support_views_too_are_counted(tmp_path, capsys):
    """By hand: support views in excess of those of the scene are taken from its query views."""
    task, files = read_task(locate_scene("example-car")), [tmp_path / "a.json", tmp_path / "a.md", tmp_path / "a.csv"]
    options = [each for pair in zip(("--json", "--markdown", "--csv"), files, strict=True) for each in pair]
    for shown in (0, 2):
        command = ["evaluate", "--data", "example-car", "--method", "nearest_view", "--support"]
        assert main([*map(str, (*command, len(task.support) + shown, *options))]) == 0
        row = json.loads(files[0].read_text())["nearest_view"]
        assert [each.get("query_views_shown", 0) for each in (row, *row["objects"].values())] == [shown] * 2
        assert next(csv.DictReader(io.StringIO(files[2].read_text())))["query_views_shown"] == str(shown or "")
        said = "1 of 1 object compared on query views that the methods were given, up to 2 views"
        streams = capsys.readouterr()
        assert [said in text for text in (streams.out + streams.err, files[1].read_text())] == [shown > 0] * 2


def test_two_checkpoints_of_one_method_are_refused_and_a_folder_given_twice_counts_once(tmp_path):
    run = demo_folder() / "hyperplanes"
    for name in ("b", "a"):
        shutil.copytree(run, tmp_path / name)
    assert find_checkpoints([tmp_path / "a", tmp_path / "a"]) == {"hyperplanes": tmp_path / "a"}
    for folders in ([tmp_path / "a", tmp_path / "b"], [tmp_path]):
        with pytest.raises(ValueError, match="one of each method, got .*/a and .*/b, which are both hyperplanes"):
            find_checkpoints(folders)


def test_a_file_of_a_checkpoint_is_refused_and_its_folder_named(tmp_path):
    with pytest.raises(ValueError, match=r"model\.json: expected a checkpoint's folder, got a file; name the folder"):
        find_checkpoints([demo_folder() / "hyperplanes" / "model.json"])


def test_fields_are_optimised_on_one_posed_scene_without_a_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "quick", tiny_preset())
    scene, table = first_object(demo_folder()), tmp_path / "table.json"
    methods = ["hull_blend", "nerf_scratch_3", "point_multiplane_scratch_3"]
    assert main(["evaluate", "--data", str(scene), "--json", str(table), "--support", "5", "--method", *methods]) == 0
    rows = json.loads(table.read_text())
    assert set(rows) == set(methods)
    assert rows["point_multiplane_scratch_3"]["psnr"] > 5


def test_a_learned_initialisation_is_trained_matched_and_evaluated(tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "quick", tiny_preset())
    data = str(demo_folder() / "data")
    for method, more in (("mv_meta", []), ("mv_matched", ["--checkpoint", str(tmp_path / "mv_meta")])):
        out = str(tmp_path / method)
        assert main(["train", "--data", data, "--method", method, "--steps", "2", "--out", out, *more]) == 0
    methods = ["standard", "mv_shuffled_1", "mv_matched", "mv_meta_2"]
    table = tmp_path / "table.json"
    arguments = ["--checkpoint", str(tmp_path), "--json", str(table), "--objects", "1", "--method", *methods]
    assert main(["evaluate", "--data", data, *arguments]) == 0
    assert set(json.loads(table.read_text())) == set(methods)


def test_render_writes_the_query_views_under_their_names(tmp_path, capsys):
    demo = demo_folder()
    scene = first_object(demo)
    older = tmp_path / "older.png"
    older.touch()
    assert main(["render", "--checkpoint", str(demo), "--views", str(scene), "--out", str(tmp_path)]) == 0
    assert f"{tmp_path}: pictures that this command did not write are there: older.png" in capsys.readouterr().err
    older.unlink()
    document = json.loads((scene / "transforms.json").read_text())
    assert {path.name for path in tmp_path.iterdir()} == {Path(name).name for name in document["test_filenames"]}
    pictures = demo / "pictures" / "hyperplanes" / scene.name
    for path in tmp_path.iterdir():
        assert abs(pixels(path) - pixels(pictures / path.name)).max() <= 1


def test_render_adds_residuals_when_asked_to(tmp_path, capsys):
    demo, scene = demo_folder(), first_object(demo_folder())
    command = ["render", "--checkpoint", str(demo), "--views", str(scene), "--out", str(tmp_path), "--residuals", "on"]
    assert main(command) == 0
    task, model = read_task(scene), HyperPlanes.from_pretrained(find_checkpoint(demo))
    corrected = ResidualField(model.adapt(task.support), task.support).render(task.query.cameras).images
    assert (corrected - model.adapt(task.support).render(task.query.cameras).images).abs().max() > 0.02
    for name, expected in zip(task.query.names, to_pixels(corrected).astype(int), strict=True):
        assert abs(pixels(tmp_path / Path(name).name) - expected).max() <= 1
    capsys.readouterr()
    assert main([*command, "--protocol", "paper"]) == 2
    assert "--protocol: expected none with --residuals" in error_line(capsys)


def test_pictures_of_many_views_are_corrected_unless_that_is_off(tmp_path, monkeypatch, capsys):
    scene = first_views(locate_scene("example-car"), tmp_path / "scene", support=MANY_VIEWS, query=2)
    command = ["--checkpoint", "small", "--views", str(scene), "--downscale", "4"]
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path / "cache"))
    with small_packaged(learned_steps=0):
        assert main(["render", *command, "--out", str(tmp_path / "corrected")]) == 0
        assert "2 pictures (colours corrected by residuals)" in capsys.readouterr().out
        with monkeypatch.context() as patch:  # on request also those of large views, by the same network
            patch.setattr(residuals, "MAX_SUPPORT_PIXELS", 0)
            assert main(["render", *command, "--out", str(tmp_path / "asked"), "--residuals", "on"]) == 0
        # without correction no support view is rendered: for pictures, for their estimated PSNR, or for voxels
        monkeypatch.setattr(ResidualField, "_compute", lambda *_: pytest.fail("a support view was rendered"))
        assert main(["render", *command, "--out", str(tmp_path / "plain"), "--residuals", "off"]) == 0
        capsys.readouterr()
        tuned = ["--out", str(tmp_path / "tuned"), "--steps", "1"]
        assert main(["render", *command, *tuned, "--residuals", "off"]) == 0
        assert "averaged with hull_blend" in capsys.readouterr().out
        suitability.held_out_psnr(HyperPlanes.from_pretrained("small"), read_task(scene).support.resized(32))
        voxels = ["--out", str(tmp_path / "voxels.safetensors"), "--voxels", "16", "--fit", "0"]
        assert main(["bake", *command, *voxels]) == 0
        assert main(["export", *command, "--out", str(tmp_path / "export"), "--what", "points"]) == 0
        assert "corrected by residuals" not in capsys.readouterr().out
    corrected, asked, plain = (sorted((tmp_path / name).glob("*.png")) for name in ("corrected", "asked", "plain"))
    assert len(corrected) == len(plain) == 2
    assert max(abs(pixels(one) - pixels(other)).max() for one, other in zip(corrected, asked, strict=True)) <= 1
    assert max(abs(pixels(one) - pixels(other)).max() for one, other in zip(corrected, plain, strict=True)) > 5


def test_an_adapted_object_renders_the_same_without_its_hypernetwork(tmp_path, capsys):
    demo = demo_folder()
    scene = str(first_object(demo))
    weights, out, reference = (str(tmp_path / name) for name in ("weights", "out", "reference"))
    assert main(["adapt", "--checkpoint", str(demo), "--views", scene, "--out", weights]) == 0
    assert main(["render", "--checkpoint", weights, "--views", scene, "--out", out]) == 0
    assert main(["render", "--checkpoint", str(demo), "--views", scene, "--out", reference]) == 0
    for path in Path(out).iterdir():
        assert path.read_bytes() == (Path(reference) / path.name).read_bytes()
    assert main(["render", "--checkpoint", weights, "--views", scene, "--out", out, "--steps", "2"]) == 0
    assert any(path.read_bytes() != (Path(reference) / path.name).read_bytes() for path in Path(out).iterdir())
    assert "other images" not in capsys.readouterr().err
    other = str(sorted(path for path in Path(scene).parent.iterdir() if path.is_dir())[1])
    for verb in (["render"], ["export", "--what", "points"]):
        assert main([*verb, "--checkpoint", weights, "--views", other, "--out", str(tmp_path / verb[0])]) == 0
        assert f"made from other images, of {Path(scene).name}, and fit no other object" in capsys.readouterr().err
    frozen = ["--steps", "2", "--fine-tune", "hypernetwork"]  # adapted weights have no hypernetwork
    assert main(["render", "--checkpoint", weights, "--views", scene, "--out", out, *frozen]) == 2


def test_the_number_of_steps_that_held_out_views_choose_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("hyperplanes.configuration.fine_tuning.FineTuning", partial(FineTuning, max_steps=2))
    monkeypatch.setattr("hyperplanes.export.surfaces.mesh_level.SILHOUETTE", 16)
    demo, scene = demo_folder(), str(first_object(demo_folder()))
    command = ["adapt", "--checkpoint", str(demo), "--views", scene, "--out", str(tmp_path / "weights")]
    assert main([*command, "--steps", "auto"]) == 0
    assert re.search(r"adapted to 6 views of .* in .*, \d+ fine-tuning steps", capsys.readouterr().out)
    common = ["--checkpoint", str(demo), "--views", scene, "--steps", "auto", "--voxels", "32"]
    assert main(["export", *common, "--what", "mesh", "--mesh-format", "ply", "--out", str(tmp_path / "export")]) == 0
    assert main(["bake", *common, "--fit", "0", "--out", str(tmp_path / "voxels.safetensors")]) == 0
    adapted = r"adapted to 6 views of .* in .*, \d+ fine-tuning steps|adapted to these 6 views before"
    assert len(re.findall(adapted, capsys.readouterr().out)) == 2  # the second time from the cache


def test_a_stage_of_capture_that_is_repeated_has_a_new_progress_bar(tmp_path, monkeypatch):
    opened, shown = [], []

    @contextmanager
    def bar(self, title):
        opened.append(title)
        yield SimpleNamespace(show=lambda *_, **__: shown.append((title, opened[-1])))
        opened.append("closed")

    def capture(photographs, out, settings, progress):
        for stage in ("features", "features", "poses", "features"):
            progress(stage, 0, 1, "")
        raise ValueError("seen enough")

    monkeypatch.setattr(Console, "bar", bar)
    monkeypatch.setattr("hyperplanes.capture.capture", capture)
    assert main(["capture", str(tmp_path), "--out", str(tmp_path / "scene")]) == 2
    assert shown == [(stage, stage) for stage in ("features", "features", "poses", "features")]


def test_a_turntable_of_no_frames_is_refused_before_anything_is_made(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["export", "--checkpoint", "small", "--views", "example-car", "--out", str(out), "--frames", "0"]) == 2
    assert "--frames" in error_line(capsys)
    assert not out.exists()


def test_psnr_over_fine_tuning_steps_is_a_table_and_a_chart(tmp_path, capsys):
    demo, chart = demo_folder(), tmp_path / "curve.svg"
    command = ["evaluate", "--data", str(demo / "data"), "--checkpoint", str(demo), "--curve", str(chart)]
    methods = ["--method", "nearest_view", "hyperplanes", "scratch", "--steps"]
    assert main([*command, *methods, "0", "1", "3", "--objects", "1"]) == 0
    shown = capsys.readouterr().out
    for name in ("nearest_view", "hyperplanes", "hyperplanes_1", "hyperplanes_3", "scratch_1", "scratch_3"):
        assert re.search(rf"^{name}  ", shown, re.MULTILINE), name
    texts = [each.text for each in ElementTree.fromstring(chart.read_text()).iter("{http://www.w3.org/2000/svg}text")]
    assert {"nearest_view", "hyperplanes", "scratch", "fine-tuning steps", "PSNR (dB)"} <= set(texts)
    assert main([*command, *methods, "3"]) == 2
    assert "at least two numbers of --steps" in error_line(capsys)


def test_a_method_that_fails_on_all_objects_is_omitted_from_the_chart(tmp_path, monkeypatch, capsys):
    def fails(self, support):
        raise ValueError("support: no masks")

    monkeypatch.setattr(HullBlend, "adapt", fails)
    chart, methods = tmp_path / "curve.svg", ["--method", "nearest_view", "hull_blend", "--steps", "0", "1"]
    command = ["evaluate", "--data", str(demo_folder() / "data"), "--objects", "2", "--curve", str(chart), *methods]
    assert main(command) == 1
    assert "hull_blend" in capsys.readouterr().err
    assert "nearest_view" in chart.read_text()
    assert "hull_blend" not in chart.read_text()


@pytest.mark.parametrize("given", [[], ["--all-views"], ["--learn-background"], ["--refine-poses"], ["--up=y"]])
def test_adapt_proposes_a_command_that_renders_with_the_same_views(given, tmp_path, monkeypatch, capsys):
    scene, small = str(first_object(demo_folder())), HyperPlanes.from_pretrained(demo_folder() / "hyperplanes")
    task, _ = read_scene(Path(scene), Console(silent=True))
    monkeypatch.setattr(adapt, "read_object", lambda *_: (task, "y"))
    monkeypatch.setattr(adapt, "load_adaptable", lambda *_, **__: small)
    assert main(["adapt", "--views", scene, "--checkpoint", "small", "--out", str(tmp_path / "my out"), *given]) == 0
    proposed = capsys.readouterr().out.splitlines()[-1]
    command = shlex.split(proposed.removeprefix("next: "))
    assert command[:2] == ["hyperplanes", "render"]
    proposed = tyro.cli(render.Arguments, args=command[2:])
    assert (proposed.checkpoint, proposed.views) == (tmp_path / "my out", Path(scene))
    taken = {name: getattr(proposed, name) for name in ("all_views", "learn_background", "refine_poses")}
    up = given == ["--up=y"]  # an explicit --up stays in the command
    assert proposed.up == ("y" if up else "auto")
    assert [f"--{name.replace('_', '-')}" for name, value in taken.items() if value] == ([] if up else given)


def test_the_views_that_evaluate_gives_to_methods(tmp_path, capsys):
    """Source of truth: the same wrappers of the data set in Python."""
    data, result = open_dataset(demo_folder() / "data"), tmp_path / "table.json"
    names = data.names("test")

    def measured(*options):
        command = ["evaluate", "--data", str(demo_folder() / "data"), "--method", "nearest_view", "--json", str(result)]
        assert main([*command, *options]) == 0
        return json.loads(result.read_text())["nearest_view"]

    def expected(tasks):
        return evaluate("nearest_view", NearestView(), tasks, names).mean("psnr")

    farthest = measured("--support", "2", "--choose", "farthest")
    assert farthest["psnr"] == pytest.approx(expected(WithSupport(data, 2, "farthest")))
    draws = measured("--support", "2", "--choose", "random", "--seeds", "2")
    assert "choices of support views" in capsys.readouterr().out
    by_seed = [expected(WithSupport(data, 2, "random", seed)) for seed in range(2)]
    assert [run["psnr"] for run in draws["seeds"]] == pytest.approx(by_seed)
    assert by_seed[0] != by_seed[1]
    placed = measured("--inputs", "1", "4", "--query", "2")
    assert placed["psnr"] == pytest.approx(expected(FewerQueries(SupportByPosition(data, (1, 4)), 2)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--choose", "random"], "--choose random: expected --support as well, got none"),
        (["--inputs", "1", "--support", "2"], "--inputs: expected neither --support nor --choose with it"),
        (["--query", "0"], "--query: expected at least 1, got 0"),
        (["--inputs", "999"], "expected inputs from 0 to"),
        (["--inputs", "1", "1"], "--inputs: expected different positions of views, from 0, got 1 1"),
        (["--support", "50", "--choose", "random"], "example-car: expected at least 50 support views to choose"),
        (["--method", "hyperplanes@"], "--method: expected METHOD@CHECKPOINT, got hyperplanes@"),
        (["--method", "@small"], "--method: expected METHOD@CHECKPOINT, got @small"),
        (["--method", "nearest_view@no-{seed}", "--seeds", "2"], "no-0: expected a checkpoint's folder"),
        (["--method", "hyperplanes@smal"], "smal: expected a checkpoint's folder or the name of a packaged model"),
    ],
)
def test_views_and_checkpoints_that_evaluate_cannot_take(options, message, capsys):
    methods = [] if "--method" in options else ["--method", "nearest_view"]
    assert main(["evaluate", "--data", "example-car", *methods, *options]) == 2
    assert message in capsys.readouterr().err


def test_seeds_of_trainings_and_of_gradient_steps_in_every_kind_of_file(tmp_path, capsys):
    """Source of truth: the evaluation of each checkpoint alone, and arithmetic."""
    demo, data = demo_folder(), ["--data", str(demo_folder() / "data")]
    kinds = {"json": "table.json", "csv": "table.csv", "markdown": "table.md", "grid": "grid.png", "boxes": "boxes.svg"}
    shutil.copytree(demo / "hyperplanes", tmp_path / "run-0")
    shutil.copytree(demo / "hyperplanes", tmp_path / "run-1")
    other = HyperPlanes.from_pretrained(demo / "hyperplanes")
    torch.nn.init.normal_(other.networks["fine"].colour.weight)
    other.save(tmp_path / "run-1")
    files = [word for kind, name in kinds.items() for word in (f"--{kind}", str(tmp_path / name))]
    methods = ["--method", "nearest_view", "hyperplanes", "hyperplanes_2"]
    seeded = ["--checkpoint", str(tmp_path / "run-{seed}"), "--seeds", "2"]
    assert main(["evaluate", *data, *methods, *seeded, *files]) == 0
    over = "over 2 seeds (of trainings, gradient steps, random weights)"
    assert f"± is the standard deviation {over}" in capsys.readouterr().out
    table = json.loads((tmp_path / "table.json").read_text())
    single = []
    for seed in (0, 1):
        alone = ["--checkpoint", str(tmp_path / f"run-{seed}"), "--method", "hyperplanes"]
        assert main(["evaluate", *data, *alone, "--json", str(tmp_path / "one.json")]) == 0
        single.append(json.loads((tmp_path / "one.json").read_text())["hyperplanes"]["psnr"])
    absent = ["--method", "nearest_view", f"hyperplanes@{tmp_path / 'run-{seed}'}", "--seeds", "3"]
    capsys.readouterr()
    assert main(["evaluate", *data, *absent]) == 2, "found before the first seed is evaluated"
    printed = capsys.readouterr()
    assert "run-2: expected a checkpoint, found no such folder" in printed.err
    assert "nearest_view" not in printed.out + printed.err
    both = [f"hyperplanes@{tmp_path / run}" for run in ("run-0", "run-1")]
    assert main(["evaluate", *data, "--method", *both, "--json", str(tmp_path / "both.json")]) == 0
    side_by_side = json.loads((tmp_path / "both.json").read_text())
    assert {row: side_by_side[row]["psnr"] for row in both} == pytest.approx(
        dict(zip(both, single, strict=True)), abs=1e-4
    )
    assert table["hyperplanes"]["psnr"] == pytest.approx(sum(single) / 2, abs=1e-4)
    assert table["hyperplanes"]["deviation"]["psnr"] == pytest.approx(abs(single[0] - single[1]) / 2**0.5, abs=1e-4)
    assert table["nearest_view"]["deviation"]["psnr"] == 0
    assert [run["psnr"] for run in table["hyperplanes"]["seeds"]] == pytest.approx(single, abs=1e-4)
    assert table["nearest_view"]["psnr_pooled"] <= table["nearest_view"]["psnr"]
    assert table["nearest_view"]["psnr_foreground"] < table["nearest_view"]["psnr"]
    assert sum(len(row.get("differences", {})) for row in table.values()) == 3
    lines = (tmp_path / "table.csv").read_text().splitlines()
    assert len(lines) == 1 + 3 * 2 * 2
    assert lines[0].startswith("method,seed,object,psnr,")
    assert (tmp_path / "table.md").read_text().count("| nearest_view |") == 1
    assert pixels(tmp_path / "grid.png").std() > 10
    texts = [each.text for each in ElementTree.fromstring((tmp_path / "boxes.svg").read_text()).iter()]
    assert {"nearest_view", "hyperplanes", "hyperplanes_2"} <= set(texts)
    assert main(["evaluate", *data, *methods, *seeded[:2], "--seeds", "0"]) == 2
    assert "--seeds: expected at least 1, got 0" in error_line(capsys)


def test_inspect_shows_diagnostics_of_the_hypernetwork(capsys):
    assert main(["inspect", str(demo_folder() / "hyperplanes")]) == 0
    assert re.search(r"diagnostics: updates differ by [\d.]+% of their norm", capsys.readouterr().out)
    assert main(["inspect", "cars-64"]) == 0
    shown = capsys.readouterr().out
    assert "low_rank update of all" in shown
    assert re.search(r"another object's update costs [\d.]+ dB", shown)


def test_an_orbit_is_pictures_and_a_turntable(tmp_path, capsys):
    demo = demo_folder()
    views = ["--views", str(first_object(demo)), "--out", str(tmp_path), "--all-views"]
    assert main(["render", "--checkpoint", str(demo), *views, "--orbit", "3", "--turntable", "gif"]) == 0
    with Image.open(tmp_path / "turntable.gif") as animation:
        assert animation.n_frames == 3
    assert len(list(tmp_path.glob("*.png"))) == 3
    assert "estimate, from fewer views than the pictures and without fine-tuning: " in capsys.readouterr().out


def test_a_cloud_of_points_is_exported(tmp_path, capsys):
    demo = demo_folder()
    line = ["export", "--checkpoint", str(demo), "--views", str(first_object(demo)), "--out", str(tmp_path)]
    assert main([*line, "--what", "points", "--points", "50"]) == 0
    number = int(re.search(r"element vertex (\d+)", (tmp_path / "points.ply").read_bytes().decode("latin1"))[1])
    assert 0 < number <= 50
    assert f"points.ply: {number} points with normals and colours" in capsys.readouterr().out


def test_errors_of_the_field_name_the_option_as_it_was_typed(tmp_path, monkeypatch, capsys):
    """A level above all densities, and a point cloud of which no point is on the surface."""
    monkeypatch.setattr(
        "hyperplanes.export.surfaces.points._is_confirmed", lambda points, *_: torch.zeros(len(points)) > 0
    )
    demo = demo_folder()
    line = ["export", "--checkpoint", str(demo), "--views", str(first_object(demo)), "--out", str(tmp_path)]
    for option, *more in (["--level", "1e9", "--what", "mesh", "--voxels", "8"], ["--points", "1", "--what", "points"]):
        capsys.readouterr()
        assert main([*line, option, *more]) == 2
        assert f"hyperplanes export: {option}: expected more" in capsys.readouterr().err


def test_a_camera_path_of_nerfstudio_is_rendered_with_all_requested_outputs(tmp_path, capsys):
    """The poses of the query views as a path give the same pictures; a path far from the object is warned about."""
    demo = demo_folder()
    scene = first_object(demo)
    document = json.loads((scene / "transforms.json").read_text())
    angle = math.degrees(2 * math.atan(document["h"] / 2 / document["fl_y"]))
    query = set(document["test_filenames"])
    frames = [each["transform_matrix"] for each in document["frames"] if each["file_path"] in query]
    path = {"render_width": document["w"], "render_height": document["h"], "seconds": 1.0, "camera_path": [
        {"camera_to_world": [number for row in pose for number in row], "fov": angle} for pose in frames
    ]}  # fmt: skip
    (tmp_path / "path.json").write_text(json.dumps(path))
    line = ["render", "--checkpoint", str(demo), "--views", str(scene), "--out", str(tmp_path / "out")]
    line += ["--turntable", "gif", "--camera-path", str(tmp_path / "path.json")]
    names = ["rgb", "depth", "normals", "accumulation"]
    assert main([*line, "--rendered-output-names", *names]) == 0
    assert "none of its" not in capsys.readouterr().err
    reference = demo / "pictures" / "hyperplanes" / scene.name
    for index, name in enumerate(name for name in document["test_filenames"] if name in query):
        found = pixels(tmp_path / f"out/{index:04d}.png")
        assert abs(found - pixels(reference / Path(name).name)).max() <= 1
        for other in names[1:]:
            assert pixels(tmp_path / "out" / other / f"{index:04d}.png").shape[:2] == found.shape[:2]
    for place in (tmp_path / "out", *(tmp_path / "out" / name for name in names[1:])):
        with Image.open(place / "camera_path.gif") as animation:
            assert animation.n_frames == len(frames)
    for frame in path["camera_path"]:
        for row in (0, 4, 8):  # move the camera to its right
            frame["camera_to_world"][row + 3] += 1000.0 * frame["camera_to_world"][row]
    (tmp_path / "path.json").write_text(json.dumps(path))
    assert main([*line, "--size", "8"]) == 0
    assert "none of its" in (warned := capsys.readouterr().err)
    assert "--dataparser-transforms" in warned
    assert max(pixels(tmp_path / "out/0000.png").shape[:2]) == 8


def test_baking_writes_one_file_that_can_be_rendered_without_the_model(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("hyperplanes.export.surfaces.mesh_level.SILHOUETTE", 16)
    out = tmp_path / "voxels.safetensors"
    views = ["--views", str(first_object(demo_folder())), "--out", str(out)]
    command = ["bake", "--checkpoint", str(demo_folder()), *views, "--voxels", "32", "--fit", "2"]
    with one_writer(tmp_path):  # another file in the folder may be written meanwhile
        assert main([*command, "--orbit", "2", "--size", "16", "--turntable", "gif"]) == 0
    assert "dB, the field" in capsys.readouterr().out
    with Image.open(tmp_path / "voxels.gif") as animation:
        assert animation.n_frames == 2
    pictures = BakedScene(BakedField.load(out)).render(read_task(first_object(demo_folder())).query.cameras)
    assert 0 < float(pictures.opacity.mean()) < 1
    scene = ["--views", str(first_object(demo_folder())), "--out", str(tmp_path / "again")]
    advised = []
    monkeypatch.setattr(suitability, "worse_than_copying", lambda *given: advised.append(given[-1]) or [])
    assert main(["render", "--checkpoint", str(out), *scene]) == 0
    assert advised == [None]  # no advice to fine-tune, which a baked file does not support
    names = sorted(Path(name).name for name in read_task(first_object(demo_folder())).query.names)
    for name, image in zip(names, to_pixels(pictures.images).astype(int), strict=True):
        assert abs(pixels(tmp_path / "again" / name) - image).max() <= 1
    mesh = ["--what", "mesh", "--voxels", "32", "--level", "10", "--texture", "32"]
    assert main(["export", "--checkpoint", str(out), *scene, *mesh]) == 0
    told = capsys.readouterr()
    assert re.search(r"overlap the rendered ones of 6 query views by [\d.]+%", told.out)
    assert "--level" in told.err
    assert "--steps" not in told.err  # likewise
    assert main(["inspect", str(out)]) == 0
    assert "of 32^3 voxels" in capsys.readouterr().out
    capsys.readouterr()
    monkeypatch.setattr("hyperplanes.commands.inputs.scene.read_scene", None)  # refused before images are read
    adapting = (["--steps", "3"], ["--refine-poses"], ["--learn-background"])
    for verb, *option in (
        *([verb, *option] for verb in ("render", "export") for option in adapting),
        *(["render", "--protocol", "paper"], ["render", "--fine-tune", "hypernetwork"], ["render", "--no-reflections"]),
        *(["render", "--representation", "field"], ["export", "--page-voxels", "32", "--what", "page"]),
        *(["export", "--fit", "3", "--what", what] for what in ("page", "turntable")),
    ):
        assert main([verb, "--checkpoint", str(out), *scene, *option]) == 2
        assert f"{option[0]}: expected none with a baked file" in error_line(capsys)
    assert main(["adapt", "--checkpoint", str(out), *scene]) == 2
    assert "expected a checkpoint's folder to adapt with, got a file" in error_line(capsys)
    assert main([*command[:-4], "--voxels", "7"]) == 2
    assert "7" in error_line(capsys)


def test_a_turntable_without_fitting_is_rendered_from_the_field(tmp_path, monkeypatch, capsys):
    asked = []

    def noted(field, views, cameras, representation="auto", **_):
        asked.append(representation)
        return field

    monkeypatch.setattr("hyperplanes.export.animation.choose_representation", noted)
    views = ["--checkpoint", str(demo_folder()), "--views", str(first_object(demo_folder()))]
    for fit in ("0", "2"):
        out = ["--out", str(tmp_path), "--what", "turntable", "--frames", "1", "--fit", fit, "--size", "8"]
        assert main(["export", *views, *out]) == 0
    assert asked == ["field", "auto"]


def test_a_video_that_cannot_be_encoded_is_refused_before_anything_is_rendered(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    views = ["--checkpoint", str(demo_folder()), "--views", str(first_object(demo_folder()))]
    for verb, more in (("render", ["--orbit", "2"]), ("bake", ["--orbit", "2"]), ("export", ["--what", "turntable"])):
        out = tmp_path / ("voxels.safetensors" if verb == "bake" else "out")
        assert main([verb, *views, "--out", str(out), "--turntable", "mp4", *more]) == 2
        assert "mp4: expected the package imageio-ffmpeg, found none" in error_line(capsys)
    assert not list(tmp_path.iterdir())


def test_pictures_are_rendered_and_evaluated_by_the_protocol_of_the_paper_if_asked(tmp_path, capsys):
    demo = demo_folder()
    scene = first_views(first_object(demo), tmp_path / "scene", support=6, query=1)
    command = ["render", "--checkpoint", str(demo), "--views", str(scene), "--out", str(tmp_path)]
    assert main([*command, "--protocol", "paper"]) == 0
    task = read_task(scene)
    expected = (
        HyperPlanes.from_pretrained(find_checkpoint(demo))
        .adapt(task.support)
        .render(task.query.cameras, Hierarchical(64, 128))
        .images
    )
    written = np.stack([pixels(tmp_path / Path(name).name) for name in task.query.names])
    wanted = expected.clamp(0, 1).permute(0, 2, 3, 1).numpy() * 255
    assert abs(written - wanted).max() <= 1
    capsys.readouterr()
    table = tmp_path / "table.json"
    command = ["evaluate", "--data", str(scene), "--checkpoint", str(demo), "--json", str(table)]
    assert main([*command, "--method", "hyperplanes", "nearest_view", "--protocol", "paper"]) == 0
    score = json.loads(table.read_text())["hyperplanes"]["objects"][scene.name]["psnr"]
    assert score == pytest.approx(float(psnr(expected.clamp(0, 1), task.query.images).mean()), abs=1e-3)


def test_a_field_of_another_kind_is_trained_by_another_protocol_and_evaluated(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "tiny", demo_preset())
    data, run = str(demo_folder() / "data"), tmp_path / "run"
    command = ["train", "--data", data, "--preset", "tiny", "--steps", "2", "--out", str(run)]
    assert main([*command, "--method", "nerf", "--protocol", "paper"]) == 0
    config = json.loads((run / "model.json").read_text())
    assert (config["target"], config["hypernetwork"], config["protocol"]) == ("nerf", None, "hierarchical")
    assert config["sampling"] == {"coarse": 64, "fine": 128, "placement": "intervals"}
    assert main(["evaluate", "--data", data, "--checkpoint", str(run), "--method", "nerf", "--objects", "1"]) == 0
    assert "nerf " in capsys.readouterr().out


def test_the_scene_that_comes_with_the_package_has_a_name(tmp_path, monkeypatch, capsys):
    task, up = read_scene(Path("example-car"), Console(silent=True))
    assert (len(task.support), len(task.query), task.name, up) == (25, 25, "example-car", "y")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hyperplanes.adaptation.alignment.canonical_frame.find_symmetry", lambda *_: None)
    assert main(["evaluate", "--data", "example-car", "--method", "nearest_view"]) == 0
    assert "1 object of example-car" in capsys.readouterr().out
    assert main(["inspect", "example-car"]) == 0
    told = capsys.readouterr().out
    assert "views: 25 support, 25 query" in told
    by_model, copied = map(float, re.findall(r"(?:given at|copied has) ([\d.]+)", told))
    assert by_model > copied + 5  # PSNR of held-out views: 30.1 and 14.8 dB
    assert (tmp_path / "runs" / "inspect" / "example-car" / "contact_sheet.png").exists()
    (tmp_path / "example-car").mkdir()  # a folder of that name has precedence
    with pytest.raises(DataError, match="example-car"):
        read_scene(Path("example-car"), Console(silent=True))


def with_z_up(scene, folder):
    """A copy of a scene whose camera poses are rotated by hand to z up, as in Blender."""
    shutil.copytree(scene, folder)
    document = json.loads((folder / "transforms.json").read_text())
    for frame in document["frames"]:
        x, y, z, last = frame["transform_matrix"]
        frame["transform_matrix"] = [x, [-value for value in z], y, last]
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def test_a_scene_with_z_up_gives_the_same_pictures(tmp_path):
    """Source of truth: the same scene with y up."""
    demo = demo_folder()
    scene = first_object(demo)
    turned = with_z_up(scene, tmp_path / scene.name)
    common = ["--checkpoint", str(demo), "--all-views"]
    assert main(["render", *common, "--views", str(scene), "--out", str(tmp_path / "y")]) == 0
    assert main(["render", *common, "--views", str(turned), "--out", str(tmp_path / "z"), "--up", "z"]) == 0
    for path in (tmp_path / "y").iterdir():
        assert abs(pixels(path) - pixels(tmp_path / "z" / path.name)).max() <= 1


def test_a_single_scene_is_evaluated_with_the_up_axis_estimated_from_its_cameras(tmp_path, capsys):
    """Source of truth: the same scene with y up, and the object in the data set."""
    demo = demo_folder()
    scene = first_object(demo)
    turned = with_z_up(scene, tmp_path / scene.name)

    def quality(data, *more):
        table = tmp_path / "table.json"
        command = ["evaluate", "--data", str(data), "--checkpoint", str(demo), "--method", "hyperplanes"]
        assert main([*command, *more, "--json", str(table)]) == 0
        return json.loads(table.read_text())["hyperplanes"]["objects"][scene.name]["psnr"]

    capsys.readouterr()
    expected = quality(scene)
    assert "up: y, guessed from how the cameras are held; --up overrides it" in capsys.readouterr().out
    assert quality(turned) == pytest.approx(expected, abs=1e-2)
    assert "up: z, guessed from how the cameras are held; --up overrides it" in capsys.readouterr().out
    assert quality(turned, "--up", "0,0,2") == pytest.approx(expected, abs=1e-2)
    assert quality(turned, "--up", "-z") == quality(turned, "--up=-z") < expected - 0.1
    assert abs(quality(turned, "--up", "y") - expected) > 0.1
    assert quality(demo / "data") == pytest.approx(expected, abs=1e-2)
    assert "up:" not in capsys.readouterr().out
    assert main(["evaluate", "--data", str(turned), "--up", "w"]) == 2
    assert "up: expected one of y, z, " in error_line(capsys)


def test_render_warns_of_photographs_with_a_background_and_prints_the_up_axis(tmp_path, capsys):
    scene = tmp_path / "photographs"
    shutil.copytree(first_object(demo_folder()), scene)
    for path in scene.rglob("*.png"):
        with Image.open(path) as image:
            image.convert("RGB").save(path)
    capsys.readouterr()
    command = ["render", "--checkpoint", str(demo_folder()), "--views", str(scene), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    shown = capsys.readouterr()
    assert "up: y, guessed from how the cameras are held; --up overrides it" in shown.out
    assert "rendering 6/6" in shown.out
    assert "the views have no alpha and no masks" in shown.err
    assert re.search("worse than copying the nearest view: .*; cut the object out first", shown.err)


def test_the_demonstration_repeats_no_finished_step(capsys):
    demo = demo_folder()
    before = {path: path.stat().st_mtime_ns for path in demo.rglob("*") if path.is_file()}
    capsys.readouterr()
    with small_demo():
        assert main(["demo", "--quick-check", "--out", str(demo)]) == 0
    assert capsys.readouterr().out.count("done before") == 18
    assert {path: path.stat().st_mtime_ns for path in demo.rglob("*") if path.is_file()} == before


@pytest.mark.usefixtures("compiled")
def test_the_demonstration_reads_meshes_before_it_renders_classes(tmp_path):
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    meshes.mkdir()
    (meshes / "broken.glb").write_bytes(b"none")
    with small_demo():
        assert main(["demo", "--quick-check", "--first-only", "--meshes", str(meshes), "--out", str(out)]) == 2
    assert not (out / "first" / "car").exists()


@pytest.mark.usefixtures("compiled")
def test_the_demonstration_shows_the_packaged_model_before_anything_is_trained(tmp_path, capsys):
    page = (demo_folder() / "first.html").read_text(encoding="utf-8")
    assert all(words in page for words in ("3 views", "car_test_00000", "data:image/webp"))
    assert "<h2>Training</h2>" not in page
    command = ["demo", "--quick-check", "--first-only", "--meshes", str(tmp_path), "--out", str(tmp_path / "out")]
    with small_demo():
        assert main(command) == 2
    assert str(tmp_path) in capsys.readouterr().err.strip().splitlines()[-1]  # the folder has no mesh


def test_training_continues_after_ctrl_c_with_the_same_result(tmp_path, monkeypatch, capsys):
    preset = demo_preset()
    monkeypatch.setitem(PRESETS, "tiny", replace(preset, training=replace(preset.training, tasks=1)))
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = ["train", "--data", str(demo_folder() / "data"), "--preset", "tiny", "--steps", "4", "--out"]
    step = Trainer.take_step

    def interrupted(trainer):
        if trainer.step == 2:
            signal.raise_signal(signal.SIGINT)
        return step(trainer)

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "take_step", interrupted)
        assert main([*command, str(parts)]) == 130
    at_once, at_the_end = capsys.readouterr().err.strip().splitlines()
    assert at_once == "SIGINT: stopping after this step; send it again to stop at once"
    assert "run the same command again to resume" in at_the_end
    assert main([*command, str(parts)]) == 0
    assert "resuming from step 3" in capsys.readouterr().out
    assert main([*command, str(whole)]) == 0
    assert capsys.readouterr().out.count("trained for 4 steps\n") == 1
    assert main([*command[:6], "3", *command[7:], str(whole)]) == 0
    assert (
        "trained for 4 steps before; nothing was trained now, because the settings ask for 3" in capsys.readouterr().out
    )
    same = (parts / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert same


@pytest.mark.skipif(not (SHARED / "posed" / "chair").is_dir(), reason="../shared/posed/chair is not here")
def test_a_real_posed_scene_is_evaluated(tmp_path):
    table = tmp_path / "chair.json"
    data = ["--data", str(SHARED / "posed" / "chair"), "--json", str(table)]
    assert main(["evaluate", "--method", "nearest_view", *data]) == 0
    assert json.loads(table.read_text())["nearest_view"]["psnr"] > 10


def test_a_missing_package_is_named_in_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "example-car", "--downscale", "4"]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line == "hyperplanes view: expected the package viser, found none; pip install 'hyperplanes[viz]'"


def test_warnings_of_commands_are_one_line_without_a_place_in_the_code():
    script = (
        "import sys, warnings, hyperplanes.cli as cli\n"
        "def run(arguments):\n"
        "    for _ in range(2):\n"
        "        warnings.warn('check\\n  cx')\n"
        "        warnings.resetwarnings()\n"
        "    warnings.warn('old', FutureWarning)\n"
        "    return 0\n"
        "cli._main = run\n"
        "sys.exit(cli.main([]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    first, second = done.stderr.splitlines()[:2]
    assert first == "warning: check cx"
    assert second.endswith("FutureWarning: old")
