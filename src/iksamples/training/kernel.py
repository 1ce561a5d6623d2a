"""The fused training loop: forward, backward and Adam of many small networks, compiled by numba.

The seeds of a group lie in the lanes of vectors: number ``k`` of a row belongs to seed ``k`` of the
group (see ``lanes``). So a seed's numbers cannot depend on its neighbours, and no sum is ever
reordered. The samples of a mini-batch are taken in tiles: a tile is a stack of vectors, one per
sample, that stays in registers while the units and weights pass by.
"""

import numba
import numpy as np

from iksamples.training.lanes import (
    absolute,
    add,
    collect,
    div,
    dot,
    fill,
    fma,
    largest,
    load,
    mul,
    relu,
    sqrt,
    store,
    sub,
    tanh,
    where_positive,
    zeros,
)


ACTIVATIONS = {"relu": 0, "tanh": 1}
"""Name -> number by which the kernel knows it."""

BETA_1, BETA_2 = 0.9, 0.999


@numba.njit
def shuffle(order, lane, seed, epoch, draws):  # type: ignore[no-untyped-def]
    """Puts a lane's rows into the order of (seed, epoch); see ``problem.permutations``."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    start = _mix(_mix(seed + golden) + np.uint64(epoch))
    n = order.shape[1]
    for i in range(1, n):
        bits = _mix(start + np.uint64(i) * golden) >> np.uint64(32)
        draws[i] = np.int32((bits * np.uint64(i + 1)) >> np.uint64(32))
    for i in range(n - 1, 0, -1):
        j = draws[i]
        order[lane, i], order[lane, j] = order[lane, j], order[lane, i]


@numba.njit(forceinline=True)
def _mix(x):  # type: ignore[no-untyped-def]
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@numba.njit
def gather(table, order, first, count, out, lanes, rows):  # type: ignore[no-untyped-def]
    """Copies ``count`` samples of every lane into the first tiles of ``out``.

    What a tile has beyond ``count`` samples is filled with the first of them.
    """
    height = len(rows)
    for r in range(height):
        at = first + (r if r < count else 0)
        for column in range(table.shape[1]):
            store(out, column * height + r, collect(table, column, order, at, lanes))


@numba.njit
def forward(w, sizes, activation, h, lanes, rows):  # type: ignore[no-untyped-def]
    """Sends the inputs in the first tiles of ``h`` through all layers, into the tiles after them.

    Returns:
        Index of the first output's tile.
    """
    x = p = 0
    last = len(sizes) - 2
    for layer in range(last + 1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        y = x + n_in
        bias = p + n_in * n_out
        for j in range(n_out):
            total = fma(
                load(h, x, lanes, rows),
                load(w, p + j, lanes, (0,)),
                load(w, bias + j, lanes, (0,)),
            )
            for i in range(1, n_in):
                weight = load(w, p + i * n_out + j, lanes, (0,))
                total = fma(load(h, x + i, lanes, rows), weight, total)
            if layer < last:
                total = tanh(total) if activation == 1 else relu(total)
            store(h, y + j, total)
        x = y
        p = bias + n_out
    return x


@numba.njit
def deviate(h, y, targets, d, n_out, count, scale, loss, lanes, rows):  # type: ignore[no-untyped-def]
    """Puts the loss's slope at the outputs into ``d``; samples from ``count`` on do not count.

    Returns:
        ``loss`` plus the squared errors of the tile.
    """
    n_lanes, height = len(lanes), len(rows)
    for j in range(n_out):
        error = sub(load(h, y + j, lanes, rows), load(targets, j, lanes, rows))
        if count < height:
            store(d, y + j, error)
            start = (y + j) * height * n_lanes
            for k in range(start + count * n_lanes, start + height * n_lanes):
                d[k] = 0
            error = load(d, y + j, lanes, rows)
        loss = dot(error, error, loss)
        store(d, y + j, mul(error, scale))
    return loss


@numba.njit(forceinline=True)
def adam(w, m, v, p, gradient, rate, epsilon, c1, c2, lanes):  # type: ignore[no-untyped-def]
    """Moves parameter ``p`` of all lanes by one step."""
    mean = fma(load(m, p, lanes, (0,)), fill(BETA_1, gradient), mul(gradient, c1))
    square = fma(load(v, p, lanes, (0,)), fill(BETA_2, gradient), mul(mul(gradient, gradient), c2))
    store(m, p, mean)
    store(v, p, square)
    move = div(mul(rate, mean), add(sqrt(square), epsilon))
    store(w, p, sub(load(w, p, lanes, (0,)), move))


@numba.njit
def backward(  # type: ignore[no-untyped-def]
    w, m, v, g, sizes, activation, h, d, first, final, rate, epsilon, lanes, rows
):
    """Gradient of a tile; the last tile of a mini-batch also updates the parameters.

    A layer's weights pass by once: each sends the slope back to its input and gets its own. ``g``
    carries the gradient from tile to tile.
    """
    zero, one = zeros(rate), fill(1.0, rate)
    c1, c2 = fill(1 - BETA_1, rate), fill(1 - BETA_2, rate)
    y = p = 0
    for layer in range(len(sizes) - 1):
        y += sizes[layer]
        p += (sizes[layer] + 1) * sizes[layer + 1]
    for layer in range(len(sizes) - 2, -1, -1):
        n_in, n_out = sizes[layer], sizes[layer + 1]
        x = y - n_in
        p -= (n_in + 1) * n_out
        # The bias is the row behind the kernel, its input is one.
        for i in range(n_in + 1):
            unit = load(h, x + i, lanes, rows)
            slope = zeros(unit)
            for j in range(n_out):
                q = p + i * n_out + j
                delta = load(d, y + j, lanes, rows)
                gradient = zero if first else load(g, q, lanes, (0,))
                if i < n_in:
                    gradient = dot(unit, delta, gradient)
                    slope = fma(delta, load(w, q, lanes, (0,)), slope)
                else:
                    gradient = dot(one, delta, gradient)
                if final:
                    adam(w, m, v, q, gradient, rate, epsilon, c1, c2, lanes)
                else:
                    store(g, q, gradient)
            if layer > 0 and i < n_in:
                if activation == 1:
                    slope = mul(slope, sub(one, mul(unit, unit)))
                else:
                    slope = where_positive(unit, slope)
                store(d, x + i, slope)
        y = x


@numba.njit
def mean_loss(  # type: ignore[no-untyped-def]
    w, sizes, activation, inputs, targets, order, h, d, y_true, lanes, rows
):
    """Mean squared error of every lane over its points, as a tile."""
    n, height = order.shape[1], len(rows)
    loss = zeros(load(w, 0, lanes, (0,)))
    for first in range(0, n, height):
        count = min(height, n - first)
        gather(inputs, order, first, count, h, lanes, rows)
        gather(targets, order, first, count, y_true, lanes, rows)
        y = forward(w, sizes, activation, h, lanes, rows)
        loss = deviate(h, y, y_true, d, sizes[-1], count, fill(1.0, loss), loss, lanes, rows)
    return div(loss, fill(n * sizes[-1], loss))


@numba.njit
def kernel_statistics(w, sizes, lanes):  # type: ignore[no-untyped-def]
    """Mean, mean absolute and largest absolute kernel entry of every lane, as tiles.

    The sums are compensated (Kahan), so that they are good to the last place or so.
    """
    like = load(w, 0, lanes, (0,))
    total = error = total_size = error_size = greatest = zeros(like)
    p = n = 0
    for layer in range(len(sizes) - 1):
        for _ in range(sizes[layer] * sizes[layer + 1]):
            entry = load(w, p, lanes, (0,))
            size = absolute(entry)
            greatest = largest(greatest, size)
            total, error = compensate(total, error, entry)
            total_size, error_size = compensate(total_size, error_size, size)
            p += 1
            n += 1
        p += sizes[layer + 1]
    count = fill(n, like)
    return div(total, count), div(total_size, count), greatest


@numba.njit(forceinline=True)
def compensate(total, error, term):  # type: ignore[no-untyped-def]
    """``total + term`` and what rounding has added to it so far."""
    term = sub(term, error)
    new = add(total, term)
    return new, sub(sub(new, total), term)


@numba.njit
def _aligned(size, like):  # type: ignore[no-untyped-def]
    """An array of zeros that starts on a cache line, so that no vector lies across two."""
    line = 64 // like.itemsize
    array = np.zeros(size + line, like.dtype)
    start = (-array.ctypes.data % 64) // like.itemsize
    return array[start : start + size]


def train_group(  # type: ignore[no-untyped-def]
    data, sizes, activation, schedule, group, filled, stopping, lanes, rows
):
    """Trains one group of seeds for a block of epochs.

    Args:
        data: An ``fused.Data``.
        sizes: Neurons of each layer, int64.
        activation: Number of the activation, see ``ACTIVATIONS``.
        schedule: An ``fused.Schedule``.
        group: An ``fused.Group``.
        filled: An ``fused.Filled``.
        stopping: An ``fused.Stopping``.
        lanes: A tuple as long as there are lanes.
        rows: A tuple as long as a tile is high.
    """
    inputs, targets, train_rows, validation_rows = data
    batch_size, first_epoch, rates, epsilons = schedule
    seeds, w, m, v, kept, best_loss, counters, factor = group
    history, slots, snapshots = filled
    patience, restore_best, min_delta, plateau = stopping
    n_lanes, height = len(lanes), len(rows)
    n, n_out, n_validation = train_rows.shape[1], sizes[-1], validation_rows.shape[1]
    steps = -(-n // batch_size)
    best_epoch, waited, stalled, stopped = 0, 1, 2, 3
    n_units = 0
    for layer in range(len(sizes)):
        n_units += sizes[layer]
    # One tile more: the bias row of the output layer's loop looks at it.
    h = _aligned((n_units + 1) * height * n_lanes, w)
    d = _aligned(n_units * height * n_lanes, w)
    y_true = _aligned(n_out * height * n_lanes, w)
    g = _aligned(len(w) if batch_size > height else n_lanes, w)
    order = np.empty(train_rows.shape, np.int32)
    draws = np.empty(n, np.int32)
    for block_epoch in range(len(slots)):
        epoch = first_epoch + block_epoch
        running = 0
        for lane in range(n_lanes):
            running += counters[stopped, lane] == 0
            for i in range(n):
                order[lane, i] = train_rows[lane, i]
            shuffle(order, lane, seeds[lane], epoch, draws)
        if running == 0:
            return
        total = error = zeros(load(w, 0, lanes, (0,)))
        for step in range(steps):
            start = step * batch_size
            size = min(batch_size, n - start)
            scale = fill(2.0 / (size * n_out), total)
            loss = zeros(total)
            at = block_epoch * steps + step
            rate = mul(fill(rates[at], total), load(factor, 0, lanes, (0,)))
            epsilon = fill(epsilons[at], total)
            for first in range(start, start + size, height):
                count = min(height, start + size - first)
                gather(inputs, order, first, count, h, lanes, rows)
                gather(targets, order, first, count, y_true, lanes, rows)
                y = forward(w, sizes, activation, h, lanes, rows)
                loss = deviate(h, y, y_true, d, n_out, count, scale, loss, lanes, rows)
                opens, closes = first == start, first + height >= start + size
                backward(
                    w, m, v, g, sizes, activation, h, d, opens, closes, rate, epsilon, lanes, rows
                )
            total, error = compensate(total, error, loss)

        row = 5 * block_epoch
        store(history, row, div(total, fill(n * n_out, total)))
        if n_validation > 0:
            checked = validation_rows
            loss = mean_loss(
                w, sizes, activation, inputs, targets, checked, h, d, y_true, lanes, rows
            )
            store(history, row + 1, loss)
        mean, mean_size, greatest = kernel_statistics(w, sizes, lanes)
        store(history, row + 2, mean)
        store(history, row + 3, mean_size)
        store(history, row + 4, greatest)

        for lane in range(n_lanes):
            if counters[stopped, lane] > 0:
                for metric in range(5):
                    history[(row + metric) * n_lanes + lane] = np.nan
                continue
            validation = history[(row + 1) * n_lanes + lane]
            better = validation < best_loss[lane] - min_delta
            if better:
                best_loss[lane] = validation
                counters[best_epoch, lane] = epoch
                counters[waited, lane] = counters[stalled, lane] = 0
            else:
                counters[waited, lane] += 1
                counters[stalled, lane] += 1
            if plateau > 0 and counters[stalled, lane] >= plateau:
                factor[lane] *= np.float32(0.5)
                counters[stalled, lane] = 0
            stops = patience > 0 and counters[waited, lane] >= patience
            if stops:
                counters[stopped, lane] = epoch
            if patience > 0 and (better if restore_best else stops):
                for p in range(lane, len(w), n_lanes):
                    kept[p] = w[p]
        if slots[block_epoch] >= 0:
            for p in range(len(w)):
                snapshots[slots[block_epoch] * len(w) + p] = w[p]
