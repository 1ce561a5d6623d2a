"""The command line: a command for each step of the workflow, and for each question."""

import errno
import sys

import typer

from iksamples.cli import ask, certify, fit_arm, next, readings, shown, size, steps
from iksamples.cli.common import app, say
from iksamples.errors import IksamplesError, UnwritableError, in_a_line


_REMEDIES = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),
        " Make room and type the same again; nothing is half-written.",
    ),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM, errno.EROFS),
        " Name a folder that you may write to, or have its rights changed.",
    ),
}


def main() -> None:
    """Entry point: an error meant for people ends with its message alone."""
    try:
        app()
    except FileNotFoundError as error:
        say(
            f"Error: {error.filename or error}: there is no such file. Either the name is wrong, "
            "or the study is not finished: run it to its end first.",
            err=True,
        )
        sys.exit(2)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        if isinstance(error, UnwritableError):
            where = f"cannot write {where}"
        remedy = _REMEDIES.get(error.errno or 0, "")
        say(f"Error: {where}{in_a_line(error)}.{remedy}", err=True)
        sys.exit(2)
    except MemoryError:
        say("Error: out of memory. Give it less at once, or a machine with more.", err=True)
        sys.exit(2)
    except IksamplesError as error:
        for line in str(error).splitlines():
            say(f"Error: {line}", err=True)
        sys.exit(2)
