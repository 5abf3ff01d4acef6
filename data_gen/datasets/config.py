"""The configuration of a generation, and its resolution for each object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from typing import Any

from data_gen import SUPERSAMPLE
from data_gen.datasets.layouts import LAYOUTS
from data_gen.datasets.sources import seed_of
from data_gen.rigs import DEFAULT_DISTANCE, OBJECT_RADIUS, RIG_PRESETS, RIGS, Rig, make_rig
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["ENGINES", "GenerationConfig"]

ENGINES = ("local", "ray")
"""Where objects are rendered: in worker processes of this machine, or on a Ray cluster."""

VIEWS, RESOLUTION = 50, 64
FEWEST_VIEWS = 2
MOST_VIEWS, MOST_SAMPLES, MOST_BYTES = 10_000, 16_384, 4 * 2**30  # per object; along a side; of all its pictures
EXTRA_CHANNELS = {"depth": 4, "normals": 12, "coordinates": 12, "mesh": 0}  # bytes a pixel
_UNSEEN = {"held_out", "workers", "engine", "timeout", "recycle"}  # fields that do not affect pictures


@dataclass(frozen=True)
class GenerationConfig:
    """How objects are rendered into a data set.

    Attributes:
        rig: "fixed" (the same poses for all objects), "random" (on the sphere), "hemisphere", "orbit", "spiral", or a
            name in `data_gen.rigs.RIG_PRESETS`.
        views: pictures per object, alternately support and query; the preset's when None, else 50.
        resolution: pixels along a side; when None, what the layout's loaders assume or the preset's, else 64.
        lighting: "studio", "headlight" or "random".
        channels: "rgba" and any of "depth", "normals", "coordinates", "mesh"; more than rgba needs the native layout.
        held_out: objects for the test split, a count or a fraction below 1; see `data_gen.datasets.sources.list_items`.
        workers: processes; as many as cores when None.
        engine: "local", or "ray" for a Ray cluster.
        layout: a name in `data_gen.datasets.layouts.LAYOUTS`.
        seed: of random rigs and lights; that of shapes belongs to the source.
        distance: of the cameras from the object's centre in object radii; when None, what suits the layout or the
            preset.
        field_of_view: in degrees; the preset's when None, or the object just fits.
        supersample: samples along a side of a pixel.
        renderer: a name in `data_gen.rendering.renderers.RENDERERS`; when None, the best that works here.
        timeout: seconds an object may take.
        recycle: objects after which a worker is replaced.
    """

    rig: str = "fixed"
    views: int | None = None
    resolution: int | None = None
    lighting: str = "studio"
    channels: Sequence[str] = ("rgba",)
    held_out: float | int | None = None
    workers: int | None = None
    engine: str = "local"
    layout: str = "native"
    seed: int = 0
    distance: float | None = None
    field_of_view: float | None = None
    supersample: int = SUPERSAMPLE
    renderer: str | None = None
    timeout: float = 300.0
    recycle: int = 200

    def resolve(self) -> GenerationConfig:
        """Check everything, and fill in missing values from the layout, else the preset, else defaults.

        Returns:
            A configuration in which all that affects pictures has a value, except for a field of view of None, with
            which the object just fits, and a distance of None, which depends on the layout and the class. An
            unknown name, a number that makes no sense, or no renderer that works is a ValueError.
        """
        from data_gen.rendering.renderers import find_renderer

        return replace(self.resolve_except_renderer(), renderer=find_renderer(self.renderer).name)

    def resolve_except_renderer(self) -> GenerationConfig:
        """As `resolve`, but the renderer, which takes seconds to find, stays as it is and is not checked.

        Raises:
            ValueError: if a name is unknown, or a number makes no sense.
        """
        from data_gen.rendering.mesh_renderer import MAX_SUPERSAMPLE

        self._check_names()
        layout, preset = LAYOUTS[self.layout], RIG_PRESETS.get(self.rig)
        if self.resolution is not None and layout.resolution not in (None, self.resolution):
            raise ValueError(
                f"resolution: the {self.layout} layout's loaders assume {layout.resolution}, got {self.resolution}"
            )
        if self.field_of_view is not None and layout.field_of_view not in (None, self.field_of_view):
            raise ValueError(
                f"field_of_view: the {self.layout} layout's loaders assume {layout.field_of_view:.10g} degrees, "
                f"got {self.field_of_view:g}; leave it out"
            )
        if not 1 <= self.supersample <= MAX_SUPERSAMPLE:
            raise ValueError(f"supersample: expected 1 to {MAX_SUPERSAMPLE}, got {self.supersample}")
        distance, field_of_view = self.distance, self.field_of_view
        if distance is None and layout.planes is None:
            distance = preset.distance if preset else DEFAULT_DISTANCE
        if field_of_view is None and preset:
            field_of_view = preset.field_of_view
        views = self.views if self.views is not None else preset.views if preset else VIEWS
        resolution = layout.resolution if self.resolution is None else self.resolution
        if resolution is None:
            resolution = preset.resolution if preset else RESOLUTION
        channels = ("rgba", *sorted(set(self.channels) - {"rgba"}))
        if not 0 < self.timeout < math.inf:
            raise ValueError(f"timeout: expected seconds above 0, got {self.timeout:g}")
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers: expected at least 1, got {self.workers}")
        if self.engine == "ray" and find_spec("ray") is None:
            raise ValueError("engine: expected ray to be installed, found no such module; pip install ray")
        _check_sizes(views, resolution, self.supersample, channels)
        config = replace(
            self,
            views=views,
            resolution=resolution,
            distance=None if distance is None else float(distance),
            field_of_view=layout.field_of_view or field_of_view,
            channels=channels,
        )
        config.make_rig("")  # invalid numbers raise here, not in every worker
        return config

    def make_rig(self, name: str, class_name: str | None = None) -> Rig:
        """The cameras of an object, for a resolved configuration.

        Random rigs depend on the object's name, and the distance may depend on its class.
        """
        assert self.views is not None
        assert self.resolution is not None
        distance = LAYOUTS[self.layout].distance(class_name) if self.distance is None else self.distance
        lens = {"distance": distance, "field_of_view": self.field_of_view}
        return make_rig(self.rig, self.views, self.resolution, seed=self.seed_for("rig", name), **lens)

    def check_class(self, class_name: str | None) -> None:
        """Refuse a class that the layout's loaders do not know, or whose objects they would not see completely.

        Args:
            class_name: of objects; None if unknown.

        Raises:
            ValueError: the class or the distance does not suit the layout.
        """
        layout, rig = LAYOUTS[self.layout], self.make_rig("", class_name)
        if layout.classes is not None and class_name not in layout.classes:
            raise ValueError(
                f"class: expected {', '.join(layout.classes)}, which the loaders of the {self.layout} layout know, got "
                f"{class_name or 'meshes without a class; give --class-name'}"
            )
        planes = layout.near_far(class_name)
        if planes is not None and (rig.near < planes[0] - 1e-9 or rig.far > planes[1] + 1e-9):
            low, high = planes[0] + OBJECT_RADIUS, planes[1] - OBJECT_RADIUS
            raise ValueError(
                f"distance: expected {low:g} to {high:g} in the {self.layout} layout, whose loaders look from "
                f"{planes[0]:g} to {planes[1]:g} radii for {class_name or 'any class'}, got {self.distance:g}"
            )

    def seed_for(self, purpose: str, name: str) -> int:
        """A 32-bit seed for one purpose and one object."""
        return seed_of(self.seed, purpose, name) % 2**32

    def as_json(self) -> dict[str, Any]:
        """The values that affect pictures, as JSON."""
        fields = asdict(self) | {"channels": list(self.channels)}
        return {name: value for name, value in fields.items() if name not in _UNSEEN}

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> GenerationConfig:
        """The inverse of `as_json`."""
        return cls(**{**fields, "channels": tuple(fields["channels"])})

    def _check_names(self) -> None:
        from data_gen.rendering.lighting import LIGHTING_PRESETS

        known = {"rig": RIGS, "engine": ENGINES, "layout": tuple(LAYOUTS), "lighting": LIGHTING_PRESETS}
        for name, values in known.items():
            if getattr(self, name) not in values:
                given, near = getattr(self, name), did_you_mean(getattr(self, name), values)
                raise ValueError(f"{name}: expected one of {', '.join(values)}, got {given!r}{near}")
        channels = tuple(self.channels)
        if set(channels) - {"rgba", *EXTRA_CHANNELS} or "rgba" not in channels:
            raise ValueError(f"channels: expected rgba and any of {', '.join(EXTRA_CHANNELS)}, got {channels}")
        if self.layout != "native" and len(channels) > 1:
            raise ValueError(f"channels: expected rgba alone in the {self.layout} layout, got {channels}")


def _check_sizes(views: int, resolution: int, supersample: int, channels: Sequence[str]) -> None:
    """Check sizes before anything is allocated: all pictures of an object are in memory at once."""
    if not FEWEST_VIEWS <= views <= MOST_VIEWS:
        wanted = f"{FEWEST_VIEWS} (support and query) to {MOST_VIEWS:,} an object"
        raise ValueError(f"views: expected {wanted}, got {views:,}")
    if resolution * supersample > MOST_SAMPLES:
        raise ValueError(
            f"resolution: expected at most {MOST_SAMPLES:,} samples along a side, got {resolution:,} pixels of "
            f"{supersample} each"
        )
    needed = views * resolution**2 * (4 + sum(EXTRA_CHANNELS.get(channel, 0) for channel in channels))
    if needed > MOST_BYTES:
        raise ValueError(
            f"resolution: expected at most {MOST_BYTES >> 30} GiB of pictures an object, got {needed / 2**30:,.1f} GiB "
            f"({views:,} views of {resolution:,} x {resolution:,} pixels); take fewer of either"
        )
