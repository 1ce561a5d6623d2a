"""Measures the certificates: cost, dense checks, an attack, agreement with another verifier.

    python benchmarks/certificates.py             # everything: half an hour on one core
    python benchmarks/certificates.py cost dense  # parts of it: cost, checked, dense, attack, peer

Prints what docs/certificates.md states; times are those of the processor. Networks are trained
here, through the arm; the forward kinematics and the networks' answers that certificates are held
against are written here as well. auto_LiRPA is left out where it cannot be imported.
"""

import os
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from certificate_attack import attack
from threadpoolctl import threadpool_limits

from iksamples.arm.chain import SerialChain
from iksamples.arm.load import load_arm
from iksamples.arm.target import COORDINATES, Target
from iksamples.certify.checker import Claim, verify
from iksamples.certify.search import Certificate, certify_stack
from iksamples.network import StackedMLP
from iksamples.region import Region


Z, Y = (0, 0, 1), (0, 1, 0)
F64 = torch.float64


def make_chain(axes: list, points: list, tip: tuple) -> SerialChain:
    """A chain of revolute joints, stretched along an axis at zero."""
    n = len(axes)
    return SerialChain(
        tuple(f"j{i}" for i in range(n)),
        tuple("revolute" for _ in axes),
        np.array(axes, float),
        np.array(points, float),
        np.array(tip, float),
        np.full(n, -np.pi),
        np.full(n, np.pi),
    )


# The paper's arm, one like a UR5 and one like an iiwa, each with a pose in its middle.
ARMS = {
    "3R": (load_arm(Path(__file__).parents[1] / "config/robots/rrr70.urdf"), [0.8, -1.2, -1.6]),
    "6R": (
        make_chain(
            [Z, Y, Y, Y, (0, 0, -1), Y],
            [(0, 0, 0), (0, 0, 89.2), (425, 0, 89.2), (817.25, 0, 89.2), (817.25, 109.15, 89.2),
             (817.25, 109.15, -5.45)],
            (817.25, 191.45, -5.45),
        ),
        [0.3, -1.2, 1.7, -0.6, -1.5, 0.2],
    ),
    "7R": (
        make_chain(
            [Z, Y, Z, (0, -1, 0), Z, Y, Z],
            [(0, 0, z) for z in (0, 340, 340, 740, 740, 1140, 1140)],
            (0, 0, 1266),
        ),
        [0.2, 0.6, 0.1, -1.4, 0.1, 0.9, 0.0],
    ),
}  # fmt: skip


