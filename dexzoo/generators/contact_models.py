"""Contact models of a demonstration: where each link lay on the surface (Kopicki et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dexzoo import rotation
from dexzoo.generators.demonstration import Demonstration
from dexzoo.grasp import GRIP
from dexzoo.hand import Hand


@dataclass(frozen=True)
class Bandwidths:
    """Widths of kernels and fields; the defaults are Kopicki's.

    Attributes:
        position: s of the position kernel, meters.
        concentration: k of the orientation kernel.
        joint: Width of the posture kernel, radians.
        curvature: Width of the feature kernel, in standard deviations of the contact's own curvatures.
        contact: Distance in meters from a link within which the surface counts as under it.
        decay: Weight of the squared distance there, 1/m^2.
    """

    position: float = 0.005
    concentration: float = 200.0
    joint: float = 0.015708
    curvature: float = 50.0
    contact: float = 0.01
    decay: float = 50.0


MIN_CONTACT = 50
"""Surface points under a link from which on it counts as in contact."""
MAX_CONTACT = 400
"""Kernels of a contact model; more points are thinned out."""


@dataclass(frozen=True)
class ContactModel:
    """M(u, r) of one link: its pose u relative to the frame of a surface feature, with the feature's curvature r.

    Attributes:
        link: Index of the link in `hand.link_names`.
        position: Positions of the link, meters, (n, 3).
        quaternion: Orientations of the link, (n, 4).
        curvature: Curvatures of the features, 1/m, (n, 2).
        weight: Weights of the kernels, (n,).
    """

    link: int
    position: Tensor
    quaternion: Tensor
    curvature: Tensor
    weight: Tensor


def contact_models(demonstration: Demonstration, hand: Hand, widths: Bandwidths) -> list[ContactModel]:
    """The contact models of all links that touch at the grip, in the order of the hand's links.

    Args:
        demonstration: The demonstration.
        hand: Its hand.
        widths: Widths of the fields.
    """
    surface, grasp = demonstration.surface, demonstration.grasp
    links = grasp.wrist_pose[0, GRIP] @ hand.forward_kinematics(grasp.joints[0, GRIP])
    points = surface.points.clone().requires_grad_()
    distance = hand.signed_distance(links, points)
    slope = torch.stack([torch.autograd.grad(row.sum(), points, retain_graph=True)[0] for row in distance])
    distance = distance.detach()
    # outside, the slope of the distance points from the link to the surface point, whose outside must face the link
    facing = -(slope * surface.normals).sum(-1) >= 0
    under = (distance < 0) | ((distance <= widths.contact) & facing)
    models = []
    for solid, name in enumerate(hand.solid_names):
        rows = under[solid].nonzero().squeeze(-1)
        if len(rows) < MIN_CONTACT:
            continue
        rows = rows[torch.linspace(0, len(rows) - 1, min(len(rows), MAX_CONTACT)).long()]
        link = hand.link_index(name)
        frame = rotation.conjugate(surface.quaternion[rows])
        models.append(
            ContactModel(
                link,
                rotation.rotate(frame, links[link, :3, 3] - surface.points[rows]),
                rotation.normalize(rotation.multiply(frame, rotation.from_matrix(links[link, :3, :3]))),
                surface.curvature[rows],
                torch.exp(-widths.decay * distance[solid, rows].clamp_min(0).square()),
            )
        )
    return models
