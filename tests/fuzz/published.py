"""Valid inputs in the layouts of published data sets and of apps, and a scene as `capture` writes it."""

import gzip
import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from hyperplanes.capture.scene import write_scene
from hyperplanes.capture.scene_record import SceneRecord
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.capture.stages import Stages

FLIP = np.diag([-1.0, -1.0, 1.0])


class Published:
    """Writers of the same pictures and cameras in each layout.

    Args:
        pictures: (height, width, 4) pixels.
        poses: camera_from_world (4, 4) with OpenCV axes.
    """

    def __init__(self, pictures, poses):
        self.pictures, self.poses = pictures, poses
        self.height, self.width = pictures[0].shape[:2]

    def save(self, folder, name, channels=slice(0, 3)):
        folder.mkdir(parents=True, exist_ok=True)
        for index, picture in enumerate(self.pictures):
            Image.fromarray(picture[..., channels]).save(folder / name.format(index))

    def nmr(self, folder):
        home = folder / "class" / "a"
        self.save(home / "image", "{:04d}.png")
        self.save(home / "mask", "{:04d}.png", 3)
        arrays = {f"world_mat_{index}": pose for index, pose in enumerate(self.poses)}
        arrays |= {f"camera_mat_{index}": np.diag([2.7, 3.2, 1, 1]) for index in range(len(self.poses))}
        np.savez(home / "cameras.npz", **arrays)
        (folder / "class/softras_train.lst").write_text("a\n")

    def co3d(self, folder):
        frames = []
        for index, pose in enumerate(self.poses):
            view = {"R": (FLIP @ pose[:3, :3]).T.tolist(), "T": (FLIP @ pose[:3, 3]).tolist()}
            view |= {"focal_length": [3.2, 3.2], "principal_point": [0.1, 0], "intrinsics_format": "ndc_isotropic"}
            image = {"path": f"class/a/images/{index}.png", "size": [self.height, self.width]}
            mask = {"path": f"class/a/masks/{index}.png"}
            frames.append({"sequence_name": "a", "frame_number": index, "image": image, "mask": mask})
            frames[-1]["viewpoint"] = view
        self.save(folder / "class/a/images", "{}.png")
        self.save(folder / "class/a/masks", "{}.png", 3)
        (folder / "class/frame_annotations.jgz").write_bytes(gzip.compress(json.dumps(frames).encode()))
        (folder / "class/set_lists").mkdir()
        lists = {"train": [["a", 0, "x"]], "val": [], "test": []}
        (folder / "class/set_lists/set_lists_fewview_dev.json").write_text(json.dumps(lists))

    def objaverse(self, folder):
        self.save(folder / "a", "{:03d}.png", slice(0, 4))
        for index, pose in enumerate(self.poses):
            np.save(folder / f"a/{index:03d}.npy", np.diag([1.0, -1.0, -1.0]) @ pose[:3])
        (folder / "valid_paths.json").write_text('["a"]')

    def omniobject(self, folder):
        home = folder / "class/class_001/render"
        self.save(home / "images", "r_{}.png")
        opengl = [(np.linalg.inv(pose) * [1, -1, -1, 1]).tolist() for pose in self.poses]
        frames = [{"file_path": f"r_{index}", "transform_matrix": pose} for index, pose in enumerate(opengl)]
        (home / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))

    def opengl(self):
        """Matrices world_from_camera (4, 4), with x right, y up and z backwards."""
        return [np.linalg.inv(pose) * [1, -1, -1, 1] for pose in self.poses]

    def polycam(self, folder):
        for index, pose in enumerate(self.opengl()):
            stated = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            stated |= {"fx": 16.0, "fy": 16.0, "cx": 6.0, "cy": 5.0, "width": self.width, "height": self.height}
            (folder / "keyframes/cameras").mkdir(parents=True, exist_ok=True)
            (folder / f"keyframes/cameras/{index}.json").write_text(json.dumps(stated))
        self.save(folder / "keyframes/images", "{}.jpg")

    def record3d(self, folder):
        self.save(folder / "rgbd", "{}.jpg")
        poses = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in self.opengl()]
        stated = {"poses": poses, "K": [16, 0, 0, 0, 16, 0, 6, 5, 1], "w": self.width, "h": self.height}
        (folder / "metadata").write_text(json.dumps(stated))

    def realitycapture(self, folder):
        self.save(folder / "images", "{}.jpg")
        rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
        for index, pose in enumerate(self.opengl()):
            angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True) * [-1, 1, 1]
            rows.append(",".join(map(str, [f"{index}.jpg", *pose[:3, 3], *angles, 48, 0, 0, 0.01, 0, 0, 0.001, 0, 0])))
        (folder / "cameras.csv").write_text("\n".join(rows))

    def metashape(self, folder):
        self.save(folder / "images", "{}.jpg")
        cameras = [
            f'<camera id="{index}" sensor_id="0" label="{index}"><transform>{" ".join(map(str, pose.ravel()))}'
            "</transform></camera>"
            for index, pose in enumerate(map(np.linalg.inv, self.poses))
        ]
        (folder / "cameras.xml").write_text(
            '<document version="2.0.0"><chunk><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 1'
            '</translation><scale>2</scale></transform><sensors><sensor id="0" type="frame"><calibration type="frame" '
            f'class="adjusted"><resolution width="{self.width}" height="{self.height}"/><f>16</f><cx>0.5</cx><k1>0.01'
            f"</k1></calibration></sensor></sensors><cameras>{''.join(cameras)}</cameras></chunk></document>"
        )

    def sparse_model(self):
        count = len(self.poses)
        matrix = np.array([[16.0, 0, 5.5], [0, 16.0, 4.5], [0, 0, 1]])
        points = np.array([[0.0, 0, 0], [0.1, 0, 0.2]])
        observed = np.array([[view, point] for view in range(count) for point in range(2)])
        return SparseModel(
            np.arange(count), self.poses, np.stack([matrix] * count), np.zeros((count, 2)), points,
            np.zeros((2, 3), np.uint8), np.ones(2), observed,
        )  # fmt: skip

    def capture(self, folder):
        """Write a scene with its masks and points, the sparse model that it is made of, and the record of a stage."""
        folder.mkdir(parents=True)
        self.save(folder / "scratch/images", "{}.jpg")
        self.save(folder / "scratch/masks", "{}.png", 3)
        files = {
            str(path.relative_to(folder / "scratch")): path.read_bytes() for path in (folder / "scratch").rglob("*.*")
        }
        names = [str(index) for index in range(len(self.poses))]
        record = SceneRecord(folder / "scene", folder / "capture.json")
        write_scene(record, (), self.sparse_model(), names, [(self.height, self.width)] * len(names), files)
        self.sparse_model().save(folder / "work/model.npz")
        Stages(folder / "work").finish("poses", "key", {"count": 4})
