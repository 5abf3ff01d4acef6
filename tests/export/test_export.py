"""Source of truth: a ball with known density and colour, whose surface and volume have closed forms."""

import gc
import io
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export import images
from hyperplanes.export.images import encode_animation, orbit_cameras, save_images, save_turntable, to_pixels, upward
from hyperplanes.export.surfaces.mesh import Surface, density_grid, extract_mesh, save_mesh
from hyperplanes.export.surfaces.mesh_filling import fill_hidden
from hyperplanes.export.surfaces.mesh_level import Agreement, agreement, choose_level
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera, distorted
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.views import Views

CENTRE, RADIUS = (0.3, -0.2, 0.1), 0.8
BOUNDS = Sphere(CENTRE, 2.0)


def ball():
    """A ball of density 100 whose surface is 0.05 soft; red on the side of +x, blue on the other."""

    def field(points, directions):
        local = points - points.new_tensor(CENTRE)
        density = ((RADIUS - local.norm(dim=-1)) / 0.05 + 0.5).clamp(0, 1) * 100
        right = (local[:, :1] > 0).float()
        return torch.cat([right, torch.zeros_like(right), 1 - right], -1), density

    return AdaptedField(field, full(BOUNDS, 16), RayMarching(steps=64))


def views(count=6, size=16, up=(0.0, 1.0, 0.0)):
    pose = camera.look_at(
        torch.tensor(CENTRE) + 5 * torch.nn.functional.normalize(torch.randn(count, 3), dim=-1), CENTRE, up
    )
    cameras = camera.pinhole(camera.symmetric_intrinsics(size, size, 0.9), pose, size, size)
    return Views(torch.ones(count, 3, size, size), cameras, bounds=BOUNDS)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_the_mesh_of_a_ball():
    surface = extract_mesh(ball(), voxels=48, level=50.0)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.02)  # positive: faces look outwards
    distance = np.linalg.norm(surface.vertices - np.array(CENTRE), axis=1)
    assert np.abs(distance - RADIUS).max() < 0.03
    side = surface.vertices[:, 0] - CENTRE[0]
    clear = np.abs(side) > 0.02
    np.testing.assert_array_equal(surface.colours[clear, 0] > 0.5, side[clear] > 0)


def test_a_surface_is_closed_at_the_sphere():
    """Rays end at the sphere, so that the corners of the cube are empty."""
    everywhere = AdaptedField(
        lambda points, _: (torch.ones_like(points), points.new_full((len(points),), 99.0)),
        full(BOUNDS, 8),
        RayMarching(),
    )
    surface = extract_mesh(everywhere, voxels=48, level=10.0)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 2**3, rel=0.05)


def test_the_level_is_the_one_with_the_rendered_silhouettes():
    """Closed form: a ball of density 8 within radius 0.5, with haze of density 0.3 up to radius 0.8.

    A chord of length s through the haze has opacity 1/2 if 0.3 s = log 2, or s = 2.3, which no chord has. So the
    silhouette is that of the core, where 8 s = log 2 at s = 0.09, at a radius of 0.498. The default level, 11.1, is
    above all densities.
    """

    def field(points, directions):
        distance = (points - points.new_tensor(CENTRE)).norm(dim=-1)
        return torch.ones_like(points), 8.0 * (distance < 0.5) + 0.3 * ((distance >= 0.5) & (distance < RADIUS))

    adapted = AdaptedField(field, full(BOUNDS, 16), RayMarching(steps=96))
    density, cameras = density_grid(adapted, 64), views(3, 32).cameras
    level = choose_level(adapted, density, cameras)
    assert 0.3 < level < 8.0
    surface = extract_mesh(adapted, level=level, density=density)
    distance = np.linalg.norm(surface.vertices - np.array(CENTRE), axis=1)
    assert np.abs(distance - 0.498).max() < 0.07
    assert agreement(surface, adapted, cameras).overlap > 0.9
    hazy = extract_mesh(adapted, level=0.1, density=density)
    assert agreement(hazy, adapted, cameras).overlap == pytest.approx((0.5 / RADIUS) ** 2, abs=0.07)
    with pytest.raises(ValueError, match="level: expected more than 0 and less than the highest density, 8, got 11.1"):
        extract_mesh(adapted, density=density)


