"""Rough structures of man-made and living things: support, repetition and symmetry of parts.

Tables, carts, figures, houses, tools, plants, machines and shelves, whose parts are random solids. Apart from their
structure they do not resemble real objects, so they are not classes to recognise.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.primitives import box
from data_gen.shapes.random.fillings import BODIES, LIMBS, crate, filling, sides
from data_gen.shapes.random.hollow import arch, vessel
from data_gen.shapes.random.primitives import ball, bent_tube, cone, cylinder, lathe, loft, pebble, primitive, torus
from data_gen.shapes.random.tubes import bar
from data_gen.shapes.solids import Solid, merged, rotation

__all__ = ["STRUCTURES", "structure"]


def table(rng: np.random.Generator) -> list[Solid]:
    """A slab on legs, with things on it and bars between its legs."""
    width, depth, high = rng.uniform(0.6, 1.6), rng.uniform(0.5, 1.0), rng.uniform(0.3, 1.6)
    thick, foot = rng.uniform(0.05, 0.25), rng.uniform(0.04, 0.14)
    parts = [filling(rng, (crate, cylinder), (-width, high, -depth), (width, high + thick, depth))]
    inset = rng.uniform(0.75, 0.97)
    leg = filling(rng, LIMBS, (-foot, 0, -foot), (foot, high + 0.02, foot))
    x, z = inset * width - foot, inset * depth - foot
    parts.append(merged([leg.moved(a * x, 0, b * z) for a in (-1, 1) for b in (-1, 1)]))
    if rng.random() < 0.5:
        level = rng.uniform(0.15, 0.6) * high
        rails = [bar(np.array([-x, level, b * z]), np.array([x, level, b * z]), 0.5 * foot, 4) for b in (-1, 1)]
        parts.append(merged(rails))
    for _ in range(int(rng.integers(0, 4))):
        size = rng.uniform(0.12, 0.4, 3)
        place = np.array([rng.uniform(-0.7, 0.7) * width, high + 0.97 * thick, rng.uniform(-0.7, 0.7) * depth])
        parts.append(filling(rng, (*BODIES, vessel, cone), place - size * (1, 0, 1), place + size))
    return parts


def cart(rng: np.random.Generator) -> list[Solid]:
    """A body on pairs of wheels, with a second body on it and things in front of it or behind."""
    length, width, high = rng.uniform(0.8, 1.6), rng.uniform(0.35, 0.8), rng.uniform(0.25, 0.8)
    radius, pairs = rng.uniform(0.18, 0.5), int(rng.integers(1, 5))
    floor = radius * rng.uniform(0.5, 1.3)
    parts = [filling(rng, BODIES, (-width, floor, -length), (width, floor + high, length))]
    wheel = primitive(rng, 0.2, (cylinder, torus, lathe))
    wheel = wheel.transformed(rotation("z", 90.0) @ np.diag([1.0, rng.uniform(0.15, 0.4), 1.0]))
    wheel = wheel.transformed(radius / np.abs(wheel.vertices[:, 1:]).max() * np.eye(3))
    places = np.linspace(-0.75, 0.75, pairs) * length if pairs > 1 else np.array([rng.uniform(-0.3, 0.3)])
    out = width * rng.uniform(0.9, 1.15)
    parts.append(merged([sides(wheel.moved(out, radius, z)) for z in places]))
    top = floor + high
    back, front = np.sort(rng.uniform(-0.9, 0.9, 2)) * length
    front = max(front, back + 0.3)
    size = width * rng.uniform(0.5, 1.0)
    parts.append(filling(rng, (*BODIES, vessel), (-size, top - 0.05, back), (size, top + rng.uniform(0.2, 0.9), front)))
    if rng.random() < 0.6:
        joints = np.array([[0, top, 0.5 * length], [0, top + rng.uniform(0.3, 1.2), rng.uniform(0.6, 1.4) * length]])
        end = joints[1] + (0, -rng.uniform(0.2, 1.0), rng.uniform(0.3, 0.9))
        thick = rng.uniform(0.04, 0.12)
        parts.append(merged([bar(joints[0], joints[1], thick, 4), bar(joints[1], end, 0.8 * thick, 4)]))
        claw = rng.uniform(0.15, 0.4)
        parts.append(filling(rng, (vessel, crate, cone, torus), end - claw, end + claw))
    return parts


def figure(rng: np.random.Generator) -> list[Solid]:
    """A trunk with a head, two arms, and two or four legs."""
    width, high, depth = rng.uniform(0.25, 0.7), rng.uniform(0.4, 1.0), rng.uniform(0.2, 0.6)
    leg, foot = rng.uniform(0.2, 1.0), rng.uniform(0.06, 0.22)
    parts = [filling(rng, BODIES, (-width, leg, -depth), (width, leg + high, depth), 0.35)]
    head = rng.uniform(0.2, 0.5)
    neck = leg + high + rng.uniform(-0.05, 0.15)
    forward = rng.uniform(-0.1, 0.5) * depth
    parts.append(
        filling(
            rng,
            (ball, pebble, crate, lathe),
            (-head, neck, forward - head),
            (head, neck + 2 * head, forward + head),
            0.35,
        )
    )
    limb = filling(rng, LIMBS, (-foot, 0, -foot), (foot, leg + 0.15, foot))
    places = (0.0,) if rng.random() < 0.5 else (-0.7 * depth, 0.7 * depth)
    x = max(0.7 * width, foot)
    parts.append(merged([sides(limb.moved(x, 0.0, z)) for z in places]))
    if rng.random() < 0.8:
        arm = primitive(rng, 0.1, (bent_tube, cylinder, loft, lathe))
        arm = arm.scaled(rng.uniform(0.08, 0.2), rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.2))
        arm = arm.transformed(rotation("x", rng.uniform(-90, 30)) @ rotation("z", rng.uniform(10, 100)))
        parts.append(sides(arm.moved(width - arm.vertices[:, 0].min() - 0.08, leg + 0.75 * high)))
    if rng.random() < 0.5:
        eye = filling(rng, (ball,), (-0.07,) * 3, (0.07,) * 3, 0)
        parts.append(sides(eye.moved(0.45 * head, neck + 1.2 * head, forward + 0.85 * head)))
    if rng.random() < 0.4:
        top = neck + 2 * head
        parts.append(
            filling(
                rng,
                (cone, vessel, cylinder, torus),
                (-head, top - 0.3 * head, forward - head),
                (head, top + 0.5 * head, forward + head),
            )
        )
    return parts


def house(rng: np.random.Generator) -> list[Solid]:
    """Storeys that get smaller, a roof, columns or windows around, stairs or a yard."""
    parts, level = [], 0.0
    size = rng.uniform(0.4, 1.1, 2)
    for _ in range(int(rng.integers(1, 5))):
        high = rng.uniform(0.25, 1.0)
        parts.append(
            filling(rng, (crate, cylinder, loft), (-size[0], level, -size[1]), (size[0], level + high, size[1]))
        )
        if rng.random() < 0.6:
            count, window = int(rng.integers(2, 6)), rng.uniform(0.03, 0.09)
            panes = []
            for x in np.linspace(-0.75, 0.75, count) * size[0]:
                pane = box(2 * window, rng.uniform(0.3, 0.7) * high, 0.08).moved(x, level + 0.5 * high, size[1])
                panes += [pane, pane.scaled(1.0, 1.0, -1.0)]
            parts.append(merged(panes))
        level += high * rng.uniform(0.9, 1.0)
        size = size * rng.uniform(0.55, 1.05, 2)
    if rng.random() < 0.7:
        over, rise = rng.uniform(0.9, 1.4), rng.uniform(0.2, 0.9)
        low, high = (-over * size[0], level - 0.02, -over * size[1]), (over * size[0], level + rise, over * size[1])
        parts.append(filling(rng, (cone, ball, crate), low, high))
    if rng.random() < 0.35:
        steps = [box(0.8, 0.1, 0.3).moved(0, 0.05 + 0.1 * k, 1.6 - 0.16 * k) for k in range(int(rng.integers(3, 7)))]
        parts.append(merged(steps))
    if rng.random() < 0.5:
        parts.append(box(2.6, 0.08, rng.uniform(2.2, 3.6)).moved(0, -0.03))
    return parts


def tool(rng: np.random.Generator) -> list[Solid]:
    """A handle with a head across it, or with blades around its end."""
    length, thick = rng.uniform(0.8, 1.8), rng.uniform(0.05, 0.2)
    parts = [filling(rng, (cylinder, lathe, crate, loft), (-thick, -length, -thick), (thick, length, thick))]
    size = rng.uniform(0.1, 0.7, 3)
    end = np.array([0.0, length * rng.uniform(0.7, 1.0), 0.0])
    if rng.random() < 0.5:
        parts.append(filling(rng, (*BODIES, vessel, torus, cone), end - size, end + size, 0.3))
    else:
        blade = filling(rng, (loft, crate, ball, arch), (0, -0.1, -0.02), (rng.uniform(0.3, 1.2), 0.1, 0.02))
        count, pitch = int(rng.integers(2, 7)), rotation("x", rng.uniform(-70, 70))
        turns = [rotation("y", 360 * k / count) @ pitch for k in range(count)]
        parts.append(merged([blade.transformed(turn, end) for turn in turns]))
    if rng.random() < 0.6:
        grip = thick * rng.uniform(1.1, 1.8)
        parts.append(filling(rng, (cylinder, lathe, torus), (-grip, -length, -grip), (grip, -0.5 * length, grip)))
    return parts


def plant(rng: np.random.Generator) -> list[Solid]:
    """A pot, a stem that forks, and leaves or fruits at its ends."""
    parts = [filling(rng, (vessel, crate, cylinder, pebble), (-0.45, -0.6, -0.45), (0.45, 0.1, 0.45))]
    branches: list[Solid] = []
    tips: list[np.ndarray] = []
    todo = [(np.zeros(3), np.array([0.0, 1.0, 0.0]), rng.uniform(0.5, 1.0), rng.uniform(0.05, 0.12), 0)]
    depth, forks = int(rng.integers(1, 4)), int(rng.integers(2, 4))
    while todo:
        start, direction, length, thick, level = todo.pop()
        end = start + length * direction
        branches.append(bar(start - 0.1 * length * direction, end, thick, 5))
        if level == depth:
            tips.append(end)
            continue
        for _ in range(forks):
            turned = direction + rng.normal(size=3) * 0.55
            turned[1] = abs(turned[1])
            todo.append((end, turned / np.linalg.norm(turned), length * rng.uniform(0.5, 0.85), 0.7 * thick, level + 1))
    parts.append(merged(branches))
    size = rng.uniform(0.12, 0.4) * np.array([1.0, rng.uniform(0.15, 1.2), rng.uniform(0.4, 1.0)])
    leaf = filling(rng, (ball, loft, pebble, cone, cylinder), -size, size, 0)
    tips = tips[: max(1, 4000 // len(leaf.faces))]
    turns = [rotation("y", rng.uniform(0, 360)) @ rotation("x", rng.uniform(-50, 50)) for _ in tips]
    parts.append(merged([leaf.transformed(turn, tip) for turn, tip in zip(turns, tips, strict=True)]))
    return parts


def machine(rng: np.random.Generator) -> list[Solid]:
    """A block with pipes, knobs and boxes on it, and a wheel at its side."""
    half = rng.uniform(0.4, 1.0, 3)
    parts = [filling(rng, (crate, cylinder, loft), -half, half)]
    for _ in range(int(rng.integers(2, 6))):
        axis, sign = int(rng.integers(3)), rng.choice([-1.0, 1.0])
        place = rng.uniform(-0.6, 0.6, 3) * half
        place[axis] = sign * half[axis]
        size = rng.uniform(0.08, 0.35, 3)
        size[axis] = rng.uniform(0.05, 0.5)
        solid = filling(rng, (*BODIES, vessel, torus, arch, cone), place - size, place + size)
        if rng.random() < 0.3:
            other = np.where(np.arange(3) == (axis + 1) % 3, -1.0, 1.0)
            solid = merged([solid, solid.scaled(*other)])
        parts.append(solid)
    for _ in range(int(rng.integers(0, 3))):
        hose = bent_tube(rng, False).scaled(*half * rng.uniform(0.8, 1.4, 3))
        parts.append(hose.moved(*rng.uniform(-0.3, 0.3, 3)))
    return parts


def shelf(rng: np.random.Generator) -> list[Solid]:
    """Boards between two sides, with things on them; or a fence of posts and rails."""
    width, depth, high = rng.uniform(0.5, 1.4), rng.uniform(0.2, 0.5), rng.uniform(0.8, 2.0)
    board = rng.uniform(0.02, 0.06)
    levels = np.linspace(0, high, int(rng.integers(2, 6)))
    parts = [merged([box(2 * width, 2 * board, 2 * depth).moved(0, level) for level in levels])]
    side = filling(
        rng, (crate, cylinder), (width - board, -0.1, -0.95 * depth), (width + board, high + 0.1, 0.95 * depth)
    )
    if rng.random() < 0.4:
        foot = filling(rng, (cylinder, lathe), (width - 0.06, -0.1, -0.06), (width + 0.06, high + 0.2, 0.06))
        side = merged([foot.moved(z=z) for z in (-0.8 * depth, 0.8 * depth)])
    parts.append(sides(side))
    gap = levels[1] - levels[0]
    for level in levels[:-1]:
        for _ in range(int(rng.integers(0, 4))):
            size = np.array([rng.uniform(0.05, 0.25), rng.uniform(0.15, 0.45) * gap, rng.uniform(0.3, 0.8) * depth])
            x = rng.uniform(-0.8, 0.8) * width
            low = (x - size[0], level + 0.5 * board, -size[2])
            parts.append(filling(rng, (*BODIES, vessel), low, (x + size[0], level + 2 * size[1], size[2]), 0.1))
    return parts


STRUCTURES = (table, cart, figure, house, tool, plant, machine, shelf)
"""All of them are equally frequent."""


def structure(rng: np.random.Generator) -> list[Solid]:
    """The solids of one of `STRUCTURES`, y up."""
    return one_of(rng, STRUCTURES)(rng)
