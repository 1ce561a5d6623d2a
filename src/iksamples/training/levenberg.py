"""Second-order training: Levenberg-Marquardt on all samples, for all seeds at once.

One epoch is one iteration: a damped Gauss-Newton step is solved for every seed (batched linear
algebra in torch, float64) and taken where it lowers that seed's loss. Damping is each seed's own,
after Nielsen's rule (Madsen, Nielsen and Tingleff, *Methods for Non-Linear Least Squares Problems*,
2nd ed., 2004, algorithm 3.16). A seed stops when its gradient or its steps have all but vanished.
"""

from collections.abc import Sequence

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from iksamples.training.problem import Problem
from iksamples.training.reference import (
    ACTIVATIONS,
    Progress,
    StackedAdam,
    forward,
    kernel_statistics,
    layers,
    one_thread,
    seed_losses,
)


INITIAL_DAMPING = 1e-3
"""Damping at the start, as a share of the largest diagonal entry of J^T J."""

SMALL_GRADIENT = 1e-12
"""A seed has converged when no entry of its gradient [rad^2] is larger."""

SMALL_STEP = 1e-12
"""A seed has converged when a step is shorter than this share of its parameters."""

_JACOBIAN_BYTES = 2**23
"""The Jacobians of one part: more would leave the cache."""


