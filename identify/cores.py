"""Cores of this machine: how many there are for processes, and that linear algebra keeps to one of them."""

import os

from threadpoolctl import OpenBLASController, register, threadpool_limits


class _CasadiBlas(OpenBLASController):
    """The BLAS that CasADi brings for IPOPT, under a name that threadpoolctl does not look for."""

    filename_prefixes = ("libcasadi-tp-openblas",)


register(_CasadiBlas)

one_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator: every BLAS that is loaded by now uses one thread. The many small matrices of a search lose by a second one
(a fifth of the time on free cores, half on busy ones), and with one the rounding does not depend on the machine's
cores or on its environment."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))
