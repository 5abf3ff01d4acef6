"""Calls of public functions with one wrong argument have to raise a one-line error or return finite numbers.

Case number i of a seed is always the same: `python -m tests.fuzz --calls 1 --only i --seed SEED`.
"""

import json
import math
import os
import random
import warnings
from dataclasses import fields, is_dataclass
from pathlib import Path

import jaxtyping
import numpy as np
import torch

import hyperplanes as hp
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.data import read_channel
from hyperplanes.data.camera_path import read_camera_path
from hyperplanes.export.baking import BakedScene, bake
from hyperplanes.export.images import encode_animation, orbit_cameras, to_pixels
from hyperplanes.export.outputs import save_outputs
from hyperplanes.export.splats import fit_splats, save_splats, splats_of
from hyperplanes.export.surfaces.points import point_cloud, save_points
from hyperplanes.geometry import Sphere, cameras, occupancy, poses, rays
from hyperplanes.geometry import lookup as lookups
from hyperplanes.rendering.depth import seen_surface
from hyperplanes.rendering.renderer import Hierarchical, RayMarching
from tests.fuzz.campaign import Failure, Hang, time_limit
from tests.fuzz.corpus import archive, baked, data_set, posed_scene, small_model


def fog(points, directions):
    """A grey field of low density."""
    return torch.full_like(points, 0.5), torch.ones(len(points))


def wall(points, directions):
    """A grey field that is opaque."""
    return torch.full_like(points, 0.5), torch.full((len(points),), 1e3)