def test_a_hole_in_front_of_a_wall_lowers_the_depth_agreement_and_the_level_closes_it():
    """Closed form: a hollow ball with a wall of 0.3, of density 30 within 0.4 of the +x axis and 300 elsewhere.

    From far along x, both are opaque (30 x 0.3 = 9), so that all levels below 300 have the same silhouette. A level
    above 30 has a hole of (0.4 / 0.8)^2 of the disc, through which the opposite wall is visible.
    """

    def field(points, directions):
        local = points - points.new_tensor(CENTRE)
        weak = (local[:, 0] > 0) & (local[:, 1:].norm(dim=-1) < 0.4)
        distance = local.norm(dim=-1)
        shell = (distance < RADIUS) & (distance > RADIUS - 0.3)
        return torch.ones_like(points), shell * torch.where(weak, 30.0, 300.0)

    adapted = AdaptedField(field, full(Sphere(CENTRE, 1.0), 16), RayMarching(steps=128))
    pose = camera.look_at(torch.tensor(CENTRE) + torch.tensor([[20.0, 0.0, 0.0]]), CENTRE, (0.0, 1.0, 0.0))
    cameras = camera.pinhole(camera.symmetric_intrinsics(64, 64, 0.1), pose, 64, 64)
    density = density_grid(adapted, 64)
    level = choose_level(adapted, density, cameras)
    assert level < 30
    whole = agreement(extract_mesh(adapted, level=level, density=density), adapted, cameras)
    assert min(whole.overlap, whole.depth) > 0.95
    holed = agreement(extract_mesh(adapted, level=150.0, density=density), adapted, cameras)
    assert holed.overlap > 0.95
    assert holed.depth == pytest.approx(1 - (0.4 / RADIUS) ** 2, abs=0.05)
    empty = Surface(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]), np.ones((3, 3), np.float32))
    assert agreement(empty, adapted, cameras) == Agreement(0.0, 0.0)


@pytest.mark.parametrize(("fog", "whole"), [(8.0, True), (0.1, False)])
def test_hidden_cavities_are_filled_and_transparent_tunnels_are_not(fog, whole):
    """Closed form: a ball of density 300 with a tunnel of fog, 0.6 wide, along x, which is empty at a level of 100.

    With density 8 the fog is opaque from all sides, with opacity 0.3 after 0.045, so that the ball has no tunnel
    (Euler number 2). With density 0.1 the tunnel has a transmittance of exp(-0.1 x 1.6) = 85 % (Euler number 0, as a
    torus).
    """

    def field(points, directions):
        local = points - points.new_tensor(CENTRE)
        dense = torch.where(local[:, 1:].norm(dim=-1) < 0.3, fog, 300.0)
        return torch.ones_like(points), dense * (local.norm(dim=-1) < RADIUS)

    adapted = AdaptedField(field, full(Sphere(CENTRE, 1.0), 16), RayMarching(steps=64))
    eyes = torch.tensor(CENTRE) + 8 * torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0.1], [0, -1, 0.1], [0.1, 0.1, 1]])
    pose = camera.look_at(eyes, CENTRE, (0.0, 0.0, 1.0))
    cameras = camera.pinhole(camera.symmetric_intrinsics(64, 64, 0.3), pose, 64, 64)
    density = density_grid(adapted, 64)
    filled = fill_hidden(density, 100.0, adapted.occupancy.bounds, cameras)
    assert (filled >= density).all()
    for grid, expected in ((density, 0), (filled, 2 if whole else 0)):
        surface = extract_mesh(adapted, level=100.0, density=grid)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces)
        assert mesh.is_watertight
        assert mesh.euler_number == expected
    if whole:
        assert mesh.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.08)


def test_a_level_above_all_densities_is_refused():
    with pytest.raises(ValueError, match=r"highest density, 100, got 1e\+03"):
        extract_mesh(ball(), voxels=24, level=1000.0)


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_meshes_are_read_back_with_their_colours(kind, tmp_path):
    surface = extract_mesh(ball(), voxels=24)
    path = save_mesh(surface, tmp_path / f"ball.{kind}")
    read = trimesh.load(path, force="mesh", process=False)
    assert len(read.faces) == len(surface.faces)
    colours = np.asarray(read.visual.vertex_colors)[:, :3]
    assert {tuple(colour) for colour in colours} == {(255, 0, 0), (0, 0, 255)}
    side = read.vertices[:, 0] - CENTRE[0]
    clear = np.abs(side) > 0.02
    np.testing.assert_array_equal(colours[clear, 0] == 255, side[clear] > 0)


