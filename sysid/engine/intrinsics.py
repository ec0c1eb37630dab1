# mypy: ignore-errors
"""What compiled code needs and Python has no words for."""

import contextlib
import inspect
import platform
from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.core.extending import intrinsic as _intrinsic

from sysid.engine.scheme import LANES

# What it makes is called without the context that its functions take first.
intrinsic: Any = _intrinsic


def many_registers() -> bool:
    """Whether the processor has 32 vector registers, room for two vectors of everything."""
    arm = platform.machine() in ("aarch64", "arm64")
    return arm or binding.get_host_cpu_features().get("avx512f", False)


def _mark(*attributes: str) -> Any:
    """An intrinsic that adds attributes to the function that calls it."""

    def mark(context: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            for attribute in attributes:
                # The set knows LLVM's keywords only, and some of these are strings.
                set.add(builder.function.attributes, attribute)
            return context.get_dummy_value()

        return types.none(), generate

    return intrinsic(mark)


def _conversion(method: str, target: Any, signature: Any) -> Any:
    """An intrinsic that converts a number by one of LLVM's instructions."""

    def convert(context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return getattr(builder, method)(args[0], target)

        return signature, generate

    return intrinsic(convert)


# Let the calling function use the widest vectors there are, and keep them aligned. Where the
# processor has 512 bits LLVM keeps to 256 by itself, for code with few vectors in it; and what
# does not fit the registers it would store across cache lines.
wide_vectors = _mark('"prefer-vector-width"="512"', '"stackrealign"')
# Have the calling function inlined whatever its size: a loop of calls is no vector code.
always_inline = _mark("alwaysinline")
# The float whose 64 bits are those of an integer, the reverse, and a float cut to a 32-bit
# integer, the conversion that vector units have.
from_bits = _conversion("bitcast", ir.DoubleType(), types.float64(types.int64))
to_bits = _conversion("bitcast", ir.IntType(64), types.int64(types.float64))
to_int32 = _conversion("fptosi", ir.IntType(32), types.int32(types.float64))


def _row(context: Any, builder: Any, kind: Any, array: Any, place: Any) -> Any:
    """Pointer to a row of lanes of a contiguous array, as one vector."""
    data = context.make_array(kind)(context, builder, array).data
    rows = ir.VectorType(ir.DoubleType(), LANES).as_pointer()
    return builder.gep(builder.bitcast(data, rows), [place])


@intrinsic
def multiply_add(context: Any, c: Any, k: Any, a: Any, i: Any, b: Any, j: Any) -> Any:
    """c[k] += a[i] * b[j] for rows of lanes, (rows, LANES).

    Written as a loop the compiler would leave it scalar, not knowing the rows apart.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointers = [
            _row(context, builder, signature.args[place], *args[place : place + 2])
            for place in (0, 2, 4)
        ]
        total, left, right = (builder.load(pointer, align=8) for pointer in pointers)
        product = builder.fmul(left, right, flags=("contract",))
        builder.store(builder.fadd(total, product, flags=("contract",)), pointers[0], align=8)
        return context.get_dummy_value()

    return types.none(c, types.intp, a, types.intp, b, types.intp), generate


@intrinsic
def copy_row(context: Any, target: Any, i: Any, source: Any, j: Any) -> Any:
    """Row i of lanes of a contiguous array of any shape set to row j of another; as above."""
    if {target.layout, source.layout} != {"C"}:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        to, of = (
            _row(context, builder, signature.args[place], *args[place : place + 2])
            for place in (0, 2)
        )
        builder.store(builder.load(of, align=8), to, align=8)
        return context.get_dummy_value()

    return types.none(target, types.intp, source, types.intp), generate


def shared(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function once for all models, for one signature; kernels call it by ``outside``."""

    def compiled(function: Callable[..., Any]) -> Any:
        # RuntimeError: there is no place to keep it.
        with contextlib.suppress(RuntimeError):
            return njit(signature, error_model="numpy", cache=True)(function)
        return njit(signature, error_model="numpy")(function)

    return compiled


def outside(dispatcher: Any) -> Any:
    """An intrinsic that calls a function of one signature by its address.

    What calls it as it is has all of its code optimised and translated again, as a part of its own.
    """
    (compiled,) = dispatcher.overloads.values()
    signature, name = compiled.signature, f"hybrid_rig_{dispatcher.__name__}"
    # Also machine code that comes from the cache finds it by this name.
    address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    binding.add_symbol(name, address)

    def call(context: Any, *arguments: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            convention = context.call_conv
            kind = convention.get_function_type(signature.return_type, signature.args)
            callee = cgutils.get_or_insert_function(builder.module, kind, name)
            status, result = convention.call_function(
                builder, callee, signature.return_type, signature.args, args
            )
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return result

        return signature, generate

    # Arguments by their names: what stands behind a star would come as one tuple.
    names = inspect.signature(dispatcher.py_func).parameters
    first = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = [inspect.Parameter(p, first.kind) for p in names]
    call.__signature__ = inspect.Signature([first, *parameters])
    return intrinsic(call)
