"""Kernels: functions of numbers, arrays and records, compiled by numba on their first call, once, into a cache on disk.

Modules called ``*_kernels`` hold them. They are imported where they are first needed: importing numba takes time.
"""

import ctypes
import hashlib
import pickle
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import njit, typeof, types
from numba.core import cgutils
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.extending import intrinsic

from dynamics.compiled.object_files import cache_folder, load_object, save_object
from dynamics.compiled.operations import MOST_LANES

Array = np.ndarray  # of any type and shape, which docstrings state
Record = Any  # a numpy.record, whose fields are those of its type


def _record_symbol(record: Any) -> tuple[str, tuple[str]]:
    """What stands for a type of record in the symbols of kernels: a digest of its fields."""
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:16],)


# numba counts the types of records instead, anew in every process: kernels for robots of other sizes that were compiled
# in another process would have the same symbols as ours, and one would be run in place of the other.
types.Record.mangling_args = property(_record_symbol)  # type: ignore[method-assign, assignment]


def kernel(function: Callable[..., Any]) -> Any:
    """A kernel that only kernels call: compiled with each of them, without a door for Python."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(**_ARITHMETIC, **_ONLY_KERNELS)(function)


def part(function: Callable[..., Any]) -> Any:
    """A kernel of a few operations, which becomes a part of those that call it: a call would cost as much."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(forceinline=True, **_ARITHMETIC, **_ONLY_KERNELS)(function)


# Nothing is allocated, and references to arrays, which their owners hold, are not counted: that took a run's twelfth.
_ARITHMETIC: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
_ONLY_KERNELS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # unknown to numba's stubs


def entry(function: Callable[..., Any]) -> Any:
    """A kernel that Python calls, or kernels by its address: kept in the user's cache with all that it calls."""
    function.kernel = True  # type: ignore[attr-defined]
    compiled: Any = njit(**_ARITHMETIC)(function)
    if isinstance(compiled, Dispatcher):  # NUMBA_DISABLE_JIT leaves the function as it is
        compiled._cache = _KernelCache(function)  # type: ignore[attr-defined]
    return compiled


