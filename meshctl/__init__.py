"""meshctl owns a fleet of mesh radios: one inventory in, right configuration on every radio out.

The flow: inventory -> model -> lint -> resolve -> render -> plan -> apply -> verify -> report (docs/design.md).
"""

__version__ = "0.6.0"
