"""Live view of a changing field in the browser, by viser: the extra `viz`."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from torch import Tensor

from hyperplanes.adaptation.base import Renderable
from hyperplanes.export.images import orbit_cameras, to_pixels, upward
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering.images import Pictures
from hyperplanes.utilities.messages.errors import MissingPackageError
from hyperplanes.views import Views

__all__ = ["LiveViewer", "beside", "require_viewer", "viewed_camera"]

LOG = logging.getLogger(__name__)

SECONDS = 0.15  # largest rendering time of a picture while the camera moves
IDLE = 0.4  # seconds without motion after which a larger picture is rendered
SHARPER = 2.5  # times as large
MIN_HEIGHT, MAX_HEIGHT = 48, 1024  # pixels of height
MAX_WIDTH = 4096  # pixels of width
THUMBNAIL = 128  # pixels of a photograph in its frustum
ALONE = "nothing"  # the default choice for what is shown beside the field


@dataclass
class _Visit:
    """Times of a visitor's last change (of camera or field) and last picture, and whether the last picture is final."""

    moved: float
    drawn: float = 0.0
    finished: bool = False

    def move(self) -> None:
        """Note that a picture is due."""
        self.moved, self.finished = time.monotonic(), False

    @property
    def due(self) -> float:
        """When the next picture is due: at once after a change, and a larger one once the camera stands still."""
        return math.inf if self.finished else self.moved + IDLE * (self.drawn >= self.moved)


def viewed_camera(
    rotation: Sequence[float], position: Sequence[float], fov: float, aspect: float, height: int
) -> PinholeCamera:
    """The camera of a visitor.

    Args:
        rotation: world_from_camera as a unit quaternion, w first; OpenCV's axes.
        position: in the world.
        fov: vertical field of view in radians.
        aspect: width over height.
        height: pixels; reduced where the width would exceed MAX_WIDTH.

    Raises:
        ValueError: impossible values, as browsers send them for a page without a size.
    """
    if not _has_size(fov, aspect):
        raise ValueError(f"camera: expected an aspect above 0 and an angle below 180 degrees, got {aspect}, {fov}")
    height = max(1, min(height, round(MAX_WIDTH / aspect)))
    pose = torch.eye(4)
    pose[:3, :3] = quaternion_to_rotation_matrix(torch.tensor([float(part) for part in rotation])).T
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([float(part) for part in position])
    width = max(1, min(MAX_WIDTH, round(height * aspect)))
    focal = height / 2 / math.tan(fov / 2)
    intrinsics = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return camera.pinhole(intrinsics, pose[None], height, width)


def _has_size(fov: float, aspect: float) -> bool:
    """Whether the page is visible, by its field of view and aspect."""
    return 0 < aspect < math.inf and 0 < fov < math.pi


def beside(left: Pictures, right: Pictures) -> Float[Tensor, "view 3 height width"]:
    """The left half of one method's pictures and the right half of another's, with a grey line between them."""
    middle = left.images.shape[-1] // 2
    images = torch.cat([left.images[..., :middle], right.images[..., middle:]], -1)
    images[..., middle] = 0.5
    return images


def require_viewer() -> None:
    """Check that viser is installed.

    Raises:
        MissingPackageError: it is not.
    """
    if find_spec("viser") is None:
        raise MissingPackageError("expected the package viser, found none; pip install 'hyperplanes[viz]'")


