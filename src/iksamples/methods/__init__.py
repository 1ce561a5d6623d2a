"""Ways from samples to joint angles other than a network; ``registry`` lists them.

A method of your own takes a function of the samples (``grid.multilinear`` is the shortest to copy),
a row in ``registry.KINDS`` and its name in ``study.MethodKind``.
"""
