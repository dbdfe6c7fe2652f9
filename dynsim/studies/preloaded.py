"""Loaded first by the process that workers are copies of: it ends with the command, also while it loads the rest.

Only Linux has such a process, see :func:`dynsim.studies.processes.begin_early`. By prctl's PR_SET_PDEATHSIG, see its
manual; copies do not take it over, and end with the command by themselves.
"""

import ctypes
import signal

_PR_SET_PDEATHSIG = 1

ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
