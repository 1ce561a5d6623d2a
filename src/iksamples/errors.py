"""The one exception that is meant for people."""


class IksamplesError(Exception):
    """Something a user can put right: what is wrong, where, and what to do.

    The command line prints the message alone (no traceback) and exits with status 2.
    """
