"""Postures with the tool held in points that nobody measured: a ball at rest in a socket.

A tool with two sockets is put in several places; in each socket joint values are read in many
postures. A model of the arm is right if it has the ball in one point in all postures of a socket,
and the two points as far apart as the sockets are.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.calibration.design import in_points
from iksamples.calibration.fit import expectation, fit_sockets
from iksamples.calibration.known import Fitted, Prior
from iksamples.calibration.worst import Measured
from iksamples.errors import IksamplesError
from iksamples.methods.predictor import attempt
from iksamples.recorded.doubts import MOST_RAD, first_of_each
from iksamples.recorded.judge import frame
from iksamples.samples.table import read_table
from iksamples.study import Design, Recorded, Study


if TYPE_CHECKING:
    import pandas as pd

Places = dict[str, list[Floats]]
"""Place of the tool -> joint values [rad or mm] by socket, shape (postures, joints)."""

FILES = ("hole_0.csv", "hole_1.csv")
FEWEST = 2
"""Postures of a point, below which it says nothing."""
_STREAM = 60


def is_sockets(folder: Path) -> bool:
    """Whether a folder holds postures of a tool with two sockets."""
    return folder.is_dir() and any((place / FILES[0]).exists() for place in folder.iterdir())


def read_places(settings: Recorded, drawing: SerialChain) -> Places:
    """Reads a folder for each place, with a file of joint values [rad or mm] for each socket.

    Args:
        settings: Where they are.
        drawing: The arm as drawn.

    Raises:
        IksamplesError: There is no such folder or fewer than two places in it, or a file holds
            something else.
    """
    folder = Path(settings.path)
    if not folder.is_dir():
        raise IksamplesError(settings.missing())
    places = {
        place.name: [_postures(place / name, drawing) for name in FILES]
        for place in sorted(folder.iterdir())
        if place.is_dir() and any((place / name).exists() for name in FILES)
    }
    if len(places) < 2:
        raise IksamplesError(
            f"{folder}: {len(places)} places of the tool (folders with {' and '.join(FILES)}); at "
            "least 2 are needed to learn in one and judge in another."
        )
    return places


def _postures(path: Path, drawing: SerialChain) -> Floats:
    table = read_table(path, names=drawing.joint_names)
    found = table.numbers(range(drawing.n_joints))
    if len(found) < FEWEST:
        raise IksamplesError(f"{path}: {len(found)} rows; at least {FEWEST} are needed.")
    if np.any(np.abs(found[:, drawing.revolute]) > MOST_RAD):
        raise IksamplesError(f"{path}: angles beyond {MOST_RAD:.3g} rad; are they in degrees?")
    return found


def odd_postures(places: Places, drawing: SerialChain) -> list[str]:
    """What is odd about the postures, a sentence each."""
    lines = []
    for name, sockets in places.items():
        for file, postures in zip(FILES, sockets, strict=True):
            outside = np.flatnonzero(~drawing.within_limits(postures))
            if len(outside):
                lines.append(
                    f"{name}/{file}: {len(outside)} of {len(postures)} postures are outside the "
                    f"joint limits (row {outside[0] + 1} first)."
                )
            again = np.setdiff1d(np.arange(len(postures)), first_of_each(postures))
            if len(again):
                lines.append(
                    f"{name}/{file}: {len(again)} of {len(postures)} postures stand there twice "
                    f"(row {again[0] + 1} first)."
                )
    return lines


def judged_sockets(
    study: Study, drawing: SerialChain, places: Places
) -> "tuple[pd.DataFrame, dict[str, str]]":
    """The drawing, and what is fitted to postures, judged in places that had no part in it.

    In an order of the places the postures are learned from place by place, some in each before the
    tool is moved on; the first places of the order judge. A method with the design *optimal* learns
    from as many postures of each socket, but from those that tell most.

    Args:
        study: The study, with ``samples.recorded``.
        drawing: The arm as drawn, with the tool about where it is held.
        places: The postures.

    Returns:
        As ``judge.judged``. An error is the distance of a posture's ball from the mean of its
        socket; ``apart_mm`` is by how much the distance of the two sockets is off, in the mean over
        the places that judge.

    Raises:
        IksamplesError: There are fewer postures than the study's sizes ask for.
    """
    import pandas as pd

    settings = study.recording
    frames, left_out = [], {}
    for name, method in study.all_methods.items():
        if method.kind == "nominal":
            frames.append(_judged(settings, drawing, places, list(places)).assign(method=name))
        elif method.kind == "calibrated":
            for seed in range(settings.subsets):
                frames += [
                    one.assign(method=name, seed=seed)
                    for one in _order(study, settings, drawing, places, seed, method.design)
                ]
        else:
            left_out[name] = "it learns from positions, and nobody measured any."
    if not frames:
        raise IksamplesError(
            f"{settings.path}: of postures in sockets only the kinds nominal and calibrated can "
            "learn; name one under methods."
        )
    found = pd.concat(frames, ignore_index=True)
    design = {name: study.designs(name)[0] for name in study.all_methods}
    return found.assign(design=found["method"].map(design)), left_out


def n_held_places(settings: Recorded, places: Places) -> int:
    """How many places judge."""
    return min(max(1, round(settings.held_out_share * len(places))), len(places) - 1)


def _order(
    study: Study,
    settings: Recorded,
    drawing: SerialChain,
    places: Places,
    seed: int,
    design: Design | None,
) -> "Iterator[pd.DataFrame]":
    """One order: the sizes of the study, judged."""
    rng = np.random.default_rng([seed, _STREAM, study.samples.seed])
    names = [str(name) for name in rng.permutation(list(places))]
    n_held = n_held_places(settings, places)
    held, learned = names[:n_held], names[n_held:]
    postures = list(_sequence(places, learned, settings.postures_per_place, rng))
    if study.sizes[-1] > len(postures):
        raise IksamplesError(
            f"{settings.path}: {n_held} of {len(names)} places judge, which leaves "
            f"{len(postures)} postures to learn from; samples.sizes asks for {study.sizes[-1]}."
        )
    prior, noise_mm, _ = expectation(settings.assumed)
    for n in study.sizes:
        points: dict[tuple[str, int], list[int]] = {}
        for place, socket, row in postures[:n]:
            points.setdefault((place, socket), []).append(row)
        points = {key: rows for key, rows in points.items() if len(rows) >= FEWEST}
        if design == "optimal":
            points = _telling_most(drawing, prior, noise_mm, places, points)
        keys = list(points)
        pairs = [
            (keys.index((place, 0)), keys.index((place, 1)), settings.socket_distance_mm)
            for place in learned
            if (place, 0) in points and (place, 1) in points
        ]
        groups = [places[place][socket][rows] for (place, socket), rows in points.items()]
        fitted, why = attempt(
            f"calibrated on {n} postures",
            partial(fit_sockets, drawing, groups, pairs, prior=prior, noise_mm=noise_mm),
        )
        rows = _judged(settings, fitted.chain if fitted else drawing, places, held)
        if not fitted:
            rows = rows.assign(error_mm=np.inf, apart_mm=np.inf, failed=why)
        yield rows.assign(n_samples=n)


def _telling_most(
    drawing: SerialChain,
    prior: Prior,
    noise_mm: float,
    places: Places,
    points: dict[tuple[str, int], list[int]],
) -> dict[tuple[str, int], list[int]]:
    """As many postures of the same points, out of all that were recorded there."""
    before = Fitted.unmeasured(drawing, prior, noise_mm)
    informs = [
        Measured(noise_mm).informs(before, places[place][socket]) for place, socket in points
    ]
    chosen = in_points(before, informs, [len(rows) for rows in points.values()])
    return {key: some.tolist() for key, some in zip(points, chosen, strict=True)}


def _sequence(
    places: Places, names: list[str], at_once: int, rng: np.random.Generator
) -> Iterator[tuple[str, int, int]]:
    """Place, socket and row of the postures in the order in which they are learned from."""
    left = {}
    for name in names:
        rows = [rng.permutation(len(postures)) for postures in places[name]]
        longest = max(map(len, rows))
        left[name] = [
            (name, socket, int(own[i]))
            for i in range(longest)
            for socket, own in enumerate(rows)
            if i < len(own)
        ]
    while any(left.values()):
        for name in names:
            yield from left[name][:at_once]
            left[name] = left[name][at_once:]


def _judged(
    settings: Recorded, model: SerialChain, places: Places, held: list[str]
) -> "pd.DataFrame":
    """How consistent a model is in some places."""
    import pandas as pd

    first = np.cumsum([0, *(len(one) for sockets in places.values() for one in sockets)])
    rows, apart, order = [], [], list(places)
    for name in held:
        balls = [model.forward_mm(postures) for postures in places[name]]
        centres = [ball.mean(axis=0) for ball in balls]
        distance = float(np.linalg.norm(centres[0] - centres[1]))
        apart.append(abs(distance - settings.socket_distance_mm))
        for socket, (ball, centre) in enumerate(zip(balls, centres, strict=True)):
            records = first[len(FILES) * order.index(name) + socket] + np.arange(len(ball))
            rows.append(frame(0, 0, records, np.linalg.norm(ball - centre, axis=1)))
    return pd.concat(rows).assign(apart_mm=float(np.mean(apart)))
