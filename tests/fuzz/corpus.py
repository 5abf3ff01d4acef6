"""Small valid inputs of every kind that the project reads, and their readers."""

import json
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from PIL import Image

from data_gen.datasets.manifest import GenerationState, verify
from data_gen.meshes.mesh import load_mesh, mesh_parts
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.capture.stages import Stages
from hyperplanes.commands.inputs.disk_cache import keep_field, recall_field
from hyperplanes.configuration.presets import preset
from hyperplanes.configuration.settings_file import read_experiment
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.data import open_dataset, read_channel, read_task, read_views
from hyperplanes.experiments.record import Record
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import Sphere, cameras
from hyperplanes.training.checkpointing import Checkpointing
from hyperplanes.training.optimisation import Optimisation
from hyperplanes.utilities.files.encoding import encode_json, sha256
from hyperplanes.utilities.files.writing import write_json
from tests.fuzz.published import Published

VIEWS, HEIGHT, WIDTH = 4, 10, 12
CONFIG = TrainingConfig(steps=3)
OBJECTS = SimpleNamespace(fingerprint={"objects": 1})


def pictures():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    alpha = np.where((rows - 5) ** 2 + (columns - 6) ** 2 < 16, 255, 0)
    return [np.stack([rows * 20, columns * 20, rows + 40 * view, alpha], -1).astype(np.uint8) for view in range(VIEWS)]


def poses():
    return cameras.fibonacci_sphere(VIEWS, 3.0).double().numpy()


def posed_scene(folder):
    names = [f"images/{index}.png" for index in range(VIEWS)]
    (folder / "images").mkdir(parents=True)
    for name, picture in zip(names, pictures(), strict=True):
        Image.fromarray(picture).save(folder / name)
    opengl = [(np.linalg.inv(pose) * [1, -1, -1, 1]).tolist() for pose in poses()]
    document = {
        "camera_angle_x": 0.7,
        "w": WIDTH,
        "h": HEIGHT,
        "k1": 0.01,
        "scene_sphere": {"centre": [0, 0, 0], "radius": 1},
    }
    document["frames"] = [{"file_path": n, "transform_matrix": p} for n, p in zip(names, opengl, strict=True)]
    (folder / "transforms.json").write_text(
        json.dumps(document | {"train_filenames": names[:2], "test_filenames": names[2:]})
    )


def data_set(folder):
    posed_scene(folder / "a")
    files = {str(path.relative_to(folder)): sha256(path.read_bytes()) for path in sorted((folder / "a").rglob("*.*"))}
    manifest = {"format": "hyperplanes-dataset", "version": 1, "layout": "native", "objects": {"a": {"files": files}}}
    (folder / "manifest.json").write_bytes(encode_json(manifest | {"splits": {"train": ["a"], "val": [], "test": []}}))


def colmap(folder, binary):
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").mkdir()
    for index, picture in enumerate(pictures()):
        Image.fromarray(picture[..., :3]).save(folder / f"images/{index}.png")
    numbers = [[1, 0, 0, 0, *pose[:3, 3]] for pose in poses()]
    if binary:
        camera = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 16.0, 16.0, 6.0, 5.0)
        images = struct.pack("<Q", VIEWS)
        for index, row in enumerate(numbers):
            images += struct.pack("<i7di", index, *row, 1) + f"{index}.png\0".encode() + struct.pack("<Q", 0)
        (folder / "sparse/cameras.bin").write_bytes(camera)
        (folder / "sparse/images.bin").write_bytes(images)
        return
    (folder / "sparse/cameras.txt").write_text(f"# a comment\n1 OPENCV {WIDTH} {HEIGHT} 16 16 6 5 0.01 0 0 0\n")
    lines = [f"{index} {' '.join(map(str, row))} 1 {index}.png\n\n" for index, row in enumerate(numbers)]
    (folder / "sparse/images.txt").write_text("".join(lines))


def srn(folder):
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    (folder / "intrinsics.txt").write_text(f"16 6 5 0.\n0. 0. 0.\n1.\n1.\n{HEIGHT} {WIDTH}\n")
    for index, (picture, pose) in enumerate(zip(pictures(), poses(), strict=True)):
        Image.fromarray(picture[..., :3]).save(folder / f"rgb/{index:06d}.png")
        (folder / f"pose/{index:06d}.txt").write_text(" ".join(map(str, np.linalg.inv(pose).ravel())))


