"""Source of truth: small trees in the layout of ShapeNetCore v1 and v2, written by hand."""

import numpy as np
import pytest
from mesh_writers import OBJ_FACES, OBJ_SOLID, picture

from data_gen.meshes.find import find_meshes
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts
from data_gen.meshes.shapenet import SYNSETS, class_of_synset, paper_split, read_split_file

CAR, CHAIR, PLANE, LAMP = "02958343", "03001627", "02691156", "03636649"


def write_model(root, synset, model, version, *, texture=None):
    texture = texture or {1: "images/texture0.jpg", 2: "../images/texture0.jpg"}[version]
    folder = root / synset / model
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "texture0.jpg").write_bytes(picture(colour=(5, 6, 7)))
    mesh = folder / "models" / "model_normalized.obj" if version == 2 else folder / "model.obj"
    mesh.parent.mkdir(exist_ok=True)
    mesh.write_text(f"mtllib {mesh.stem}.mtl\n{OBJ_SOLID}usemtl paint\n{OBJ_FACES}")
    mesh.with_suffix(".mtl").write_text(f"newmtl paint\nKd 0 0 0\nmap_Kd {texture}\n")
    (mesh.parent / "model_normalized.solid.binvox").write_bytes(b"#binvox 1")
    return mesh


def texel(mesh):
    (part,) = mesh_parts(mesh)
    return part.visual.material.baseColorTexture.getpixel((0, 0))


def test_there_are_55_classes_and_the_numbers_of_the_paper():
    assert len(SYNSETS) == len(set(SYNSETS.values())) == 55
    assert [class_of_synset(number) for number in (CAR, CHAIR, PLANE, LAMP)] == ["car", "chair", "plane", "lamp"]
    assert class_of_synset("00000001") == "00000001"


def test_version_2_finds_its_textures_next_to_the_models_folder(tmp_path):
    mesh = load_mesh(write_model(tmp_path, CAR, "abc", 2))
    assert mesh.warnings == ()
    assert texel(mesh) == (5, 6, 7)


def test_version_1_finds_its_textures_inside_its_folder(tmp_path):
    for model, texture in (
        ("a", "images/texture0.jpg"),
        ("b", "../b/images/texture0.jpg"),
        ("c", "./images/texture0.jpg"),
    ):
        mesh = load_mesh(write_model(tmp_path, CAR, model, 1, texture=texture))
        assert mesh.warnings == ()
        assert texel(mesh) == (5, 6, 7)


@pytest.mark.parametrize(("version", "texture"), [(2, "../../b/images/texture0.jpg"), (1, "../b/images/texture0.jpg")])
def test_a_model_does_not_read_files_of_another_model(tmp_path, version, texture):
    """It uses its own file of that name with a warning, or is refused. Other models are read only within one tree."""
    write_model(tmp_path, CAR, "b", version)
    path = write_model(tmp_path, CAR, "a", version, texture=texture)
    assert load_mesh(path).warnings == (f"{texture}: not there, images/texture0.jpg taken",)
    (tmp_path / CAR / "a/images/texture0.jpg").unlink()
    with pytest.raises(MeshError, match="which leaves it"):
        load_mesh(path)
    assert load_mesh(path, within=tmp_path).warnings == ()


@pytest.mark.parametrize("version", [1, 2])
def test_a_tree_gives_classes_and_the_split_of_the_paper(tmp_path, version):
    for index in range(5):
        write_model(tmp_path, CAR, f"m{index}", version)
    write_model(tmp_path, CHAIR, "x", version)
    (tmp_path / CAR / "empty").mkdir()
    (tmp_path / "taxonomy.json").write_text("[]")
    found = find_meshes(tmp_path).meshes
    assert [(mesh.name, mesh.class_name, mesh.split) for mesh in found] == [
        ("car_m0", "car", "train"),
        ("car_m1", "car", "train"),
        ("car_m2", "car", "train"),
        ("car_m3", "car", "train"),
        ("car_m4", "car", "test"),
        ("chair_x", "chair", "test"),
    ]
    assert all(load_mesh(mesh.path).face_count == 4 for mesh in found[:2])
    assert [mesh.name for mesh in find_meshes(tmp_path / CAR).meshes] == [f"car_m{index}" for index in range(5)]


