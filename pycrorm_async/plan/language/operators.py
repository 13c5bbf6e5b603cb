"""The operators with which plans are put together: `a + b`, `a - b`, `a | b`, `a ^ b`, `a * 3`, `a >> Monitor(…)`.

Whatever can be performed has them, descriptions too. Each makes an expression of `plan.language`; what cannot
stand in one is refused at once, and the message says what it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pycrorm_async.plan.language.expressions import Parallel, Repeat, Sequential, TryAll, TryInOrder
    from pycrorm_async.plan.language.monitor import Monitor

__all__ = ["Composable"]


class Composable:
    """What can be an operand.

    The other operand may be anything at run time; what is none raises `NotALanguageExpression`.
    """

    __slots__ = ()
    __array_ufunc__ = None  # an array of numbers times a plan would be an array of plans

    def __add__(self, other: Composable) -> Sequential:
        """This one, then the other."""
        from pycrorm_async.plan.language.expressions import Sequential

        return Sequential(self, other)

    def __sub__(self, other: Composable) -> TryInOrder:
        """This one, and the other only if it fails."""
        from pycrorm_async.plan.language.expressions import TryInOrder

        return TryInOrder(self, other)

    def __or__(self, other: Composable) -> Parallel:
        """Both at once; both must succeed."""
        from pycrorm_async.plan.language.expressions import Parallel

        return Parallel(self, other)

    def __xor__(self, other: Composable) -> TryAll:
        """Both at once; one must succeed."""
        from pycrorm_async.plan.language.expressions import TryAll

        return TryAll(self, other)

    def __mul__(self, times: int) -> Repeat:
        """So many times."""
        from pycrorm_async.plan.language.expressions import Repeat

        return Repeat(self, times)

    __rmul__ = __mul__

    def __rshift__(self, monitor: Monitor) -> Monitor:
        """Until it is done, or until the monitor's condition holds."""
        from pycrorm_async.plan.language.monitor import watch_operand

        return watch_operand(self, monitor)

    # The left operand has none of these operators, so it is no operand; the classes say so.

    def __radd__(self, other: Composable) -> Sequential:
        return Composable.__add__(other, self)

    def __rsub__(self, other: Composable) -> TryInOrder:
        return Composable.__sub__(other, self)

    def __ror__(self, other: Composable) -> Parallel:
        return Composable.__or__(other, self)

    def __rxor__(self, other: Composable) -> TryAll:
        return Composable.__xor__(other, self)

    def __rrshift__(self, other: Composable) -> Monitor:
        from pycrorm_async.plan.language.monitor import watch_operand

        return watch_operand(other, self)
