"""Retry an operand that failed: with the next alternative of a description, or the same designator again."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import AsyncGenerator, AsyncIterable
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any

from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.exceptions import describe_error
from pycrorm_async.plan.failures import IllPosedGoalFailure, NotALanguageExpression
from pycrorm_async.plan.language.expressions import Expression, perform_operand
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.outcome import attempt, combine_failures


@dataclass(init=False, repr=False, eq=False)
class Retry(Expression):
    """Performs the alternatives of a description in turn, or a designator repeatedly, until one succeeds.

    >>> await Retry(PickUpAction(milk, [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT, Grasp.TOP]), max_tries=4).perform()

    Args:
        max_tries: greatest number of tries; a description may have fewer alternatives.

    Raises:
        NotALanguageExpression: the operand is not performable, or `max_tries` is not an integer >= 1.
    """

    max_tries: int

    def __init__(self, operand: Composable, max_tries: int = 3) -> None:
        try:
            self.max_tries = operator.index(max_tries)
        except TypeError:
            self.max_tries = 0
        if isinstance(max_tries, bool) or self.max_tries < 1:
            raise NotALanguageExpression(f"Retry needs an integer max_tries >= 1, got {max_tries!r}")
        self.hold([operand])

    async def perform(self) -> Any:
        """Return the result of the first success, or raise the last failure with the earlier ones as notes."""
        failures: list[Exception] = []
        notes: list[str] = []
        async with aclosing(self._alternatives()) as alternatives:
            async for performable in alternatives:
                result, failure = await attempt(functools.partial(perform_operand, performable))
                if failure is None:
                    return result
                failures = [failure]
                notes.append(f"try {len(notes) + 1}: {describe_error(failure)}")
                del failure
                if len(notes) == self.max_tries:
                    break
        if not failures:
            raise IllPosedGoalFailure(f"{self!r}: the description has no alternative")
        for note in notes[:-1]:
            failures[0].add_note(note)
        raise combine_failures(failures, "")

    async def _alternatives(self) -> AsyncGenerator[Any, None]:
        (operand,) = self.operands
        if isinstance(operand, AsyncIterable):  # a description that asks a memory between two alternatives
            async for each in operand:
                yield each
        else:
            for each in itertools.repeat(operand) if isinstance(operand, Designator) else operand:
                yield each
