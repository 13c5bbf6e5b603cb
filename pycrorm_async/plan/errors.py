"""Errors in the code of a plan: designators that are declared or used in a wrong way.

Three modules share the exceptions of plans. `errors` has the mistakes of a plan's author, which are a `CallerError` and
need a change of code. `failures` has the outcomes of actions, such as an unreachable object, which a plan catches to
try an alternative. `exceptions` defines no class; its functions classify and describe any exception.

A *description*, such as `NavigateAction([pose_1, pose_2])`, lists alternatives. `resolve()` chooses one and returns a
*designator*, such as `NavigateActionPerformable(pose_1)`, which can be performed.
"""

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
    """The call needs an acting robot with a robot description in the current world."""
