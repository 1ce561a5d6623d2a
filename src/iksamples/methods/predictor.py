"""What every method gives in the end: something that answers positions with joint values."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError


_Fitted = TypeVar("_Fitted")
_BLOCK = 8192
"""Points answered at once: what a method holds per point (512 kernel values, say) stays small."""


class NotApplicableError(IksamplesError):
    """A method is not made for samples that lie like these, so that it has no result on them."""


def attempt(what: str, fit: Callable[[], _Fitted]) -> tuple[_Fitted | None, str]:
    """Fits, asks or proves something, which numbers may defeat: too few samples, a singular system.

    That is a result, as an error is, and other methods and samples have theirs. What stems from the
    machine or from a mistake in the program is none, and is not caught.

    Args:
        what: Which method on which samples, for the reason.
        fit: Does it.

    Returns:
        What was fitted or found, and an empty text; or None, and why there is nothing.

    Raises:
        NotApplicableError: The method is not made for such samples.
    """
    try:
        return fit(), ""
    except NotApplicableError:
        raise
    except IksamplesError as error:
        why = str(error)
    except (np.linalg.LinAlgError, ArithmeticError) as error:
        why = f"{what}: {error}."
    return None, " ".join(why.split())


class Predictor(Protocol):
    """Fitted methods, stacked: one member per seed, or a single one where nothing is random.

    ``network.StackedMLP`` is one.
    """

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each member."""

    def predict(self, x: ArrayLike, /) -> Floats:
        """Joint values for inputs.

        Args:
            x: Inputs of the task [mm or rad], shape (points, d).

        Returns:
            Joint values [rad, or mm for a prismatic joint], shape (members, points, joints).
        """

    def select(self, rows: Sequence[int], /) -> Self:
        """The members in the given rows of the stack, in that order."""


P = TypeVar("P", bound=Predictor)


def in_parts(predictor: P, n_points: int, most: int) -> Iterator[P]:
    """The members in parts, so that what is known of each at every point fits in memory.

    Args:
        predictor: Fitted methods.
        n_points: Points that each is asked.
        most: Points of all members of a part, where a part has more than one.
    """
    n, size = len(predictor.seeds), max(1, most // n_points)
    if n <= size:
        yield predictor
        return
    for first in range(0, n, size):
        yield predictor.select(range(first, min(first + size, n)))


@dataclass(frozen=True)
class Single:
    """A predictor of one member, made of a function.

    Attributes:
        answer: Joint values (points, joints) for inputs (points, d).
        confident_mm: Worst error over the region that is not exceeded with 95 % confidence, as far
            as the samples tell [mm]; NaN: it does not say.
        failed: Why it answers nothing; empty: it does.
    """

    answer: Callable[[Floats], Floats]
    seeds: tuple[int, ...] = (0,)
    confident_mm: float = float("nan")
    failed: str = ""

    def predict(self, x: ArrayLike, /) -> Floats:
        """Joint values [rad or mm], shape (1, points, joints), for inputs (points, d)."""
        x = np.asarray(x, float)
        blocks = np.split(x, range(_BLOCK, len(x), _BLOCK))
        return np.concatenate([self.answer(block) for block in blocks])[None]

    def select(self, rows: Sequence[int], /) -> Self:
        """Itself, the only member."""
        return self


def no_answer(n_joints: int, why: str, seeds: tuple[int, ...] = (0,)) -> Single:
    """What stands for a method that failed: NaN everywhere."""
    return Single(lambda x: np.full((len(x), n_joints), np.nan), seeds, failed=why)


@dataclass(frozen=True)
class Stacked:
    """A member for each arm, in the order of their seeds.

    Attributes:
        members: One for each seed; the same one where all arms are answered alike.
        seeds: The arms' seeds.
    """

    members: Sequence[Single]
    seeds: tuple[int, ...]

    def predict(self, x: ArrayLike, /) -> Floats:
        """Joint values [rad or mm], shape (members, points, joints), for inputs (points, d)."""
        answers = {member: member.predict(x)[0] for member in dict.fromkeys(self.members)}
        return np.stack([answers[member] for member in self.members])

    def select(self, rows: Sequence[int], /) -> Self:
        """The members in the given rows, in that order."""
        seeds = tuple(self.seeds[i] for i in rows)
        return replace(self, members=[self.members[i] for i in rows], seeds=seeds)