def nsvf(folder):
    srn(folder)
    for index in range(VIEWS):
        for name in (f"rgb/{index:06d}.png", f"pose/{index:06d}.txt"):
            path = folder / name
            path.rename(path.with_name(f"{index % 3}_{path.name}"))
    (folder / "intrinsics.txt").write_text("16 0 6 0\n0 16 5 0\n0 0 1 0\n0 0 0 1\n")
    (folder / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.4\n")


def save_pictures(folder, names, channels=slice(0, 3)):
    folder.mkdir(parents=True)
    for name, picture in zip(names, pictures(), strict=True):
        Image.fromarray(picture[..., channels].squeeze()).save(folder / name)


def llff(folder):
    save_pictures(folder / "images", [f"{index}.png" for index in range(VIEWS)])
    save_pictures(folder / "masks", [f"{index}.png" for index in range(VIEWS)], 3)
    rows = []
    for pose in np.linalg.inv(poses()):
        right, down, forward, eye = pose[:3].T
        rows.append([*np.stack([down, right, -forward, eye, [HEIGHT, WIDTH, 16]], 1).ravel(), 1, 6])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def neus(folder):
    save_pictures(folder / "image", [f"{index:06d}.png" for index in range(VIEWS)])
    save_pictures(folder / "mask", [f"{index:03d}.png" for index in range(VIEWS)], 3)
    matrix = np.diag([16.0, 16.0, 1.0, 1.0])
    matrix[:2, 2] = 6, 5
    arrays = {f"world_mat_{index}": matrix @ pose for index, pose in enumerate(poses())}
    np.savez(folder / "cameras_sphere.npz", **arrays, **{f"scale_mat_{index}": np.eye(4) for index in range(VIEWS)})


def archive(folder):
    folder.mkdir(parents=True)
    opengl = np.stack([np.linalg.inv(pose) * [1, -1, -1, 1] for pose in poses()])
    np.savez_compressed(folder / "4_a.npz", rgba=np.stack(pictures()), cam_poses=opengl, focal=16.0)
    np.savez(folder / "depth.npz", depth=np.ones((VIEWS, HEIGHT, WIDTH), np.float32))


def published():
    return Published(pictures(), poses())


def progress(folder):
    """A data set with one finished object and one that is only listed."""
    with GenerationState(folder, {"count": 2}) as state:
        posed_scene(folder / "a")
        files = {f"a/{path.name}": sha256(path.read_bytes()) for path in (folder / "a").glob("*.json")}
        write_json(state.folder / "done" / "a.json", {"name": "a", "record": {}, "files": files})


def go_on_generating(folder):
    with GenerationState(folder, {"count": 2}) as state:
        state.done()


def stages(folder):
    with Record(folder / "stages.json").working("data", SETTINGS):
        pass


def go_on_in_stages(folder):
    record = Record(folder / "stages.json")
    if not record.done("data", SETTINGS):
        with record.working("data", SETTINGS):
            pass
    record.seconds("data")


SETTINGS = {"count": 2}


def settings(folder):
    folder.mkdir(parents=True)
    text = "preset: quick\nmethod: hyperplanes\nmodel:\n  network: {depth: 2, width: 8}\n"
    (folder / "config.yaml").write_text(text + "training:\n  steps: 10\n  learning_rate: 1.0e-3\n")


def kept(folder):
    """A field that was adapted to the posed scene next to it."""
    posed_scene(folder / "scene")
    model, views = small_model(), read_views(folder / "scene")
    keep_field(model, model.adapt(views), folder / "kept" / "a")


def recall(folder):
    found = recall_field(folder / "kept" / "a", read_views(folder / "scene"))
    if found is not None:
        found.density(torch.zeros(1, 3))


def read_capture(folder):
    read_task(folder / "scene")
    SparseModel.load(folder / "work/model.npz")
    Stages(folder / "work").begin("poses", "key")


def small_model():
    config = preset("quick").model
    network = replace(config.network, depth=1, width=8, planes=2)
    hyper = replace(config.hypernetwork, views=1, code=4, depth=1, width=8)
    model = HyperPlanes(replace(config, network=network, hypernetwork=hyper, hull_resolution=8))
    model.rig.copy_(torch.eye(3)[: len(model.rig)])
    return model


def training(folder):
    model = small_model()
    optimisation = Optimisation(model, CONFIG)
    sum(parameter.sum() for parameter in model.parameters()).backward()
    optimisation.step(0)
    Checkpointing(folder, model, optimisation, CONFIG, True).save(1, [{"step": 1.0, "loss": 0.5}], None, OBJECTS)


def go_on(folder):
    model = HyperPlanes.from_pretrained(find_checkpoint(folder))
    Checkpointing(folder, model, Optimisation(model, CONFIG), CONFIG, True).resume(OBJECTS)


def baked(folder):
    folder.mkdir(parents=True)
    index = torch.full((8, 8, 8), -1, dtype=torch.int32)
    index[3:5, 3:5, 3:5] = torch.arange(8, dtype=torch.int32).reshape(2, 2, 2)
    BakedField(index, torch.rand(8, 28, generator=torch.Generator().manual_seed(0)), Sphere()).save(
        folder / "a.safetensors"
    )


CORNERS = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def meshes(folder):
    import trimesh

    folder.mkdir(parents=True)
    rows = [" ".join(str(each + 1) for each in face) for face in FACES]
    (folder / "a.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\nd 0.9\nmap_Kd a.png\n")
    Image.fromarray(pictures()[0][..., :3]).save(folder / "a.png")
    lines = [f"v {corner}" for corner in CORNERS] + ["vt 0 0", "vt 1 0", "vt 0 1", "usemtl red"]
    lines += ["f " + " ".join(f"{each}/1" for each in row.split()) for row in rows]
    (folder / "a.obj").write_text("mtllib a.mtl\n" + "\n".join(lines) + "\n")
    mesh = trimesh.Trimesh([[float(x) for x in corner.split()] for corner in CORNERS], FACES, process=False)
    for suffix in ("glb", "ply", "stl", "off"):
        mesh.export(folder / f"a.{suffix}")


def render_mesh(suffix):
    return lambda folder: mesh_parts(load_mesh(folder / f"a.{suffix}"))


def gltf(folder):
    """A glTF with all supported features: morph target, skin, instances, sparse and quantised accessors, textures."""
    folder.mkdir(parents=True)
    Image.fromarray(pictures()[0]).save(folder / "a.png")
    positions = np.array([corner.split() for corner in CORNERS], np.float32)
    arrays = [
        (positions, 5126, "VEC3"),
        (np.array(FACES, np.uint16).ravel(), 5123, "SCALAR"),
        (np.array([[0, 0], [255, 0], [0, 255], [255, 255]], np.uint8), 5121, "VEC2"),
        (np.array([[0, 0, 0, 0]] * 4, np.uint8), 5121, "VEC4"),
        (np.array([[1, 0, 0, 0]] * 4, np.float32), 5126, "VEC4"),
        (np.eye(4, dtype=np.float32)[None], 5126, "MAT4"),
        (np.array([[2, 0, 0], [0, 2, 0]], np.float32), 5126, "VEC3"),
        (np.array([3], np.uint16), 5123, "SCALAR"),
        (np.array([[0, 0, 2]], np.float32), 5126, "VEC3"),
    ]
    views, accessors, buffer = [], [], b""
    for number, (array, component, kind) in enumerate(arrays):
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data)})
        accessors.append({"bufferView": number, "componentType": component, "count": len(array), "type": kind})
        buffer += data + b"\0" * (-len(data) % 4)
    accessors[2]["normalized"] = True
    sparse = {"count": 1, "indices": {"bufferView": 7, "componentType": 5123}, "values": {"bufferView": 8}}
    accessors.append(accessors[0] | {"sparse": sparse})
    moved = {"KHR_texture_transform": {"offset": [0.5, 0], "rotation": 1, "scale": [2, 1]}}
    glossy = {"diffuseTexture": {"index": 0}, "specularFactor": [0.1, 0.1, 0.1], "glossinessFactor": 0.5}
    materials = [
        {
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": moved}, "metallicFactor": 0},
            "emissiveTexture": {"index": 0},
            "emissiveFactor": [0.5, 0.5, 0.5],
            "extensions": {
                "KHR_materials_emissive_strength": {"emissiveStrength": 2},
                "KHR_materials_transmission": {"transmissionFactor": 0.5},
            },
        },
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy, "KHR_materials_unlit": {}}},
    ]
    plain = {"attributes": {"POSITION": 9, "TEXCOORD_0": 2}, "indices": 1, "material": 1}
    plain["targets"] = [{"POSITION": 0}]
    skinned = {"attributes": {"POSITION": 0, "TEXCOORD_0": 2, "JOINTS_0": 3, "WEIGHTS_0": 4}, "material": 0, "mode": 5}
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 6}}}
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "extensions": instances, "weights": [0.5]}, {"mesh": 1, "skin": 0, "children": [2]}, {}],
        "skins": [{"joints": [2], "inverseBindMatrices": 5}],
        "meshes": [{"primitives": [plain]}, {"primitives": [skinned]}],
        "materials": materials,
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "wrapT": 33648}],
        "images": [{"uri": "a.png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"uri": "a.bin", "byteLength": len(buffer)}],
    }
    (folder / "a.gltf").write_text(json.dumps(header))
    (folder / "a.bin").write_bytes(buffer)


DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="t"><lambert><diffuse><color>1 0 0 1</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="15">0 0 0 2 0 0 1 1 0 0 2 0 0 0 1
</float_array><technique_common><accessor source="#a" count="5" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="2" material="s"><input semantic="VERTEX" source="#v" offset="0"/><vcount>4 3</vcount>
<p>1 2 3 0 0 1 4</p></polylist></mesh></geometry></library_geometries>
<library_controllers><controller id="c"><skin source="#g"/></controller></library_controllers>
<library_visual_scenes><visual_scene id="vs"><node id="n"><instance_controller url="#c"><bind_material>
<technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_controller>
</node></visual_scene></library_visual_scenes><scene><instance_visual_scene url="#vs"/></scene></COLLADA>
"""


def polygons(folder):
    """Concave polygons with colours of faces, smoothing groups and options of textures."""
    folder.mkdir(parents=True)
    (folder / "a.dae").write_text(DAE)
    corners = ["0 0 0", "2 0 0", "1 1 0", "0 2 0", "0 0 1"]
    head = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\n"
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    (folder / "a.ply").write_text(head + "\n".join(corners) + "\n4 1 2 3 0 9 8 7\n3 0 1 4 1 2 3\n")
    Image.fromarray(pictures()[0]).save(folder / "a.png")
    (folder / "a.mtl").write_text("newmtl red\nKe 1 1 1\nmap_Ke a.png\nmap_Kd -clamp on -s 2 2 1 -o 0.5 0 a.png\n")
    lines = ["mtllib a.mtl", *(f"v {corner}" for corner in corners), "vt 0 0", "vt 1 1", "usemtl red", "s 1"]
    (folder / "a.obj").write_text("\n".join([*lines, "f 2/1 3/2 4/1 1/2", "s 2", "f 1/1 2/1 5/2", "l 1 2"]) + "\n")


def read_all(folder):
    data = open_dataset(folder)
    for name in data.names():
        data.task(name)


CORPUS = {  # kind: (writer, pattern of the files that are damaged, reader)
    "posed": (posed_scene, "**/*.*", read_task),
    "data set": (data_set, "**/*.*", read_all),
    "manifest": (data_set, "manifest.json", verify),
    "COLMAP text": (lambda folder: colmap(folder, False), "sparse/*", read_views),
    "COLMAP binary": (lambda folder: colmap(folder, True), "sparse/*", read_views),
    "SRN": (srn, "**/*.*", read_views),
    "NSVF": (nsvf, "**/*.*", read_views),
    "LLFF": (llff, "**/*.*", read_views),
    "NeuS": (neus, "**/*.*", read_views),
    "NMR": (lambda folder: published().nmr(folder), "**/*.*", read_all),
    "CO3D": (lambda folder: published().co3d(folder), "**/*.*", read_all),
    "Objaverse": (lambda folder: published().objaverse(folder), "**/*.*", read_all),
    "OmniObject3D": (lambda folder: published().omniobject(folder), "**/*.*", read_all),
    "Polycam": (lambda folder: published().polycam(folder), "**/*.*", read_views),
    "Record3D": (lambda folder: published().record3d(folder), "**/*", read_views),
    "RealityCapture": (lambda folder: published().realitycapture(folder), "**/*.*", read_views),
    "Metashape": (lambda folder: published().metashape(folder), "**/*.*", read_views),
    "capture": (lambda folder: published().capture(folder), "[sw][co]*/**/*.*", read_capture),
    "generation": (progress, "**/*.json", go_on_generating),
    "stages": (stages, "*", go_on_in_stages),
    "settings": (settings, "*", lambda folder: read_experiment(folder / "config.yaml")),
    "kept": (kept, "kept/*/*", recall),
    "archive": (archive, "4_a.npz", lambda folder: read_views(folder / "4_a.npz")),
    "channel": (archive, "depth.npz", lambda folder: read_channel(folder, "depth")),
    "model": (training, "model.*", lambda path: HyperPlanes.from_pretrained(find_checkpoint(path))),
    "training": (training, "training*", go_on),
    "baked": (baked, "*", lambda folder: BakedField.load(folder / "a.safetensors")),
    "OBJ": (meshes, "a.[omp][btn][jlg]", render_mesh("obj")),
    "GLB": (meshes, "a.glb", render_mesh("glb")),
    "PLY": (meshes, "a.ply", render_mesh("ply")),
    "STL": (meshes, "a.stl", render_mesh("stl")),
    "glTF": (gltf, "a.*", render_mesh("gltf")),
    "COLLADA": (polygons, "a.dae", render_mesh("dae")),
    "polygons of PLY": (polygons, "a.ply", render_mesh("ply")),
    "polygons of OBJ": (polygons, "a.[omp][btn][jlg]", render_mesh("obj")),
    "OFF": (meshes, "a.off", render_mesh("off")),
}
