"""Exports of Polycam, Record3D, RealityCapture, Metashape and KIRI Engine, written here as they are published.

Source of truth: pixels of known points by hand, as in test_formats. For lenses: a dot is drawn at the distorted pixel
of a known point, by the formulas of the programs' manuals; after reading, it is at the pixel without distortion.
Layouts: nerfstudio's process_data, the author of Record3D in its issues 27, 33 and 83, Metashape's manual ("Camera
models"), "RealityCapture XMP Camera Math".
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from test_formats import FOCAL, HEIGHT, VIEWS, WIDTH, are_graded, expected, eyes_and_axes, found, graded_masks, pictures

from hyperplanes.commands.inputs.scene import refuse_sources
from hyperplanes.data import DataError, open_dataset, read_task, read_views
from hyperplanes.data.formats.apps.realitycapture import world_from_angles
from hyperplanes.data.formats.calibration import brown_lens
from hyperplanes.data.pictures.undistort import distort

CENTRE = (14.0, 9.0)  # pixel centres at integers; add 0.5 from the corner
NAMES = [f"IMG_{index}.JPG" for index in range(VIEWS)]


def opengl():
    """world_from_camera (view, 4, 4), x right, y up, z backwards."""
    for eye, right, down, forward in eyes_and_axes():
        yield np.vstack([np.stack([right, -down, -forward, eye], 1), [0, 0, 0, 1]])


def polycam(folder, kind=""):
    for index, pose in enumerate(opengl()):
        stated = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        stated |= {"fx": FOCAL, "fy": FOCAL, "cx": CENTRE[0] + 0.5, "cy": CENTRE[1] + 0.5}
        stated |= {"width": WIDTH, "height": HEIGHT, "blur_score": 100, "timestamp": index}
        path = folder / f"keyframes/{kind}cameras/{1000 + index}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(stated))
    pictures(folder / f"keyframes/{kind}images", [f"{1000 + index}.jpg" for index in range(VIEWS)])


def record3d(folder, file="metadata", home="rgbd", **change):
    poses = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in opengl()]
    matrix = [FOCAL, 0, 0, 0, FOCAL, 0, CENTRE[0] + 0.5, CENTRE[1] + 0.5, 1]  # by columns
    pictures(folder / home, [f"{index}.jpg" for index in range(VIEWS)])
    (folder / file).write_text(json.dumps({"poses": poses, "K": matrix, "w": WIDTH, "h": HEIGHT, "fps": 30} | change))


def realitycapture(folder, lens="0,0,0,0,0,0", head="#cameras 6\n", size=(WIDTH, HEIGHT), focal=FOCAL):
    rows = []
    for name, pose in zip(NAMES, opengl(), strict=True):
        heading, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True) * [-1, 1, 1]
        px, py = (CENTRE[0] + 0.5 - size[0] / 2) / size[0], (CENTRE[1] + 0.5 - size[1] / 2) / size[0]
        numbers = [*pose[:3, 3], heading, pitch, roll, focal * 36 / size[0], px, py]
        rows.append(f"{name},{','.join(f'{number:.17g}' for number in numbers)},{lens}\n")
    columns = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    (folder / "cameras.csv").write_text(head + columns + "".join(rows))


def metashape(folder, lens="", component=True, size=(WIDTH, HEIGHT), focal=FOCAL, more=""):
    turn, shift, scale = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([2.0, -1.0, 4.0]), 2.5
    words = " ".join
    cameras = []
    for name, pose in zip(NAMES, opengl(), strict=True):
        local = np.eye(4)
        local[:3, :3] = turn.T @ (pose[:3, :3] * [1, -1, -1])
        local[:3, 3] = turn.T @ (pose[:3, 3] - shift) / scale
        label = f"D:\\photos\\{name}" if component else name.removesuffix(".JPG")
        cameras.append(
            f'<camera id="{name}" sensor_id="0" component_id="0" label="{label}">'
            f"<transform>{words(map(repr, local.ravel().tolist()))}</transform></camera>"
        )
    transform = (
        f'<transform><rotation locked="1">{words(map(repr, turn.ravel().tolist()))}</rotation><translation>'
        f"{words(map(repr, shift.tolist()))}</translation><scale>{scale}</scale></transform>"
    )
    own = transform if component else ""
    inside = f'<components><component id="0" label="Component 1">{own}</component></components>'
    cx, cy = CENTRE[0] + 0.5 - size[0] / 2, CENTRE[1] + 0.5 - size[1] / 2
    (folder / "scan.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1"><sensor id="0" label="a" type="frame"><resolution width="{size[0]}" height="{size[1]}"/>'
        f'<calibration type="frame" class="adjusted"><resolution width="{size[0]}" height="{size[1]}"/><f>{focal}</f>'
        f"<cx>{cx}</cx><cy>{cy}</cy>{lens}</calibration></sensor></sensors>"
        f'{inside}{"" if component else transform}<cameras next_id="9"><group id="0">{cameras[0]}</group>'
        f"{''.join(cameras[1:])}{more}</cameras></chunk></document>"
    )


def test_polycam(tmp_path):
    """Corrected cameras are preferred to the original ones, which are wrong here. ARKit's world has y up."""
    polycam(tmp_path)
    views = read_views(tmp_path)
    np.testing.assert_allclose(found(views), expected(CENTRE), atol=1e-3)
    assert (views.up, len(read_task(tmp_path).support)) == ("y", 3)
    for path in (tmp_path / "keyframes/cameras").iterdir():
        path.write_text(path.read_text().replace('"t_03": ', '"t_03": 1'))
    polycam(tmp_path, "corrected_")
    np.testing.assert_allclose(found(read_views(tmp_path / "keyframes")), expected(CENTRE), atol=1e-3)
    graded_masks(tmp_path / "keyframes/masks", [f"{1000 + index}.png" for index in range(VIEWS)])
    assert are_graded(read_views(tmp_path).masks)
    broken = tmp_path / "keyframes/corrected_cameras/1002.json"
    broken.write_text(broken.read_text().replace('"fx"', '"f"'))
    with pytest.raises(DataError, match=r"1002\.json: expected a camera of Polycam: .*found something else: KeyError"):
        read_views(tmp_path)
    broken.write_text(broken.read_text().replace('"f": 40.0', '"fx": -40.0'))
    with pytest.raises(DataError, match=r"1002\.json: expected positive focal lengths .*, found -40, 40, 14.5, 9.5"):
        read_views(tmp_path)


