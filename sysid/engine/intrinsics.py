# mypy: ignore-errors
"""What compiled code needs and Python has no words for."""

import platform
from typing import Any

from llvmlite import binding, ir
from numba import types
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


@intrinsic
def multiply_add(context: Any, c: Any, k: Any, a: Any, i: Any, b: Any, j: Any) -> Any:
    """c[k] += a[i] * b[j] for rows of lanes, (rows, LANES).

    Written as a loop the compiler would leave it scalar, not knowing the rows apart.
    """
    rows = ir.VectorType(ir.DoubleType(), LANES)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointers = []
        for place in (0, 2, 4):
            array = context.make_array(signature.args[place])(context, builder, args[place])
            data = builder.bitcast(array.data, rows.as_pointer())
            pointers.append(builder.gep(data, [args[place + 1]]))
        total, left, right = (builder.load(pointer, align=8) for pointer in pointers)
        product = builder.fmul(left, right, flags=("contract",))
        builder.store(builder.fadd(total, product, flags=("contract",)), pointers[0], align=8)
        return context.get_dummy_value()

    return types.none(c, types.intp, a, types.intp, b, types.intp), generate