def test_another_format_of_a_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="ply, glb, obj"):
        save_mesh(extract_mesh(ball(), voxels=12), tmp_path / "ball.fbx")


def test_the_up_direction_is_found_for_any_up_axis():
    for up in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        assert np.dot(upward(views(40, up=up).cameras), up) > 0.98


def test_an_orbit_looks_at_the_centre_from_a_constant_height():
    scene = views(up=(0.0, 0.0, 1.0), count=40)
    cameras = orbit_cameras(scene, 8, size=32, elevation=0.4)
    assert camera.image_size(cameras) == (32, 32)
    offset = camera.centres(cameras) - torch.tensor(CENTRE)
    torch.testing.assert_close(offset.norm(dim=1), torch.full((8,), 5.0), atol=1e-3, rtol=0)
    height = offset @ torch.tensor(upward(scene.cameras))
    torch.testing.assert_close(height, torch.full((8,), 5 * math.sin(0.4)), atol=1e-3, rtol=0)
    middle = cameras.project(torch.tensor(CENTRE).expand(8, 1, 3)).reshape(8, 2)
    torch.testing.assert_close(middle, torch.full((8, 2), 15.5), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("distance", "moved"), [(5.0, False), (1.9, True)])
def test_an_orbit_of_close_ups_is_far_enough_to_show_the_object(distance, moved):
    """A ball with the angular radius asin(r / d) fits into half of the field of view at distance 5, and not at 1.9."""
    eyes = camera.centres(views(40).cameras) - torch.tensor(CENTRE)
    eyes[::2] *= distance / 5  # close-ups, and for the whole outline some far views
    eyes[1::8] *= distance / 5
    pose = camera.look_at(eyes + torch.tensor(CENTRE), CENTRE)
    cameras = camera.pinhole(camera.symmetric_intrinsics(48, 48, 0.9), pose, 48, 48)
    rays = cast(
        cameras, torch.arange(40).repeat_interleave(48 * 48), pixel_grid(48, 48).repeat(40, 1), Sphere(CENTRE, RADIUS)
    )
    masks = (rays.far > rays.near).float().reshape(40, 1, 48, 48)
    scene = Views(torch.ones(40, 3, 48, 48), cameras, masks, bounds=BOUNDS)
    orbit = orbit_cameras(scene, 8)
    away = (camera.centres(orbit) - torch.tensor(CENTRE)).norm(dim=1)
    assert away.max() - away.min() < 1e-3
    assert (float(away[0]) > distance + 0.1) == moved
    surface = torch.tensor(CENTRE) + 0.95 * RADIUS * torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    pixels = orbit.project(surface.expand(8, 500, 3))
    assert float(pixels.min()) > 0
    assert float(pixels.max()) < 47


def test_an_orbit_of_distorted_cameras_has_the_same_poses(tmp_path):
    bare = views()
    lens = distorted(bare.cameras, torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0]))
    seen = Views(bare.images, lens, torch.ones(6, 1, 16, 16), bounds=BOUNDS)
    orbit = orbit_cameras(seen, 4)
    assert isinstance(orbit, DistortedCamera)
    assert torch.equal(orbit.distortion, lens.distortion[:4])
    assert torch.equal(orbit.extrinsics, orbit_cameras(bare, 4).extrinsics)
    save_turntable(ball(), seen, tmp_path / "turn.webp", frames=2)


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_a_turntable_has_all_frames(kind, tmp_path):
    path = save_turntable(ball(), views(), tmp_path / f"turn.{kind}", frames=5, size=24)
    with Image.open(path) as animation:
        assert (animation.n_frames, animation.size, animation.info["loop"]) == (5, (24, 24), 0)


