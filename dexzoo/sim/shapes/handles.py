"""Attachments of a body: handles, spouts, stems, knobs. Lengths in millimeters; handles point along +x."""

from __future__ import annotations

import numpy as np

from dexzoo.sim.shapes.curves import Array, Number, rounded
from dexzoo.sim.shapes.solid import Solid, loft, swept, turned


def radius_at(profile: Array, height: Number) -> float:
    """The radius of a profile at one height.

    Args:
        profile: Radii and rising heights, (row, 2).
        height: The height.
    """
    return float(np.interp(height, profile[:, 1], profile[:, 0]))


def ear(
    high: tuple[Number, Number],
    low: tuple[Number, Number],
    reach: Number,
    width: Number,
    thickness: Number,
    bend: Number = 40.0,
    taper: Number = 1.0,
) -> Solid:
    """A loop handle between two points of a wall, for one to three fingers.

    Args:
        high: Upper point (radius, height).
        low: Lower point.
        reach: How far it stands out.
        width: Half width.
        thickness: Half thickness.
        bend: How far from its corners it starts to turn; small ones make a D, large ones a C.
        taper: Reach at the lower end over that at the upper.
    """
    path = rounded(
        [high, (high[0] + reach, high[1] + 0.08 * reach, bend), (low[0] + taper * reach, low[1], bend), low], 5.0
    )
    return loft(swept(path, width, thickness))


def grip(path: list[tuple[Number, ...]], width: list[Number], thickness: list[Number], exponent: Number = 2.8) -> Solid:
    """A straight or curved handle along a path.

    Args:
        path: Corners (x, z, cut).
        width: Half widths along it.
        thickness: Half thicknesses along it.
        exponent: Exponent of its section.
    """
    points = rounded(path, 8.0)
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    share = length / length[-1]

    def along(values: list[Number]) -> Array:
        return np.asarray(np.interp(share, np.linspace(0, 1, len(values)), values), np.float64)

    return loft(swept(points, along(width), along(thickness), exponent))


def spout(start: tuple[Number, Number], tip: tuple[Number, Number], root: Number, mouth: Number, swan: Number) -> Solid:
    """A tapered spout along -x from a point in the body to its tip.

    Args:
        start: Point (radius, height) in the body.
        tip: The tip.
        root: Radius at the body.
        mouth: Radius at the tip.
        swan: How much it is curved.
    """
    middle = ((start[0] + tip[0]) / 2 + swan, (start[1] + tip[1]) / 2 - swan, 60.0)
    path = rounded([start, middle, tip], 4.0)
    size = np.linspace(root, mouth, len(path))
    size = size + 0.25 * mouth * np.linspace(0, 1, len(path)) ** 8
    return loft(swept(path, size, size, 2.0, 24)).moved(degrees=180)


def knob(radius: Number, bottom: Number, neck: Number = 0.55) -> Solid:
    """A round knob with a waist, standing on a lid.

    Args:
        radius: Its radius.
        bottom: Height of the lid.
        neck: Radius of the waist over that of the knob.
    """
    r = radius
    profile = [(0.8 * r, bottom - 2), (0.8 * r, bottom, 1), (neck * r, bottom + 0.4 * r, 2), (r, bottom + 0.9 * r, 3)]
    return loft(turned(rounded([*profile, (0.9 * r, bottom + 1.7 * r, 4), (0.15 * r, bottom + 1.8 * r)])))