class LiveViewer:
    """A local web page that shows each visitor a field from their camera.

    Args:
        views: the support views, whose cameras are drawn as frusta with their photographs.
        port: of the page.
        on_number: called with the number of views when a visitor moves the slider; no slider if absent.
        others: names of other methods, one of which visitors may show beside the field; `show_other` sets their
            fields.

    Raises:
        MissingPackageError: viser is not installed.
    """

    def __init__(
        self,
        views: Views,
        port: int = 8080,
        on_number: Callable[[int], None] | None = None,
        others: Sequence[str] = (),
    ) -> None:
        require_viewer()
        import viser

        self._shown: Renderable | None = None
        self._others: dict[str, Renderable | None] = {}
        self._notes: dict[str, str] = {}  # of the other methods
        self._chosen = ALONE
        self._changed, self._stopped = threading.Condition(), False
        self._visits: dict[int, _Visit] = {}
        self._height = 96
        self._views = views.to("cpu", torch.float32)
        self._server = viser.ViserServer("127.0.0.1", port, label="HyperPlanes", verbose=False)
        self._server.scene.set_up_direction(upward(self._views.cameras))
        self._note, self._text = self._server.gui.add_markdown(""), ""
        show_frusta = self._add_frusta()
        if on_number is not None:
            slider = self._server.gui.add_slider("support views", 1, len(views), 1, len(views))

            @slider.on_update
            def _(_: object) -> None:
                show_frusta(int(slider.value))
                on_number(int(slider.value))

        if others:
            choice = self._server.gui.add_dropdown("on the right", (ALONE, *others), initial_value=others[0])
            choice.on_update(lambda _: self._choose(choice.value))
            self._chosen = others[0]
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._leave)
        self._worker = threading.Thread(target=self._draw, daemon=True)
        self._worker.start()

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://127.0.0.1:{self._server.get_port()}"

    def show(self, shown: Renderable, note: str) -> None:
        """Show another field, or the same one after it changed.

        Args:
            shown: the field.
            note: text about it, beside the picture.
        """
        with self._changed:
            self._shown, self._text = shown, note
            self._draw_anew()

    def show_other(self, name: str, shown: Renderable | None, note: str = "") -> None:
        """Set the field that another method makes of the same views.

        Args:
            name: one of `others`.
            shown: its field; None if it has none, so that the field fills the picture.
            note: text about it, below that about the field.
        """
        with self._changed:
            self._others[name], self._notes[name] = shown, note
            self._draw_anew()

    def _choose(self, name: str) -> None:
        with self._changed:
            self._chosen = name
            self._draw_anew()

    def _notes_shown(self) -> str:
        """The notes about the field and the method beside it, as two paragraphs of Markdown."""
        return "\n\n".join(filter(None, [self._text, self._notes.get(self._chosen)]))

    def _draw_anew(self) -> None:
        """Redraw for every visitor; the caller holds the lock."""
        self._note.content = self._notes_shown()
        for visit in self._visits.values():
            visit.move()
        self._changed.notify()

    def stop(self) -> None:
        """Close the page."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._worker.join(10)
        self._server.stop()

    def _add_frusta(self) -> Callable[[int], None]:
        """Add the frusta of all views; return a function that shows those of the first views alone."""
        cameras = self._views.cameras
        height, width = camera.image_size(cameras)
        every = max(1, max(height, width) // THUMBNAIL)
        pictures = to_pixels(self._views.images[..., ::every, ::every])
        rotations = camera.camera_from_world(cameras)[:, :3, :3].mT
        frusta = []
        for view, (picture, place) in enumerate(zip(pictures, camera.centres(cameras).tolist(), strict=True)):
            focal = float(camera.intrinsics(cameras)[view, 1, 1])
            frusta.append(
                self._server.scene.add_camera_frustum(
                    f"/photographs/{view}",
                    2 * math.atan(height / 2 / focal),
                    width / height,
                    scale=0.08 * self._views.bounds.radius,
                    thickness=1.0,
                    thickness_units="screen",
                    image=picture,
                    wxyz=_quaternion(rotations[view]),
                    position=tuple(place),
                )
            )
        switch, number = self._server.gui.add_checkbox("photographs", True), len(frusta)

        def show(first: int) -> None:
            nonlocal number
            number = first
            for view, frustum in enumerate(frusta):
                frustum.visible = switch.value and view < number

        switch.on_update(lambda _: show(number))
        return show

    def _welcome(self, client: object) -> None:
        start = orbit_cameras(self._views, 1)
        x, y, z = camera.centres(start)[0].tolist()
        client.camera.up_direction = upward(self._views.cameras)  # pyright: ignore
        client.camera.position = (x, y, z)  # pyright: ignore
        client.camera.look_at = self._views.bounds.centre  # pyright: ignore

        visit = _Visit(time.monotonic())

        def moved(_: object) -> None:
            with self._changed:
                visit.move()
                self._changed.notify()

        client.camera.on_update(moved)  # pyright: ignore
        with self._changed:
            self._visits[client.client_id] = visit  # pyright: ignore
            self._changed.notify()

    def _leave(self, client: object) -> None:
        with self._changed:
            self._visits.pop(client.client_id, None)  # pyright: ignore

    def _draw(self) -> None:
        """Render for each visitor whose camera moved, and once more, larger, when it stands still."""
        while True:
            with self._changed:
                if self._stopped:
                    return
                soonest = min((visit.due for visit in self._visits.values()), default=math.inf)
                now = time.monotonic()
                if self._shown is None or soonest > now:
                    self._changed.wait(None if self._shown is None or soonest == math.inf else soonest - now)
                    continue
                # the waiting visitor whose last picture is oldest
                waiting = [(visit.drawn, visitor) for visitor, visit in self._visits.items() if visit.due <= now]
                _, visitor = min(waiting)
                client = self._server.get_clients().get(visitor)
                if client is None:  # left before being set up
                    del self._visits[visitor]
                    continue
                shown, other, visit = self._shown, self._others.get(self._chosen), self._visits[visitor]
                moved, still = visit.moved, visit.drawn >= visit.moved
                visit.drawn, visit.finished = now, still
            try:
                drawn, failure = self._draw_for(client, shown, other, still), ""
            except Exception as error:  # concerns one picture of one visitor; the page goes on
                LOG.exception("a picture of the page could not be drawn")
                drawn, failure = False, f"a picture could not be drawn: {error}"
            with self._changed:
                if self._note.content != (note := failure or self._notes_shown()):
                    self._note.content = note
                # not again until the camera moves or the field changes
                visit.finished = visit.finished or (not drawn and visit.moved == moved)

    def _draw_for(self, client: object, shown: Renderable, other: Renderable | None, still: bool) -> bool:
        """Render one picture for one visitor; False if the visitor's page has no size.

        Args:
            client: viser's handle for the visitor.
            shown: what to render.
            other: what to render on the right half, if anything.
            still: whether the camera stands still, so that rendering may take longer.
        """
        height = min(MAX_HEIGHT, round(self._height * (SHARPER if still else 1)))
        eye = client.camera  # pyright: ignore
        if not _has_size(eye.fov, eye.aspect):
            return False
        seen = viewed_camera(eye.wxyz.tolist(), eye.position.tolist(), eye.fov, eye.aspect, height)
        started = time.perf_counter()
        found = shown.render(seen)
        picture = to_pixels(found.images if other is None else beside(found, other.render(seen)))[0]
        if not still:
            ratio = (SECONDS / max(1e-3, time.perf_counter() - started)) ** 0.5
            self._height = round(min(MAX_HEIGHT / SHARPER, max(MIN_HEIGHT, self._height * min(1.5, max(0.5, ratio)))))
        # lossless when it stands still: JPEG artefacts would be mistaken for the field's
        client.scene.set_background_image(picture, "png" if still else "jpeg", jpeg_quality=90)  # pyright: ignore
        return True


def _quaternion(matrix: Float[Tensor, "3 3"]) -> tuple[float, float, float, float]:
    w, x, y, z = rotation_matrix_to_quaternion(matrix.contiguous()).tolist()
    return w, x, y, z
