"""Source of truth: the glTF 2.0 specification and its extensions, for files of a few faces, and Khronos' samples.

The samples show a tick if a viewer draws them correctly, or else a cross. They are not part of the project.
"""

import io
import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import trimesh
from mesh_writers import TETRAHEDRON, TETRAHEDRON_FACES, glb_bytes, gltf, write_glb, write_gltf, write_obj

from data_gen.meshes.formats.gltf import write_glb as exported
from data_gen.meshes.mesh import MeshError, load_mesh, mesh_parts, prepare_scene
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rendering.renderers import probe
from data_gen.rigs import Rig, orbit
from data_gen.shapes import make
from hyperplanes.utilities.images.colour import linear_from_srgb

KHRONOS = Path(__file__).parents[3] / ".." / "shared" / "meshes" / "khronos"
SHEET = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
SHEET_FACES = [[0, 1, 2], [0, 2, 3]]
SHEET_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=np.float32)  # v points down, so that the picture is upright


@pytest.fixture(params=["pyrender-egl", "embree"])
def backend(request):
    if not probe(request.param).works:
        pytest.skip(f"{request.param} does not work here")
    return request.param


def quarters():
    """A picture of four colours: red and green at the top, blue and white at the bottom."""
    stream = io.BytesIO()
    texels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)
    PIL.Image.fromarray(texels.repeat(16, axis=0).repeat(16, axis=1)).save(stream, "PNG")
    return stream.getvalue()


def draw(mesh, backend="embree", size=64):
    """RGBA of a mesh from the front, unlit or with a light behind the camera."""
    rig = orbit(1, size, elevation=0.0)
    return MeshRenderer(backend).render(mesh_parts(mesh), rig, lighting="headlight").rgba[0].astype(int)


def sheet(path, *, uv=SHEET_UV, change=None, image=None, **keywords):
    """A square that faces the camera, with the picture of four colours, unlit."""
    header, buffer = gltf(
        positions=SHEET, faces=SHEET_FACES, uv=uv, image=quarters() if image is None else image, **keywords
    )
    header["materials"][0].setdefault("extensions", {})["KHR_materials_unlit"] = {}
    if change is not None:
        buffer = change(header, buffer) or buffer
    path.write_bytes(glb_bytes(header, buffer))
    return load_mesh(path)


def at(pictured, u, v):
    """The colour at a position in the square, whose upper left corner is (0, 0)."""
    rows, columns = np.nonzero(pictured[..., 3] == 255)
    row = rows.min() + v * np.ptp(rows)
    column = columns.min() + u * np.ptp(columns)
    return [round(value / 255) for value in pictured[round(row), round(column), :3]]


RED, GREEN, BLUE, WHITE = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]


def test_unlit_is_the_colour_of_the_texture_whatever_the_light(tmp_path, backend):
    found = draw(sheet(tmp_path / "a.glb"), backend)
    assert found[20, 20].tolist() == [255, 0, 0, 255]
    assert [at(found, u, v) for v in (0.2, 0.8) for u in (0.2, 0.8)] == [RED, GREEN, BLUE, WHITE]


@pytest.mark.parametrize(
    ("mode", "expected"),
    [(10497, [RED, GREEN, RED, GREEN]), (33071, [RED, GREEN, GREEN, GREEN]), (33648, [RED, GREEN, GREEN, RED])],
)
def test_textures_are_wrapped_by_the_mode_of_their_sampler(tmp_path, backend, mode, expected):
    def change(header, _):
        header["samplers"] = [{"wrapS": mode}]
        header["textures"][0]["sampler"] = 0

    found = draw(sheet(tmp_path / "a.glb", uv=SHEET_UV * [2, 1], change=change), backend)
    assert [at(found, u, 0.2) for u in (0.125, 0.375, 0.625, 0.875)] == expected


def test_a_texture_transform_rotates_after_scaling_and_before_the_offset(tmp_path):
    """Offset [0, 1] and rotation pi/2 map (u, v) to (v, 1 - u), which rotates the picture clockwise by 90 degrees."""

    def change(header, _):
        moved = {"KHR_texture_transform": {"offset": [0, 1], "rotation": np.pi / 2}}
        header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = moved

    found = draw(sheet(tmp_path / "a.glb", change=change))
    assert [at(found, u, v) for v in (0.2, 0.8) for u in (0.2, 0.8)] == [BLUE, RED, WHITE, GREEN]


