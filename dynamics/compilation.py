"""C code from CasADi functions, compiled once and kept in the user's cache folder.

The cache key is the content: package sources, robot geometry, CasADi version, compiler and flags. Without a C compiler
`load_library` returns None after one warning line, and callers use CasADi's virtual machine.
"""

import ctypes
import hashlib
import os
import platform
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
from dynamics.geometry import Rss6Geometry

# No fused multiply-add: the same seed must give the same numbers on every x86-64 and on the plain path.
FLAGS = ("-O2", "-ftree-vectorize", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno")


class CompilerWarning(UserWarning):
    """Said once when no C compiler is found."""


def cache_folder() -> Path:
    """Folder of compiled robots; the environment variable CMMSIM_CACHE overrides the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_library(
    name: str, geometry: Rss6Geometry, build: Callable[[Rss6Geometry], list[ca.Function]], driver: str | None = None
) -> Path | None:
    """Path of a shared library with the functions that `build(geometry)` returns, and the C file `driver` if named.

    Compiles on first use (some seconds). Returns None without a compiler. Raises DynamicsError with the compiler's
    words when compiling fails.
    """
    compiler = find_compiler()
    if compiler is None:
        return None
    library = cache_folder() / f"{name}-{_key(name, geometry, compiler)}.so"
    if not library.exists():
        library.parent.mkdir(parents=True, exist_ok=True)
        _compile(compiler, _source(build(geometry), driver), library)
    return library


@cache
def find_compiler() -> str | None:
    """Path of the C compiler ($CC, cc, gcc or clang), or None with one warning. CC=none turns compiling off."""
    wanted = os.environ.get("CC")
    names = [wanted] if wanted else ["cc", "gcc", "clang"]
    for candidate in names:
        found = shutil.which(candidate)
        if found:
            return found
    warnings.warn(
        f"no C compiler found (looked for {', '.join(names)}): using CasADi's virtual machine, some 50 times slower; "
        "on Debian: apt-get install gcc libc6-dev",
        CompilerWarning,
        stacklevel=3,
    )
    return None


def open_library(path: Path) -> ctypes.CDLL:
    """The shared library, loaded. Raises DynamicsError when the file is damaged (and removes it)."""
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise DynamicsError(f"compiled robot {path} could not be loaded and was removed; run again: {error}") from error


@cache
def _package_digest() -> bytes:
    digest = hashlib.sha256()
    for entry in sorted(resources.files("dynamics").iterdir(), key=lambda item: item.name):
        if entry.name.endswith((".py", ".c")):
            digest.update(entry.name.encode() + entry.read_bytes())
    return digest.digest()


def _key(name: str, geometry: Rss6Geometry, compiler: str) -> str:
    digest = hashlib.sha256(_package_digest())
    for value in vars(geometry).values():
        digest.update(value.tobytes() if hasattr(value, "tobytes") else repr(value).encode())
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    digest.update("|".join([name, ca.__version__, platform.machine(), version, *FLAGS]).encode())
    return digest.hexdigest()[:24]


def _source(functions: list[ca.Function], driver: str | None) -> str:
    generator = ca.CodeGenerator("robot.c")
    for function in functions:
        generator.add(function)
    text = generator.dump()
    return text + ((resources.files("dynamics") / driver).read_text(encoding="utf-8") if driver else "")


def _compile(compiler: str, source: str, library: Path) -> None:
    """Compile next to the target under a temporary name, then rename: a broken run leaves nothing behind."""
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        code, built = Path(folder) / "robot.c", Path(folder) / "robot.so"
        code.write_text(source, encoding="utf-8")
        command = [compiler, *FLAGS, str(code), "-o", str(built), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or ["no message"]
            raise DynamicsError(f"{compiler} failed on the generated code of the robot: {lines[0]}")
        os.replace(built, library)