def make_calls(home):
    """Functions with valid arguments, by name."""
    posed_scene(home / "scene")
    data_set(home / "data")
    archive(home / "archive")
    baked(home / "baked")
    model = small_model()
    model.save(home / "model")
    task = hp.read_task(home / "scene")
    views = hp.read_views(home / "scene")
    images, batch = views.images, views.cameras
    field = model.adapt(views)
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    planes = hp.ImagePlanes(images, batch)
    traced = rays.cast(batch, torch.zeros(4, dtype=torch.long), rays.pixel_grid(2, 2), views.bounds)
    data, voxels = hp.open_dataset(home / "data"), bake(field, side=16)
    splats, out = splats_of(voxels), home / "written"
    matrix, pose = cameras.intrinsics(batch)[0], cameras.camera_from_world(batch)
    surface = hp.extract_mesh(field, voxels=8, level=1e-6)
    few = hp.FineTuning(rays=16, max_steps=2)
    shown = hp.render(wall, batch, bounds=Sphere())
    frame = {"camera_to_world": torch.eye(4).flatten().tolist(), "fov": 50.0}
    path = {"render_width": 8, "render_height": 4, "seconds": 1.0, "camera_path": [frame]}
    (home / "path.json").write_text(json.dumps(path))
    (home / "world.json").write_text(json.dumps({"transform": torch.eye(4).tolist(), "scale": 1.0}))
    calls = {
        "read_views": (hp.read_views, {"path": home / "scene", "downscale": 1, "up": "y"}),
        "read_task": (hp.read_task, {"path": home / "scene", "downscale": 1, "up": "auto"}),
        "open_dataset": (hp.open_dataset, {"path": home / "data", "budget": 1000, "legacy": False}),
        "Dataset.task": (data.task, {"name": "a"}),
        "Dataset.names": (data.names, {"split": "train"}),
        "read_channel": (read_channel, {"folder": home / "archive", "channel": "depth"}),
        "Views": (hp.Views, {"images": images, "cameras": batch, "masks": views.masks, "bounds": views.bounds}),
        "Views[]": (views.__getitem__, {"index": [0, 1]}),
        "Views.rays": (views.rays, {"view": 0, "near_far": "sphere"}),
        "Views.sample_rays": (views.sample_rays, {"count": 3, "among": torch.arange(5)}),
        "Views.to": (views.to, {"device": "cpu", "dtype": torch.float32}),
        "Task": (hp.Task, {"support": task.support, "query": task.query, "name": "a"}),
        "Sphere": (Sphere, {"centre": (0.0, 0.0, 0.0), "radius": 1.0}),
        "pinhole": (cameras.pinhole, {"intrinsics": matrix, "camera_from_world": pose, "height": 10, "width": 12}),
        "symmetric_intrinsics": (cameras.symmetric_intrinsics, {"height": 4, "width": 5, "field_of_view": 0.7}),
        "resized": (cameras.resized, {"cameras": batch, "height": 4, "width": 5}),
        "cropped": (cameras.cropped, {"cameras": batch, "height": 4, "width": 5}),
        "with_poses": (cameras.with_poses, {"cameras": batch, "camera_from_world": pose}),
        "moved": (cameras.moved, {"cameras": batch, "motion": torch.eye(4, dtype=torch.float64)}),
        "select": (cameras.select, {"cameras": batch, "index": [0, 1]}),
        "look_at": (poses.look_at, {"eyes": points, "target": (1.0, 1.0, 1.0)}),
        "orbit": (poses.orbit, {"views": 3, "distance": 2.0, "elevation": 0.3}),
        "fibonacci_sphere": (poses.fibonacci_sphere, {"views": 3, "distance": 2.0}),
        "cast": (rays.cast, {"cameras": batch, "view": torch.zeros(1, dtype=torch.long),
                             "pixels": torch.zeros(1, 2), "bounds": views.bounds}),
        "carve": (occupancy.carve, {"masks": views.masks, "cameras": batch, "bounds": views.bounds, "side": 8}),
        "full": (occupancy.full, {"bounds": views.bounds, "side": 8}),
        "ImagePlanes": (hp.ImagePlanes, {"images": images, "cameras": batch, "background": 1.0}),
        "ImagePlanes.lookup": (planes.lookup, {"points": points, "views": torch.zeros(5, 1, dtype=torch.long)}),
        "lookup": (lookups.lookup, {"points": points, "matrices": cameras.projection_matrices(batch),
                                    "images": images, "background": 1.0}),
        "sample": (lookups.sample, {"images": images, "coordinates": torch.zeros(3, len(images), 2)}),
        "render": (hp.render, {"field": fog, "target": batch, "sampling": RayMarching(8), "bounds": Sphere(),
                               "background": 1.0, "chunk": 100}),
        "render rays": (hp.render, {"field": fog, "target": traced, "sampling": Hierarchical(4, 4), "chunk": 2}),
        "psnr": (hp.psnr, {"predicted": images, "truth": images * 0.9}),
        "ssim": (hp.ssim, {"predicted": images.repeat(1, 1, 2, 2), "truth": images.repeat(1, 1, 2, 2) * 0.9}),
        "preset": (hp.preset, {"name": "quick"}),
        "from_pretrained": (hp.HyperPlanes.from_pretrained, {"name": home / "model"}),
        "adapt": (model.adapt, {"support": views}),
        "fine_tune": (model.fine_tune, {"support": views, "steps": 1, "settings": few}),
        "save": (model.save, {"folder": out, "dtype": torch.float32}),
        "NearestView": (hp.NearestView().adapt, {"support": views}),
        "HullBlend": (HullBlend().adapt, {"support": views}),
        "AdaptedField.render": (field.render, {"cameras": batch, "sampling": RayMarching(8)}),
        "evaluate": (hp.evaluate, {"method": "nearest", "adapter": hp.NearestView(), "data": data, "names": ["a"]}),
        "FineTuning": (hp.FineTuning, {"rays": 16, "optimiser": "adam", "learning_rate": 1e-3, "holdout": 2,
                                       "final_rate_factor": 0.1, "fresh": 0.5, "seed": 0, "max_steps": 3}),
        "TrainingConfig": (TrainingConfig, {"steps": 1, "rays": 8, "evaluate_every": 1, "learning_rate": 1e-3,
                                            "rotations": 0.5, "views": (2,), "optimiser": "adam", "seed": 1}),
        "RayMarching": (RayMarching, {"steps": 8, "stop": 0.1}),
        "Hierarchical": (Hierarchical, {"coarse": 8, "fine": 8, "placement": "samples"}),
        "Trainer": (hp.Trainer, {"model": model, "data": data, "config": TrainingConfig(steps=1, rays=8, tasks=1)}),
        "save_images": (hp.save_images, {"images": images, "folder": out, "names": ["a", "b", "c", "d"]}),
        "to_pixels": (to_pixels, {"images": images}),
        "encode_animation": (encode_animation, {"frames": to_pixels(images), "kind": "gif", "seconds": 1.0}),
        "orbit_cameras": (orbit_cameras, {"views": views, "count": 3, "size": 8, "elevation": 0.3}),
        "save_turntable": (hp.save_turntable, {"field": field, "views": views, "path": out / "a.gif", "frames": 2}),
        "bake": (bake, {"adapted": field, "side": 8}),
        "splats_of": (splats_of, {"baked": voxels}),
        "fit_splats": (fit_splats, {"splats": splats, "views": views, "steps": 1}),
        "save_splats": (save_splats, {"splats": splats, "path": out / "a.ply"}),
        "read_camera_path": (read_camera_path, {"path": home / "path.json", "transforms": home / "world.json",
                                                "scene": {"applied_scale": 2.0}}),
        "seen_surface": (seen_surface, {"pictures": shown, "cameras": batch}),
        "save_outputs": (save_outputs, {"outputs": ["depth", "normals"], "pictures": shown, "cameras": batch,
                                        "folder": out, "names": ["a", "b", "c", "d"]}),
        "point_cloud": (point_cloud, {"pictures": shown, "cameras": batch, "bounds": Sphere(), "count": 20}),
        "save_points": (save_points, {"cloud": point_cloud(shown, batch, Sphere()), "path": out / "points.ply"}),
        "BakedScene.render": (BakedScene(voxels).render, {"cameras": batch}),
        "save_mesh": (hp.save_mesh, {"surface": surface, "path": out / "b.ply"}),
        "extract_mesh": (hp.extract_mesh, {"field": field, "voxels": 8, "level": 1e-6}),
    }  # fmt: skip
    return calls


