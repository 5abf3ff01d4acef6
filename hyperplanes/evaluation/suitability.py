"""Whether a model can be expected to do well on some views, and whether it did: warnings before and after."""

from __future__ import annotations

import torch

from hyperplanes.adaptation.base import Renderable
from hyperplanes.adaptation.context import observe
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.nearest_view import NearestView
from hyperplanes.adaptation.network import in_use
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Views

__all__ = ["held_out_psnr", "suitability_warnings", "worse_than_copying"]

COVERED = 0.95  # mean opacity above which masks say no more than none
UNLIKE = 3.0  # deviations of the codes; held-out objects of a trained class have 0.7 to 2, other classes 3.3 to 8
ELSEWHERE = 30.0  # degrees between camera directions, on average, above which planes stand in for others
HELD_OUT = 4  # left-out views, and pixels along their longer side
HELD_OUT_SIZE = 64
SHOWN_SIZE = 4 * HELD_OUT_SIZE


def suitability_warnings(model: HyperPlanes, shown: Views, steps: object = 0) -> list[str]:
    """What speaks against good pictures of these views, a sentence each, before anything has been adapted.

    Args:
        model: what will adapt.
        shown: the views it will be shown.
        steps: fine-tuning steps that are asked for.
    """
    found = []
    covered = _covered(shown)
    if covered > COVERED:
        what = "no alpha and no masks" if shown.masks is None else f"masks that cover {covered:.0%}"
        found.append(
            f"the views have {what}, and the model was trained on objects over white: it takes the background for the "
            "object; cut the object out (RGBA images, or a folder masks/), or give --learn-background"
        )
    planes = model.config.network.planes
    if len(shown) < planes and len(model.known_rig):
        stated = f"{len(shown)} views are shown and the model was trained with {planes}"
        found.append(f"{stated}: some views fill several planes")
    unlike, angle = _unlikeness(model, shown)
    if unlike is not None and unlike > UNLIKE:
        found.append(
            f"the views are unlike those of the training: their codes deviate {unlike:.1f} times as much as those did"
            + ("" if steps or len(shown) < 2 else "; --steps 100 adapts to them")
        )
    if angle > ELSEWHERE and len(shown) >= planes:
        found.append(f"the cameras stand {angle:.0f} degrees from where those of the training stood, on average")
    return found


def _covered(shown: Views) -> float:
    """Mean opacity of the masks; 1 where there are none."""
    return 1.0 if shown.masks is None else float(shown.masks.mean())


def worse_than_copying(shown: Views, rendered: float, copied: float, steps: object) -> list[str]:
    """A sentence where the pictures of a field are worse than the nearest view, copied.

    Args:
        shown: the views that it was shown.
        rendered: PSNR of the field in decibels.
        copied: PSNR of the nearest view.
        steps: fine-tuning steps that were asked for; None of a baked file, which takes none.
    """
    if rendered >= copied:
        return []
    advice = "`hyperplanes inspect` checks images, masks and poses"
    if steps == 0 and len(shown) > 1:
        advice += ", and --steps 100 adapts the model to the views"
    advice = "cut the object out first" if _covered(shown) > COVERED else advice
    return [f"worse than copying the nearest view: {rendered:.2f} dB against {copied:.2f} dB; {advice}"]


def held_out_psnr(model: HyperPlanes, shown: Views) -> tuple[float, float] | None:
    """PSNR of a field on support views that it was not shown, and of the nearest view copied, in one forward pass.

    Pictures are those without residual correction, for which all shown views would be rendered.

    Up to four views are left out, and rendered at 64 pixels. The others are shown with 256 at most.

    Args:
        model: what adapts.
        shown: the views, of which some are left out.

    Returns:
        Both figures in decibels; None with fewer than four views.
    """
    if len(shown) < 4:
        return None
    holdout = torch.linspace(0, len(shown) - 1, min(HELD_OUT, len(shown) // 2) + 2)[1:-1].round().long()
    rest = [index for index in range(len(shown)) if index not in holdout.tolist()]
    shown = shown.resized(SHOWN_SIZE)
    left_out, remaining = shown[holdout].resized(HELD_OUT_SIZE), shown[rest]
    fields: list[Renderable] = [model.adapt(remaining).without_residuals(), NearestView().adapt(remaining)]
    pictures = (each.render(left_out.cameras).images.clamp(0, 1) for each in fields)
    first, second = (float(psnr(images, left_out.images).mean()) for images in pictures)
    return first, second


def _unlikeness(model: HyperPlanes, shown: Views) -> tuple[float | None, float]:
    """Root mean square of the standardised codes, None without such, and the mean angle from the training's rig."""
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
