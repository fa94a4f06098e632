"""Kernels: functions of numbers, arrays and records that Numba compiles on their first call.

Modules called ``*_kernels`` hold them. They are imported where they are first needed, because
importing Numba takes time. This module adds to Numba what it does not do by itself:

- `kernel`, `part` and `entry` set the options of the compiler, the same for all kernels. An entry
  is kept in a file of the user's cache, named by everything that its machine code depends on.
- `address` and `invoke` call a kernel by its address. Numba would otherwise copy the callee into
  each of its callers, and a kernel that many call would be compiled many times.
- `call`, `call_columns` and `add_row` are LLVM code for three calls that Numba cannot express:
  a function of the robot, one for many columns, and a multiply-add of vectors.
- `_record_symbol` replaces how Numba names the type of a record in the symbols of machine code.
- `plain` makes the ordinary Python function of a kernel, as the oracle of the compiled one.
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
    """Name of a record's type in the symbols of kernels: a digest of its fields.

    Numba counts the types of records instead, in the order in which a process meets them. A kernel
    for a robot of six joints in one process could then have the symbol of a kernel for a robot of
    three in another. When both come from the cache into a third process, LLVM would link one in
    place of the other, and it would read memory with the wrong layout. A digest of the fields is
    the same in every process, and another one for every layout. Numba has no option for it, so
    that the property of its class is replaced, once, before any kernel is compiled.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:16],)


types.Record.mangling_args = property(_record_symbol)  # type: ignore[method-assign, assignment]


def kernel(function: Callable[..., Any]) -> Any:
    """Make a kernel that only kernels call. It is compiled with each of them."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(**_ARITHMETIC, **_ONLY_KERNELS)(function)


def part(function: Callable[..., Any]) -> Any:
    """Make a kernel of a few operations that is inlined, because a call would cost as much."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(forceinline=True, **_ARITHMETIC, **_ONLY_KERNELS)(function)


# Kernels allocate nothing. References to arrays are not counted, because their owners hold them
# and counting took a twelfth of a run.
_ARITHMETIC: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# Numba's stubs do not know these options.
_ONLY_KERNELS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def entry(function: Callable[..., Any]) -> Any:
    """Make a kernel that Python calls, or that kernels call by its address.

    Its machine code is kept in the user's cache together with all kernels that it calls.
    """
    function.kernel = True  # type: ignore[attr-defined]
    compiled: Any = njit(**_ARITHMETIC)(function)
    # NUMBA_DISABLE_JIT leaves the function as it is
    if isinstance(compiled, Dispatcher):
        compiled._cache = _KernelCache(function)  # type: ignore[attr-defined]
    return compiled


