"""Ways from samples to joint angles other than a network, one file each; ``registry`` lists them.

A method of your own takes a file with a ``fit`` (``multilinear`` is the shortest to copy), a row in
``registry.FITS`` and its name in ``study.MethodKind``.
"""
