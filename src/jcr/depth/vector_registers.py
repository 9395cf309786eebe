"""Vector arithmetic for numba intrinsics, with a fixed order of sums: results are the same bits on every machine."""

from functools import partialmethod
from typing import Any

from llvmlite import ir
from numba.core import cgutils

FLOAT, INT, LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)


class Lanes:
    """Vector of numbers or conditions (one per lane) in a register, as the LLVM value that `builder` has emitted."""

    def __init__(self, builder: Any, value: Any) -> None:
        """Wrap `value`, an LLVM value of a vector type; `builder` is the LLVM IR builder that emits operations on it."""
        self.builder, self.value, self.count = builder, value, value.type.count

    @classmethod
    def constant(cls, builder: Any, numbers: Any, kind: Any = FLOAT) -> "Lanes":
        """Return a vector constant for the IR builder `builder`: one of the `numbers` per lane, of LLVM type `kind`."""
        return cls(builder, ir.Constant(ir.VectorType(kind, len(numbers)), [kind(n) for n in numbers]))

    @classmethod
    def repeated(cls, builder: Any, number: Any, count: int) -> "Lanes":
        """Return a vector that the IR builder `builder` emits, with the LLVM scalar `number` in all `count` lanes."""
        empty = ir.Constant(ir.VectorType(number.type, count), ir.Undefined)
        return cls(builder, builder.insert_element(empty, number, INT(0))).at([0] * count)

    @classmethod
    def read(cls, builder: Any, start: Any, place: Any, count: int) -> "Lanes":
        """Load `count` consecutive floats from memory, beginning at element `place` of the array `start`.

        `builder` is the IR builder, `start` an LLVM pointer, `place` an LLVM integer.
        """
        there = builder.bitcast(builder.gep(start, [place]), ir.VectorType(FLOAT, count).as_pointer())
        return cls(builder, builder.load(there, align=4))

    def gathered(self, start: Any) -> "Lanes":
        """Load 64 bits for each lane: the lanes are the indices, from the LLVM pointer `start`, at which these begin."""
        b, found = self.builder, ir.Constant(ir.VectorType(LONG, self.count), [LONG(0)] * self.count)
        for lane in range(self.count):
            place = b.zext(b.extract_element(self.value, INT(lane)), LONG)
            there = b.bitcast(b.gep(start, [place]), LONG.as_pointer())
            found = b.insert_element(found, b.load(there, align=4), INT(lane))
        return Lanes(b, found)

    def _same(self, other: Any) -> Any:
        """Return the Python number `other` in every lane of a vector of this type; return a vector `other` unchanged."""
        kind = self.value.type.element
        return other if isinstance(other, Lanes) else Lanes.constant(self.builder, [other] * self.count, kind)

    def _emit(self, of_floats: str, of_ints: str, other: Any) -> "Lanes":
        operation = getattr(self.builder, of_floats if self.value.type.element == FLOAT else of_ints)
        return Lanes(self.builder, operation(self.value, self._same(other).value))

    def _compare(self, sign: str, other: Any) -> "Lanes":
        return Lanes(self.builder, self.builder.fcmp_ordered(sign, self.value, self._same(other).value))

    __add__ = partialmethod(_emit, "fadd", "add")
    __sub__ = partialmethod(_emit, "fsub", "sub")
    __mul__ = partialmethod(_emit, "fmul", "mul")
    __truediv__ = partialmethod(_emit, "fdiv", "sdiv")
    __and__ = partialmethod(_emit, "and_", "and_")
    __rshift__ = partialmethod(_emit, "lshr", "lshr")
    __lt__ = partialmethod(_compare, "<")
    __gt__ = partialmethod(_compare, ">")
    __ge__ = partialmethod(_compare, ">=")

    def __abs__(self) -> "Lanes":
        return (self < 0.0).choose(self * -1.0, self)

    def choose(self, yes: Any, no: Any) -> "Lanes":
        """Return per lane `yes` where this vector of conditions is true, else `no`.

        Both are vectors or Python numbers; numbers are repeated in every lane as floats.
        """
        zero = Lanes.constant(self.builder, [0.0] * self.count)
        return Lanes(
            self.builder, self.builder.select(self.value, zero._same(yes).value, zero._same(no).value)
        )

    def as_ints(self) -> "Lanes":
        """Truncate each float32 lane to int32."""
        return Lanes(self.builder, self.builder.fptosi(self.value, ir.VectorType(INT, self.count)))

    def as_floats(self) -> "Lanes":
        """Convert each int32 lane to float32."""
        return Lanes(self.builder, self.builder.sitofp(self.value, ir.VectorType(FLOAT, self.count)))

    def as_pairs(self) -> "tuple[Lanes, Lanes]":
        """Split each 64-bit lane into its low and its high 32 bits; return vectors (low, high) of int32."""
        pairs = Lanes(self.builder, self.builder.bitcast(self.value, ir.VectorType(INT, 2 * self.count)))
        return pairs.at(range(0, 2 * self.count, 2)), pairs.at(range(1, 2 * self.count, 2))

    def inverted(self) -> "Lanes":
        """Return the reciprocal 1/x of each lane."""
        return self._same(1.0) / self

    def root(self) -> "Lanes":
        """Return the square root of each lane."""
        kind = ir.FunctionType(self.value.type, [self.value.type])
        root = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.sqrt.v{self.count}f32")
        return Lanes(self.builder, self.builder.call(root, [self.value]))

    def at(self, lanes: Any) -> "Lanes":
        """Return the vector of the lanes at the indices `lanes`, a sequence of Python integers, in this order."""
        chosen = Lanes.constant(self.builder, lanes, INT).value
        return Lanes(self.builder, self.builder.shuffle_vector(self.value, self.value, chosen))

    def write(self, start: Any, place: Any) -> None:
        """Store the lanes to memory as consecutive elements, from element `place` of the LLVM pointer `start` on."""
        there = self.builder.bitcast(self.builder.gep(start, [place]), self.value.type.as_pointer())
        self.builder.store(self.value, there, align=4)