@pytest.mark.parametrize(("file", "home"), [("metadata", "rgbd"), ("metadata.json", "rgb")])
def test_record3d(tmp_path, file, home):
    record3d(tmp_path, file, home)
    views = read_views(tmp_path)
    np.testing.assert_allclose(found(views), expected(CENTRE), atol=1e-3)
    assert open_dataset(tmp_path).names("test") == [tmp_path.name]
    own = [[FOCAL, FOCAL, CENTRE[0] + 0.5 + index, CENTRE[1] + 0.5] for index in range(VIEWS)]
    record3d(tmp_path, file, home, perFrameIntrinsicCoeffs=own)
    shift = np.arange(VIEWS)[:, None, None] * [1.0, 0.0]
    np.testing.assert_allclose(found(read_views(tmp_path)), expected(CENTRE) + shift, atol=1e-3)
    record3d(tmp_path, file, home, poses=[[0, 0, 0, 2, 0, 0, 0]] * VIEWS)
    with pytest.raises(DataError, match=rf"{file}, pose 0: expected a unit quaternion .*, found length 2; export"):
        read_views(tmp_path)
    record3d(tmp_path, file, home, poses=[[0, 0, 0, 1]])
    with pytest.raises(DataError, match=r"expected poses, seven numbers each, found shape \(1, 4\)"):
        read_views(tmp_path)


@pytest.mark.parametrize("head", ["", "#cameras 6\n"])
def test_realitycapture(tmp_path, head):
    pictures(tmp_path / "images", NAMES)
    realitycapture(tmp_path, head=head)
    np.testing.assert_allclose(found(read_views(tmp_path)), expected(CENTRE), atol=1e-3)
    graded_masks(tmp_path / "masks", [name.replace("JPG", "png") for name in NAMES])
    assert are_graded(read_views(tmp_path).masks)
    whole = (tmp_path / "cameras.csv").read_text()
    for old, new, match in (
        ("IMG_2.JPG,", "IMG_2.JPG,east", r"line \d: expected a number as x, found 'east"),
        (",0,0\nIMG_3", "\nIMG_3", r"line \d: expected 16 columns, found 14"),
        ("IMG_2", "IMG_1", "expected a name for each photograph, found IMG_1.JPG more than once"),
        ("IMG_", "DSC_", r"expected its photographs beside it or in images/, .*, found no DSC_0.JPG; copy them"),
    ):
        (tmp_path / "cameras.csv").write_text(whole.replace(old, new))
        with pytest.raises(DataError, match=rf"cameras\.csv.* {match}"):
            read_views(tmp_path)
    (tmp_path / "other.csv").write_text(whole)
    with pytest.raises(DataError, match=r"expected one table of cameras .*, found cameras.csv and other.csv; move"):
        read_views(tmp_path)