def second_coordinates(header, buffer):
    """TEXCOORD_1: the coordinates of the square with u mirrored."""
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 32})
    header["accessors"].append(
        {"bufferView": len(header["bufferViews"]) - 1, "componentType": 5126, "count": 4, "type": "VEC2"}
    )
    header["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = len(header["accessors"]) - 1
    header["buffers"][0]["byteLength"] += 32
    return buffer + (np.array([1, 0]) + SHEET_UV * [-1, 1]).astype(np.float32).tobytes()


def test_each_texture_uses_its_own_coordinates(tmp_path, backend):
    def base(header, buffer):
        header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
        return second_coordinates(header, buffer)

    def emissive(header, buffer):
        material = header["materials"][0]
        del material["extensions"]
        material.update(emissiveTexture={"index": 0, "texCoord": 1}, emissiveFactor=[1, 1, 1])
        return second_coordinates(header, buffer)

    found = draw(sheet(tmp_path / "a.glb", change=base), backend)
    assert [at(found, u, 0.2) for u in (0.2, 0.8)] == [GREEN, RED]
    found = draw(sheet(tmp_path / "b.glb", change=emissive), backend)
    assert [at(found, u, 0.2) for u in (0.2, 0.8)] == [[1, 1, 0], [1, 1, 0]]  # red of one texture, green of the other


def glows_by_other_coordinates(header, buffer):
    material = header["materials"][0]
    del material["extensions"]
    material.update(emissiveTexture={"index": 0, "texCoord": 1}, emissiveFactor=[1, 0.5, 1])
    material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 1.5}}
    return second_coordinates(header, buffer)


def does_not_repeat(header, _):
    header["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    header["textures"][0]["sampler"] = 0


def painted_ball(kind):
    """A ball with dark colours of its vertices or faces."""
    ball = trimesh.creation.icosphere(2)
    colours = np.random.default_rng(0).integers(0, 60, (len(getattr(ball, kind)), 4), dtype=np.uint8) | [0, 0, 0, 255]
    ball.visual = trimesh.visual.ColorVisuals(ball, **{f"{'vertex' if kind == 'vertices' else 'face'}_colors": colours})
    return prepare_scene(trimesh.Scene(ball), "ball")


MESHES = {
    "unlit, coloured texture": lambda folder: sheet(folder / "a.glb", colours=np.array([[1, 0, 0.2, 1]] * 4)),
    "second coordinates": lambda folder: sheet(folder / "a.glb", change=glows_by_other_coordinates),
    "no repetition": lambda folder: sheet(folder / "a.glb", uv=SHEET_UV * 3 - 1, change=does_not_repeat),
    "cut out": lambda folder: sheet(folder / "a.glb", material={"alphaMode": "MASK"}, colours=[[1, 1, 1, 0.6]] * 4),
    "vertex colours": lambda folder: painted_ball("vertices"),
    "face colours": lambda folder: painted_ball("faces"),
    "mtl": lambda folder: load_mesh(write_obj(folder, mtl="newmtl paint\nKd 0.05 0.3 0.1\nKe 0 0 0.1\n")),
    "procedural": lambda folder: prepare_scene(make("car", 1), "car", closed=True),
}


@pytest.mark.parametrize("kind", MESHES)
def test_the_exported_mesh_is_drawn_as_the_original(tmp_path, kind):
    """Property: after export and import the picture is the same, except for rounding to single precision."""
    mesh = MESHES[kind](tmp_path)
    (tmp_path / "again.glb").write_bytes(exported(mesh.scene))
    again = load_mesh(tmp_path / "again.glb")
    assert again.warnings == ()
    difference = np.abs(draw(mesh) - draw(again))
    assert difference.max() <= 16  # samples on an edge may round to either side
    assert difference.mean() < 0.02


def test_other_programs_draw_the_exported_mesh_in_the_same_way(tmp_path):
    # By the specification: linear colours, opaque, double-sided, not metallic.
    mesh = prepare_scene(trimesh.Scene(trimesh.creation.box()), "box")
    for made in (mesh, painted_ball("vertices"), load_mesh(write_obj(tmp_path, mtl="newmtl paint\nKd 0.5 0 1\n"))):
        tree, _ = header_and_buffer(exported(made.scene))
        (material,) = tree["materials"]
        assert material["doubleSided"]
        assert material.get("alphaMode", "OPAQUE") == "OPAQUE"
        assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    ball = painted_ball("vertices")
    tree, buffer = header_and_buffer(exported(ball.scene))
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert accessor["componentType"] == 5126
    view = tree["bufferViews"][accessor["bufferView"]]
    found = np.frombuffer(buffer, np.float32, 4 * accessor["count"], view["byteOffset"]).reshape(-1, 4)
    seen = mesh_parts(ball)[0].visual.vertex_colors[:, :3] / 255
    np.testing.assert_allclose(found[:, :3], linear_from_srgb(seen), atol=1e-6)


def header_and_buffer(data):
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_vertex_colours_in_files_of_trimesh_are_srgb(tmp_path):
    ball = painted_ball("vertices")
    ball.scene.export(tmp_path / "a.glb")
    found = mesh_parts(load_mesh(tmp_path / "a.glb"))[0].visual.vertex_colors
    assert np.array_equal(found, mesh_parts(ball)[0].visual.vertex_colors)


def test_vertex_colours_multiply_the_texture(tmp_path, backend):
    colours = np.array([[1, 0, 1, 1]] * 4)
    found = draw(sheet(tmp_path / "a.glb", colours=colours), backend)
    assert [at(found, u, v) for v in (0.2, 0.8) for u in (0.2, 0.8)] == [RED, [0, 0, 0], BLUE, [1, 0, 1]]


def test_emissive_strength_multiplies_the_emission(tmp_path):
    def change(header, _):
        material = header["materials"][0]
        material.update(emissiveFactor=[0.25, 0, 0], pbrMetallicRoughness={"baseColorFactor": [0, 0, 0, 1]})
        material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}

    assert draw(sheet(tmp_path / "a.glb", change=change))[32, 32, 0] == 255


