"""An ideal torque source: the reference is the torque itself, within its limit.

In the ledger it is a motor with K_m = 1 and R = 0: its current is τ, its voltage v, its power τ v.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.limit import clipped


def open_torque(motor, a, command):
    """τ [N m]: the command within the limit."""
    return clipped(command, motor[a, ka.I_MAX])
