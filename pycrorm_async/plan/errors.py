"""Errors of a plan's author; failures of a running plan are in `pycrorm_async.plan.failures`."""

from __future__ import annotations

from collections.abc import Sequence

from pycrorm_async.errors import CallerError


class PerformNotAsync(CallerError, TypeError):
    """A designator class declares a `perform` that is not `async def perform(self)`."""

    def __init__(self, designator: str) -> None:
        super().__init__(f"{designator}.perform must be declared as `async def perform(self)`")
        self.designator = designator


class ResourcesNotAMethod(CallerError, TypeError):
    """A designator class declares `resources` as a field or value and not as a method."""

    def __init__(self, designator: str) -> None:
        super().__init__(
            f"{designator}.resources must be a method that returns a frozenset of Resource: rename the field"
        )
        self.designator = designator


class NotResolved(CallerError, AttributeError):
    """A description is used where a resolved designator is needed: `.resolve()` is missing."""

    def __init__(self, description: str, name: str) -> None:
        super().__init__(
            f"{description} is a description and has no {name!r}: resolve it first, as in {description}(…).resolve()"
            f"{'.perform()' if name == 'perform' else ''}"
        )
        self.description = description


class ResolutionError(CallerError):
    """The arguments of a designator do not fit its declared properties.

    Attributes:
        designator: the class name.
        missing: properties that are None and must not be.
        wrong: properties of another type than declared, each as "name: expected …, got …".
    """

    def __init__(self, designator: str, *, missing: Sequence[str] = (), wrong: Sequence[str] = ()) -> None:
        parts = []
        if missing:
            parts.append(f"missing: {', '.join(missing)}")
        if wrong:
            parts.append(f"wrong: {'; '.join(wrong)}")
        super().__init__(f"{designator} cannot be built; {'. '.join(parts)}")
        self.designator = designator
        self.missing = tuple(missing)
        self.wrong = tuple(wrong)


class NoRobotChosen(CallerError):
    """A motion was performed in a context without a chosen robot."""

    def __init__(self, motion: str) -> None:
        super().__init__(f"{motion} moves a robot: perform it inside `with simulated_robot:`")
        self.motion = motion


class NoRobotHere(CallerError):
    """The call needs a robot that has a robot description, and there is none."""
