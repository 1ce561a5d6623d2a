"""The one exception that is meant for people, and text of others as part of a line."""

import re


class IksamplesError(Exception):
    """Something a user can put right: what is wrong, where, and what to do.

    The command line prints the message alone (no traceback) and exits with status 2.
    """


_STEERS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]+")


def one_line(text: str) -> str:
    """Text of others as part of one line: a terminal, a comment or a page cannot be steered by it.

    What ends a line, controls a terminal or turns the direction of reading becomes a space.
    """
    return _STEERS.sub(" ", text)
