"""The exceptions that are meant for people, and text of others as part of a line."""

import re
from collections.abc import Sequence


_STEERS = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]+"
)
_MOST = 1000


class IksamplesError(Exception):
    """Something a user can put right: what is wrong, where, and what to do.

    The command line prints the message alone (no traceback) and exits with status 2.
    """

    def __init__(self, message: str) -> None:
        """Keeps the message: lines that steer no terminal and fill no screen."""
        super().__init__("\n".join(_shortened(one_line(line)) for line in message.split("\n")))


class UnwritableError(OSError):
    """The system does not let a file or a folder be written; as ``OSError``, with its name."""


def one_line(text: str) -> str:
    """Text of others as part of one line: a terminal, a comment or a page cannot be steered by it.

    What ends a line, controls a terminal, turns the direction of reading or is half a letter
    becomes a space.
    """
    return _STEERS.sub(" ", text)


def some_of(names: Sequence[str], most: int = 12) -> str:
    """The first of some names, and how many more: ``a, b and 3 more``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def in_a_line(error: BaseException) -> str:
    """What the system or another library says is wrong."""
    said = getattr(error, "strerror", None) or " ".join(str(error).split())[:300]
    return said or type(error).__name__


def _shortened(line: str) -> str:
    return line if len(line) <= _MOST else f"{line[: _MOST * 3 // 5]} ... {line[-_MOST // 3 :]}"
