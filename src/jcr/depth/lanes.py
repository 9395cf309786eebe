"""Numbers in the lanes of a vector register, for loops whose order of sums must be that which is written.

The compiler does not vectorise a loop that reads where numbers point, nor may it reorder a sum. Intrinsics of numba
build such code from `Lanes`, whose operators emit one instruction for all lanes. Every machine then gives the same
bits, whatever the width of its registers.
"""

from functools import partialmethod
from typing import Any

from llvmlite import ir

FLOAT, INT, LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)


class Lanes:
    """One number or condition a lane: the result of an instruction that `builder` emits."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value, self.count = builder, value, value.type.count

    @classmethod
    def constant(cls, builder: Any, numbers: Any, kind: Any = FLOAT) -> "Lanes":
        """Given numbers, one a lane."""
        return cls(builder, ir.Constant(ir.VectorType(kind, len(numbers)), [kind(n) for n in numbers]))

    @classmethod
    def repeated(cls, builder: Any, number: Any, count: int) -> "Lanes":
        """A scalar in all `count` lanes."""
        empty = ir.Constant(ir.VectorType(number.type, count), ir.Undefined)
        return cls(builder, builder.insert_element(empty, number, INT(0))).at([0] * count)

    @classmethod
    def read(cls, builder: Any, start: Any, place: Any, count: int) -> "Lanes":
        """`count` consecutive floats from a place on."""
        there = builder.bitcast(builder.gep(start, [place]), ir.VectorType(FLOAT, count).as_pointer())
        return cls(builder, builder.load(there, align=4))

    def gathered(self, start: Any, used: int) -> "Lanes":
        """64 bits from each of these places after `start`; the lanes from `used` on are 0."""
        b, found = self.builder, ir.Constant(ir.VectorType(LONG, self.count), [LONG(0)] * self.count)
        for lane in range(used):
            place = b.zext(b.extract_element(self.value, INT(lane)), LONG)
            there = b.bitcast(b.gep(start, [place]), LONG.as_pointer())
            found = b.insert_element(found, b.load(there, align=4), INT(lane))
        return Lanes(b, found)

    def _same(self, other: Any) -> Any:
        """The other operand; a number stands for itself in every lane."""
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
        """`yes` in the lanes where this condition holds, `no` in the others; numbers stand for floats."""
        zero = Lanes.constant(self.builder, [0.0] * self.count)
        return Lanes(
            self.builder, self.builder.select(self.value, zero._same(yes).value, zero._same(no).value)
        )

    def as_ints(self) -> "Lanes":
        """The numbers as int32: those of floats without their fraction, the low bits of longer ones."""
        convert = self.builder.fptosi if self.value.type.element == FLOAT else self.builder.trunc
        return Lanes(self.builder, convert(self.value, ir.VectorType(INT, self.count)))

    def as_floats(self) -> "Lanes":
        """The numbers of int32 as float32."""
        return Lanes(self.builder, self.builder.sitofp(self.value, ir.VectorType(FLOAT, self.count)))

    def as_pairs(self) -> "tuple[Lanes, Lanes]":
        """The two floats that lie in the 64 bits of every lane."""
        floats = Lanes(self.builder, self.builder.bitcast(self.value, ir.VectorType(FLOAT, 2 * self.count)))
        return floats.at(range(0, 2 * self.count, 2)), floats.at(range(1, 2 * self.count, 2))

    def at(self, lanes: Any) -> "Lanes":
        """The numbers of some lanes, in a given order."""
        chosen = Lanes.constant(self.builder, lanes, INT).value
        return Lanes(self.builder, self.builder.shuffle_vector(self.value, self.value, chosen))

    def sum(self) -> Any:
        """The scalar sum, by halves: lane k is added to lane k + n/2, then k to k + n/4, and so on."""
        lanes = self
        while (n := lanes.count) > 1:
            lanes = lanes.at(range(n // 2)) + lanes.at(range(n // 2, n))
        return self.builder.extract_element(lanes.value, INT(0))

    def add_to(self, start: Any, place: Any) -> None:
        """Add the lanes to consecutive floats from a place on."""
        there = self.builder.bitcast(self.builder.gep(start, [place]), self.value.type.as_pointer())
        self.builder.store((self + Lanes.read(self.builder, start, place, self.count)).value, there, align=4)