def test_a_palette_texture_of_the_specular_workflow_has_the_colours_of_the_palette(tmp_path):
    """As in Duck and BoxTextured of Khronos' first samples. trimesh reads indices of the palette as grey values."""
    stream = io.BytesIO()
    PIL.Image.open(io.BytesIO(quarters())).quantize(4).save(stream, "PNG")
    assert PIL.Image.open(io.BytesIO(stream.getvalue())).mode == "P"

    def change(header, _):
        glossy = {"diffuseTexture": {"index": 0}, "specularFactor": [0, 0, 0]}
        header["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}}]

    mesh = sheet(tmp_path / "a.glb", image=stream.getvalue(), change=change)
    (part,) = mesh_parts(mesh)
    texels = np.asarray(part.visual.material.baseColorTexture)
    expected = np.asarray(PIL.Image.open(io.BytesIO(quarters())))
    assert np.abs(texels.astype(int) - expected).max() <= 12  # diffuse colours are scaled by 1 / 0.96


@pytest.mark.parametrize(("mode", "corners"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_are_the_same_two_triangles(tmp_path, mode, corners):
    mesh = load_mesh(write_glb(tmp_path / "a.glb", positions=SHEET, faces=corners, mode=mode))
    (part,) = mesh_parts(mesh)
    assert mesh.face_count == 2
    assert part.area == pytest.approx(2.0)  # a square with corners at distance 1
    assert np.allclose(part.face_normals, [0, 0, 1])


def add(header, buffer, array, kind, component, **more):
    """Add an accessor with its buffer view. Returns its index and the longer buffer."""
    data = np.ascontiguousarray(array).tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data)})
    accessor = {"bufferView": len(header["bufferViews"]) - 1, "componentType": component, "count": len(array)}
    header["accessors"].append(accessor | {"type": kind} | more)
    buffer += data + b"\0" * (-len(data) % 4)
    header["buffers"][0]["byteLength"] = len(buffer)
    return len(header["accessors"]) - 1, buffer


def points_in_file(mesh):
    """The vertices of a mesh in the coordinates of its file."""
    world = np.concatenate([part.vertices for part in mesh_parts(mesh)])
    return (world - mesh.world_from_file[:3, 3]) @ np.linalg.inv(mesh.world_from_file[:3, :3]).T