class _KernelCache:
    """Cache of an entry, with the methods that Numba calls.

    Numba's own cache loads a file whoever wrote it, and renews it only when the file of the entry
    itself has changed. This one loads files that only the user can have written, and renews them
    when any kernel has changed.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._name = (
            f"{function.__module__}.{function.__qualname__} {function.__code__.co_code.hex()}"
        )

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(cache_folder())

    def load_overload(self, signature: object, context: Any) -> object | None:
        """Return what was compiled for a signature on this kind of processor, or None."""
        context.refresh()
        found = load_object(self._file(signature, context.codegen()))
        return None if found is None else CompileResult._rebuild(context, *pickle.loads(found))

    def save_overload(self, signature: object, result: Any) -> None:
        """Write what was compiled for a signature."""
        save_object(self._file(signature, result.codegen), dumps(result._reduce()))

    def _file(self, signature: object, codegen: Any) -> str:
        content = f"{self._name} {numba.__version__} {_stamp()} {signature} {codegen.magic_tuple()}"
        return f"{hashlib.sha256(content.encode()).hexdigest()[:24]}.kernel"


_at_address: dict[int, Any] = {}


def address(compiled: Any, *arguments: object) -> int:
    """Address of an entry's machine code for arguments of these types, for `invoke`.

    The entry is compiled unless that has been done. The lines of `plain` get a number that serves
    `invoke` in the same way.
    """
    found = id(compiled)
    if isinstance(compiled, Dispatcher):
        kinds = tuple(map(typeof, arguments))
        compiled.compile(kinds)
        result: Any = compiled.overloads[kinds]
        found = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)
    _at_address[found] = compiled
    return found


# The functions that follow are in the form that `numba.extending.intrinsic` wants: they take the
# types of the arguments and return a signature, with a function that writes LLVM code.


def _invoke(context: Any, address: Any, task: Any, now: Any, at: Any, d: Any, number: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in values[1:]])
        return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])

    return types.int64(address, task, now, at, d, number), code


def _call(context: Any, address: Any, inputs: Any, outputs: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:], values[1:], strict=True)
        pointers = [
            context.make_array(kind)(context, builder, value=value).data for kind, value in arrays
        ]
        kind = ir.FunctionType(ir.VoidType(), [pointer.type for pointer in pointers])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, inputs, outputs), code


def _call_columns(context: Any, address: Any, common: Any, rows: Any, into: Any, width: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:4], values[1:4], strict=True)
        given = [
            context.make_array(kind)(context, builder, value=value).data for kind, value in arrays
        ]
        given.append(values[4])
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in given])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(address, common, rows, into, types.int64), code


invoke: Any = intrinsic(_invoke)
"""Calls an entry by its address with four records and a number, and returns its status."""


def _add_row(context: Any, factor: Any, row: Any, into: Any, width: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:3], values[1:3], strict=True)
        row, into = (
            context.make_array(kind)(context, builder, value=value).data for kind, value in arrays
        )
        vector = ir.VectorType(ir.DoubleType(), MOST_LANES)
        first = builder.insert_element(
            ir.Constant(vector, ir.Undefined), values[0], ir.IntType(32)(0)
        )
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), MOST_LANES), [0] * MOST_LANES)
        factors = builder.shuffle_vector(first, first, lanes)
        start = ir.IntType(64)(0)
        with cgutils.for_range_slice(builder, start, values[3], ir.IntType(64)(MOST_LANES)) as (
            column,
            _,
        ):
            places = [
                builder.bitcast(builder.gep(one, [column]), vector.as_pointer())
                for one in (row, into)
            ]
            given, before = (builder.load(place, align=8) for place in places)
            builder.store(builder.fadd(before, builder.fmul(factors, given)), places[1], align=8)
        return context.get_dummy_value()

    return types.void(types.float64, row, into, types.int64), code


call: Any = intrinsic(_call)
"""Calls a `MachineFunction` by its address with the memory of its inputs and of its outputs."""


call_columns: Any = intrinsic(_call_columns)
"""Calls a `ColumnFunction` by its address.

The arguments are what all columns have in common, the first row of inputs, the first row of
outputs, and the number of columns.
"""

add_row: Any = intrinsic(_add_row)
"""Adds a factor times a row to another row. The number of columns fills whole vectors."""


def _invoke_plain(address: int, *arguments: Any) -> int:
    return plain(_at_address[int(address)])(*arguments)


def _call_plain(address: int, inputs: np.ndarray, outputs: np.ndarray) -> None:
    single = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    single(int(address))(inputs.ctypes.data, outputs.ctypes.data)


def _call_columns_plain(
    address: int, common: np.ndarray, rows: np.ndarray, into: np.ndarray, width: int
) -> None:
    function = ctypes.CFUNCTYPE(
        None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64
    )
    function(int(address))(common.ctypes.data, rows.ctypes.data, into.ctypes.data, int(width))


def _add_row_plain(factor: float, row: np.ndarray, into: np.ndarray, width: int) -> None:
    into[:width] += factor * row[:width]


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Digest of all files of kernels. It changes when any kernel changes."""
    files = sorted(Path(__file__).parent.parent.rglob("*kernel*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@cache
def plain(compiled: Any) -> Callable[..., Any]:
    """Ordinary Python function with the lines of a kernel. It calls other kernels in this form."""
    source = getattr(compiled, "py_func", compiled)
    names = {
        name: source.__globals__[name]
        for name in source.__code__.co_names
        if name in source.__globals__
    }
    lines = {name: getattr(value, "py_func", value) for name, value in names.items()}
    kernels = [
        name
        for name, value in lines.items()
        if isinstance(value, FunctionType) and hasattr(value, "kernel")
    ]
    called: dict[str, Any] = {name: plain(names[name]) for name in kernels}
    called |= {"invoke": _invoke_plain, "call": _call_plain}
    called |= {"call_columns": _call_columns_plain, "add_row": _add_row_plain}
    return FunctionType(
        source.__code__, source.__globals__ | called, source.__name__, source.__defaults__
    )


def chosen(kernel: Any, compiled: bool) -> Callable[..., Any]:
    """Kernel to be called from Python: compiled, or plain if so wanted or if Numba is off."""
    if compiled and isinstance(kernel, Dispatcher):
        return kernel
    # compiled code does not warn either
    lines: Callable[..., Any] = np.errstate(all="ignore")(plain(kernel))
    return lines
