"""Source of truth: an uninterrupted run of the same generation, byte for byte, and the requested cameras."""

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from rendered_here import rendered_here

from data_gen import SUPERSAMPLE
from data_gen.commands.generate import Arguments, remarks, source_of
from data_gen.datasets import objects
from data_gen.datasets.generate import PICTURES, GenerationConfig, MeshFolder, Procedural, generate
from data_gen.datasets.inspect import inspect
from data_gen.datasets.manifest import verify
from data_gen.datasets.sources import list_items
from data_gen.rigs import RIG_PRESETS, fixed, make_rig
from hyperplanes.data import DataError, Dataset
from hyperplanes.data.inspection.describe import describe
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.files.writing import one_writer

SMALL = {"views": 4, "resolution": 16, "workers": 1}
CARS = Procedural("car", 5, seed=3)
SPLITS = ("test", "train", "val")
SCRIPT = """
from data_gen.datasets.generate import *
from data_gen.rendering import renderers
renderers.probe = lambda name: renderers.ProbeResult(name, True, "tried by the tests", "")
config = GenerationConfig(views=4, resolution=16, workers=1, held_out=2)
print(generate(Procedural("car", 5, seed=3), {out!r}, config,
    progress=lambda *state: print(*state, flush=True)))
"""


def tree(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def here():
    with rendered_here():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "cars"
    with rendered_here():
        report = generate(CARS, out, GenerationConfig(held_out=2, **SMALL))
    return out, report


def test_a_data_set_has_the_requested_objects_views_and_cameras(whole):
    out, report = whole
    assert (report.written, report.reused, report.skipped) == (5, 0, [])
    data = Dataset(out)
    assert data.names("train") == ["car_00000", "car_00001", "car_00002"]
    assert data.names("test") == ["car_test_00000", "car_test_00001"]
    task = data.task("car_00000")
    rig = fixed(4, 16)
    assert task.support.images.shape == (2, 3, 16, 16)
    assert torch.allclose(
        camera.camera_from_world(task.support.cameras),
        camera.camera_from_world(rig.cameras())[::2].float(),
        atol=1e-6,
    )
    assert torch.allclose(camera.intrinsics(task.query.cameras), torch.tensor(rig.intrinsics[1::2]).float(), atol=1e-5)
    assert (task.support.bounds.centre, task.support.bounds.radius) == ((0.0, 0.0, 0.0), 1.0)
    assert 0.02 < float(task.support.masks.mean()) < 0.8
    assert not (out / ".progress").exists()


def test_the_manifest_has_the_settings_and_no_path_of_this_machine(whole):
    text = (whole[0] / "manifest.json").read_text()
    manifest = json.loads(text)
    assert manifest["configuration"]["source"] == {"class_name": "car", "count": 5, "seed": 3}
    assert manifest["configuration"]["generator"].startswith("hyperplanes")
    assert manifest["renderer"]
    assert manifest["skipped"] == []
    assert str(whole[0].parent) not in text
    assert manifest["objects"]["car_00000"]["files"].keys() == {
        "car_00000/transforms.json",
        *(f"car_00000/images/{index:03d}.png" for index in range(4)),
    }


@pytest.mark.usefixtures("here")
def test_verify_finds_missing_and_changed_files(whole, tmp_path):
    out = tmp_path / "copy"
    shutil.copytree(whole[0], out)
    assert verify(out).intact
    assert verify(out).files == 25
    (out / "car_00000/images/000.png").unlink()
    (out / "car_00001/images/001.png").write_bytes(b"other")
    found = verify(out)
    assert found.missing == ["car_00000/images/000.png"]
    assert found.changed == ["car_00001/images/001.png"]
    lines = inspect(out, tmp_path / "pictures", 1, checksums=True).lines()
    assert "checksums: car_00000/images/000.png is missing" in lines
    assert "checksums: car_00001/images/001.png has changed since it was written" in lines
    report = generate(CARS, out, GenerationConfig(held_out=2, **SMALL))
    assert (report.written, report.reused) == (5, 3), "what is missing or changed is made again"


def goes_on(out, whole, reused):
    """Check that a second run completes a data set that was interrupted after some objects."""
    assert not (out / "manifest.json").exists(), "the end of the run was not awaited"
    with pytest.raises(DataError, match=r"found an unfinished one \(\d of 5 objects\); run the same"):
        Dataset(out)
    (out / ".progress/unfinished/.junk.part").write_bytes(b"half a file")
    with rendered_here():
        report = generate(CARS, out, GenerationConfig(held_out=2, **SMALL))
    assert report.written == 5
    assert report.reused >= reused
    assert tree(out) == tree(whole[0])


def test_a_killed_generation_is_completed_with_the_same_bytes(whole, tmp_path):
    out = tmp_path / "cars"
    root = str(Path(objects.__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT.format(out=str(out))],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": root},
    )
    process.stdout.readline()
    process.kill()
    process.stdout.close()
    process.wait()
    goes_on(out, whole, 1)


@pytest.mark.usefixtures("here")
def test_an_interrupted_generation_is_completed_with_the_same_bytes(whole, tmp_path):
    """Python raises KeyboardInterrupt on Ctrl-C."""

    def interrupt(done, *_):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(CARS, tmp_path / "cars", GenerationConfig(held_out=2, **SMALL), progress=interrupt)
    goes_on(tmp_path / "cars", whole, 2)


def test_the_number_of_workers_changes_nothing(whole, tmp_path):
    generate(CARS, tmp_path / "cars", GenerationConfig(held_out=2, views=4, resolution=16, workers=2, recycle=4))
    assert tree(tmp_path / "cars") == tree(whole[0])


def test_another_configuration_in_the_same_folder_is_refused(whole):
    with pytest.raises(DataError, match=r"cars: expected the data set it holds \(--views 4\), found a request for"):
        generate(CARS, whole[0], GenerationConfig(held_out=2, views=6, resolution=16))


def test_a_folder_with_other_things_in_it_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(DataError, match=r"found thesis\.tex; name another one"):
        generate(CARS, tmp_path, GenerationConfig(**SMALL))
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="found a file"):
        generate(CARS, tmp_path / "file", GenerationConfig(**SMALL))