def test_the_angles_of_realitycapture():
    """The CSV and XMP exports of one camera by RealityCapture, from a question in Epic's forum (710449)."""
    rotation = world_from_angles(163.736597399311, 83.4154313461628, 174.386496244756)
    xmp = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296885582437, 0.976472781986697, 0.114],
    ]
    np.testing.assert_allclose((rotation * [1, -1, -1]).T, xmp, atol=2e-4)


@pytest.mark.parametrize("component", [True, False])
def test_metashape(tmp_path, component):
    """The transform is that of the component, or else that of the chunk. Paths are those of Windows."""
    more = (
        '<camera id="8" sensor_id="0" component_id="0" label="lost.JPG"/>'
        '<camera id="9" sensor_id="0" component_id="0" enabled="false" label="off"><transform>1</transform></camera>'
    )
    pictures(tmp_path, NAMES)
    metashape(tmp_path, component=component, more=more, lens="<b1>2</b1>")
    with pytest.warns(UserWarning, match=r"2 of 8 cameras are not aligned.*: lost.JPG, off"):
        views = read_views(tmp_path)
    wide = (expected(CENTRE) - CENTRE) * [(FOCAL + 2) / FOCAL, 1] + CENTRE
    np.testing.assert_allclose(found(views), wide, atol=1e-3)
    whole = (tmp_path / "scan.xml").read_text()
    for old, new, match in (
        ("<b1>2</b1>", "<b2>3</b2>", r"sensor 0: expected a lens of .*, found a skew b2 that moves pixels by 0.68"),
        ('type="frame" class', 'type="fisheye" class', r"expected perspective cameras \(frame\), found fisheye"),
        ("<f>40.0</f>", "", "expected the focal length f, found cx, cy, b1"),
        ("<document", "<!DOCTYPE a><document", "expected plain XML, found a document type"),
        ("</chunk>", "", "expected whole XML, found a broken file"),
        ("<scale>2.5", "<scale>-2.5", "expected a positive scale, found -2.5"),
        ("<transform>", "<transform>1 ", "found something else: ValueError .transform with 17 numbers instead of 16"),
    ):
        (tmp_path / "scan.xml").write_text(whole.replace(old, new))
        with pytest.raises(DataError, match=rf"scan\.xml.* {match}"):
            read_views(tmp_path)


@pytest.mark.parametrize(
    ("write", "home"),
    [
        (polycam, "keyframes/images"),
        (record3d, "rgbd"),
        (realitycapture, "photos"),
        (realitycapture, "."),
        (metashape, "photos"),
    ],
)
def test_names_refer_to_the_photographs_and_no_output_is_written_to_their_folder(tmp_path, write, home):
    if write in (realitycapture, metashape):
        pictures(tmp_path / home, NAMES)
    write(tmp_path)
    task = read_task(tmp_path)
    assert all((tmp_path / name).samefile(tmp_path / home / Path(name).name) for name in task.support.names)
    with pytest.raises(ValueError, match=f"--out: expected a folder that no images .* got {tmp_path / home}, "):
        refuse_sources(tmp_path / home, tmp_path, task)
    refuse_sources(tmp_path / "made", tmp_path, task)


def test_a_label_without_a_suffix_needs_a_single_photograph(tmp_path):
    pictures(tmp_path / "photos", NAMES)
    metashape(tmp_path, component=False)
    assert read_views(tmp_path).names[1] == "photos/IMG_1.JPG"
    pictures(tmp_path / "photos", ["IMG_1.png"])
    with pytest.raises(DataError, match=r"scan\.xml: expected one photograph IMG_1, found several, with different end"):
        read_views(tmp_path)


LENS = {"k1": -0.35, "k2": 0.3, "k3": -0.2, "k4": 0.15, "p1": 0.02, "p2": -0.03}


