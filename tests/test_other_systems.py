"""What only some systems have: our modules are loaded, and a study runs, where all of it is hidden.

Nothing here says that a system other than Linux works. It says that no line of ours needs what
only Linux, or only POSIX, has.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HIDE = """
import builtins, importlib, os, pkgutil, signal, types

OURS = ("cmmsim", "dynamics", "identify")
MODULES = {
    "crypt", "fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty",
}
NAMES = {
    "os": '''O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK chown chroot fchmod fchown fork getegid
        geteuid getgid getgroups getloadavg getpgid getsid getuid killpg lchown mkfifo mknod nice
        pread pwrite register_at_fork sched_getaffinity sched_setaffinity setgid setsid setuid
        statvfs sync uname wait4'''.split(),
    "signal": '''SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGTSTP SIGUSR1
        SIGUSR2 alarm pause pthread_kill pthread_sigmask set_wakeup_fd setitimer siginterrupt
        sigpending sigwait'''.split(),
}


def without(name):
    there = vars(importlib.import_module(name))
    part = types.ModuleType(name)
    part.__dict__.update({key: there[key] for key in there if key not in NAMES[name]})
    return part


hidden = {name: without(name) for name in NAMES}
real = builtins.__import__


def importing(name, globals=None, *more, **named):
    if str((globals or {}).get("__name__")).partition(".")[0] in OURS:
        if name.partition(".")[0] in MODULES:
            raise ModuleNotFoundError(name)
        if name in hidden:
            return hidden[name]
    return real(name, globals, *more, **named)


builtins.__import__ = importing
"""

LOAD = """
for package in map(importlib.import_module, OURS):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
            print(found.name)
"""

USE = """
from pathlib import Path
from identify.progress import SilentProgress
from identify.runtime import cores, shield_children, delay_interrupts, record_interrupts
from identify.studies.runner import run_study
from tests.identify.study_rows import small_study

with record_interrupts(), delay_interrupts(), shield_children():
    assert cores() >= 1
print(*(run_study(small_study(), Path("a"), SilentProgress()).found for _ in range(2)))
"""


PROVE = """
for line in ("import fcntl", "import pwd", "import os; os.geteuid", "from os import fork"):
    for scope in ("cmmsim.new", "numpy.new"):
        try:
            exec(line, {"__name__": scope})
        except (ImportError, AttributeError):
            print(scope)
"""


def output(folder, code):
    run = {"cwd": folder, "capture_output": True, "text": True, "check": False}
    path = {"PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", HIDE + code]
    done = subprocess.run(command, env=os.environ | path, **run)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_lines_of_ours_that_need_what_is_hidden_fail_and_those_of_others_do_not(tmp_path):
    shown = output(tmp_path, PROVE)
    assert shown == ["cmmsim.new"] * 4


@pytest.mark.thorough
def test_every_module_is_loaded_and_a_study_runs_and_goes_on_where_what_only_some_systems_have_is_hidden(
    tmp_path,
):
    """One process does both, as importing is most of what each takes; the study is its last line."""
    *found, computed, continued = output(tmp_path, LOAD + USE)
    assert {"cmmsim.sensor", "dynamics.robot", "identify.studies.store"} <= {*found}
    assert (computed, continued) == ("0", "18")
