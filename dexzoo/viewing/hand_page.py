"""A page in the browser that shows a hand: a slider for each joint that moves by itself, shapes, frames and limits.

The page comes from this machine alone and needs no network. It is drawn by viser, which the extra `viewer` installs.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexzoo import rotation
from dexzoo.hand import Hand, Joint, Side

if TYPE_CHECKING:
    import viser

PALM_COLOR = (150, 155, 165)
FINGER_COLORS = ((213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
STEP = 0.5  # degrees between two places of a slider


@dataclass(frozen=True)
class _Finger:
    """A branch of the tree at the palm: its links from the palm on, and its joints that move by themselves."""

    name: str
    links: list[str]
    joints: list[Joint]


class HandPage:
    """A hand in its palm frame, on a page served at `url`; it moves as soon as a slider does.

    Args:
        hand: The hand.
        port: Port of this machine; the next free one if it is taken, any free one if 0.
        seed: Seed of the random postures.

    Attributes:
        url: Address of the page.
        sliders: Sliders by joint name, in degrees, in the order of `hand.freedoms`.
        links: Frames of the scene by link name.

    Raises:
        ValueError: viser is not installed.
    """

    def __init__(self, hand: Hand, port: int, seed: int) -> None:
        try:
            import viser
        except ImportError:
            raise ValueError("the viewer needs viser; install it with `pip install dexzoo[viewer]`") from None
        self.hand = hand
        self.server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
        self.url = f"http://127.0.0.1:{self.server.get_port()}"
        self.sliders: dict[str, Any] = {}  # viser's types hold a slider's value to be read-only
        self.links: dict[str, viser.FrameHandle] = {}
        self._meshes: list[viser.MeshHandle] = []
        self._link_names: list[viser.LabelHandle] = []
        self._finger_names: list[viser.LabelHandle] = []
        self._lower, self._upper = hand.reduce(hand.lower).double(), hand.reduce(hand.upper).double()
        self._random = torch.Generator().manual_seed(seed)
        self._moving = threading.Lock()  # each event of the page comes on a thread of its own
        fingers = _fingers(hand)
        with self.server.atomic():
            self._add_links(fingers)
            self._add_controls(fingers)
            self._show()
            self._set_stage()

    @property
    def posture(self) -> Float[Tensor, " joint"]:
        """All joint angles that the sliders ask for, in radians and within the limits."""
        degrees = torch.tensor([slider.value for slider in self.sliders.values()], dtype=torch.float64)
        return self.hand.expand(torch.deg2rad(degrees).clamp(self._lower, self._upper))

    def move(self, q15: Float[Tensor, " freedom"]) -> None:
        """Set the sliders, and so the hand.

        Args:
            q15: Angles of the free joints, radians.
        """
        with self.server.atomic():
            for slider, angle in zip(self.sliders.values(), q15.tolist(), strict=True):
                slider.value = _degrees(angle)

    def reset(self) -> None:
        """Open the hand: every joint at zero, or at the limit next to it."""
        self.move(torch.zeros_like(self._lower).clamp(self._lower, self._upper))

    def move_randomly(self) -> None:
        """Draw a posture within the limits in which the hand does not touch itself."""
        self.move(self.hand.reduce(self.hand.random(1, self._random)[0]).double())

    def stop(self) -> None:
        """Stop serving."""
        self.server.stop()

    def _show(self) -> None:
        """Bring the links to where the sliders say."""
        with self._moving, torch.no_grad(), self.server.atomic():
            poses = self.hand.forward_kinematics(self.posture)
            turns = rotation.from_matrix(poses[:, :3, :3]).numpy()
            for link, pose, turn in zip(self.hand.link_names, poses.numpy(), turns, strict=True):
                self.links[link].position = pose[:3, 3]
                self.links[link].wxyz = turn

    def _add_links(self, fingers: list[_Finger]) -> None:
        scene = self.server.scene
        for link in self.hand.link_names:
            self.links[link] = scene.add_frame(
                f"/{link}", show_axes=False, axes_length=0.025, axes_radius=0.0008, origin_radius=0.0016
            )
            centers = [shape.pose[:3, 3] for shape in self.hand.shapes if shape.link == link] or [np.zeros(3)]
            self._link_names.append(
                scene.add_label(
                    f"/{link}/name", link, position=np.mean(centers, axis=0), font_screen_scale=0.8, visible=False
                )
            )
        colors = {self.hand.spec.palm: PALM_COLOR}
        for i, finger in enumerate(fingers):
            colors |= dict.fromkeys(finger.links, FINGER_COLORS[i % len(FINGER_COLORS)])
            self._finger_names.append(scene.add_label(f"/{finger.links[-1]}/finger", finger.name))
        for i, shape in enumerate(self.hand.shapes):
            mesh = shape.mesh()
            solid = scene.add_mesh_simple(
                f"/{shape.link}/shape_{i}",
                np.asarray(mesh.vertices),
                np.asarray(mesh.faces),
                color=colors[shape.link],
                flat_shading=not shape.is_capsule,
                position=shape.pose[:3, 3],
                wxyz=rotation.from_matrix(torch.from_numpy(shape.pose[:3, :3])).numpy(),
            )
            self._meshes.append(solid)

    def _set_stage(self) -> None:
        """Look at the palm past the thumb, a little from above; under the hand lies a floor."""
        shapes = self.hand.shapes
        poses = self.hand.shape_poses(self.hand.forward_kinematics(self.posture)).numpy()
        bounds = [shape.mesh().apply_transform(pose).bounds for shape, pose in zip(shapes, poses, strict=True)]
        low, high = np.min(bounds, axis=(0, 1)), np.max(bounds, axis=(0, 1))
        center, size = (low + high) / 2, np.linalg.norm(high - low)
        aside = -0.4 if self.hand.spec.side == "right" else 0.4
        camera = self.server.initial_camera
        camera.fov = math.radians(45)
        camera.look_at = center
        camera.position = center + 1.6 * size * np.array([0.9, aside, 0.3])
        floor = (center[0], center[1], low[2])
        self.server.scene.add_grid("/floor", 0.5, 0.5, cell_size=0.05, section_size=0.5, position=floor)

    def _add_controls(self, fingers: list[_Finger]) -> None:
        gui, spec = self.server.gui, self.hand.spec
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"{spec.name}, {spec.side} hand")
        coupled = [f"{joint.name} = {_coupling(joint)}" for joint in spec.joints if joint.mimic is not None]
        gui.add_markdown(
            "Each slider moves one joint between its limits, in degrees: drag it or type a number."
            + (f" Coupled joints follow: {', '.join(coupled)}." if coupled else "")
            + " The floor's squares are 5 cm."
        )
        posture = gui.add_button_group("Posture", ("Reset", "Random"), hint="all zero, or anywhere within the limits")
        posture.on_click(lambda _: self.reset() if posture.value == "Reset" else self.move_randomly())
        frames = gui.add_checkbox("Link frames", False, hint="x red, y green, z blue; 25 mm long")
        frames.on_update(lambda _: self._show_frames(frames.value))
        names = gui.add_checkbox("Link names", False, hint="as in the URDF")
        names.on_update(lambda _: self._show_names(names.value))
        sliders = {}
        for finger in fingers:
            with gui.add_folder(finger.name):
                for joint in finger.joints:
                    lower, upper = _degrees(joint.lower), _degrees(joint.upper)
                    sliders[joint.name] = gui.add_slider(
                        joint.name,
                        min=lower,
                        max=upper,
                        step=STEP,
                        initial_value=min(max(0.0, lower), upper),
                        marks=((lower, f"{lower:g}°"), (upper, f"{upper:g}°")),
                        hint=f"{joint.lower:.3f} to {joint.upper:.3f} rad",
                    )
                    sliders[joint.name].on_update(lambda _: self._show())
        self.sliders = {name: sliders[name] for name in self.hand.freedoms}

    def _show_frames(self, shown: bool) -> None:
        """The axes of all links, seen through the shapes around them."""
        with self.server.atomic():
            for frame in self.links.values():
                frame.show_axes = shown
            for mesh in self._meshes:
                mesh.opacity = 0.4 if shown else None

    def _show_names(self, shown: bool) -> None:
        """The names of all links, in place of the fingers'."""
        with self.server.atomic():
            for name in self._link_names:
                name.visible = shown
            for name in self._finger_names:
                name.visible = not shown


