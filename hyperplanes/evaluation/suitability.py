"""Warnings about a model on given views: before it adapts, if it is likely to do badly, and after, if it did badly."""

from __future__ import annotations

import torch

from hyperplanes.adaptation.base import Renderable, masks_problem, no_masks_warning
from hyperplanes.adaptation.baselines.nearest_view import NearestView
from hyperplanes.adaptation.context import observe
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.network import in_use
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views

__all__ = ["FEWEST_VIEWS", "held_out_psnr", "suitability_warnings", "worse_than_copying"]

# standardised codes, root mean square: 0.7 to 2 for held-out objects of a trained class, others 3.3 to 8
MAX_CODE_DISTANCE = 3.0
ELSEWHERE = 30.0  # mean degrees between the directions of cameras and of the planes that they fill, above which to warn
FEWEST_VIEWS = 4  # of which some are held out
MAX_HELD_OUT = 4  # most held-out views, and pixels along their longer side
HELD_OUT_SIZE = 64
SHOWN_SIZE = 4 * HELD_OUT_SIZE


def suitability_warnings(model: HyperPlanes, shown: Views, steps: object = 0) -> list[str]:
    """Warnings, before adapting, about views of which the model is likely to make bad pictures. Each is one sentence.

    Args:
        model: the model that will adapt.
        shown: the support views.
        steps: the requested fine-tuning steps.
    """
    found = []
    if problem := masks_problem(shown):
        found.append(f"{problem}, or give --learn-background")
    planes = model.config.network.planes
    if len(shown) < planes and len(model.known_rig):
        stated = f"{len(shown)} support views are given and the model was trained with {planes}"
        found.append(f"{stated}: some views fill several planes")
    unlike, angle = _unlikeness(model, shown)
    if unlike is not None and unlike > MAX_CODE_DISTANCE:
        found.append(
            f"the images differ from those of the training, {unlike:.1f} times as much as those among each other"
            + ("" if steps or len(shown) < 2 else "; --steps 100 adapts to them")
        )
    if angle > ELSEWHERE and len(shown) >= planes:
        found.append(
            f"the directions of the cameras differ by {angle:.0f} degrees from those of the training, on average"
        )
    return found


def worse_than_copying(shown: Views, rendered: float, copied: float, steps: object) -> list[str]:
    """A warning if the pictures of a field are worse than copies of the nearest support view; otherwise no warning.

    Args:
        shown: the support views.
        rendered: PSNR of the field in dB.
        copied: PSNR of the nearest view in dB.
        steps: the requested fine-tuning steps; None for a baked file, which takes none.
    """
    if rendered >= copied:
        return []
    advice = "`hyperplanes inspect` checks images, masks and poses"
    if steps == 0 and len(shown) > 1:
        advice += ", and --steps 100 adapts the model to the views"
    advice = "cut the object out first" if masks_problem(shown) else advice
    return [f"worse than copying the nearest view: {rendered:.2f} dB against {copied:.2f} dB; {advice}"]


def held_out_psnr(model: HyperPlanes, shown: Views) -> tuple[float, float] | None:
    """PSNR on held-out support views: of the field after one forward pass, and of copies of the nearest view.

    Up to four views are held out and rendered with 64 pixels along the longer side; the others are given to the model
    with at most 256 pixels. There is no residual correction, because that would render all support views.

    Args:
        model: the model that adapts.
        shown: the support views, of which some are held out.

    Returns:
        Both values in dB; None with fewer than FEWEST_VIEWS views.
    """
    if len(shown) < FEWEST_VIEWS:
        return None
    holdout = torch.linspace(0, len(shown) - 1, min(MAX_HELD_OUT, len(shown) // 2) + 2)[1:-1].round().long()
    rest = [index for index in range(len(shown)) if index not in holdout.tolist()]
    shown = shown.resized(SHOWN_SIZE)
    left_out, remaining = shown[holdout].resized(HELD_OUT_SIZE), shown[rest]
    with no_masks_warning():
        fields: list[Renderable] = [model.adapt(remaining).without_residuals(), NearestView().adapt(remaining)]
    pictures = (each.render(left_out.cameras).images.clamp(0, 1) for each in fields)
    first, second = (float(psnr(images, left_out.images).mean()) for images in pictures)
    return first, second


def _unlikeness(model: HyperPlanes, shown: Views) -> tuple[float | None, float]:
    """The root mean square of the standardised codes, or None without codes; and the mean angle to the training's rig.

    The angle is in degrees, between the cameras and the planes that they fill; 0 without a rig.
    """
    network, rig, angle = model.hypernetwork, model.known_rig.positions, 0.0
    if not len(rig) and (network is None or network.reads_volume):
        return None, angle
    with torch.no_grad():
        context = model.prepare(shown, carved=False)
        if len(rig):
            cosine = (context.views.camera_directions.to(rig) * rig).sum(-1)
            angle = float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).mean())
        with in_use(model):
            codes = None if network is None else network.standardised_codes(observe([context], network.resolution))
    return None if codes is None else float(codes.square().mean().sqrt()), angle