def forward(chain: SerialChain, joints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Tip [mm] and orientation by the product of exponentials."""
    rotation = torch.eye(3, dtype=F64).expand(len(joints), 3, 3)
    tip = torch.zeros(len(joints), 3, dtype=F64)
    for i, (axis, point) in enumerate(zip(chain.axes, chain.points_mm, strict=True)):
        x, y, z = axis / np.linalg.norm(axis)
        skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=F64)
        sine, cosine = torch.sin(joints[:, i, None, None]), torch.cos(joints[:, i, None, None])
        turn = torch.eye(3, dtype=F64) + sine * skew + (1 - cosine) * (skew @ skew)
        shift = torch.tensor(point) - turn @ torch.tensor(point)
        tip, rotation = tip + (rotation @ shift[:, :, None])[:, :, 0], rotation @ turn
    return tip + rotation @ torch.tensor(chain.tip_mm), rotation


def rotations(angles: torch.Tensor) -> torch.Tensor:
    """Rotation matrices of roll, pitch and yaw about the fixed axes."""
    total = torch.eye(3, dtype=F64).expand(len(angles), 3, 3)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        turn = torch.eye(3, dtype=F64).repeat(len(angles), 1, 1)
        sine, cosine = torch.sin(angles[:, i]), torch.cos(angles[:, i])
        turn[:, j, j] = turn[:, k, k] = cosine
        turn[:, j, k], turn[:, k, j] = -sine, sine
        total = turn @ total
    return total


Case = tuple[SerialChain, StackedMLP, np.ndarray, np.ndarray]


def train(arm: str, task: str, hidden: tuple[int, ...], activation: str, seed: int) -> Case:
    """A network trained through the arm: 1500 steps of Adam, batches of 128.

    Half of each batch is pressed onto the faces of the box, since a grid's samples are there too.

    Args:
        arm: Key of ``ARMS``.
        task: "position": three inputs. "pose": position and orientation, in a cube of 200 mm and
            0.3 rad either way about each axis. "posture": position and the last three joints, in a
            cube of 400 mm and 0.6 rad either way.
        hidden: Widths of the hidden layers.
        activation: "relu" or "tanh".
        seed: Seed of the weights and the batches.
    """
    chain, middle = ARMS[arm]
    pose = torch.tensor(middle, dtype=F64)
    torch.manual_seed(seed)
    tip, upright = forward(chain, pose[None])
    centre, half = tip[0].numpy(), 200.0 if task == "posture" else 100.0
    if arm == "3R":
        centre, half = np.array([50.0, 50.0, 30.0]), 30.0
    lower, upper = centre - half, centre + half
    if task != "position":
        more = np.zeros(3) if task == "pose" else np.array(middle[3:])
        turn = 0.3 if task == "pose" else 0.6
        lower, upper = np.r_[lower, more - turn], np.r_[upper, more + turn]
    layers: list[torch.nn.Module] = []
    for a, b in pairwise((len(lower), *hidden, chain.n_joints)):
        kind = torch.nn.ReLU if activation == "relu" else torch.nn.Tanh
        layers += [torch.nn.Linear(a, b, dtype=F64), kind()]
    net = torch.nn.Sequential(*layers[:-1])
    linear = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        linear[-1].bias.add_(pose)
    low, size = torch.tensor(lower), torch.tensor(upper - lower)
    adam = torch.optim.Adam(net.parameters(), lr=3e-3)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, 1500, 1e-4)
    for _ in range(1500):
        share = torch.rand(128, len(lower), dtype=F64)
        share[:64] = torch.where(torch.rand(64, len(lower)) < 0.5, share[:64].round(), share[:64])
        goal, joints = low + size * share, net(share)
        tip, rotation = forward(chain, joints)
        loss = ((tip - goal[:, :3]) ** 2).sum(1).mean()
        if task == "pose":
            apart = rotation - rotations(goal[:, 3:]) @ upright[0]
            loss = loss + 0.5 * 100.0**2 * (apart**2).sum((1, 2)).mean()
        elif task == "posture":
            loss = loss + 100.0**2 * ((joints[:, 3:] - goal[:, 3:]) ** 2).sum(1).mean()
        else:
            loss = loss + ((joints - pose) ** 2).sum(1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        rate.step()
    with torch.no_grad():
        weights = [layer.weight.T.numpy().astype(np.float32)[None] for layer in linear]
        biases = [layer.bias.numpy().astype(np.float32)[None] for layer in linear]
    stack = StackedMLP(
        tuple(weights), tuple(biases), activation, lower, upper - lower, (seed,)
    )  # fmt: skip
    return chain, stack, lower, upper


def upright(arm: str) -> np.ndarray:
    """Rotation of an arm's tool in the pose in its middle."""
    chain, middle = ARMS[arm]
    return forward(chain, torch.tensor(middle, dtype=F64)[None])[1][0].numpy()


def turned_to(arm: str) -> dict:
    """What is asked where an angle is to be certified."""
    return {"target": Target(COORDINATES, "fixed", upright(arm)), "measure": "angle"}


def enclosed(case: Case, rtol: float, asked: dict, *, kept: bool = False) -> Certificate:
    """Certifies a case; ``asked`` are a target and a measure, or nothing."""
    chain, stack, lower, upper = case
    region = Region.box(lower, upper)
    return certify_stack(stack, chain, region, rtol=rtol, keep_leaves=kept, **asked)[0]


def spent(do: Callable[[], Any], times: int = 1) -> tuple[float, Any]:
    """Processor time [ms] in the median of some times, and what came out."""
    all_ms = []
    for _ in range(times):
        began = time.process_time()
        result = do()
        all_ms.append(1e3 * (time.process_time() - began))
    return float(np.median(all_ms)), result


def cost(title: str, cases: list[Case], rtol: float, asked: dict) -> None:
    """Prints a row of the table."""
    seen = []
    for case in cases:
        took, found = spent(partial(enclosed, case, rtol, asked), 5 if len(case[2]) == 3 else 1)
        seen.append((np.degrees(found.upper) if asked else found.upper, took, found.boxes))
        if not found.complete:
            print("not complete:")
    sizes, ms, boxes = zip(*seen, strict=True)
    print(
        f"| {title} | {len(cases)} | {rtol:.0%} | {min(sizes):.1f} to {max(sizes):.1f} "
        f"| {np.median(ms):.1f} | {max(ms):.1f} | {np.median(boxes):.0f} | {max(boxes)} |",
        flush=True,
    )


def plain_answer(stack: StackedMLP, points: np.ndarray) -> np.ndarray:
    """Joint values, shape (points, joints)."""
    hidden = (points - stack.offset) / stack.scale
    for depth, (weight, bias) in enumerate(zip(stack.weights, stack.biases, strict=True)):
        hidden = hidden @ np.float64(weight[0]) + np.float64(bias[0])
        if depth + 1 < len(stack.weights):
            hidden = np.tanh(hidden) if stack.activation == "tanh" else hidden * (hidden > 0)
    return hidden


def plain_errors(stack: StackedMLP, points: np.ndarray) -> np.ndarray:
    """Errors [mm] on the paper's arm, whose forward kinematics is written out."""
    q1, q2, q3 = plain_answer(stack, points).T
    radius = -70 * (np.sin(q2) + np.sin(q2 + q3))
    x, y, z = points.T
    return np.sqrt(
        (radius * np.cos(q1) - x) ** 2
        + (radius * np.sin(q1) - y) ** 2
        + (70 + 70 * (np.cos(q2) + np.cos(q2 + q3)) - z) ** 2
    )


def turned(vectors: np.ndarray, axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Vectors (3, ..., n) turned about a coordinate axis, either way round."""
    i = int(np.abs(axis).argmax())
    j, k = (i + 1) % 3, (i + 2) % 3
    sine, cosine = axis[i] * np.sin(angles), np.cos(angles)
    result = np.array(np.broadcast_to(vectors, (*vectors.shape[:-1], len(angles))))
    result[j], result[k] = (
        cosine * vectors[j] - sine * vectors[k],
        sine * vectors[j] + cosine * vectors[k],
    )
    return result


def plain_misses(case: Case, points: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Errors [mm], and of six inputs angles [rad], on arms whose axes are coordinate axes."""
    chain, stack, _, _ = case
    joints = plain_answer(stack, points)
    tip, tool = chain.tip_mm[:, None], np.eye(3)[:, :, None]
    for i in reversed(range(chain.n_joints)):
        point = chain.points_mm[i][:, None]
        tip = turned(tip - point, chain.axes[i], joints[:, i]) + point
        if points.shape[1] == 6:
            tool = turned(tool, chain.axes[i], joints[:, i])
    apart = np.linalg.norm(tip - points.T[:3], axis=0)
    if points.shape[1] < 6:
        return apart, None
    asked = upright("6R")[:, :, None]
    for axis, angles in zip(np.eye(3), points.T[3:], strict=True):
        asked = turned(asked, axis, angles)
    between = np.einsum("ikn,jkn->ijn", tool, asked)
    twist = [between[j, i] - between[i, j] for i, j in ((0, 1), (1, 2), (2, 0))]
    return apart, np.arctan2(np.linalg.norm(twist, axis=0), np.einsum("iin->n", between) - 1)


def dense(cases: list[Case], rtol: float, n: int = 10**7) -> None:
    """Holds certificates against dense points, a quarter of whose coordinates are on faces."""
    rng = np.random.default_rng(0)
    above, parts = np.zeros(2, int), []
    for case in cases:
        _, _, lower, upper = case
        measures = ({}, turned_to("6R"))[: 2 if len(lower) == 6 else 1]
        bounds = [enclosed(case, rtol, asked).upper for asked in measures]
        largest = np.zeros(len(bounds))
        for _ in range(n // 20_000):
            share = rng.uniform(size=(20_000, len(lower)))
            share = np.where(rng.uniform(size=share.shape) < 0.25, share.round(), share)
            misses = plain_misses(case, lower + (upper - lower) * share)
            for k, bound in enumerate(bounds):
                above[k] += int((misses[k] > bound).sum())
                largest[k] = max(largest[k], misses[k].max())
        parts.append(largest / bounds)
    shares = np.concatenate(parts)
    print(
        f"{len(cases)} networks, {len(shares)} bounds at {rtol:.1%}, {n:.0e} points each: above "
        f"are {above[0]} positions and {above[1]} angles; the largest of the points is "
        f"{shares.min():.1%} to {shares.max():.2%} of the bound",
        flush=True,
    )


def checked(title: str, cases: list[Case], rtol: float, asked: dict) -> None:
    """Has the checker prove certificates again, with every rounding counted."""
    seconds, apart, leaves, proved = [], [], [], 0
    for case in cases:
        found = enclosed(case, rtol, asked, kept=True)
        chain, stack, lower, upper = case
        claim = Claim(
            stack, 0, chain, Region.box(lower, upper), found.upper, found.lower, found.argmax,
            **asked,
        )  # fmt: skip
        took, result = spent(partial(verify, claim, found.leaves))
        seconds.append(1e-3 * took)
        proved += result.verified
        apart.append(found.upper - result.upper)
        leaves.append(result.leaves)
    print(
        f"checker, {title}: {proved} of {len(cases)} proved, bounds at most {max(apart):.0e} below "
        f"the search's; median {np.median(leaves):.0f} leaves in {np.median(seconds):.2f} s, at "
        f"most {max(leaves)} in {max(seconds):.2f} s",
        flush=True,
    )


def lirpa_bounds(stack: StackedMLP) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """Upper bounds of the error over boxes by auto_LiRPA's CROWN, float32."""
    from auto_LiRPA import BoundedModule, BoundedTensor, PerturbationLpNorm

    # The paper's arm as sums of sines of sums of the joints, which CROWN bounds as they stand.
    angles = torch.tensor([[1, 1, 0], [-1, 1, 0], [1, 1, 1], [-1, 1, 1], [0, 1, 0], [0, 1, 1]])
    links = torch.zeros(3, 10)
    links[0, :4] = -35.0
    links[1, 4:8] = torch.tensor([35.0, -35.0, 35.0, -35.0])
    links[2, 8:] = 70.0

    class Miss(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            kind = torch.nn.ReLU if stack.activation == "relu" else torch.nn.Tanh
            parts: list[torch.nn.Module] = []
            for weight, bias in zip(stack.weights, stack.biases, strict=True):
                layer = torch.nn.Linear(*weight.shape[1:])
                layer.weight.data = torch.tensor(weight[0].T).clone()
                layer.bias.data = torch.tensor(bias[0])
                parts += [layer, kind()]
            self.net = torch.nn.Sequential(*parts[:-1])
            self.sums = torch.nn.Linear(3, 10)
            self.sums.weight.data = torch.cat([angles[:4], angles[:4], angles[4:]]).float()
            self.sums.bias.data = torch.tensor([0.0] * 4 + [np.pi / 2] * 6)
            self.tip = torch.nn.Linear(10, 3)
            self.tip.weight.data = links
            self.tip.bias.data = torch.tensor([0.0, 0.0, 70.0])
            self.own = torch.nn.Linear(3, 3)
            self.own.weight.data = torch.diag(torch.tensor(np.float32(stack.scale)))
            self.own.bias.data = torch.tensor(np.float32(stack.offset))

        def forward(self, share: torch.Tensor) -> torch.Tensor:
            return self.tip(torch.sin(self.sums(self.net(share)))) - self.own(share)

    model = BoundedModule(Miss(), torch.zeros(2, 3))

    def bound(low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
        region = PerturbationLpNorm(norm=np.inf, x_L=low, x_U=high)
        below, above = model.compute_bounds(
            x=(BoundedTensor(0.5 * (low + high), region),), method="CROWN"
        )
        return torch.maximum(below.abs(), above.abs()).norm(dim=1).detach()

    return bound


def agreement(cases: list[Case], rtol: float = 0.05) -> None:
    """Certifies the same networks with auto_LiRPA by plain branch and bound."""
    both, seconds, mine, ratios = 0, [], [], []
    for chain, stack, lower, upper in cases:
        took, found = spent(partial(enclosed, (chain, stack, lower, upper), rtol, {}))
        mine.append(1e-3 * took)
        bounds, largest, settled = lirpa_bounds(stack), 0.0, 0.0
        began = time.perf_counter()
        corners = lower + (upper - lower) * np.stack(np.meshgrid(*[[0, 1]] * 3), -1).reshape(-1, 3)
        largest = float(plain_errors(stack, corners).max())
        low, high = torch.zeros(1, 3), torch.ones(1, 3)
        while len(low) and time.perf_counter() - began < 30:
            ends = torch.stack([low, high, 0.5 * (low + high)]).numpy().reshape(-1, 3)
            points = lower + (upper - lower) * ends.astype(float)
            largest = max(largest, float(plain_errors(stack, points).max()))
            above = bounds(low, high)
            done = above <= (1 + rtol) * largest
            settled = max(settled, float(above[done].max()) if done.any() else 0.0)
            low, high = low[~done], high[~done]
            if len(low):
                axis = (high - low).argmax(1, keepdim=True)
                middle = 0.5 * (low.gather(1, axis) + high.gather(1, axis))
                low, high = (
                    torch.cat([low, low.scatter(1, axis, middle)]),
                    torch.cat([high.scatter(1, axis, middle), high]),
                )
        seconds.append(time.perf_counter() - began)
        if not len(low):
            both += found.lower <= settled and largest <= found.upper
            ratios.append(found.upper / settled)
    print(
        f"auto_LiRPA: {both} of {len(cases)} networks agree (finished {len(ratios)}); our upper / "
        f"its upper {min(ratios):.3f} to {max(ratios):.3f}; median {np.median(seconds):.2f} s "
        f"beside {np.median(mine) * 1e3:.1f} ms, max {max(seconds):.2f} s"
    )


def main() -> None:
    """Trains, measures and prints."""
    torch.set_num_threads(1)
    threadpool_limits(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with Path("/proc/cpuinfo").open() as lines:
        print(next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "?"))
    print(f"numpy {np.__version__}, torch {torch.__version__}, one core")
    parts = set(sys.argv[1:]) or {"cost", "checked", "dense", "attack", "peer"}
    angle = turned_to("6R")
    for arm, task, hidden, seeds, rtol in (
        ("3R", "position", (16,), 5, 0.01),
        ("3R", "position", (16, 16), 5, 0.01),
        ("6R", "position", (32, 32), 5, 0.01),
        ("7R", "position", (32, 32), 5, 0.01),
        ("6R", "pose", (32,), 3, 0.05),
        ("6R", "posture", (32,), 3, 0.05),
        ("6R", "pose", (32, 32), 3, 0.05),
        ("6R", "posture", (32, 32), 3, 0.05),
    ):
        for activation in ("relu", "tanh") if "cost" in parts else ():
            cases = [train(arm, task, hidden, activation, seed) for seed in range(seeds)]
            shape = "-".join(str(len(b[0])) for b in cases[0][1].biases)
            title = f"{arm} {task}, {len(cases[0][2])}-{shape} {activation}"
            cost(title, cases, rtol, {})
            if task == "pose":
                cost(f"{title}, angle [deg]", cases, rtol, angle)
    kinds = ("relu", "tanh")
    small = [
        train("3R", "position", hidden, kind, seed)
        for hidden in ((16,), (16, 16))
        for kind in kinds
        for seed in range(5 if parts & {"checked", "dense"} else 3)
        if parts & {"checked", "dense", "attack", "peer"}
    ]
    if parts & {"checked", "dense"}:
        poses = [train("6R", "pose", (32,), kind, seed) for kind in kinds for seed in range(3)]
    if "checked" in parts:
        checked("3R position", small, 0.01, {})
        checked("6R pose", poses, 0.05, {})
        checked("6R pose, angle [rad]", poses, 0.05, angle)
    if "dense" in parts:
        dense(poses, 0.05)
        dense(
            [train(arm, "position", (32, 32), kind, 0) for arm in ("6R", "7R") for kind in kinds],
            0.01,
        )
        dense(small, 0.001)
    if "attack" in parts:
        attack([case for i, case in enumerate(small) if i % (len(small) // 4) < 3], plain_errors)
    if "peer" in parts:
        try:
            agreement(small[::4])
        except ImportError as error:
            print(f"second verifier left out: {error}")


if __name__ == "__main__":
    main()