def view_hand(hand: Hand, port: int = 8080, seed: int = 0) -> HandPage:
    """Serve a page that shows a hand, and return at once; `stop()` ends it.

    Args:
        hand: The hand.
        port: Port of this machine; the next free one if it is taken, any free one if 0.
        seed: Seed of the random postures.

    Returns:
        The page; its `url` has the port.

    Raises:
        ValueError: The port cannot be, or viser is not installed.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"port is {port}, expected 0 to 65535")
    return HandPage(hand, port, seed)


def view(hand: str | Path = "dlr2", side: Side = "right", port: int = 8080, seed: int = 0) -> None:
    """Serve the page of a hand until interrupted; its address is printed to stderr.

    Args:
        hand: Name in robots/, or a folder with a URDF and a hand.yaml.
        side: Side of the hand.
        port: As in `view_hand`.
        seed: As in `view_hand`.

    Raises:
        FileNotFoundError: The hand is unknown.
        ValueError: As in `view_hand`, or the hand cannot be.
    """
    with contextlib.redirect_stdout(sys.stderr):  # viser announces itself on stdout, which is for results
        page = view_hand(Hand.load(hand, side), port, seed)
        try:
            page.server.sleep_forever()
        except KeyboardInterrupt:
            pass
        finally:
            page.stop()


def _fingers(hand: Hand) -> list[_Finger]:
    """The branches at the palm, each named as its pad or else as its first link."""
    spec = hand.spec
    branches: dict[str, list[str]] = {}
    first: dict[str, str] = {}  # of each link but the palm, the link of its branch that is next to the palm
    for joint in spec.joints:
        first[joint.child] = first.get(joint.parent, joint.child)
        branches.setdefault(first[joint.child], []).append(joint.child)
    names = {first[pad.link]: name for name, pad in spec.pads.items() if pad.link in first}
    return [
        _Finger(
            names.get(start, start),
            links,
            [spec.joint(name) for name in hand.freedoms if spec.joint(name).child in links],
        )
        for start, links in branches.items()
    ]


def _coupling(joint: Joint) -> str:
    """Formula of a coupled joint's angle, such as `0.5 thumb_pip + 10°`."""
    factor = "" if joint.multiplier == 1 else f"{joint.multiplier:g} "
    offset = f" {'+' if joint.offset > 0 else '-'} {abs(_degrees(joint.offset)):g}°" if joint.offset else ""
    return f"{factor}{joint.mimic}{offset}"


def _degrees(radians: float) -> float:
    """To a tenth, as sliders show them."""
    return round(math.degrees(radians), 1)
