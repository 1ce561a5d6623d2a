"""``python -m iksamples``: the command line of the Python that runs it."""

from iksamples.cli import main


main()
