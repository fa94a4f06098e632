"""C code from CasADi functions, compiled once and kept in the user's cache folder.

The cache key is the content: package sources, robot geometry, CasADi version, compiler and flags. Without a C compiler
that works and a folder to write to, `load_library` returns None after one warning line, and callers use CasADi's
virtual machine.
"""

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from importlib import resources
from pathlib import Path

import casadi as ca
import platformdirs

from dynamics.errors import DynamicsError
from dynamics.legs.rss_geometry import Rss6Geometry

# CasADi exports its own `sq`: without -fno-semantic-interposition every square of a variable is a call. -O3 takes a
# fifth longer to compile, for 2 % of speed in plain runs and a loss in sensitivities.
_SPEED = ("-O2", "-ftree-vectorize", "-fpeel-loops", "-fno-semantic-interposition")
# No fused multiply-add: the same seed must give the same numbers on every x86-64 and on the plain path.
FLAGS = (*_SPEED, "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno")


class CompilerWarning(UserWarning):
    """Said once when nothing can be compiled."""


def cache_folder() -> Path:
    """Folder of compiled robots; the environment variable CMMSIM_CACHE overrides the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_library(
    name: str,
    geometry: Rss6Geometry,
    build: Callable[[Rss6Geometry], list[ca.Function]],
    drivers: tuple[str, ...] = (),
) -> Path | None:
    """Path of a shared library with the functions that `build(geometry)` returns, followed by the C files `drivers`.

    Compiles on first use (some seconds). Returns None where nothing can be compiled. Raises DynamicsError with the
    compiler's words when it works but refuses the generated code.
    """
    compiler = find_compiler()
    if compiler is None:
        return None
    library = cache_folder() / f"{name}-{_key(name, geometry, compiler)}.so"
    if not library.exists():
        if not can_compile(compiler, library.parent):
            return None
        complaint = _compile(compiler, _source(build(geometry), drivers), library.parent, library)
        if complaint:
            raise DynamicsError(f"{compiler[0]} failed on the generated code of the robot: {complaint}")
    return library


@cache
def find_compiler() -> tuple[str, ...] | None:
    """The C compiler ($CC, cc, gcc or clang) and its own arguments, or None with one warning. CC=none: no compiling."""
    wanted = os.environ.get("CC")
    names = [wanted] if wanted else ["cc", "gcc", "clang"]
    for candidate in names:
        program, *arguments = shlex.split(candidate) or [""]
        found = shutil.which(program)
        if found:
            return (found, *arguments)
    _warn(f"no C compiler found (looked for {', '.join(names)}); on Debian: apt-get install gcc libc6-dev")
    return None


@cache
def can_compile(compiler: tuple[str, ...], folder: Path) -> bool:
    """Whether a trial program compiles and `folder` can be written to; one warning says why not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        complaint = _compile(compiler, "#include <math.h>\n#include <stdlib.h>\n#include <string.h>\n", folder)
    except OSError as error:
        _warn(f"cannot compile into {folder} ({error.strerror}); name another folder with CMMSIM_CACHE")
        return False
    if complaint:
        _warn(f"the C compiler {compiler[0]} does not work ({complaint}); on Debian: apt-get install gcc libc6-dev")
    return not complaint


def open_library(path: Path) -> ctypes.CDLL:
    """The shared library, loaded. Raises DynamicsError when the file is damaged (and removes it)."""
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise DynamicsError(f"compiled robot {path} could not be loaded and was removed; run again: {error}") from error


def _warn(reason: str) -> None:
    text = f"{reason}: using CasADi's virtual machine, some 50 times slower"
    warnings.warn(text, CompilerWarning, stacklevel=4)


@cache
def _package_digest() -> bytes:
    digest = hashlib.sha256()
    for entry in sorted(path for path in Path(__file__).parent.rglob("*") if path.suffix in (".py", ".c", ".h")):
        digest.update(entry.name.encode() + entry.read_bytes())
    return digest.digest()


@cache
def _compiler_version(compiler: tuple[str, ...]) -> str:
    done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False)
    return " ".join(compiler[1:]) + done.stdout


def _key(name: str, geometry: Rss6Geometry, compiler: tuple[str, ...]) -> str:
    digest = hashlib.sha256(_package_digest() + geometry.digest)
    parts = [name, ca.CasadiMeta.version(), platform.machine(), _compiler_version(compiler), *FLAGS]
    digest.update("|".join(parts).encode())
    return digest.hexdigest()[:24]


def _source(functions: list[ca.Function], drivers: tuple[str, ...]) -> str:
    generator = ca.CodeGenerator("robot.c")
    for function in functions:
        generator.add(function)
    own = [(resources.files("dynamics.closed_loop") / "c" / driver).read_text(encoding="utf-8") for driver in drivers]
    return "".join([generator.dump(), *own])


def _compile(compiler: tuple[str, ...], source: str, folder: Path, library: Path | None = None) -> str:
    """Compile in `folder`, keep the result as `library` if named; returns the compiler's complaint or nothing.

    The file is built in a folder of its own and then renamed: a run that breaks off, or another process that compiles
    the same robot, never leaves half a library.
    """
    with tempfile.TemporaryDirectory(dir=folder) as workplace:
        code, built = Path(workplace) / "robot.c", Path(workplace) / "robot.so"
        code.write_text(source, encoding="utf-8")
        command = [*compiler, *FLAGS, str(code), "-o", str(built), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            return (done.stderr.strip().splitlines() or ["no message"])[0]
        if library:
            built.replace(library)
    return ""