def test_another_format_of_a_turntable_is_refused(tmp_path):
    with pytest.raises(ValueError, match="webp"):
        save_turntable(ball(), views(), tmp_path / "turn.avi")
    with pytest.raises(ValueError, match="webp, gif"):
        encode_animation(np.zeros((1, 2, 2, 3), np.uint8), "avi")


def test_images_are_written_unchanged(tmp_path):
    images = torch.rand(3, 3, 4, 5)
    paths = save_images(images, tmp_path / "new", ("a/x.png", "a/y.png", "b/z"))
    assert [path.name for path in paths] == ["x.png", "y.png", "z.png"]
    assert [path.name for path in save_images(images[:2], tmp_path, ("t_0.25", "t_0.50"))] == [
        "t_0.25.png",
        "t_0.50.png",
    ]
    with Image.open(paths[1]) as image:
        np.testing.assert_array_equal(np.asarray(image), to_pixels(images)[1])
    assert [path.name for path in save_images(images, tmp_path, ("a/x.png", "b/x.png", "c"))][0] == "0000.png"
    with pytest.raises(ValueError, match="expected 3"):
        save_images(images, tmp_path, ("one",))
    for wrong in (images * 255 + 2, images * torch.nan):
        with pytest.raises(ValueError, match=r"images: expected finite numbers in \[0, 1\]"):
            save_images(wrong, tmp_path / "wrong")
    assert not (tmp_path / "wrong").exists()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its pipes stay open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("kind", ["mp4", "webm"])
def test_a_video_has_the_frames(kind, tmp_path):
    # Source of truth: the reader of ffmpeg. Sizes are made even, and the codec changes colours slightly.
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed; the extra video")
    frames = np.zeros((6, 33, 48, 3), np.uint8)
    frames[..., 0] = np.arange(6)[:, None, None] * 40
    path = tmp_path / f"round.{kind}"
    path.write_bytes(encode_animation(frames, kind, seconds=1.0))
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    found = [np.frombuffer(frame, np.uint8).reshape(34, 48, 3) for frame in reader]
    assert about["size"] == (48, 34)
    assert len(found) == 6
    assert all(abs(float(part[..., 0].mean()) - 40 * number) < 12 for number, part in enumerate(found))
    del reader
    gc.collect()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_webm_is_as_good_as_an_mp4_and_its_encoder_warns_of_nothing(tmp_path, capfd):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed; the extra video")
    coarse = np.random.default_rng(0).integers(0, 255, (8, 8, 8, 1), dtype=np.uint8)
    frames = coarse.repeat(8, 1).repeat(8, 2).repeat(3, 3)
    errors = {}
    for kind in ("mp4", "webm"):
        path = tmp_path / f"round.{kind}"
        path.write_bytes(encode_animation(frames, kind, seconds=1.0))
        reader = ffmpeg.read_frames(str(path))
        next(reader)
        found = np.stack([np.frombuffer(frame, np.uint8).reshape(64, 64, 3) for frame in reader])
        errors[kind] = np.square(found.astype(float) - frames).mean()
    assert errors["webm"] < 1.6 * errors["mp4"]  # 2 dB
    assert not capfd.readouterr().err
    del reader
    gc.collect()


@pytest.mark.parametrize("seconds", [0.5, 5.0])
def test_a_video_has_the_given_duration(monkeypatch, seconds):
    given = []
    monkeypatch.setattr(images, "_video", lambda frames, kind, rate: given.append((frames, rate)) or b"")
    frames = np.arange(2, dtype=np.uint8)[:, None, None, None].repeat(3, 3)
    encode_animation(frames, "mp4", seconds=seconds)
    ((shown, rate),) = given
    assert len(shown) / rate == seconds
    assert rate >= 1
    assert (np.diff(shown[:, 0, 0, 0].astype(int)) >= 0).all()


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_an_animation_has_the_given_duration(kind):
    frames = np.random.default_rng(0).integers(0, 255, (48, 2, 2, 3), np.uint8)
    with Image.open(io.BytesIO(encode_animation(frames, kind, seconds=4.0))) as picture:
        durations = []
        for index in range(picture.n_frames):
            picture.seek(index)
            picture.load()
            durations.append(picture.info["duration"])
    assert sum(durations) == 4000
    assert max(durations) - min(durations) <= 10
