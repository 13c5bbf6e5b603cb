"""Operators that combine plans: `a + b`, `a - b`, `a | b`, `a ^ b`, `a * 3`, `a >> Monitor(…)`.

Designators and descriptions have them. Each operator creates an expression of `plan.language`, which refuses an operand
that is not performable immediately and names it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pycrorm_async.plan.language.expressions import Parallel, Repeat, Sequential, TryAll, TryInOrder
    from pycrorm_async.plan.language.monitor import Monitor


class Composable:
    """Base of everything that can be an operand.

    At run time the other operand may be any object; one that is not performable raises `NotALanguageExpression`.
    """

    __slots__ = ()
    __array_ufunc__ = None  # numpy would otherwise turn an array times a plan into an array of plans

    def __add__(self, other: Composable) -> Sequential:
        """Perform this one, then the other."""
        return _expressions().sequential(self, other)

    def __sub__(self, other: Composable) -> TryInOrder:
        """Perform this one, and the other only if it fails."""
        return _expressions().try_in_order(self, other)

    def __or__(self, other: Composable) -> Parallel:
        """Perform both in parallel; both must succeed."""
        return _expressions().parallel(self, other)

    def __xor__(self, other: Composable) -> TryAll:
        """Perform both in parallel; one must succeed."""
        return _expressions().try_all(self, other)

    def __mul__(self, times: int) -> Repeat:
        """Perform this one `times` times."""
        return _expressions().repeat(self, times)

    __rmul__ = __mul__

    def __rshift__(self, monitor: Monitor) -> Monitor:
        """Perform this one until it ends or the monitor's condition holds."""
        return _expressions().watch_operand(self, monitor)

    # Python calls these only if the left operand lacks the operator, so it is not performable: the constructors raise.

    def __radd__(self, other: Composable) -> Sequential:
        return Composable.__add__(other, self)

    def __rsub__(self, other: Composable) -> TryInOrder:
        return Composable.__sub__(other, self)

    def __ror__(self, other: Composable) -> Parallel:
        return Composable.__or__(other, self)

    def __rxor__(self, other: Composable) -> TryAll:
        return Composable.__xor__(other, self)

    def __rrshift__(self, other: Composable) -> Monitor:
        return _expressions().watch_operand(other, self)


class _Expressions(NamedTuple):
    sequential: type[Sequential]
    try_in_order: type[TryInOrder]
    parallel: type[Parallel]
    try_all: type[TryAll]
    repeat: type[Repeat]
    watch_operand: Callable[[Composable, Composable], Monitor]


def _expressions() -> _Expressions:
    """Import the expressions when an operator is used: they are designators, whose base class is `Composable`."""
    from pycrorm_async.plan.language.expressions import Parallel, Repeat, Sequential, TryAll, TryInOrder
    from pycrorm_async.plan.language.monitor import watch_operand

    return _Expressions(Sequential, TryInOrder, Parallel, TryAll, Repeat, watch_operand)
