"""The interactive page of an object, in a real browser.

Source of truth: pictures of `BakedScene`. These tests need Chromium, whose software renderer supports WebGL 2.
"""

import shutil
import subprocess
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.baking import BakedScene, bake
from hyperplanes.export.images import encode_animation, to_pixels
from hyperplanes.export.page import PAGE_FRAME_BYTES, address_of, page_of, save_page, turning_picture
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.images.metrics import psnr
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
    """Two balls with soft surfaces and colours by position and direction, so that all views differ."""
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


@pytest.fixture(scope="module")
def coarse():
    return bake(AdaptedField(two_balls, full(SPHERE, 32), RayMarching(96)), side=32)


@pytest.fixture(scope="module")
def small(views):
    """A fragment of a page that renders quickly."""
    tiny = bake(AdaptedField(two_balls, full(SPHERE, 8), RayMarching(16)), side=8)
    fragment = page_of(tiny, views, picture=encode_animation(to_pixels(views.images[:1]), "webp"))
    return f'<div style="width:16px;float:left">{fragment}</div>'


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_the_page_shows_the_same_picture_as_the_baked_scene(baked, views, tmp_path):
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


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_a_wide_window_shows_the_whole_object_of_tall_pictures(coarse, views, tmp_path):
    tall = camera.pinhole(camera.symmetric_intrinsics(96, 48, 0.4), camera.camera_from_world(views.cameras), 96, 48)
    page = save_page(page_of(coarse, Views(torch.ones(6, 3, 96, 48), tall, bounds=SPHERE)), tmp_path / "page.html", "")
    picture = tmp_path / "shot.png"
    flags = [flag for flag in FLAGS if "window-size" not in flag]
    place = [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}", "--window-size=500,190"]
    command = [str(chromium), *flags, *place, page.resolve().as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    drawn = (np.array(Image.open(picture).convert("RGB")).astype(int).min(-1) < 200)[:150]  # above the caption
    rows, columns = (drawn.any(axis).nonzero()[0] for axis in (1, 0))
    assert np.ptp(rows) > 58
    assert 0 < rows.min() < rows.max() < len(drawn) - 1
    assert 125 < columns.min() < columns.max() < 375


STORY = """
const boxes = [...document.querySelectorAll(".voxels")], told = [];
const state = () => boxes.map((box) => box.dataset.shown === "voxels" ? "v" : "p").join("");
const until = async (what, condition) => {
  for (let n = 0; n < 1500 && !condition(); n++) await new Promise((done) => setTimeout(done, 20));
  told.push(what + " " + state());
};
const drawn = () => state().split("v").length - 1;
const tap = (box) => box.dispatchEvent(new PointerEvent("pointerdown"));
(async () => {
  await until("loaded", () => drawn() === 12);
  const canvas = boxes[0].querySelector("canvas");
  canvas.focus();
  canvas.getContext("webgl2").getExtension("WEBGL_lose_context").loseContext();
  await until("lost", () => drawn() === 11);
  await until("again", () => drawn() === 12);
  told.push(boxes[0].contains(document.activeElement) ? "focused" : "lost focus");
  tap(boxes[13]);
  await until("tapped", () => state()[13] === "v");
  boxes[5].remove();
  tap(boxes[12]);
  await until("removed", () => state()[12] === "v");
  tell(told);
})();
"""


INPUT = """
let eye = "";
const set = WebGL2RenderingContext.prototype.uniform3f;
WebGL2RenderingContext.prototype.uniform3f = function (place, ...values) {
  eye = values.join();
  set.call(this, place, ...values);
};
const frames = async () => { for (let n = 0; n < 3; n++) await new Promise(requestAnimationFrame); };
const told = [], box = document.querySelector(".voxels");
(async () => {
  while (box.dataset.shown !== "voxels") await new Promise((done) => setTimeout(done, 20));
  const canvas = box.querySelector("canvas");
  canvas.setPointerCapture = () => {}; // of pointers that are none
  const send = (kind, clientX, more) =>
    canvas.dispatchEvent(new PointerEvent(kind, { clientX, clientY: 20, pointerId: 1, bubbles: true, ...more }));
  const moves = async (name, action) => {
    await frames();
    const before = eye;
    action();
    await frames();
    told.push(`${name} ${eye === before ? "stays" : "moves"}`);
  };
  send("pointerdown", 10, { buttons: 1 });
  send("pointerup", 10); // it no longer turns by itself
  await moves("hover", () => send("pointermove", 40, { buttons: 0 }));
  await moves("drag", () => {
    send("pointerdown", 10, { buttons: 1 });
    send("pointermove", 40, { buttons: 1 });
  });
  await moves("release-unseen", () => send("pointermove", 70, { buttons: 0 }));
  await moves("move-after", () => send("pointermove", 90, { buttons: 1 }));
  await moves("right", () => {
    send("pointerdown", 10, { button: 2, buttons: 2 });
    send("pointermove", 40, { buttons: 2 });
  });
  send("pointerdown", 10, { buttons: 1 });
  send("lostpointercapture", 10);
  await moves("capture-lost", () => send("pointermove", 40, { buttons: 1 }));
  for (const pointerId of [2, 3]) send("pointerdown", 10 * pointerId, { pointerId, buttons: 1 });
  await moves("two-fingers", () => send("pointermove", 40, { pointerId: 3, buttons: 1 }));
  for (const modifier of ["none", "ctrlKey", "metaKey", "altKey"]) for (const key of ["+", "ArrowLeft"]) {
    const event = new KeyboardEvent("keydown", { key, cancelable: true, [modifier]: true });
    canvas.dispatchEvent(event);
    told.push(`${modifier}${key} ${event.defaultPrevented ? "moves" : "stays"}`);
  }
  tell(told);
})();
"""

ADDRESSES = """
const box = document.querySelector(".voxels"), pose = "1,0,0,0,0,1,0,0,0,0,1,2,";
const addresses = ["9,9,4,4,0,8", "9,9,4,4,-5,8", "9,9,4,4,10.5,8", "9,9,4,4,8,100000", "0,9,4,4,8,8", "9,9,4,4,12,8"];
const told = JSON.parse(sessionStorage.told || "[]");
(async () => {
  while (box.dataset.shown !== "voxels") await new Promise((done) => setTimeout(done, 20));
  const { style, width, height } = box.querySelector("canvas");
  told.push(style.position === "fixed" ? `${width}x${height}` : "turns");
  sessionStorage.told = JSON.stringify(told);
  const next = addresses[told.length - 1];
  if (next) location.hash = "#camera=" + pose + next;
  setTimeout(() => tell(told), next ? 5000 : 100); // unless it is loaded anew
})();
"""


TELL = """
const tell = async (told) => {
  const next = await fetch(location.pathname, { method: "POST", body: told.join(", ") });
  location.href = await next.text();
};
"""


class Listener(BaseHTTPRequestHandler):
    """A server of pages, each of which posts its results and opens the next one."""

    pages, loads, told = {}, {}, {}

    def do_GET(self):
        if self.path in self.pages:
            self.loads[self.path] = self.loads.get(self.path, 0) + 1
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.pages.get(self.path, b""))

    def do_POST(self):
        self.told[self.path] = self.rfile.read(int(self.headers["Content-Length"])).decode().split(", ")
        self.send_response(200)
        self.end_headers()
        self.wfile.write(next((path for path in self.pages if path not in self.told), "about:blank").encode())

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def heard(small, tmp_path_factory):
    """A function of a path: the results that its page posted from a browser, and how often it was loaded."""
    folder, pages = tmp_path_factory.mktemp("pages"), {}
    for path, count, script in (("/many", 18, STORY), ("/input", 1, INPUT), ("/addresses", 1, ADDRESSES)):
        fragments = [*[small] * count, f"<script>{TELL}{script}</script>"]
        pages[path] = save_page("\n".join(fragments), folder / "page.html", path).read_bytes()
    listener = type("Heard", (Listener,), {"pages": pages, "loads": {}, "told": {}})
    flags = [each for each in FLAGS if not each.startswith("--virtual-time")]
    with ThreadingHTTPServer(("127.0.0.1", 0), listener) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        command = [str(chromium), *flags, f"--user-data-dir={folder / 'profile'}", "--remote-debugging-port=0"]
        address = f"http://127.0.0.1:{server.server_port}{next(iter(pages))}"
        browser = subprocess.Popen([*command, address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            deadline = time.monotonic() + 120
            while len(listener.told) < len(pages) and time.monotonic() < deadline:
                if max(listener.loads.values(), default=0) > MOST_LOADS:
                    break
                time.sleep(0.05)
        finally:
            browser.terminate()
            browser.wait(20)
            server.shutdown()

    def of(path):
        assert path in listener.told, f"{path} told nothing"
        return listener.told[path], listener.loads[path]

    return of


MOST_LOADS = 9
"""Of one page, after which it is not waited for any longer: it would be loaded for ever."""


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_of_many_viewers_twelve_render_and_tapped_or_lost_ones_are_restored(heard):
    told, loads = heard("/many")
    states = dict(each.split(" ") for each in told if "focus" not in each)
    assert states["loaded"] == states["again"] == "v" * 12 + "p" * 6
    assert states["lost"] == "p" + "v" * 11 + "p" * 6
    assert states["tapped"].count("v") == 12
    assert states["tapped"][13] == "v"
    assert states["removed"][12] == "v"
    assert "focused" in told
    assert loads == 1


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_the_object_turns_with_the_primary_button_and_keys_without_modifiers(heard):
    found = dict(each.split(" ") for each in heard("/input")[0])
    assert found == {
        "hover": "stays",
        "drag": "moves",
        "release-unseen": "stays",
        "move-after": "stays",
        "right": "stays",
        "capture-lost": "stays",
        "two-fingers": "moves",
        **dict.fromkeys(["none+", "noneArrowLeft"], "moves"),
        **dict.fromkeys([f"{each}Key{key}" for each in ("ctrl", "meta", "alt") for key in ("+", "ArrowLeft")], "stays"),
    }


@pytest.mark.skipif(chromium is None, reason="chromium is not installed; apt-get install chromium")
def test_a_typed_camera_address_is_used_only_if_it_is_valid(heard):
    assert heard("/addresses")[0] == ["turns"] * 6 + ["12x8"]


def test_a_page_is_one_file_without_external_resources(coarse, views, tmp_path, monkeypatch):
    monkeypatch.setattr("hyperplanes.export.page.TURNTABLE_SIZE", 32)
    picture = turning_picture(coarse, views)
    text = save_page(page_of(coarse, views, picture=picture), tmp_path / "page.html", "Two <balls>").read_text()
    assert "<title>Two &lt;balls&gt;</title>" in text
    assert "data:image/webp;base64," in text
    assert not [word for word in ("http:", "https:", 'src="/', "import(", "fetch(") if word in text]


def test_a_too_large_page_is_written_with_less_precision_or_refused(coarse, views, tmp_path):
    """The limit is for the whole file, including the picture, the viewer and the longest title."""
    picture = bytes(4000)
    whole = len(page_of(coarse, views, picture=picture).encode())
    limit = whole - 1
    smaller = page_of(coarse, views, picture=picture, largest=limit)
    assert len(smaller.encode()) <= limit
    assert len(page_of(coarse, views, picture=picture, largest=int(0.8 * whole))) < 0.8 * whole
    assert save_page(smaller, tmp_path / "page.html", 255 * '"').stat().st_size <= limit + PAGE_FRAME_BYTES
    with pytest.raises(ValueError, match=r"page: expected at most 0.001 MB, got .* and a picture of 0.004 MB"):
        page_of(coarse, views, picture=picture, largest=1000)
