"""Time the hand: kinematics beside plain pytorch_kinematics on the same URDF in the same run, and distances.

python benchmarks/kinematics.py --out benchmarks/results/kinematics.json
Both chains are timed in turn, so that what else the machine does meets both alike; the medians count.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytorch_kinematics
import torch

from dexzoo.hand import Hand
from dexzoo.resources import resource

Poses = Callable[[torch.Tensor], list[torch.Tensor]]  # of all links, in one tensor or in one for each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=10_000, help="postures")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    generator = torch.Generator().manual_seed(options.seed)
    hand = Hand.load("dlr2")
    result = {
        "threads": options.threads,
        "torch": torch.__version__,
        "pytorch_kinematics": version("pytorch_kinematics"),
        "kinematics": kinematics(hand, options.batch, options.repeats, generator),
        "distances": distances(hand, options.repeats, generator),
    }
    text = json.dumps(result, indent=2)
    if options.out:
        options.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")


def kinematics(hand: Hand, batch: int, repeats: int, generator: torch.Generator) -> dict[str, object]:
    q = hand.lower + (hand.upper - hand.lower) * torch.rand(batch, len(hand.joint_names), generator=generator)
    both = {"ours": ours(hand), "pytorch_kinematics": theirs(hand, torch.float32)}
    forward = alternate({name: lambda poses=poses: poses(q) for name, poses in both.items()}, repeats)
    backward = alternate({name: lambda poses=poses: gradient(poses, q) for name, poses in both.items()}, repeats)
    exact = q[:1000].double()
    plain = torch.stack(torch.broadcast_tensors(*theirs(hand, torch.float64)(exact)), 1)
    difference = hand.forward_kinematics(exact) - plain
    return {
        "batch": batch,
        "postures_per_second": {
            "forward": {name: round(batch / seconds) for name, seconds in forward.items()},
            "forward_and_backward": {name: round(batch / seconds) for name, seconds in backward.items()},
        },
        "ratio": {
            "forward": round(forward["pytorch_kinematics"] / forward["ours"], 2),
            "forward_and_backward": round(backward["pytorch_kinematics"] / backward["ours"], 2),
        },
        # what remains is theirs: pytorch_kinematics reads the URDF's rotations in single precision
        "largest_disagreement_in_float64": {
            "position_m": largest(difference[..., :3, 3]),
            "rotation": largest(difference[..., :3, :3]),
            "gradient": largest(gradient(ours(hand), exact) - gradient(theirs(hand, torch.float64), exact)),
        },
    }


def ours(hand: Hand) -> Poses:
    return lambda q: [hand.forward_kinematics(q)]


def theirs(hand: Hand, dtype: torch.dtype) -> Poses:
    urdf = (resource("robots") / "dlr2" / "dlr2.urdf").read_bytes()
    chain = pytorch_kinematics.build_chain_from_urdf(urdf).to(dtype=dtype)
    order = [hand.joint_names.index(name) for name in chain.get_joint_parameter_names()]

    def poses(q: torch.Tensor) -> list[torch.Tensor]:
        found = chain.forward_kinematics(q[:, order])
        return [found[link].get_matrix() for link in hand.link_names]

    return poses


def gradient(poses: Poses, q: torch.Tensor) -> torch.Tensor:
    """Of the sum of all entries of all poses."""
    q = q.clone().requires_grad_()
    sum(pose.sum() for pose in poses(q)).backward()
    return q.grad


def largest(difference: torch.Tensor) -> float:
    return float(difference.abs().max())


def distances(hand: Hand, repeats: int, generator: torch.Generator) -> dict[str, object]:
    """What a refinement of 100 grasps at ten waypoints asks for."""
    share = torch.rand(100, 10, len(hand.freedoms), generator=generator)
    q = hand.expand(hand.reduce(hand.lower) + hand.reduce(hand.upper - hand.lower) * share)
    points = 0.3 * torch.rand(2000, 3, generator=generator) - 0.1
    table = torch.tensor([0.0, 0, 1, 0.1])
    asked: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "signed_distance": lambda links: hand.signed_distance(links, points),
        "self_distance": hand.self_distance,
        "clearance": lambda links: hand.clearance(links, table),
    }

    def alone(distance: Callable[[torch.Tensor], torch.Tensor]) -> None:
        with torch.no_grad():
            distance(hand.forward_kinematics(q))

    def with_gradient(distance: Callable[[torch.Tensor], torch.Tensor]) -> None:
        moved = q.clone().requires_grad_()
        distance(hand.forward_kinematics(moved)).sum().backward()

    # kinematics are included
    seconds = {
        name: {
            "forward": alternate({name: lambda distance=distance: alone(distance)}, repeats)[name],
            "forward_and_backward": alternate({name: lambda distance=distance: with_gradient(distance)}, repeats)[name],
        }
        for name, distance in asked.items()
    }
    return {
        "grasps": 100,
        "waypoints": 10,
        "links": len(hand.solid_names),
        "points": len(points),
        "pairs_of_links": len(hand.self_pairs),
        "seconds": {name: {way: round(value, 4) for way, value in row.items()} for name, row in seconds.items()},
    }


def alternate(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each call, after one to warm up."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(values[1:]) for name, values in seconds.items()}


if __name__ == "__main__":
    main()
