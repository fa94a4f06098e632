"""Kernels: functions of numbers, arrays and records that Numba compiles at their first call.

The modules with kernels are called ``*_kernels``, and are imported at their first use, because
importing Numba takes time. This module adds what Numba lacks:

- `kernel`, `part` and `entry` set the same compiler options for all kernels. The machine code of an
  entry is saved in the user's cache, under a digest of everything that it depends on.
- `_InnerCompiler` makes no machine code for kernels that only other kernels call. Their LLVM code
  is linked into that of their callers, and optimised with these.
- `address` and `invoke` call a kernel by its address. Otherwise, Numba would copy the called kernel
  into each of its callers, and a kernel with many callers would be compiled many times.
- `call`, `call_columns` and `add_row` are LLVM code for three calls that Numba cannot express: a
  function of the robot, a function of many columns, and a multiply-add of vectors.
- `_record_symbol` replaces the way in which Numba names record types in the symbols of machine
  code.
- `plain` makes an ordinary Python function from a kernel. Tests compare the compiled kernel with
  it.
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
from numba import _dynfunc, njit, typeof, types  # type: ignore[attr-defined]
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, CompileResult, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.core.typed_passes import NativeLowering
from numba.extending import intrinsic

from dynamics.compiled.object_files import cache_folder, load_object, save_object
from dynamics.compiled.operations import MOST_LANES

Array = np.ndarray  # of any type and shape; the docstrings of kernels state both
Record = Any  # a numpy.record


def _record_symbol(record: Any) -> tuple[str, tuple[str]]:
    """Name of a record type in the symbols of kernels: a digest of its fields.

    By default, Numba numbers record types in the order in which a process meets them. A kernel for
    a robot of six joints in one process could then have the same symbol as a kernel for a robot of
    three joints in another. If a third process loaded both from the cache, LLVM would link one in
    place of the other, and the code would read memory with the wrong layout. A digest of the fields
    is the same in every process, and differs between layouts.

    Numba has no option for this. The property of its class is therefore replaced, once, before any
    kernel is compiled.
    """
    return "Record", (hashlib.sha256(record.name.encode()).hexdigest()[:16],)


types.Record.mangling_args = property(_record_symbol)  # type: ignore[method-assign, assignment]


class _InnerLibrary(JITCodeLibrary):
    """Code of a kernel that only other kernels call, for linking into their code.

    By default, Numba also optimises each kernel by itself, and translates it to machine code that
    nothing calls. This took two fifths of the time that compiling the kernels of a loop takes.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Numba's translation to LLVM code, without machine code."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        name = state.func_id.func_qualname
        state.library = _InnerLibrary(state.targetctx.codegen(), name)
        state.flags.no_compile = True
        super().run_pass(state)
        lowered = state.cr
        # callers find the code under this function, which has no machine code and is never called
        function = _dynfunc.make_function(
            lowered.fndesc.lookup_module(), name, "", 0, lowered.env, (state.library,)
        )
        state.targetctx.insert_user_function(function, lowered.fndesc, [state.library])
        state.cr = lowered._replace(cfunc=function)
        return True


class _InnerCompiler(CompilerBase):
    """Compiler of kernels that only other kernels call."""

    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (_InnerLowering if one is NativeLowering else one, text) for one, text in passes.passes
        ]
        return [passes]


def kernel(function: Callable[..., Any]) -> Any:
    """Make a kernel that only other kernels call. It is compiled with each of its callers."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(**_ARITHMETIC, **_ONLY_KERNELS)(function)


def part(function: Callable[..., Any]) -> Any:
    """Make a small kernel that is inlined into its callers, to save the time of the call."""
    function.kernel = True  # type: ignore[attr-defined]
    return njit(forceinline=True, **_ARITHMETIC, **_ONLY_KERNELS)(function)


# Kernels allocate no memory, and do not count references to arrays: the arrays outlive the kernels,
# and counting took a twelfth of the time of a run.
_ARITHMETIC: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# Numba's stubs do not know these options.
_ONLY_KERNELS: dict[str, Any] = {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": _InnerCompiler,
}


def entry(function: Callable[..., Any]) -> Any:
    """Make a kernel that Python calls, or that kernels call by its address.

    Its machine code, with all kernels that it calls, is saved in the user's cache.
    """
    function.kernel = True  # type: ignore[attr-defined]
    compiled: Any = njit(**_ARITHMETIC)(function)
    # with NUMBA_DISABLE_JIT, njit returns the function unchanged
    if isinstance(compiled, Dispatcher):
        compiled._cache = _KernelCache(function)  # type: ignore[attr-defined]
    return compiled


class _KernelCache:
    """Cache of an entry, with the methods that Numba calls.

    Numba's own cache loads a file of any owner, and recompiles only if the module of the entry has
    changed. This cache loads only files that nobody but the user can have written, and recompiles
    if any file of kernels in this package has changed.
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
        """Return the code compiled for a signature on this kind of processor, or None."""
        context.refresh()
        code = load_object(self._file(signature, context.codegen()))
        return None if code is None else CompileResult._rebuild(context, *pickle.loads(code))

    def save_overload(self, signature: object, result: Any) -> None:
        """Save the code compiled for a signature."""
        # connect the code with the environments of the kernels in it, as Numba does when loading
        for environment in result._find_referenced_environments():
            result.codegen.set_env(environment.env_name, environment)
        save_object(self._file(signature, result.codegen), dumps(result._reduce()))

    def _file(self, signature: object, codegen: Any) -> str:
        content = f"{self._name} {numba.__version__} {_stamp()} {signature} {codegen.magic_tuple()}"
        return f"{hashlib.sha256(content.encode()).hexdigest()[:24]}.kernel"


