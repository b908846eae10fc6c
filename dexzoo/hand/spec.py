"""Tables of a hand: read from its folder, checked, and mirrored for the other side.

A hand is a folder with a URDF (kinematics, masses, limits, coupling) and a hand.yaml (shapes, pads, ignored contacts).
"""

from __future__ import annotations

import difflib
import hashlib
import itertools
import json
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dexzoo.hand.reading import (
    parse_direction,
    parse_finger,
    parse_inertia,
    parse_joint,
    parse_primitive,
    parse_vector,
    read_urdf,
    read_yaml,
    tree_order,
)
from dexzoo.hand.tables import Inertia, Joint, Pad, Primitive
from dexzoo.resources import resource

Side = Literal["right", "left"]
_MIRROR = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class HandSpec:
    """All tables of a hand. Joints are in tree order: a parent stands before its children.

    Attributes:
        name: Name of the hand's folder.
        side: Side of the hand.
        palm: Name of the palm's link.
        joints: All joints, fixed ones too.
        joint_names: Moving joints, in the order of the posture vector.
        link_names: All links, the palm first.
        inertias: Mass and inertia of links by name.
        primitives: Shapes of links.
        pads: Contact points of the fingertips by finger.
        exclude: Pairs of links whose contact is ignored.
    """

    name: str
    side: Side
    palm: str
    joints: tuple[Joint, ...]
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    inertias: dict[str, Inertia]
    primitives: tuple[Primitive, ...]
    pads: dict[str, Pad]
    exclude: tuple[tuple[str, str], ...]

    @classmethod
    def load(cls, name: str | Path = "dlr2", side: Side = "right") -> HandSpec:
        """Read a hand.

        Args:
            name: Name in robots/, or a folder with a URDF and a hand.yaml.
            side: Side of the hand.

        Raises:
            FileNotFoundError: The hand is unknown.
            ValueError: Its tables contradict each other, or it has no such side.
        """
        if side not in ("right", "left"):
            raise ValueError(f'side {side!r} is unknown, use "right" or "left"')
        folder = _folder(name)
        path = folder / "hand.yaml"
        config = read_yaml(path)
        try:
            urdf = read_urdf(folder / config["urdf"])
            joints = tree_order(config["palm"], [parse_joint(joint) for joint in urdf.joints])
            spec = cls(
                name=folder.resolve().name,
                side=config["side"],
                palm=config["palm"],
                joints=joints,
                joint_names=tuple(joint for finger in config["joints"] for joint in parse_finger(finger)),
                link_names=(config["palm"], *(joint.child for joint in joints)),
                inertias={link.name: parse_inertia(link.inertial) for link in urdf.links if link.inertial is not None},
                primitives=tuple(
                    parse_primitive(link, shape) for link, shapes in config["primitives"].items() for shape in shapes
                ),
                pads={
                    finger: Pad(
                        pad["link"],
                        parse_vector(pad["point"], f"point of the pad {finger}"),
                        parse_direction(pad["normal"], f"normal of the pad {finger}"),
                    )
                    for finger, pad in config.get("pads", {}).items()
                },
                exclude=tuple((a, b) for a, b in config.get("exclude", [])),
            )
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from None
        except (AttributeError, TypeError) as error:
            raise ValueError(f"{path}: an entry lacks the form it has in robots/dlr2/hand.yaml: {error}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        _check(spec, path)
        if side != spec.side:
            if "mirror" not in config:
                raise ValueError(
                    f'hand {spec.name} has no {side} side: {path} has no entry mirror; use side="{spec.side}"'
                )
            _check_links(spec, path, config["mirror"])
            spec = _mirrored(spec, side, config["mirror"])
        return spec

    @staticmethod
    def known() -> list[str]:
        """Names of the hands in robots/."""
        return sorted(path.parent.name for path in resource("robots").glob("*/hand.yaml"))

    @property
    def digest(self) -> str:
        """SHA-256 of all tables, whatever the name: equal for equal hands, on any machine."""
        content = json.dumps([_plain(getattr(self, field.name)) for field in fields(self) if field.name != "name"])
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def freedoms(self) -> tuple[str, ...]:
        """Names of the joints that move by themselves, in posture order."""
        free = {joint.name for joint in self.joints if joint.mimic is None}
        return tuple(name for name in self.joint_names if name in free)

    @property
    def fixed_to(self) -> dict[str, str]:
        """For each link, the first of those that are fixed to each other and to it."""
        first = {self.palm: self.palm}
        for joint in self.joints:
            first[joint.child] = first[joint.parent] if joint.axis is None else joint.child
        return first

    @property
    def joined(self) -> frozenset[frozenset[str]]:
        """Pairs of links that cannot but touch: they share a joint, where links fixed to each other count as one."""
        first = self.fixed_to
        shared = {frozenset((first[joint.parent], first[joint.child])) for joint in self.joints}
        pairs = (frozenset(pair) for pair in itertools.combinations(self.link_names, 2))
        return frozenset(pair for pair in pairs if frozenset(first[link] for link in pair) in shared)

    def joint(self, name: str) -> Joint:
        """A joint by its name.

        Args:
            name: Name of the joint.
        """
        return next(joint for joint in self.joints if joint.name == name)


def _folder(name: str | Path) -> Path:
    """The folder of a hand: of that name in robots/, or as given."""
    for folder in (resource("robots") / str(name), Path(name)):
        if (folder / "hand.yaml").is_file():
            return folder
    known = ", ".join(HandSpec.known())
    raise FileNotFoundError(f"hand {str(name)!r} has no hand.yaml; known hands: {known}, or give a folder")


def _plain(value: object) -> object:
    """A table as JSON knows it; numbers are rounded to a billionth, below which machines differ."""
    if is_dataclass(value):
        return [_plain(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, dict):
        return [[key, _plain(entry)] for key, entry in sorted(value.items())]
    if isinstance(value, (tuple, list, np.ndarray)):
        return [_plain(entry) for entry in value]
    return round(float(value), 9) + 0.0 if isinstance(value, (float, np.floating)) else value


def _check(spec: HandSpec, path: Path) -> None:
    moving = {joint.name: joint for joint in spec.joints if joint.axis is not None}
    if len(set(spec.joint_names)) != len(spec.joint_names) or set(spec.joint_names) != set(moving):
        odd = set(moving).symmetric_difference(spec.joint_names) or set(spec.joint_names)
        raise ValueError(f"{path}: joints and the URDF's moving joints differ in {', '.join(sorted(odd))}")
    if not spec.primitives:
        raise ValueError(f"{path}: primitives is empty; give at least one link a box or a capsule")
    for joint in moving.values():
        if not joint.lower < joint.upper:
            raise ValueError(
                f"{path}: joint {joint.name} has the limits {joint.lower:g} to {joint.upper:g} in the URDF; "
                "give it a range, or make it a fixed joint"
            )
        if joint.mimic is None:
            continue
        if joint.mimic not in moving:
            raise ValueError(f"{path}: joint {joint.name} is coupled to {joint.mimic}, which does not exist")
        if joint.mimic not in spec.freedoms:
            raise ValueError(f"{path}: joint {joint.name} is coupled to {joint.mimic}, which is coupled itself")
        leader = moving[joint.mimic]
        for angle in (leader.lower, leader.upper):
            follows = joint.multiplier * angle + joint.offset
            if not joint.lower - 1e-3 <= follows <= joint.upper + 1e-3:
                raise ValueError(
                    f"{path}: joint {joint.name} would follow {leader.name} at {angle:g} to {follows:.3f} rad, outside "
                    f"its limits {joint.lower:.3f} to {joint.upper:.3f}; widen them, or narrow those of {leader.name}"
                )
    _check_links(spec, path, {p.link for p in spec.primitives} | {p.link for p in spec.pads.values()})
    _check_links(spec, path, set(sum(spec.exclude, ())))


def _check_links(spec: HandSpec, path: Path, links: Iterable[str]) -> None:
    for link in sorted(set(links) - set(spec.link_names)):
        near = difflib.get_close_matches(link, spec.link_names, 1)
        raise ValueError(f"{path}: link {link} is not in the URDF" + (f", did you mean {near[0]}?" if near else ""))


def _mirrored(spec: HandSpec, side: Side, axes: dict[str, str]) -> HandSpec:
    """The other side's hand: each link's frame mirrored along an axis of its own.

    A joint's axis stays where it lies along that axis or across it, and its angle changes sign in the second case.
    """
    flip = {link: np.array(_MIRROR[axes.get(link, "z")]) for link in spec.link_names}

    def mirror(
        parent: NDArray[np.float64], pose: NDArray[np.float64], child: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        mirrored: NDArray[np.float64] = np.append(parent, 1.0)[:, None] * pose * np.append(child, 1.0)
        return mirrored

    sign: dict[str, float] = {}  # of each joint's angle

    def turn(joint: Joint) -> Joint:
        joint = replace(joint, origin=mirror(flip[joint.parent], joint.origin, flip[joint.child]))
        if joint.axis is None:
            return joint
        image = flip[joint.child] * joint.axis
        sign[joint.name] = -1.0 if image @ joint.axis > 0 else 1.0  # a mirror image turns the other way
        lower, upper = sorted((sign[joint.name] * joint.lower, sign[joint.name] * joint.upper))
        return replace(joint, axis=-sign[joint.name] * image, lower=lower, upper=upper)

    def follow(joint: Joint) -> Joint:
        if joint.mimic is None:
            return joint
        own = sign[joint.name]
        return replace(joint, multiplier=own * sign[joint.mimic] * joint.multiplier, offset=own * joint.offset)

    return replace(
        spec,
        side=side,
        joints=tuple(follow(joint) for joint in [turn(joint) for joint in spec.joints]),
        inertias={
            link: Inertia(i.mass, flip[link] * i.center, np.outer(flip[link], flip[link]) * i.matrix)
            for link, i in spec.inertias.items()
        },
        # a rounded box is its own mirror image along its third axis
        primitives=tuple(
            Primitive(p.link, mirror(flip[p.link], p.pose, np.array(_MIRROR["z"])), p.half, p.radius)
            for p in spec.primitives
        ),
        pads={f: Pad(p.link, flip[p.link] * p.point, flip[p.link] * p.normal) for f, p in spec.pads.items()},
    )
