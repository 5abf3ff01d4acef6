"""Small whole inputs of every kind that the project reads, and what reads each of them."""

import json
import struct
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from data_gen.datasets.manifest import verify
from data_gen.meshes.mesh import load_mesh, mesh_parts
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.presets import configure
from hyperplanes.data import open_dataset, read_channel, read_task, read_views
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import Sphere, cameras
from hyperplanes.training.state import load_state, save_state
from hyperplanes.utilities.files import encode_json, sha256

VIEWS, HEIGHT, WIDTH = 4, 10, 12
CONFIG = {"steps": 3, "seed": 0}


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


def small_model():
    config = configure("quick", "hyperplanes").model
    network = replace(config.network, depth=1, width=8, planes=2)
    hyper = replace(config.hypernetwork, views=1, code=4, depth=1, width=8)
    model = HyperPlanes(replace(config, network=network, hypernetwork=hyper, hull_resolution=8))
    model.rig.copy_(torch.eye(3)[: len(model.rig)])
    return model


def training(folder):
    model = small_model()
    optimiser = torch.optim.Adam(model.parameters())
    sum(parameter.sum() for parameter in model.parameters()).backward()
    optimiser.step()
    save_state(folder, model, [optimiser], 1, [{"step": 1.0, "loss": 0.5}], CONFIG)


def go_on(folder):
    model = HyperPlanes.from_pretrained(find_checkpoint(folder))
    load_state(folder, model, [torch.optim.Adam(model.parameters())], CONFIG, ("steps",), {})


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


def read_all(folder):
    data = open_dataset(folder)
    for name in data.names():
        data.task(name)


CORPUS = {  # how each is made, which of its files are damaged, and what reads it then
    "posed": (posed_scene, "**/*.*", read_task),
    "data set": (data_set, "**/*.*", read_all),
    "manifest": (data_set, "manifest.json", verify),
    "COLMAP text": (lambda folder: colmap(folder, False), "sparse/*", read_views),
    "COLMAP binary": (lambda folder: colmap(folder, True), "sparse/*", read_views),
    "SRN": (srn, "**/*.*", read_views),
    "NSVF": (nsvf, "**/*.*", read_views),
    "LLFF": (llff, "**/*.*", read_views),
    "NeuS": (neus, "**/*.*", read_views),
    "archive": (archive, "4_a.npz", lambda folder: read_views(folder / "4_a.npz")),
    "channel": (archive, "depth.npz", lambda folder: read_channel(folder, "depth")),
    "model": (training, "model.*", lambda path: HyperPlanes.from_pretrained(find_checkpoint(path))),
    "training": (training, "training*", go_on),
    "baked": (baked, "*", lambda folder: BakedField.load(folder / "a.safetensors")),
    "OBJ": (meshes, "a.[omp][btn][jlg]", render_mesh("obj")),
    "GLB": (meshes, "a.glb", render_mesh("glb")),
    "PLY": (meshes, "a.ply", render_mesh("ply")),
    "STL": (meshes, "a.stl", render_mesh("stl")),
    "OFF": (meshes, "a.off", render_mesh("off")),
}
