"""Calls of functions in another process, within limits of time and memory.

On a damaged or malicious file, a library can hang, crash, or allocate all memory. The process that
reads such a file is killed at the time limit. Beyond the memory limit its allocations fail, which
ends the library's call with an error, or the process.
"""

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from dynamics.errors import DynamicsError

LIMIT_S = 8  # longest time for reading, s
START_S = 60  # additional time for the process to start on a busy machine, s
# Largest amount of data in the process, with that of the imported libraries, in bytes. Some systems
# cannot limit it.
LIMIT_MEMORY = 1_000_000_000

CODE = "from identify.files.limited_process import serve; serve()"


class UntrustedFileError(Exception):
    """Reason, in one line, why a file cannot be read."""


def within_limits(read: Callable[..., Any], *given: object, limit_s: int | None = None) -> Any:
    """Call a function in another process, within the limits, and return its result.

    The other process imports the function by its name and module. `limit_s` replaces LIMIT_S, for
    valid files that take longer to read.

    Raises UntrustedFileError with the reason if a limit is exceeded, if the process dies, or if the
    function raises an exception. A DynamicsError passes unchanged.
    """
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    limit = LIMIT_S if limit_s is None else limit_s
    too_long = f"it cannot be read within {limit} s"
    try:
        done = subprocess.run(
            [sys.executable, "-c", CODE],
            input=pickle.dumps((read, given, limit)),
            capture_output=True,
            timeout=START_S + limit,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise UntrustedFileError(too_long) from None
    if _ended_by_alarm(done.returncode):
        raise UntrustedFileError(too_long)
    if done.returncode:
        raise UntrustedFileError(f"the library that reads it ends with status {done.returncode}")
    result = pickle.loads(done.stdout)
    if isinstance(result, Exception):
        raise result
    return result


def _ended_by_alarm(status: int) -> bool:
    return hasattr(signal, "SIGALRM") and status == -signal.SIGALRM


def serve() -> None:
    """Read a pickled call from standard input, run it, and write the pickled result or error."""
    # Output of the library must not be mixed with the bytes of the pickle.
    out = sys.stdout
    sys.stdout = sys.stderr
    # Functions are pickled by name. Their modules are imported here, before the limits are set.
    read, given, limit = pickle.loads(sys.stdin.buffer.read())
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_MEMORY, LIMIT_MEMORY))
    if hasattr(signal, "alarm"):  # on other systems, only the calling process limits the time
        signal.alarm(limit)
    try:
        result = read(*given)
    except DynamicsError as error:
        result = error
    except Exception as error:  # the library can raise any error for such a file
        result = UntrustedFileError(" ".join(str(error).split()) or type(error).__name__)
    if hasattr(signal, "alarm"):
        signal.alarm(0)  # the time to return the result is not limited
    out.buffer.write(pickle.dumps(result))
