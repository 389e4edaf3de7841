"""Two products of 6 x 6 and 3 x 6 numbers for compiled loops, written in vectors of six.

Both are the inner work of sums over pairs of rays. The compiler makes vectors of loops over long arrays, but
not of six numbers at a time: as loops they take 21 ns, as vectors 5 ns.

Source: vector types and `contract` (fused multiply-add): LLVM Language Reference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import types

from sfm.conventions import FloatArray

SIX = ir.VectorType(ir.DoubleType(), 6)
FUSED = ("contract",)
_intrinsic: Any = extending.intrinsic  # whose types are those of the code that is generated
ALIGNED = 8  # bytes; no more is known of where six numbers lie


def _subtract_pair(_: Any, flat: Any, at: Any, stride: Any, Y: Any, s: Any, t: Any) -> Any:
    """Take Y_s Y_t' off 6 x 6 numbers: flat[at + q stride + p] -= sum_r Y[s, r, q] Y[t, r, p].

    Args:
        flat: contiguous numbers, (any,).
        at: place of the first of them.
        stride: from one row to the next.
        Y: rows Y' of image points, contiguous, (k, 3, 6).
        s: one of them.
        t: another.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flat, at, stride, Y, s, t = arguments
        numbers = _data(context, builder, signature.args[0], flat)
        rows = _data(context, builder, signature.args[3], Y)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        others = [_six(builder, _place(builder, rows, second, 6 * r)) for r in range(3)]
        for q in range(6):
            place = builder.bitcast(
                builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))]), SIX.as_pointer()
            )
            value = builder.load(place, align=ALIGNED)
            for r in range(3):
                one = _repeated(builder, builder.load(_place(builder, rows, first, 6 * r + q)))
                value = builder.fsub(value, builder.fmul(one, others[r], flags=FUSED), flags=FUSED)
            builder.store(value, place, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(flat, types.intp, types.intp, Y, types.intp, types.intp), generate


def _add_product(_: Any, YQ: Any, s: Any, Y: Any, t: Any, flat: Any, at: Any, stride: Any) -> Any:
    """Add Y_t' Q to YQ_s: YQ[s, r, p] += sum_q Y[t, r, q] flat[at + q stride + p].

    Args:
        YQ: what is added to, rows of image points, contiguous, (k, 3, 6).
        s: image point of YQ.
        Y: rows of image points, contiguous, (k, 3, 6).
        t: image point of Y.
        flat: contiguous numbers, (any,).
        at: place of the first of 6 x 6 numbers Q.
        stride: from one row to the next.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        YQ, s, Y, t, flat, at, stride = arguments
        sums = _data(context, builder, signature.args[0], YQ)
        rows = _data(context, builder, signature.args[2], Y)
        numbers = _data(context, builder, signature.args[4], flat)
        first, second = (builder.mul(k, _integer(18)) for k in (s, t))
        places = [builder.bitcast(_place(builder, sums, first, 6 * r), SIX.as_pointer()) for r in range(3)]
        values = [builder.load(place, align=ALIGNED) for place in places]
        for q in range(6):
            row = _six(builder, builder.gep(numbers, [builder.add(at, builder.mul(stride, _integer(q)))]))
            for r in range(3):
                one = _repeated(builder, builder.load(_place(builder, rows, second, 6 * r + q)))
                values[r] = builder.fadd(values[r], builder.fmul(one, row, flags=FUSED), flags=FUSED)
        for place, value in zip(places, values, strict=True):
            builder.store(value, place, align=ALIGNED)
        return context.get_dummy_value()

    return types.void(YQ, types.intp, Y, types.intp, flat, types.intp, types.intp), generate


subtract_pair: Callable[[FloatArray, int, int, FloatArray, int, int], None] = _intrinsic(_subtract_pair)
add_product: Callable[[FloatArray, int, FloatArray, int, FloatArray, int, int], None] = _intrinsic(
    _add_product
)


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the pointer to the numbers of an array."""
    return context.make_array(kind)(context, builder, array).data


def _integer(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), value)


def _place(builder: Any, numbers: Any, start: Any, offset: int) -> Any:
    return builder.gep(numbers, [builder.add(start, _integer(offset))])


def _six(builder: Any, place: Any) -> Any:
    """Return the six numbers from a place on."""
    return builder.load(builder.bitcast(place, SIX.as_pointer()), align=ALIGNED)


def _repeated(builder: Any, number: Any) -> Any:
    """Return one number six times."""
    nothing, lane = ir.Constant(SIX, ir.Undefined), ir.IntType(32)
    one = builder.insert_element(nothing, number, ir.Constant(lane, 0))
    return builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(lane, 6), [0] * 6))
