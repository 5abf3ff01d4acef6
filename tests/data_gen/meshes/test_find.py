"""Source of truth: folders of empty files with a known number of objects."""

import pytest

from data_gen.datasets.sources import MeshFolder, list_items
from data_gen.meshes.find import find_meshes
from data_gen.meshes.mesh import load_mesh


def touch(root, *names):
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return root


def taken(root, **keywords):
    return [mesh.path.relative_to(root).as_posix() for mesh in find_meshes(root, **keywords).meshes]


def test_files_of_one_name_are_one_object_in_the_best_format(tmp_path):
    touch(tmp_path, "a.glb", "a.obj", "a.fbx", "b.stl", "b.PLY", "c/b.off", "d.fbx", "d.blend")
    found = find_meshes(tmp_path)
    assert [mesh.path.name for mesh in found.meshes] == ["a.glb", "b.PLY", "b.off"]
    assert found.duplicates == [
        ("a.fbx", "the same object as a.glb, which is taken"),
        ("a.obj", "the same object as a.glb, which is taken"),
        ("b.stl", "the same object as b.PLY, which is taken"),
    ]
    assert [name for name, _ in found.unreadable] == ["d.blend", "d.fbx"]


@pytest.mark.parametrize(
    ("folders", "best"),
    [
        (("DAE format/x.dae", "GLTF format/x.glb", "OBJ format/x.obj", "FBX format/x.fbx"), "GLTF format/x.glb"),
        (("glTF/x.gltf", "glTF-Binary/x.glb", "glTF-Embedded/x.gltf", "glTF-Draco/x.gltf"), "glTF-Binary/x.glb"),
        (("OBJ/old/x.obj", "Blends/old/x.blend", "FBX/old/x.fbx"), "OBJ/old/x.obj"),
        (("x.blend", "exports/x.fbx", "stl/x.stl", "ply files/x.ply"), "ply files/x.ply"),
    ],
)
def test_folders_named_after_formats_have_the_same_objects(tmp_path, folders, best):
    touch(tmp_path, *folders, *(name.replace("x.", "y.") for name in folders))
    assert taken(tmp_path) == [best, best.replace("x.", "y.")]


def test_other_folders_have_other_objects(tmp_path):
    names = ["obj_chairs/x.obj", "obj_tables/x.obj", "plywood/x.ply", "office/x.glb", "stlouis/x.stl", "x.off"]
    names += ["max/part.stl", "ma/part.stl", "part.stl", "step/part.stl"]  # folders of programs and of other formats
    names += ["y.obj", "obj/y.obj"]  # two files of one format
    names += ["a/z.obj", "a/a/z.obj"]
    assert sorted(taken(touch(tmp_path, *names))) == sorted(names)


def test_a_dot_in_a_name_does_not_begin_the_suffix(tmp_path):
    touch(tmp_path, "a.obj", "OBJ/a.v2.obj", "PLY/a.v2.ply", "b.v2.obj", "OBJ/b.v2.obj")
    assert sorted(taken(tmp_path)) == ["OBJ/a.v2.obj", "OBJ/b.v2.obj", "a.obj", "b.v2.obj"]


def test_an_object_in_several_formats_is_in_one_split(tmp_path):
    objects = ("chair", "desk", "lamp", "sofa", "table")
    kinds = {"DAE format": "dae", "GLTF format": "glb", "OBJ format": "obj"}
    touch(tmp_path, *(f"Models/{folder}/{name}.{kind}" for folder, kind in kinds.items() for name in objects))
    listing = list_items(MeshFolder(tmp_path), None)
    assert [(item.split, item.path.rpartition("/")[2]) for item in listing.items] == [
        *(("train", f"{name}.glb") for name in objects[:4]),
        ("test", "table.glb"),
    ]
    assert len(listing.duplicates) == 10


def test_names_in_other_scripts_differ_and_do_not_depend_on_other_files(tmp_path):
    texts = ("椅子", "机", "стул", "стол", "Stuhl", "Stühle", "が", "か")
    touch(tmp_path, *(f"{text}.glb" for text in texts))
    names = {mesh.path.stem: mesh.name for mesh in find_meshes(tmp_path).meshes}
    assert len({name.rpartition("_")[2] for name in names.values()}) == len(texts)
    assert (names["Stuhl"], names["Stühle"]) == ("Stuhl", "Stuhle")
    assert all(name.isascii() for name in names.values())
    (tmp_path / "机.glb").unlink()
    names.pop("机")
    assert {mesh.path.stem: mesh.name for mesh in find_meshes(tmp_path).meshes} == names


def test_linked_folders_are_searched_and_each_folder_once(tmp_path):
    touch(tmp_path / "elsewhere", "a/x.obj", "b/y.obj")
    root = touch(tmp_path / "meshes", "kept/z.obj")
    (root / "linked").symlink_to(tmp_path / "elsewhere/a")
    (root / "again").symlink_to(tmp_path / "elsewhere")
    (root / "first").symlink_to(root / "kept")
    (root / "kept/back").symlink_to(root)
    (root / "kept/itself").symlink_to(root / "kept/itself")
    assert taken(root) == ["again/a/x.obj", "again/b/y.obj", "kept/z.obj"]


def test_the_mesh_in_a_linked_folder_may_be_outside_and_reads_the_files_next_to_it(tmp_path):
    folder = touch(tmp_path / "elsewhere/tree")
    folder.mkdir(parents=True)
    (folder / "x.obj").write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 1\nusemtl paint\nf 1 2 3\n")
    (folder / "x.mtl").write_text("newmtl paint\nKd 1 0 0\n")
    root = touch(tmp_path / "meshes")
    root.mkdir()
    (root / "tree").symlink_to(folder)
    (found,) = find_meshes(root).meshes
    assert load_mesh(found.path, within=root).lost_files == ()
