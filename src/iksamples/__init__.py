"""How many samples does a learned inverse kinematics need?

The packages follow the way of the data, and each imports only what lies before it: ``study``,
``arm``, ``samples``, ``methods`` and ``training``, ``evaluation``, ``certify``, ``answer``,
``report``. ``recording`` (Rerun), ``export`` (ONNX, C) and ``tracking`` (MLflow) are windows beside
the report; ``paper`` is what is about the paper alone. ARCHITECTURE.md has the whole picture.
"""

from importlib.metadata import version


__version__ = version("iksamples")
