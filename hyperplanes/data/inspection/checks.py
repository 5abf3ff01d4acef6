"""Is it one object in one world? What can be wrong with posed pictures beside the convention of their poses."""

from __future__ import annotations

import torch

from hyperplanes.data.inspection.conventions import FEWEST_MATCHES, LEAST_COVERAGE, RANDOM, near_lines
from hyperplanes.data.inspection.matches import match_pictures
from hyperplanes.data.inspection.silhouettes import coarse_hull, masks_tell, small_masks, with_object
from hyperplanes.data.pictures.bounds import empty_masks, inverted, nearest_point
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.files.order import natural_order
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.views import Views

__all__ = ["check_duplicates", "check_gaze", "check_masks", "check_poses", "check_splits"]

PARALLEL = 1e-6  # from 1, the cosine of the angle between two axes: 0.08 degrees
SAME_POSE_TOLERANCE = 1e-6  # largest difference between the entries of two poses that count as one


def check_duplicates(views: Views) -> str | None:
    """A sentence where one picture stands for several poses, None where each pose has a picture of its own."""
    names = views.names or tuple(map(str, range(len(views))))
    pose = camera.camera_from_world(views.cameras).reshape(len(views), -1)
    seen: dict[bytes, list[int]] = {}
    for view, image in enumerate(views.images):
        if float(image.amax() - image.amin()) > 0:  # an empty view is the same from everywhere
            seen.setdefault(image.cpu().numpy().tobytes(), []).append(view)
    groups = [group for group in seen.values() if (pose[group] - pose[group[0]]).abs().max() > 1e-4]
    if not groups:
        return None
    count, largest = sum(map(len, groups)), max(groups, key=len)
    return (
        f"images: WRONG, {count} of {len(views)} poses have the image of another pose ({names[largest[0]]} and "
        f"{names[largest[1]]} are the same, {len(largest)} times in all); give every pose its own image"
    )


def check_poses(views: Views) -> str | None:
    """A sentence where more than half of three or more views have one and the same pose, otherwise None."""
    pose = camera.camera_from_world(views.cameras).reshape(len(views), -1)
    same = int((torch.cdist(pose, pose, p=torch.inf) < SAME_POSE_TOLERANCE).sum(1).max())
    if len(views) < 3 or 2 * same <= len(views):
        return None
    return (
        f"poses: WRONG, {same} of {len(views)} are the same; give every image the pose of the camera relative to the "
        "object (on a turntable, the camera moves around the object)"
    )


def check_masks(views: Views) -> str | None:
    """A sentence where masks seem to show the background or are empty, otherwise None.

    The notes of the reader name those that seem to show the background.
    """
    if views.masks is None:
        return None
    if wrong := int(inverted(views.masks).sum()):
        return f"masks: WRONG, {wrong} of {len(views)} seem to show the background"
    empty = empty_masks(views.masks).nonzero()[:, 0].tolist()
    if not empty:
        return None
    names = listed(sorted((views.names[view] if views.names else str(view) for view in empty), key=natural_order))
    return (
        f"masks: WRONG, {len(empty)} of {len(views)} are empty ({names}); leave these views out or correct their masks"
    )


def check_gaze(views: Views) -> tuple[bool, str] | None:
    """Whether the cameras look at one place: the point nearest to all their axes is seen by most of them.

    Returns:
        Whether at least half of them see it, and a line that says how many; None where all axes are parallel, so that
        no point is the nearest.
    """
    eyes, axes = camera.centres(views.cameras), camera.viewing_directions(views.cameras)
    if float((axes @ axes[0]).abs().min()) > 1 - PARALLEL:
        return None
    point = nearest_point(eyes, axes)
    ahead = ((point - eyes) * axes).sum(-1) > 0
    pixels = views.cameras.project(point.expand(len(views), 1, 3))[:, 0]
    border = pixels.new_tensor([views.size[1], views.size[0]]) - 0.5
    seen = int((ahead & (pixels > -0.5).all(1) & (pixels < border).all(1)).sum())
    if 2 * seen >= len(views):
        return True, f"cameras: {seen} of {len(views)} look at one place"
    return False, (
        f"cameras: only {seen} of {len(views)} look at one place ({int(ahead.sum())} have it ahead); poses in other "
        "axes look away from the object"
    )


@torch.no_grad()
def check_splits(support: Views, query: Views) -> tuple[bool, str]:
    """Whether support and query are posed in one world.

    Returns:
        False where they are clearly not, and a line that says what was compared.
    """
    if masks_tell(support) and masks_tell(query) and len(with_object(support)) >= 3:
        support, query = with_object(support), with_object(query)
        masks, cameras = small_masks(support)
        hull = coarse_hull(masks, cameras)
        own, other = hull.coverage(masks, cameras), hull.coverage(*small_masks(query))
        found = f"the hull of the support's masks covers {other:.0%} of the query's"
        if other >= min(LEAST_COVERAGE, own - 0.1):
            return True, f"splits: {found}"
        return False, f"splits: WRONG, {found} and {own:.0%} of its own; the two are posed in different worlds"
    if support.size != query.size:
        return True, "splits: not checked, their pictures have different sizes"
    both = Views(torch.cat([support.images, query.images]), camera.concatenate([support.cameras, query.cameras]))
    matches = match_pictures(both, torch.arange(len(both)) < len(support))
    if len(matches) < FEWEST_MATCHES:
        return True, f"splits: not checked, only {len(matches)} corners could be matched between support and query"
    near = near_lines(matches, camera.camera_from_world(both.cameras))
    found = f"{near:.0%} of {len(matches)} corners matched between support and query are on their epipolar lines"
    if near >= RANDOM:
        return True, f"splits: {found}"
    return False, f"splits: WRONG, only {found}; the two are posed in different worlds"
