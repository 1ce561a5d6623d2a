"""The command line: a command for each step of the workflow, and for each question."""

import sys

import typer

from iksamples.cli import ask, certify, fit_arm, next, readings, shown, size, steps
from iksamples.cli.common import app, say
from iksamples.errors import IksamplesError, in_a_line


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
        # A full disk, a folder that may not be written to.
        where = f"{error.filename}: " if error.filename else ""
        say(f"Error: {where}{in_a_line(error)}.", err=True)
        sys.exit(2)
    except IksamplesError as error:
        for line in str(error).splitlines():
            say(f"Error: {line}", err=True)
        sys.exit(2)