class _KernelCache:
    """The cache of an entry, as numba asks for it: in our files, which nobody else can have written.

    numba's own would load files whoever wrote them, want a folder besides ours, and ask only whether the function's own
    file has changed.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._name = f"{function.__module__}.{function.__qualname__} {function.__code__.co_code.hex()}"

    @property
    def cache_path(self) -> str:
        """Where it is kept."""
        return str(cache_folder())

    def load_overload(self, signature: object, context: Any) -> object | None:
        """What was compiled for a signature on such a processor, if that is there."""
        context.refresh()
        found = load_object(self._file(signature, context.codegen()))
        return None if found is None else CompileResult._rebuild(context, *pickle.loads(found))

    def save_overload(self, signature: object, result: Any) -> None:
        """Keep what was compiled."""
        save_object(self._file(signature, result.codegen), dumps(result._reduce()))

    def _file(self, signature: object, codegen: Any) -> str:
        content = f"{self._name} {numba.__version__} {_stamp()} {signature} {codegen.magic_tuple()}"
        return f"{hashlib.sha256(content.encode()).hexdigest()[:24]}.kernel"


_at_address: dict[int, Any] = {}


def address(compiled: Any, *arguments: object) -> int:
    """Where the machine code of an entry for such arguments is, for `invoke`; compiled if that has not been done.

    A kernel that calls another contains it: those that many call are called by address, and compiled once. One that is
    not compiled, see `plain`, has a number that serves `invoke` alike.
    """
    found = id(compiled)
    if isinstance(compiled, Dispatcher):
        kinds = tuple(map(typeof, arguments))
        compiled.compile(kinds)
        result: Any = compiled.overloads[kinds]
        found = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)
    _at_address[found] = compiled
    return found


def _invoke(context: Any, address: Any, task: Any, now: Any, at: Any, d: Any, number: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in values[1:]])
        return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])

    return types.int64(address, task, now, at, d, number), code


def _call(context: Any, address: Any, inputs: Any, outputs: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:], values[1:], strict=True)
        pointers = [context.make_array(kind)(context, builder, value=value).data for kind, value in arrays]
        kind = ir.FunctionType(ir.VoidType(), [pointer.type for pointer in pointers])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, inputs, outputs), code


def _call_columns(context: Any, address: Any, common: Any, rows: Any, into: Any, width: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:4], values[1:4], strict=True)
        given = [*(context.make_array(kind)(context, builder, value=value).data for kind, value in arrays), values[4]]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in given])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(address, common, rows, into, types.int64), code


invoke: Any = intrinsic(_invoke)
"""Calls an entry by its address with four records and a number; returns its status."""


def _add_row(context: Any, factor: Any, row: Any, into: Any, width: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:3], values[1:3], strict=True)
        row, into = (context.make_array(kind)(context, builder, value=value).data for kind, value in arrays)
        vector = ir.VectorType(ir.DoubleType(), MOST_LANES)
        first = builder.insert_element(ir.Constant(vector, ir.Undefined), values[0], ir.IntType(32)(0))
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), MOST_LANES), [0] * MOST_LANES)
        factors, start = builder.shuffle_vector(first, first, lanes), ir.IntType(64)(0)
        with cgutils.for_range_slice(builder, start, values[3], ir.IntType(64)(MOST_LANES)) as (column, _):
            places = [builder.bitcast(builder.gep(one, [column]), vector.as_pointer()) for one in (row, into)]
            given, before = (builder.load(place, align=8) for place in places)
            builder.store(builder.fadd(before, builder.fmul(factors, given)), places[1], align=8)
        return context.get_dummy_value()

    return types.void(types.float64, row, into, types.int64), code


call: Any = intrinsic(_call)
"""Calls a `MachineFunction` by its address with its inputs and outputs, which lie in memory one after the other."""


call_columns: Any = intrinsic(_call_columns)
"""Calls a `ColumnFunction` by its address with what columns have in common, the first of their rows, the first of those
that it writes, and the number of columns."""

add_row: Any = intrinsic(_add_row)
"""Adds a factor times a row to another one, over a number of columns, which fill whole vectors."""


def _invoke_plain(address: int, *arguments: Any) -> int:
    return plain(_at_address[int(address)])(*arguments)


def _call_plain(address: int, inputs: np.ndarray, outputs: np.ndarray) -> None:
    single = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    single(int(address))(inputs.ctypes.data, outputs.ctypes.data)


def _call_columns_plain(address: int, common: np.ndarray, rows: np.ndarray, into: np.ndarray, width: int) -> None:
    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
    function(int(address))(common.ctypes.data, rows.ctypes.data, into.ctypes.data, int(width))


def _add_row_plain(factor: float, row: np.ndarray, into: np.ndarray, width: int) -> None:
    into[:width] += factor * row[:width]


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Changes when any kernel changes."""
    files = sorted(Path(__file__).parent.parent.rglob("*kernel*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@cache
def plain(compiled: Any) -> Callable[..., Any]:
    """The same lines as an ordinary Python function, which calls other kernels as ordinary functions, too."""
    source = getattr(compiled, "py_func", compiled)
    names = {name: source.__globals__[name] for name in source.__code__.co_names if name in source.__globals__}
    lines = {name: getattr(value, "py_func", value) for name, value in names.items()}
    kernels = [name for name, value in lines.items() if isinstance(value, FunctionType) and hasattr(value, "kernel")]
    called: dict[str, Any] = {name: plain(names[name]) for name in kernels}
    called |= {"invoke": _invoke_plain, "call": _call_plain}
    called |= {"call_columns": _call_columns_plain, "add_row": _add_row_plain}
    return FunctionType(source.__code__, source.__globals__ | called, source.__name__, source.__defaults__)


def chosen(kernel: Any, compiled: bool) -> Callable[..., Any]:
    """A kernel as it is called from Python: compiled, or else, or where numba is switched off, its plain lines."""
    if compiled and isinstance(kernel, Dispatcher):
        return kernel
    lines: Callable[..., Any] = np.errstate(all="ignore")(plain(kernel))  # compiled code does not warn either
    return lines