@pytest.mark.parametrize("where", ["mesh", "node"])
def test_morph_targets_have_their_default_weights(tmp_path, where):
    header, buffer = gltf()
    shift = np.array([[0, 0, 0], [2, 0, 0], [0, 0, 0], [0, 0, 0]], dtype=np.float32)
    number, buffer = add(header, buffer, shift, "VEC3", 5126)
    header["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": number}]
    (header["meshes"] if where == "mesh" else header["nodes"])[0]["weights"] = [0.5]
    (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
    mesh = load_mesh(tmp_path / "a.glb")
    assert mesh.warnings == ()
    assert np.allclose(points_in_file(mesh), TETRAHEDRON + 0.5 * shift, atol=1e-6)


def test_skinned_vertices_have_the_transform_of_their_joints_and_not_of_their_node(tmp_path):
    above = {"translation": [0, 3, 0], "scale": [2, 2, 2], "children": [2]}
    skinned = {"mesh": 0, "skin": 0, "translation": [9, 9, 9]}
    header, buffer = gltf(nodes=[skinned, above, {"translation": [1, 0, 0]}])
    header["scenes"][0]["nodes"] = [0, 1]
    joints, buffer = add(header, buffer, np.zeros((4, 4), np.uint8), "VEC4", 5121)
    weights, buffer = add(header, buffer, np.array([[255, 0, 0, 0]] * 4, np.uint8), "VEC4", 5121, normalized=True)
    header["meshes"][0]["primitives"][0]["attributes"].update(JOINTS_0=joints, WEIGHTS_0=weights)
    header["skins"] = [{"joints": [2]}]
    (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
    mesh = load_mesh(tmp_path / "a.glb")
    assert mesh.warnings == ()
    assert np.allclose(points_in_file(mesh), 2 * (TETRAHEDRON + [1, 0, 0]) + [0, 3, 0], atol=1e-6)


def test_normalised_integer_positions_are_divided_by_their_maximum(tmp_path):
    header, buffer = gltf()
    number, buffer = add(header, buffer, (TETRAHEDRON * 127).astype(np.int8), "VEC3", 5120, normalized=True)
    header["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = number
    header["extensionsRequired"] = ["KHR_mesh_quantization"]
    (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
    assert np.allclose(points_in_file(load_mesh(tmp_path / "a.glb")), TETRAHEDRON, atol=1e-6)


def test_sparse_accessors_replace_items_of_a_buffer_or_of_zeros(tmp_path):
    def written(base, count=1):
        header, buffer = gltf()
        _, buffer = add(header, buffer, np.array([3], np.uint16), "SCALAR", 5123)
        _, buffer = add(header, buffer, np.array([[0, 0, 5]], np.float32), "VEC3", 5126)
        views = len(header["bufferViews"])
        accessor = header["accessors"][0]
        accessor["sparse"] = {
            "count": count,
            "indices": {"bufferView": views - 2, "componentType": 5123},
            "values": {"bufferView": views - 1},
        }
        if not base:
            del accessor["bufferView"]
        (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
        return tmp_path / "a.glb"

    expected = TETRAHEDRON.copy()
    expected[3] = [0, 0, 5]
    assert np.allclose(points_in_file(load_mesh(written(True))), expected, atol=1e-6)
    with pytest.raises(MeshError, match="no extent|without area|found none"):
        load_mesh(written(False))  # three vertices are zero
    with pytest.raises(MeshError, match="sparse indices: expected 9 items"):
        load_mesh(written(True, count=9))


def test_instances_are_drawn_with_their_transforms(tmp_path):
    places = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]], dtype=np.float32)
    header, buffer = gltf()
    number, buffer = add(header, buffer, places, "VEC3", 5126)
    header["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": number}}}
    header["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
    mesh = load_mesh(tmp_path / "a.glb")
    assert np.allclose(points_in_file(mesh), np.concatenate([TETRAHEDRON + place for place in places]), atol=1e-5)


def test_too_many_parts_to_draw_are_refused_at_once(tmp_path, monkeypatch):
    """One node with too many instances, and many nodes with a few each."""

    def written(instances, nodes=1):
        header, buffer = gltf(nodes=[{"mesh": 0} for _ in range(nodes)])
        number, buffer = add(header, buffer, np.zeros((instances, 3), dtype=np.float32), "VEC3", 5126)
        for node in header["nodes"]:
            node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": number}}}
        header["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
        (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
        return tmp_path / "a.glb"

    with pytest.raises(
        MeshError, match=r"a\.glb: expected at most 20000 parts, found 100000 instances; leave some out"
    ):
        load_mesh(written(100_000))
    monkeypatch.setattr("data_gen.meshes.formats.gltf.read.MAX_PARTS", 5)
    with pytest.raises(MeshError, match="expected at most 5 parts, found 6 or more; merge its nodes"):
        load_mesh(written(2, nodes=4))


@pytest.mark.parametrize(("factor", "metallic", "opacity"), [(0.5, 0.0, 0.7), (0.5, 1.0, 1.0), (0.0, 0.0, 1.0)])
def test_transmission_is_drawn_as_opacity_with_a_warning(tmp_path, factor, metallic, opacity):
    """By hand: a dielectric of colour 0.6 transmits 0.5 x 0.6 of the light, and a metal none."""
    material = {
        "pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.6, 0.6, 1.0], "metallicFactor": metallic},
        "extensions": {"KHR_materials_transmission": {"transmissionFactor": factor}},
    }
    mesh = load_mesh(write_glb(tmp_path / "a.glb", material=material))
    alpha = np.asarray(mesh_parts(mesh)[0].visual.material.baseColorFactor)[3] / 255
    assert alpha == pytest.approx(opacity, abs=1 / 255)
    assert any("KHR_materials_transmission drawn as opacity 0.70" in said for said in mesh.warnings) == (opacity < 1)


def test_geometry_compressed_by_draco_is_read_or_the_missing_package_named(tmp_path, monkeypatch):
    draco = pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    header, buffer = gltf()
    block = draco.encode(TETRAHEDRON, faces=TETRAHEDRON_FACES, preserve_order=True, quantization_bits=16)
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(block)})
    buffer += block + b"\0" * (-len(block) % 4)
    header["buffers"][0]["byteLength"] = len(buffer)
    for accessor in header["accessors"]:
        del accessor["bufferView"]
    compressed = {"bufferView": len(header["bufferViews"]) - 1, "attributes": {"POSITION": 0}}
    header["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": compressed}
    header["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    path = tmp_path / "a.glb"
    path.write_bytes(glb_bytes(header, buffer))
    mesh = load_mesh(path)
    assert np.allclose(points_in_file(mesh), TETRAHEDRON, atol=1e-4)
    assert mesh.face_count == 4
    broken = bytearray(path.read_bytes())
    broken[broken.find(b"DRACO")] ^= 1
    (tmp_path / "b.glb").write_bytes(broken)
    with pytest.raises(MeshError, match="expected data compressed by Draco"):
        load_mesh(tmp_path / "b.glb")
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(MeshError, match=r"pip install 'hyperplanes\[draco\]'"):
        load_mesh(path)


def test_a_missing_buffer_is_named(tmp_path):
    path = write_gltf(tmp_path)
    (tmp_path / "mesh.bin").unlink()
    with pytest.raises(MeshError, match=r"buffer 0 mesh.bin \(not found\)"):
        load_mesh(path)


def test_a_node_with_two_parents_is_drawn_once_with_a_warning(tmp_path):
    nodes = [{"children": [2]}, {"children": [2]}, {"mesh": 0}]
    header, buffer = gltf(nodes=nodes)
    header["scenes"] = [{"nodes": [0, 1]}]
    (tmp_path / "a.glb").write_bytes(glb_bytes(header, buffer))
    mesh = load_mesh(tmp_path / "a.glb")
    assert mesh.face_count == 4
    assert mesh.warnings == ("node 2 is the child of several nodes; drawn once",)


# --- Khronos' samples ----------------------------------------------------------------------------------------------


def sample(name):
    """One of Khronos' samples."""
    (path,) = [path for path in sorted((KHRONOS / name).rglob("*.gl*")) if path.suffix in (".glb", ".gltf")]
    return load_mesh(path)


def from_the_front(mesh, size=128):
    rig = orbit(1, size, elevation=0.0)
    eye = np.array([0.0, 0.0, np.linalg.norm(rig.world_from_camera[0][:3, 3])])
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = eye
    rig = Rig(pose[None], rig.intrinsics, size, size, rig.near, rig.far)
    return MeshRenderer("embree").render(mesh_parts(mesh), rig, lighting="headlight").rgba[0].astype(int)


@pytest.mark.skipif(not KHRONOS.is_dir(), reason="Khronos' samples in ../shared/meshes/khronos are not here")
@pytest.mark.parametrize("name", ["TextureSettingsTest", "NegativeScaleTest"])
def test_samples_with_red_crosses_show_none(name):
    found = from_the_front(sample(name))
    red = (found[..., 0] > 140) & (found[..., 1] < 60) & (found[..., 2] < 60)
    assert red.sum() == 0
