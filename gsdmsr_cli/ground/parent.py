"""Lets a process end with the one that has started it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
"""Of prctl: the signal that a process gets when the one ends that has forked it."""


def end_with_parent(parent: int) -> None:
    """Let this process be killed when its parent ends in any way; elsewhere than on Linux, not.

    Args:
        parent: id of the process that has started this one; it may have ended already.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
