"""How many samples does a learned inverse kinematics need?

The packages follow the way of the data, and each imports only what lies before it:
``arm`` -> ``samples`` -> ``training`` -> ``evaluation`` -> ``certify`` -> ``answer`` ->
``report``, with ``tracking`` (MLflow) and ``recording`` (Rerun) as two side windows; ``paper`` is
what only the paper's own study needs.
"""

from importlib.metadata import version


__version__ = version("iksamples")