_at_address: dict[int, Any] = {}  # kernels for which `address` has been called, by address


def address(compiled: Any, *arguments: object) -> int:
    """Address of an entry's machine code for arguments of these types, for use with `invoke`.

    The entry is compiled at the first call. For a plain function, the result is a number that the
    plain form of `invoke` accepts in the same way.
    """
    pointer = id(compiled)
    if isinstance(compiled, Dispatcher):
        kinds = tuple(map(typeof, arguments))
        compiled.compile(kinds)
        result: Any = compiled.overloads[kinds]
        pointer = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)
    _at_address[pointer] = compiled
    return pointer


# From here to `_add_row`, functions have the form that `numba.extending.intrinsic` requires: they
# take the types of the arguments, and return a signature and a function that writes LLVM code.


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
        pointers = [
            context.make_array(kind)(context, builder, value=value).data for kind, value in arrays
        ]
        pointers.append(values[4])
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in pointers])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, common, rows, into, types.int64), code


# Calls an entry by its address with four records and a number, and returns its status.
invoke: Any = intrinsic(_invoke)


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
            pointers = [
                builder.bitcast(builder.gep(one, [column]), vector.as_pointer())
                for one in (row, into)
            ]
            added, before = (builder.load(pointer, align=8) for pointer in pointers)
            builder.store(builder.fadd(before, builder.fmul(factors, added)), pointers[1], align=8)
        return context.get_dummy_value()

    return types.void(types.float64, row, into, types.int64), code


# Calls a `MachineFunction` by its address, with the memory of its inputs and outputs.
call: Any = intrinsic(_call)
# Calls a `ColumnFunction` by its address. The arguments are the address, the inputs common to all
# columns, the first row of the other inputs, the first row of outputs, and the number of columns.
call_columns: Any = intrinsic(_call_columns)
# Adds a factor times a row to another row, in place. The number of columns must be a multiple of
# MOST_LANES.
add_row: Any = intrinsic(_add_row)


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
    """Digest of all kernel files. It changes if any kernel changes."""
    files = sorted(Path(__file__).parent.parent.rglob("*kernel*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@cache
def plain(compiled: Any) -> Callable[..., Any]:
    """Ordinary Python function with the code of a kernel.

    The kernels that it calls are plain functions, too.
    """
    source = getattr(compiled, "py_func", compiled)
    names = {
        name: source.__globals__[name]
        for name in source.__code__.co_names
        if name in source.__globals__
    }
    functions = {name: getattr(value, "py_func", value) for name, value in names.items()}
    kernels = [
        name
        for name, value in functions.items()
        if isinstance(value, FunctionType) and hasattr(value, "kernel")
    ]
    called: dict[str, Any] = {name: plain(names[name]) for name in kernels}
    called |= {"invoke": _invoke_plain, "call": _call_plain}
    called |= {"call_columns": _call_columns_plain, "add_row": _add_row_plain}
    return FunctionType(
        source.__code__, source.__globals__ | called, source.__name__, source.__defaults__
    )


def chosen(kernel: Any, compiled: bool) -> Callable[..., Any]:
    """Function to call from Python: the compiled kernel, or the plain one.

    It is the plain one if `compiled` is False or Numba's compiler is switched off.
    """
    if compiled and isinstance(kernel, Dispatcher):
        return kernel
    # compiled code gives no floating-point warnings either
    function: Callable[..., Any] = np.errstate(all="ignore")(plain(kernel))
    return function