class LevenbergEngine:
    """Trains blocks of iterations."""

    dtype = torch.float64
    pace = 3e4

    def __init__(self, problem: Problem) -> None:
        """Takes the problem whose seeds it trains."""
        self.problem = problem

    @one_thread()
    @threadpool_limits.wrap(limits=1, user_api="blas")
    def run(
        self, flat: Tensor, state: StackedAdam, progress: Progress, first: int, n_epochs: int
    ) -> None:
        """Trains from iteration ``first`` for ``n_epochs``; see ``ReferenceEngine.run``.

        Damping and its growth are kept in the optimiser's state in place of Adam's moments.
        """
        problem = self.problem
        inputs, targets = (
            torch.from_numpy(table).to(flat) for table in (problem.inputs, problem.targets)
        )
        train_rows, validation_rows = (
            torch.tensor(rows, dtype=torch.int64, device=flat.device)
            for rows in (problem.train_rows, problem.validation_rows)
        )
        flat = flat.detach()
        damping, growth = (state.state[state.flat][name] for name in ("mean", "square"))
        for epoch in range(first, first + n_epochs):
            losses = torch.full((problem.n_seeds,), torch.nan).to(flat)
            checks, converged = losses.clone(), torch.zeros_like(losses, dtype=torch.bool)
            for rows in self._parts(progress):
                x, y = inputs[train_rows[rows]], targets[train_rows[rows]]
                losses[rows], converged[rows] = iterate(
                    problem, flat, damping[:, 0], growth[:, 0], rows, x, y, epoch == 1
                )
                stack = list(layers(flat[rows], problem.sizes))
                x, y = inputs[validation_rows[rows]], targets[validation_rows[rows]]
                checks[rows] = seed_losses(stack, problem.activation, x, y)
            statistics = torch.stack(kernel_statistics(list(layers(flat, problem.sizes))))
            metrics = torch.cat([torch.stack([losses, checks]).float(), statistics])
            progress.end_epoch(epoch, metrics, flat)
            progress.stop(converged, epoch, flat)
            if progress.all_stopped():
                return

    def _parts(self, progress: Progress) -> Sequence[Tensor]:
        """Rows of the running seeds, in parts whose Jacobians fit in memory."""
        problem = self.problem
        size = problem.n_train * problem.sizes[-1] * problem.n_parameters * 8
        running = torch.nonzero(progress.stopped == 0)[:, 0]
        return running.split(max(1, _JACOBIAN_BYTES // size))


def iterate(
    problem: Problem,
    flat: Tensor,
    damping: Tensor,
    growth: Tensor,
    rows: Tensor,
    x: Tensor,
    y: Tensor,
    start: bool,
) -> tuple[Tensor, Tensor]:
    """One iteration of some seeds.

    Args:
        problem: What is trained.
        flat: Parameters of all seeds, changed in place, shape (seeds, parameters).
        damping: Damping of all seeds, changed in place, shape (seeds,).
        growth: Factor of the next increase, changed in place, shape (seeds,).
        rows: The seeds' rows.
        x: Their inputs, shape (rows, points, in).
        y: Their targets, shape (rows, points, out).
        start: Whether this is the first iteration.

    Returns:
        The loss after the iteration [rad^2] and whether the seed has converged, shape (rows,).
    """
    old = flat[rows]
    stack = list(layers(old, problem.sizes))
    residual, jacobian = linearise(stack, problem.activation, x, y)
    normal = gram(jacobian)
    gradient = (jacobian.mT @ residual[..., None])[..., 0]
    diagonal = normal.diagonal(dim1=1, dim2=2)
    if start:
        damping[rows] = INITIAL_DAMPING * diagonal.amax(1)
        growth[rows] = 2.0
    mu, nu = damping[rows], growth[rows]
    diagonal += mu[:, None]
    factor, _ = torch.linalg.cholesky_ex(normal)
    step = torch.cholesky_solve(-gradient[..., None], factor)[..., 0]
    new = old + step
    n = residual.shape[1]
    before = residual.square().sum(1)
    errors = forward(list(layers(new, problem.sizes)), problem.activation, x) - y
    after = errors.flatten(1).square().sum(1)
    # Twice the drop that the linear model promises, and what there was of it.
    promised = (step * (mu[:, None] * step - gradient)).sum(1)
    gain = (before - after) / promised
    better = after < before
    shrink = (1 - (2 * gain - 1) ** 3).clamp(min=1 / 3)
    damping[rows] = torch.where(better, mu * shrink, mu * nu)
    growth[rows] = torch.where(better, 2.0, 2.0 * nu)
    flat[rows] = torch.where(better[:, None], new, old)
    converged = gradient.abs().amax(1) * (2 / n) <= SMALL_GRADIENT
    converged |= step.norm(dim=1) <= SMALL_STEP * old.norm(dim=1)
    # A damping beyond all bounds: no step helps (or the loss is not a number).
    converged |= ~torch.isfinite(damping[rows]) | (damping[rows] > 1e30)
    return torch.where(better, after, before) / n, converged


def gram(jacobian: Tensor) -> Tensor:
    """The product J^T J of each seed.

    NumPy hands a matrix times its own transpose to the BLAS's symmetric product, which does half
    the work; torch does not.

    Args:
        jacobian: Shape (seeds, residuals, parameters).
    """
    if jacobian.device.type != "cpu":
        return jacobian.mT @ jacobian
    return torch.from_numpy(np.stack([one.T @ one for one in jacobian.numpy()]))


def linearise(
    stack: Sequence[tuple[Tensor, Tensor]], activation: str, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor]:
    """Residuals and their derivatives with respect to the parameters.

    Args:
        stack: Kernels (seeds, in, out) and biases (seeds, out).
        activation: Activation of the hidden layers.
        x: Inputs, shape (seeds, points, in).
        y: Targets, shape (seeds, points, out).

    Returns:
        Residuals, shape (seeds, points * out), and their Jacobian, shape
        (seeds, points * out, parameters), parameters in the order of ``layers``.
    """
    seeds, points, n_out = y.shape
    units, slopes = [x], []
    for kernel, bias in stack[:-1]:
        before = torch.baddbmm(bias[:, None, :], units[-1], kernel).requires_grad_()
        with torch.enable_grad():
            after = ACTIVATIONS[activation](before)
            (slope,) = torch.autograd.grad(after.sum(), before)
        units.append(after.detach())
        slopes.append(slope)
    kernel, bias = stack[-1]
    residual = torch.baddbmm(bias[:, None, :], units[-1], kernel) - y
    # How each output (third axis) hangs on the units of the current layer (last axis).
    back = torch.eye(n_out, dtype=x.dtype, device=x.device).expand(seeds, points, n_out, n_out)
    columns: list[Tensor] = []
    for depth in reversed(range(len(stack))):
        kernel, _ = stack[depth]
        to_kernel = units[depth][:, :, None, :, None] * back[:, :, :, None, :]
        columns[:0] = [to_kernel.flatten(3), back]
        if depth > 0:
            back = (back.flatten(1, 2) @ kernel.mT).unflatten(1, (points, n_out))
            back = back * slopes[depth - 1][:, :, None, :]
    jacobian = torch.cat(columns, dim=3).flatten(1, 2)
    return residual.flatten(1), jacobian
