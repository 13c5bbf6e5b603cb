"""Designators are the performable parts of a plan: dataclasses with parameters as fields and an async `perform`.

A user's own designator needs nothing else; every call of its `perform` creates a node of the task tree:

>>> @dataclass
... class SayingActionPerformable(ActionAbstract):
...     text: str
...     async def perform(self) -> None:
...         print(self.text)
>>> SayingActionPerformable.dtype
'SayingAction'
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from pycrorm_async.plan.constructor_arguments import record_arguments
from pycrorm_async.plan.errors import PerformNotAsync, ResourcesNotAMethod
from pycrorm_async.plan.execution.node_execution import is_wrapped, wrap_perform
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.resources import NOTHING, Resource
from pycrorm_async.plan.protocols import NodeKind


class Designator(Composable, ABC):
    """Base of everything performable; derive from `ActionAbstract` or `BaseMotion`.

    Class attributes:
        kind: the kind of its nodes.
        dtype: its name in a memory, by default derived from the class name, also for a subclass of a class that sets
            it, so that two types never share a name by accident. Set it to keep the name when the class is renamed.
        aliases: a tuple of former names; queries for this type include records under them. Not inherited.
        concept: the SOMA concept it corresponds to, if there is one.
        orm_class: a mapped class of the user's own for queries.

    Raises:
        PerformNotAsync: at class definition, if `perform` is not a coroutine function.
        ResourcesNotAMethod: at class definition, if `resources` is a field or a value.
    """

    kind: ClassVar[NodeKind]
    dtype: ClassVar[str]
    concept: ClassVar[str | None] = None
    orm_class: ClassVar[type | None] = None

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        own = vars(cls)
        if not isinstance(own.get("dtype"), str):
            cls.dtype = cls._name_in_memory()
        if "resources" in own.get("__annotations__", ()) or not callable(own.get("resources", len)):
            raise ResourcesNotAMethod(cls.__qualname__)
        initialise = own.get("__init__")
        if inspect.isfunction(initialise) and "__dataclass_fields__" not in own and not _is_built_in(cls):
            cls.__init__ = record_arguments(initialise)  # type: ignore[method-assign]  # as `perform` below
        perform = own.get("perform")
        if perform is None or is_wrapped(perform):  # dataclass(slots=True) copies a class whose `perform` is wrapped
            return
        if not inspect.iscoroutinefunction(perform):
            raise PerformNotAsync(cls.__qualname__)
        cls.perform = wrap_perform(perform)  # type: ignore[assignment]  # the wrapper replaces the method

    @classmethod
    def _name_in_memory(cls) -> str:
        return cls.__name__

    @abstractmethod
    async def perform(self) -> Any:
        """Perform the designator and return when it has ended. Raises a `PlanFailure` if it fails."""

    def resources(self) -> frozenset[Resource]:
        """Return the parts of the robot it uses exclusively from start to end; nested designators declare their own."""
        return NOTHING


def _is_built_in(designator: type) -> bool:
    return designator.__module__.startswith("pycrorm_async.")


class ActionAbstract(Designator):
    """A goal of a plan, achieved by performing motions and other actions."""

    kind: ClassVar[NodeKind] = "action"

    @classmethod
    def _name_in_memory(cls) -> str:
        """Derive the name: both `FaceAtPerformable` and `FaceAtActionPerformable` give `FaceAtAction`."""
        stem = cls.__name__.removesuffix("Performable")
        return stem if stem.endswith("Action") else f"{stem}Action"


class BaseMotion(Designator):
    """A single command to a robot's controllers. Its fields are checked when it is built.

    Raises:
        ResolutionError: names the fields that are missing or have another type than declared.
    """

    kind: ClassVar[NodeKind] = "motion"

    def __post_init__(self) -> None:
        check_properties(self)