def test_two_generations_do_not_write_into_one_folder(tmp_path):
    with one_writer(tmp_path), pytest.raises(DataError, match="found another hyperplanes at work there"):
        generate(CARS, tmp_path, GenerationConfig(**SMALL))


@pytest.mark.usefixtures("here")
def test_a_broken_mesh_is_skipped_with_a_reason_and_the_others_are_rendered(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.box().export(meshes / "box.ply")
    trimesh.creation.icosphere(subdivisions=1).export(meshes / "ball.obj")
    (meshes / "broken.glb").write_bytes(b"glTF but not really")
    (meshes / "empty.obj").write_text("")
    cut = "mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 1\nusemtl paint\nf 1 2 3\n"
    (meshes / "grey.obj").write_text(cut)
    for kind in ("3mf", "fbx", "usdz"):
        (meshes / f"amphora.{kind}").write_text("a format that is not read")
    (meshes / "ball.fbx").write_text("the same object as ball.obj")
    report = generate(MeshFolder(meshes), tmp_path / "out", GenerationConfig(held_out=0, **SMALL))
    assert report.written == 3
    assert [name for name, _ in report.skipped] == ["amphora.3mf", "amphora.fbx", "amphora.usdz", "broken", "empty"]
    assert [reason.partition("found ")[2] for _, reason in report.skipped[:3]] == [
        f"{kind}; convert it" for kind in (".3mf", ".fbx", ".usdz")
    ]
    assert all(reason.startswith(f"{name}.") for name, reason in report.skipped[3:]), "no path of this machine"
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    skipped = [(entry["name"], entry["reason"]) for entry in manifest["skipped"]]
    assert skipped == sorted([*report.skipped, ("ball.fbx", "the same object as ball.obj, which is taken")])
    assert Dataset(tmp_path / "out").names() == ["ball", "box", "grey"]
    assert manifest["with_lost_files"] == {"count": 1, "names": ["grey"]}
    assert manifest["objects"]["grey"]["lost_files"] == ["gone.mtl"]
    fewer, line, other = remarks(report, tmp_path / "out")
    assert fewer == "fewer objects in the split train: 3 of 5; repair what was skipped, or choose another --held-out"
    assert line.startswith("drawn without a texture or another file that they name: 1 of 3 objects (grey), listed in")
    assert line.endswith("under with_lost_files; the text is in the warnings of each object, under objects")
    assert any("gone.mtl" in text for text in manifest["objects"]["grey"]["warnings"])
    assert "taken in another format: 1 of the files (ball.fbx), listed in" in other


@pytest.mark.usefixtures("here")
def test_a_split_with_skipped_objects_is_named(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name in "abcdef":
        trimesh.creation.box().export(meshes / f"{name}.ply")
    for broken, lines in (
        ("f", ["fewer objects in the split test: 1 of 2"]),
        ("e", ["no objects in the split test: 0 of 2"]),
        ("a", ["fewer objects in the split train: 3 of 4", "no objects in the split test: 0 of 2"]),
    ):
        (meshes / f"{broken}.ply").write_text("ply")
        report = generate(MeshFolder(meshes), tmp_path / "out", GenerationConfig(**SMALL))
        assert [line.partition(";")[0] for line in remarks(report, tmp_path / "out")] == lines
    alone = generate(Procedural("car", 1), tmp_path / "one", GenerationConfig(held_out=0.5, **SMALL))
    assert remarks(alone, tmp_path) == [
        "no objects in the split test: 0 of 1; one more object is needed, because one alone is not held out"
    ]


def test_the_up_axis_is_that_of_the_format_except_for_named_files_and_folders(tmp_path):
    for name in ("a.obj", "b.glb", "c.dae", "scans/d.glb", "scans/e.ply", "scans/old/f.stl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()

    def axes(**keywords):
        items = list_items(MeshFolder(tmp_path, **keywords), 0).items
        return "".join(item.up or "-" for item in sorted(items, key=by_path))

    def by_path(item):
        return item.path

    assert axes() == "y---yy"
    assert axes(up="z") == "z---zz"
    assert axes(up="z", up_of=("scans=y",)) == "z--yyy"
    assert axes(up_of=("scans=z", "*.stl=y", "b.glb=z")) == "yz-zzy"
    for wrong, message in (("scan=z", "'scan', which fits none"), ("scans", "expected PATTERN=y or PATTERN=z")):
        with pytest.raises(ValueError, match=message):
            axes(up_of=(wrong,))


@pytest.mark.usefixtures("here")
def test_a_full_disk_is_a_one_line_error_and_leaves_no_partial_files(tmp_path, monkeypatch):
    """A renderer that may not write files above 1 kB simulates a full disk."""
    monkeypatch.setattr("data_gen.datasets.generate.TARGET", "limited_worker:open_renderer")
    with pytest.raises(DataError, match=r"expected room to write \d+ bytes, found .*; ") as caught:
        generate(CARS, tmp_path / "out", GenerationConfig(held_out=2, views=4, resolution=64, workers=1))
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "out").rglob("*.part"))
    assert not (tmp_path / "out/manifest.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rig": "circle"}, "rig: expected one of fixed, random, hemisphere, orbit, .*, got 'circle'"),
        ({"layout": "tar"}, "layout: expected one of native, .*, got 'tar'"),
        ({"engine": "slurm"}, "engine: expected one of local, ray, got 'slurm'"),
        ({"channels": ("depth",)}, "channels: expected rgba and any of"),
        ({"channels": ("rgba", "depth"), "layout": "srn"}, "channels: expected rgba alone in the srn layout"),
        ({"layout": "hyperplanes-200", "resolution": 64}, "resolution: the hyperplanes-200 layout's .* assume 200"),
        ({"layout": "srn", "distance": 2.5}, "distance: expected 2.6 to 2.6 in the srn layout, .*, got 2.5"),
        (
            {"layout": "learnit-128", "distance": 5.5},
            "distance: expected 3 to 5 in the learnit-128 layout, .*, got 5.5",
        ),
        ({"resolution": 100_000}, "resolution: expected at most 16,384 samples along a side, got 100,000 pixels of 3"),
        ({"resolution": 5000}, "resolution: expected at most 4 GiB of pictures an object, got 4.7 GiB"),
        ({"views": 10**9}, r"views: expected 2 \(support and query\) to 10,000 an object, got 1,000,000,000"),
        ({"views": 1}, "views: expected 2 .* an object, got 1"),
        ({"timeout": 0.0}, "timeout: expected seconds above 0, got 0"),
        ({"views": 0}, "views: expected 2 .* an object, got 0"),
        ({"held_out": math.inf}, "held_out: expected a fraction below 1 or a count up to 5 of each class, got inf"),
        ({"held_out": math.nan}, "held_out: expected a fraction below 1 or a count up to 5 of each class, got nan"),
        ({"supersample": 0}, "supersample: expected 1 to 8, got 0"),
        ({"supersample": 9}, "supersample: expected 1 to 8, got 9"),
        ({"lighting": "sun"}, "lighting: expected one of studio, headlight, random, got 'sun'"),
        (
            {"layout": "hyperplanes-200", "field_of_view": 60.0},
            "field_of_view: the hyperplanes-200 layout's loaders assume 39.59877529 degrees, got 60; leave it out",
        ),
        ({"held_out": 9}, "held_out: expected a fraction below 1 or a count up to 5 of each class, got 9"),
    ],
)
def test_invalid_arguments_are_named(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        generate(CARS, tmp_path / "out", GenerationConfig(**arguments))
    assert not (tmp_path / "out").exists()


def test_names_that_are_equal_in_the_authors_layout_are_refused(tmp_path):
    for name in ("a_1", "a-1"):
        trimesh.creation.box().export(tmp_path / f"{name}.ply")
    config = GenerationConfig(layout="hyperplanes-200", views=2)
    with pytest.raises(ValueError, match="a_1: expected a name that hyperplanes-200 tells from a-1"):
        generate(MeshFolder(tmp_path, class_name="car"), tmp_path / "out", config)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"meshes": Path("meshes"), "count": 1}, "count: expected with --class"),
        ({"class_name": "car", "up": "z"}, "--up: expected with --meshes, found with --class; leave it out"),
    ],
)
def test_options_of_the_other_source_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        source_of(Arguments(Path("out"), **given))


