"""The page that turns an object: its pictures against those of the baked form, in a real browser.

Source of truth: `BakedScene`, which the CPU renders. Needs Chromium, whose software renderer has WebGL 2.
"""

import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.baking import BakedScene, bake
from hyperplanes.export.page import address_of, page_of, save_page, turning_picture
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Views

SIZE = 64
SPHERE = Sphere((0.2, -0.1, 0.3), 1.5)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--disable-background-networking --disable-component-update --disable-sync --no-first-run --hide-scrollbars "
    "--force-device-scale-factor=1 --force-color-profile=srgb --virtual-time-budget=20000 --window-size=512,512"
).split()
chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def two_balls(points, directions):
    """Two balls with soft surfaces, coloured by place and direction, so that no view is that of another."""
    local = (points - points.new_tensor(SPHERE.centre)) / SPHERE.radius
    large = 40 * torch.sigmoid((0.5 - (local - local.new_tensor([0.1, 0.2, 0.0])).norm(dim=-1)) * 30)
    small = 40 * torch.sigmoid((0.2 - (local - local.new_tensor([-0.5, -0.4, 0.3])).norm(dim=-1)) * 30)
    colour = 0.5 + 0.3 * torch.sin(4 * local) + 0.15 * directions
    return colour.clamp(0, 1), large + small


@pytest.fixture(scope="module")
def views():
    poses = camera.fibonacci_sphere(6, 4.5)
    poses[:, :3, 3] -= poses[:, :3, :3] @ torch.tensor(SPHERE.centre)
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), poses, SIZE, SIZE)
    return Views(torch.ones(6, 3, SIZE, SIZE), cameras, bounds=SPHERE)


@pytest.fixture(scope="module")
def baked():
    return bake(AdaptedField(two_balls, full(SPHERE, 32), RayMarching(96)), side=64)


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_the_page_shows_what_the_baked_form_shows(baked, views, tmp_path):
    page = save_page(page_of(baked, views), tmp_path / "page.html", "Two <balls>")
    one = camera.select(views.cameras, [3])
    picture = tmp_path / "shot.png"
    address = page.resolve().as_uri() + address_of(one)
    command = [str(chromium), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}", address]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    pixels = np.array(Image.open(picture).convert("RGB"))[:SIZE, :SIZE]
    shown = torch.from_numpy(pixels).permute(2, 0, 1)[None].float() / 255
    truth = BakedScene(baked).render(one).images
    assert float(truth.min()) < 0.5
    assert float(psnr(shown, truth)) > 38


STORY = """
const boxes = [...document.querySelectorAll(".voxels")], told = [];
const wait = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
const state = (box) => box.dataset.shown === "voxels" ? "v" : "p";
const tell = (what) => told.push(what + " " + boxes.map(state).join(""));
const lose = (box) => box.querySelector("canvas").getContext("webgl2").getExtension("WEBGL_lose_context").loseContext();
const tap = (box) => box.dispatchEvent(new PointerEvent("pointerdown"));
sessionStorage.loads = Number(sessionStorage.loads || 0) + 1;
(async () => {
  await wait(2000);
  tell("loaded");
  boxes[0].querySelector("canvas").focus();
  lose(boxes[0]);
  await wait(100);
  tell("lost");
  await wait(2500);
  tell("again");
  told.push(boxes[0].contains(document.activeElement) ? "focused" : "not focused");
  tap(boxes[13]);
  await wait(1000);
  tell("tapped");
  boxes[5].remove();
  tap(boxes[12]);
  await wait(1000);
  tell("removed");
  document.title = [...told, "loads " + sessionStorage.loads].join(", ");
})();
"""


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_of_many_viewers_twelve_draw_and_what_is_tapped_or_lost_comes_back(views, tmp_path):
    small = bake(AdaptedField(two_balls, full(SPHERE, 8), RayMarching(16)), side=8)
    fragment = page_of(small, views, picture=turning_picture(small, views, frames=1, size=8))
    boxes = [f'<div style="width:40px;float:left">{fragment}</div>' for _ in range(18)]
    page = save_page("\n".join([*boxes, f"<script>{STORY}</script>"]), tmp_path / "page.html", "many")
    command = [str(chromium), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.resolve().as_uri()]
    seen = subprocess.run(command, check=True, capture_output=True, timeout=100, text=True).stdout
    told = re.search("<title>(.*?)</title>", seen)[1].split(", ")
    states = dict(each.split(" ") for each in told if " v" in each or " p" in each)
    assert states["loaded"] == "v" * 12 + "p" * 6
    assert states["lost"] == "p" + "v" * 11 + "p" * 6
    assert states["again"] == states["loaded"]
    assert states["tapped"].count("v") == 12
    assert states["tapped"][13] == "v"
    assert states["removed"].count("v") >= 12  # what was removed may say that it was drawn
    assert states["removed"][12] == "v"
    assert "focused" in told
    assert told[-1] == "loads 1"


def test_a_page_is_one_file_that_asks_for_nothing(baked, views, tmp_path):
    picture = turning_picture(baked, views, frames=2, size=32)
    text = save_page(page_of(baked, views, picture=picture), tmp_path / "page.html", "Two <balls>").read_text()
    assert "<title>Two &lt;balls&gt;</title>" in text
    assert "data:image/webp;base64," in text
    assert not [word for word in ("http:", "https:", 'src="/', "import(", "fetch(") if word in text]


def test_a_page_that_is_too_large_loses_precision_before_it_is_refused(baked, views):
    whole = len(page_of(baked, views))
    smaller = len(page_of(baked, views, largest=int(0.7 * whole)))
    assert smaller < 0.75 * whole
    with pytest.raises(ValueError, match="page: expected at most 0.001 MB, got"):
        page_of(baked, views, largest=1000)
