"""Source of truth: a new data set of the changed files, byte for byte."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from PIL import Image
from rendered_here import rendered_here

from data_gen.commands.generate import summary
from data_gen.datasets.generate import GenerationConfig, MeshFolder, generate
from hyperplanes.data import DataError
from hyperplanes.utilities.files.encoding import sha256

CONFIG = GenerationConfig(views=2, resolution=16, workers=1, held_out=1)
QUAD = "mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl paint\nf 1/1 2/2 3/3 4/1\n"
PAINT = "newmtl paint\nKd 1 1 1\nmap_Kd wood.png\n"


@pytest.fixture(autouse=True)
def here():
    with rendered_here():
        yield


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box().export(folder / "a.ply")
    (folder / "b.obj").write_text(QUAD)
    (folder / "c.glb").write_bytes(b"glTF but cut")
    return folder


def run(meshes, out="out"):
    return generate(MeshFolder(meshes), meshes.parent / out, CONFIG)


def tree(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def anew(meshes):
    run(meshes, "anew")
    return tree(meshes.parent / "anew")


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param([("b.mtl", PAINT), ("wood.png", "brown"), ("wood.png", "blue")], id="files come and change"),
        pytest.param([("b.obj", QUAD.replace("v 0 1 1", "v 0 2 1"))], id="a mesh changes and keeps its size"),
    ],
)
def test_only_an_object_with_a_changed_file_is_generated_again(meshes, steps):
    assert (run(meshes).written, run(meshes).reused) == (2, 2)
    for name, content in steps:
        if name.endswith(".png"):
            Image.new("RGB", (8, 8), content).save(meshes / name)
        else:
            (meshes / name).write_text(content)
        report = run(meshes)
        assert (report.written, report.reused, report.changed) == (2, 1, ["b"])
        assert "1 made again, for their files have changed (b)" in summary(report, Path("out"))
    assert tree(meshes.parent / "out") == anew(meshes)
    assert (run(meshes).reused, run(meshes).changed) == (2, [])


def test_a_skipped_mesh_is_rendered_after_its_repair(meshes):
    assert [name for name, _ in run(meshes).skipped] == ["c"]
    trimesh.creation.icosphere(subdivisions=1).export(meshes / "c.glb")
    report = run(meshes)
    assert (report.written, report.reused, report.changed, report.skipped) == (3, 2, [], [])
    assert tree(meshes.parent / "out") == anew(meshes)


def test_an_object_is_removed_when_its_mesh_can_no_longer_be_rendered(meshes):
    run(meshes)
    (meshes / "b.obj").write_text("v 0 0 0\n")
    report = run(meshes)
    assert (report.written, [name for name, _ in report.skipped]) == (1, ["b", "c"])
    assert tree(meshes.parent / "out") == anew(meshes)
    assert not (meshes.parent / "out/b").exists()


def test_a_new_mesh_makes_another_data_set_and_is_named(meshes):
    run(meshes)
    trimesh.creation.box().export(meshes / "d.ply")
    with pytest.raises(DataError, match=r"splits\.c test, splits\.d None.*found.*splits\.c train, splits\.d test;"):
        run(meshes)


def test_meshes_of_data_sets_inside_the_folder_do_not_belong_to_the_source(meshes):
    config = replace(CONFIG, channels=("rgba", "mesh"))
    for out in (meshes / "out", meshes / "sets/other"):
        reports = [generate(MeshFolder(meshes), out, config) for _ in range(2)]
        assert [report.reused for report in reports] == [0, 2]
    assert [name for name, _ in reports[1].skipped] == ["c", "out"]
    assert [name for name, _ in reports[0].skipped] == ["c", "out"]
    (meshes / "sets/other/manifest.json").unlink()
    (meshes / "sets/other/.progress").mkdir()
    (meshes / "sets/other/.progress/configuration.json").write_text("{}")
    assert [name for name, _ in generate(MeshFolder(meshes), meshes / "out", config).skipped] == ["c", "sets/other"]
    alone = generate(MeshFolder(meshes / "out"), meshes.parent / "again", replace(CONFIG, held_out=0))
    assert (alone.written, alone.skipped) == (2, []), "given itself, it is a folder of meshes"


def test_the_manifest_lists_the_file_of_each_model_and_the_files_that_it_uses(meshes):
    (meshes / "b.mtl").write_text(PAINT)
    (meshes / "стол").mkdir()
    (meshes / "a.ply").rename(meshes / "стол/a.ply")
    run(meshes)
    records = json.loads((meshes.parent / "out/manifest.json").read_text())["objects"]
    assert {record["source"] for record in records.values()} == {"b.obj", "стол/a.ply"}
    made_of = records["b"]["made_of"]
    checksums = {name: sha256((meshes / name).read_bytes()) for name in ("b.obj", "b.mtl")}
    assert made_of == {**checksums, "wood.png": None}