def wrong_value(value, draw):
    """A value of another type, shape or size than the valid one."""
    if isinstance(value, torch.Tensor) and draw.random() < 0.7:
        return draw.choice(TENSORS)(value)
    if isinstance(value, hp.Views) and draw.random() < 0.6:
        return draw.choice(VIEWS)(value)
    if isinstance(value, int | float) and draw.random() < 0.5:
        return draw.choice([-value, 0, -1, str(value), [value], np.float64(value), np.array(value), math.nan, math.inf])
    return draw.choice(ANYTHING)


ANYTHING = [
    *(None, "white", "", -1, 0, 2.5, math.nan, math.inf, -math.inf, True, [], {}, (), object(), 10**30, "../a", b"a"),
    *(np.zeros(3), torch.zeros(3), torch.zeros(2, 3), torch.tensor(1), lambda *_: None, int),
]
TENSORS = [
    lambda value: value.numpy(),
    lambda value: value.tolist(),
    lambda value: value[0],
    lambda value: value[None],
    lambda value: value[:0],
    lambda value: value[..., :-1],
    lambda value: value.transpose(0, -1),
    lambda value: value * 255,
    lambda value: -value - 1,
    lambda value: value * math.inf,
    lambda value: value * math.nan if value.is_floating_point() else value + 10**6,
    lambda value: value.to(torch.uint8),
    lambda value: value.to(torch.complex64),
    lambda value: value.double(),
    lambda value: value.half(),
    lambda value: value.clone().requires_grad_() if value.is_floating_point() else value.int(),
]
VIEWS = [
    lambda value: value[:0],
    lambda value: value[:1],
    lambda value: value.images,
    lambda value: value.cameras,
    lambda value: value.to(dtype=torch.float64),
    lambda value: [value, value],
    lambda value: (value, value),
    lambda value: hp.Views(value.images, value.cameras),
    lambda value: hp.Views(value.images * 0, value.cameras, value.masks * 0),
]


def _numbers(value):
    """All tensors and arrays in a result."""
    if isinstance(value, torch.Tensor | np.ndarray):
        yield torch.as_tensor(value)
    elif is_dataclass(value) and not isinstance(value, type):
        for each in fields(value):
            yield from _numbers(getattr(value, each.name))
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _numbers(each)


def judge_call(function, arguments, finite=True):
    """The failure of a call, as text; None if it returned a valid result or a one-line error.

    Args:
        function: the function.
        arguments: its arguments by name.
        finite: whether the result must have no NaN. It may have some if an argument is not finite.
    """
    try:
        with time_limit(), warnings.catch_warnings(), torch.random.fork_rng():
            warnings.simplefilter("ignore")
            result = function(**arguments)
    except Hang:
        return "not done in time"
    except ValueError as error:
        text = str(error)
        foreign = ("shape mismatch", "not enough values", "too many values", "could not convert", "must match")
        if "\n" in text or not text or any(part in text for part in foreign):
            return f"ValueError: {text!r}"
        return None
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    for found in _numbers(result) if finite else ():
        if found.is_floating_point() and not found.is_meta and bool(found.isnan().any()):
            return f"answered with NaN, {tuple(found.shape)}"
    return None


def run_calls(cases, seed, home, report=lambda failure: None):
    """Run these cases as users do, without the type checks of the tests.

    Args:
        cases: numbers of the cases.
        seed: seed of the campaign.
        home: an empty folder to work in.
        report: called with each failure when it is found.

    Returns:
        One `Failure` for each case that failed.
    """
    before, place = jaxtyping.config.jaxtyping_disable, Path.cwd()
    jaxtyping.config.update("jaxtyping_disable", True)
    os.chdir(home)  # some names are relative to this folder
    try:
        calls, failures = make_calls(home), []
        for name, (function, arguments) in calls.items():
            assert (wrong := judge_call(function, arguments)) is None, f"{name}: a right call: {wrong}"
        for case in cases:
            draw = random.Random(f"{seed} {case}")
            name = draw.choice(sorted(calls))
            function, arguments = calls[name]
            which = draw.choice(sorted(arguments))
            value = wrong_value(arguments[which], draw)
            finite = not isinstance(value, torch.Tensor) or bool(value.isfinite().all())
            wrong = judge_call(function, arguments | {which: value}, finite)
            if wrong is not None:
                shown = " ".join(repr(value).split())[:80]
                failures.append(Failure(case, "call", f"{name}({which}={shown})", wrong))
                report(failures[-1])
        return failures
    finally:
        os.chdir(place)
        jaxtyping.config.update("jaxtyping_disable", before)