def test_folders_named_after_dates_are_no_classes(tmp_path):
    for name in ("20240131/chair/model.obj", "20240131/sofa/model.obj", "20240207/lamp/model.obj", "other.glb"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "20240131/desk.ply").touch()
    found = find_meshes(tmp_path).meshes
    assert {mesh.class_name for mesh in found} == {None}
    assert [mesh.name for mesh in found] == [
        "20240131_chair_model",
        "20240131_desk",
        "20240131_sofa_model",
        "20240207_lamp_model",
        "other",
    ]


def test_unknown_numbers_are_classes_in_version_2(tmp_path):
    write_model(tmp_path, "00000001", "a", 2)
    assert [(mesh.name, mesh.class_name) for mesh in find_meshes(tmp_path).meshes] == [("00000001_a", "00000001")]


@pytest.mark.parametrize("version", [1, 2])
def test_meshes_next_to_the_models_of_a_tree_are_listed(tmp_path, version):
    write_model(tmp_path, CAR, "a", version)
    for name in (f"{CAR}/b.obj", "20240131/chair/model.obj", "more/c.glb", "d.fbx"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = find_meshes(tmp_path)
    assert [mesh.name for mesh in found.meshes] == ["car_a"]
    assert [name for name, _ in found.unreadable] == [f"{CAR}/b.obj", "20240131/chair/model.obj", "d.fbx", "more/c.glb"]
    assert found.unreadable[0][1].startswith("expected a model of the ShapeNetCore tree, found another mesh")


def test_the_official_split_is_used_if_given(tmp_path):
    for model in ("a", "b", "c"):
        write_model(tmp_path, PLANE, model, 2)
    rows = f"id,synsetId,subSynsetId,modelId,split\n1,{PLANE},02690373,a,test\n2,2691156,02690373,b,val\n"
    (tmp_path / "given.csv").write_text(rows)
    found = find_meshes(tmp_path, split_file=tmp_path / "given.csv").meshes
    assert [mesh.split for mesh in found] == ["test", "val", None]
    (tmp_path / "all.csv").write_text(rows.replace("val", "train"))
    assert [mesh.split for mesh in find_meshes(tmp_path).meshes] == ["test", "train", None]


def test_rows_of_a_split_file_may_have_no_last_column(tmp_path):
    (tmp_path / "s.csv").write_text(f"modelId,split,synsetId\na,test,{PLANE}\nb,val\n")
    assert read_split_file(tmp_path / "s.csv")[PLANE, "a"] == "test"


def test_a_wrong_split_file_is_refused(tmp_path):
    write_model(tmp_path, PLANE, "a", 2)
    path = tmp_path / "s.csv"
    for text, message in (
        ("", "expected the columns"),
        ("id,modelId\n1,a\n", "found id,modelId"),
        ("synsetId,modelId,split\n1,a,holdout\n", "line 2: expected train, val or test, found 'holdout'"),
        ("synsetId,modelId,split\n1,a\n", "line 2: expected train, val or test, found ''"),
    ):
        path.write_text(text)
        with pytest.raises(MeshError, match=message):
            read_split_file(path)
    with pytest.raises(MeshError, match="expected a readable split file"):
        find_meshes(tmp_path, split_file=tmp_path / "gone.csv")
    (tmp_path / "other").mkdir()
    with pytest.raises(MeshError, match="expected a ShapeNetCore tree"):
        find_meshes(tmp_path / "other", split_file=path)


def test_the_split_does_not_depend_on_the_order_and_takes_80_percent(tmp_path):
    from data_gen.meshes.shapenet import ShapeNetModel

    models = [ShapeNetModel(CAR, f"{index:03d}", tmp_path, tmp_path) for index in range(101)]
    shuffled = [models[index] for index in np.random.default_rng(0).permutation(len(models))]
    split = paper_split(shuffled)
    assert split == paper_split(models)
    assert [name for (_, name), part in sorted(split.items()) if part == "train"] == [
        f"{index:03d}" for index in range(80)
    ]