def seen(x, y, k1, k2, k3, k4, p1, p2):
    """The distorted coordinates of a direction (x, y), by Metashape's manual."""
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3 + k4 * r**4
    across = p1 * (r + 2 * x * x) + 2 * p2 * x * y, p2 * (r + 2 * y * y) + 2 * p1 * x * y
    return np.stack([x * radial + across[0], y * radial + across[1]], -1)


@pytest.mark.parametrize("program", ["metashape", "realitycapture"])
def test_lenses(tmp_path, program):
    """RealityCapture's t1 and t2 are Metashape's p2 and p1."""
    size, focal = (90, 54), 60.0
    ideal = (expected(CENTRE)[:, 0] - CENTRE) / FOCAL + [0.35, 0.3]  # dots away from the centre
    shown = seen(*ideal.T, **LENS) * focal + CENTRE
    rows, columns = np.mgrid[: size[1], : size[0]]
    for name, (x, y) in zip(NAMES, shown, strict=True):
        dot = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
        Image.fromarray(dot.round().astype(np.uint8)).convert("RGB").save(tmp_path / name, quality=100)
    if program == "metashape":
        metashape(tmp_path, "".join(f"<{name}>{value}</{name}>" for name, value in LENS.items()), True, size, focal)
    else:
        numbers = [LENS[name] for name in ("k1", "k2", "k3", "k4", "p2", "p1")]
        realitycapture(tmp_path, ",".join(map(str, numbers)), "", size, focal)
    images = read_views(tmp_path).images[:, 0].double().numpy()
    images = np.where(images > 0.05, images, 0)
    found = np.stack([(images * grid).sum((1, 2)) / images.sum((1, 2)) for grid in (columns, rows)], -1)
    assert np.abs(shown - (ideal * focal + CENTRE)).max() > 2
    assert np.abs(found - (ideal * focal + CENTRE)).max() < 0.25


def test_a_lens_with_four_radial_coefficients():
    """OpenCV's quotient of polynomials is equal to the polynomial to 1e-5, or 0.01 pixels at a focal length of 1000."""
    radii = np.stack([np.linspace(0, 0.9, 50), np.zeros(50)], -1)
    lens = brown_lens([-0.09, -0.08, 0.12, -0.076], [0.0, 0.0], 0.9, "")
    wanted = seen(*radii.T, -0.09, -0.08, 0.12, -0.076, 0.0, 0.0)
    assert np.abs(distort(radii, lens) - wanted).max() < 1e-5
    with pytest.raises(DataError, match="expected distortion that OpenCV's model can fit, found k4 = 50"):
        brown_lens([-9.0, 30.0, -70.0, 50.0], [0.0, 0.0], 3.0, "cameras.xml")


def test_kiri_engine(tmp_path):
    """It exports transforms.json and images/ as nerfstudio does (its documentation, "KIRI Engine Capture")."""
    pictures(tmp_path / "images", NAMES)
    frames = [
        {"file_path": f"./images/{name}", "transform_matrix": pose.tolist()}
        for name, pose in zip(NAMES, opengl(), strict=True)
    ]
    document = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTRE[0] + 0.5, "cy": CENTRE[1] + 0.5, "w": WIDTH, "h": HEIGHT}
    (tmp_path / "transforms.json").write_text(json.dumps(document | {"camera_model": "OPENCV", "frames": frames}))
    np.testing.assert_allclose(found(read_views(tmp_path)), expected(CENTRE), atol=1e-3)


@pytest.mark.parametrize(("name", "inner"), [("scan.zip", "scan.zip"), ("video.r3d", "."), ("a.zip", "a.zip")])
def test_for_packed_exports_the_error_says_to_unpack_them(tmp_path, name, inner):
    (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(DataError, match=rf"expected the folder of an export, found {name}, .*; unpack it \(unzip"):
        read_task(tmp_path / inner)


def test_links_may_not_lead_out_of_the_folder(tmp_path):
    for write, file in ((polycam, "keyframes/images/1000.jpg"), (record3d, "rgbd/0.jpg")):
        folder = tmp_path / write.__name__
        write(folder)
        (folder / file).rename(tmp_path / "outside.jpg")
        (folder / file).symlink_to(tmp_path / "outside.jpg")
        with pytest.raises(DataError, match="expected a file inside .*, found a symbolic link to"):
            read_views(folder)