@pytest.mark.usefixtures("here")
def test_the_authors_layout_takes_only_the_classes_of_their_loader(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    config = GenerationConfig(layout="hyperplanes-200", views=2, held_out=0, workers=1)
    for source, found in (
        (Procedural("lamp", 1), "lamp"),
        (MeshFolder(tmp_path), "meshes without a class; give --class-name"),
    ):
        with pytest.raises(ValueError, match=f"class: expected car, chair, plane, .*, got {found}"):
            generate(source, tmp_path / "out", config)
    GenerationConfig(layout="srn", distance=4.0).resolve().check_class("chair")
    generate(MeshFolder(tmp_path, class_name="chair"), tmp_path / "out", config)
    assert (tmp_path / "out/chairs/sampled/2_box.npz").is_file()


def test_data_sets_of_one_seed_share_objects_and_never_mix_training_and_held_out():
    small = {item.name: item.seed for item in list_items(Procedural("car", 20, 1), 5).items}
    large = {item.name: item.seed for item in list_items(Procedural("car", 100, 1), 10).items}
    assert small.items() <= large.items()
    assert len(set(large.values())) == len(large)


@pytest.mark.parametrize("count_of_seeds", [2**9, 2**32])
def test_only_an_object_with_the_seed_of_another_gets_a_new_seed(monkeypatch, count_of_seeds):
    """About 34 of 200 draws from 512 numbers repeat one. Each training object comes before its held-out one."""

    class Sequence(np.random.SeedSequence):
        def generate_state(self, words):
            return super().generate_state(words).astype(np.int64) % count_of_seeds

    monkeypatch.setattr(np.random, "SeedSequence", Sequence)
    whole = {item.name: item.seed for item in list_items(Procedural("car", 200, 1), 100).items}
    before = set()
    for index in range(100):
        for test, name in enumerate((f"car_{index:05d}", f"car_test_{index:05d}")):
            drawn = int(np.random.SeedSequence([1, test, index]).generate_state(1)[0])
            assert (whole[name] == drawn) == (drawn not in before)
            before.add(whole[name])
    assert len(before) == 200
    for count, held_out in ((100, 0), (120, 20), (60, 59)):
        part = {item.name: item.seed for item in list_items(Procedural("car", count, 1), held_out).items}
        assert part.items() <= whole.items(), "data sets of one seed share objects"


def test_meshes_are_split_four_to_one_by_name(tmp_path):
    for index in range(10):
        trimesh.creation.box().export(tmp_path / f"mesh{index}.ply")
    splits = [item.split for item in list_items(MeshFolder(tmp_path), None).items]
    assert splits == ["train"] * 8 + ["test"] * 2


def test_random_rigs_differ_between_objects_but_not_between_runs():
    config = GenerationConfig(rig="random", views=3, resolution=8, seed=5).resolve()
    first, again, other = (config.make_rig(name).world_from_camera for name in ("a", "a", "b"))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


@pytest.mark.usefixtures("here")
def test_progress_is_reported(tmp_path):
    told = []
    generate(Procedural("car", 2), tmp_path, GenerationConfig(**SMALL), progress=lambda *state: told.append(state))
    assert [state[:2] for state in told] == [(1, 2), (2, 2)]


def test_the_manifest_has_the_version_of_the_generator(whole):
    manifest = json.loads((whole[0] / "manifest.json").read_text())
    assert manifest["configuration"]["generator"] == f"hyperplanes {version('hyperplanes')}, pictures {PICTURES}"
    assert manifest["configuration"]["supersample"] == SUPERSAMPLE


@pytest.mark.usefixtures("here")
def test_changed_files_are_generated_again_if_requested(tmp_path, whole):
    out = shutil.copytree(whole[0], tmp_path / "cars")
    for name in ("car_00001/images/002.png", "car_test_00000/transforms.json"):
        (out / name).write_bytes(b"worm")
    (out / "car_00002" / "images" / "001.png").write_bytes(b"")
    assert not verify(out).intact
    assert generate(CARS, out, GenerationConfig(held_out=2, **SMALL)).reused == 2
    assert tree(out) == tree(whole[0])


@pytest.mark.usefixtures("here")
def test_rigs_of_the_paper_define_distance_lens_and_sizes(tmp_path):
    car = Procedural("car", 1, seed=3)
    generate(car, tmp_path / "200", GenerationConfig(rig="paper-200", resolution=8, held_out=0, workers=1))
    task = Dataset(tmp_path / "200").task("car_00000")
    expected = make_rig("paper-200", 50, 8, distance=4.0, field_of_view=RIG_PRESETS["paper-200"].field_of_view)
    assert len(task.support) + len(task.query) == len(expected) == 50
    poses = camera.camera_from_world(expected.cameras())[::2].float()
    assert torch.allclose(camera.camera_from_world(task.support.cameras), poses, atol=1e-6)

    generate(car, tmp_path / "128", GenerationConfig(rig="paper-128", views=2, held_out=0, workers=1))
    support = Dataset(tmp_path / "128").task("car_00000").support
    expected = make_rig("paper-128", 2, 128, distance=4.0, field_of_view=RIG_PRESETS["paper-128"].field_of_view)
    assert support.size == (128, 128)
    assert torch.allclose(camera.intrinsics(support.cameras)[0], torch.tensor(expected.intrinsics[0]).float())
    assert float(camera.centres(support.cameras).norm(dim=-1)) == pytest.approx(4.0, abs=1e-5)
    manifest = json.loads((tmp_path / "128" / "manifest.json").read_text())
    assert (manifest["near"], manifest["far"]) == (3.0, 5.0)
    with pytest.raises(ValueError, match="rig: expected one of .*paper-200, srn, got 'paper-64'"):
        generate(car, tmp_path / "64", GenerationConfig(rig="paper-64"))


def test_a_class_without_entries_in_the_split_file_is_for_training_and_named(tmp_path):
    for synset, name in (("02958343", "a"), ("03001627", "x"), ("03001627", "y")):
        path = tmp_path / "tree" / synset / name / "model.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box().export(path)
    official = tmp_path / "tree" / "all.csv"
    official.write_text("id,synsetId,subSynsetId,modelId,split\n0,02958343,02958343,a,test")
    items = list_items(MeshFolder(tmp_path / "tree"), None).items
    assert [(item.name, item.split, item.unlisted) for item in items] == [
        ("chair_x", "train", True),
        ("chair_y", "train", True),
        ("car_a", "test", False),
    ]
    assert not any(item.unlisted for item in list_items(MeshFolder(tmp_path / "tree"), 1).items)


@pytest.mark.usefixtures("here")
def test_an_official_split_file_is_used(tmp_path):
    tree_of_cars = tmp_path / "ShapeNetCore.v1"
    for name in "abcd":
        path = tree_of_cars / "02958343" / name / "model.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box().export(path)
    official = tmp_path / "all.csv"
    rows = [f"{i},02958343,02958343,{name},{split}" for i, (name, split) in enumerate(zip("abc", SPLITS, strict=True))]
    official.write_text("\n".join(["id,synsetId,subSynsetId,modelId,split", *rows]))
    items = list_items(MeshFolder(tree_of_cars, split_file=official), None).items
    assert [(item.name, item.split) for item in items] == [
        ("car_b", "train"),
        ("car_d", "train"),  # not listed
        ("car_c", "val"),
        ("car_a", "test"),
    ]
    assert [item.name for item in items if item.unlisted] == ["car_d"]
    out = tmp_path / "out"
    report = generate(MeshFolder(tree_of_cars, split_file=official), out, GenerationConfig(**SMALL))
    assert report.unlisted == ["car_d"]
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["not_in_split_file"] == {"count": 1, "split": "train", "names": ["car_d"]}
    assert manifest["splits"]["train"] == ["car_b", "car_d"]
    assert "not in the split file, so trained on: 1, named in the manifest" in describe(out, 1).lines()
    with pytest.raises(ValueError, match="held_out: expected none, for .*all.csv decides, got 0.5"):
        list_items(MeshFolder(tree_of_cars, split_file=official), 0.5)
    official.write_text("id,synsetId,subSynsetId,modelId,split\n0,03001627,03001627,a,test")
    with pytest.raises(ValueError, match="all.csv: expected models of .*, found none of them"):
        list_items(MeshFolder(tree_of_cars, split_file=official), None)
