"""How many samples does a learned inverse kinematics need?

The packages follow the way of the data, and each imports only what lies before it:
``robot`` -> ``samples`` -> ``training`` -> ``evaluation`` -> ``bounds`` -> ``sizing`` ->
``report``, with ``tracking`` (MLflow) and ``recording`` (Rerun) as two side windows.
"""

from importlib.metadata import version


__version__ = version("iksamples")
