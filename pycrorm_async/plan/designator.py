"""What a plan performs: a dataclass whose fields say what, and whose `async def perform(self)` does it.

A class of one's own needs nothing else; every call of its `perform` is a node of the task tree:

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

from pycrorm_async.plan.constructor_arguments import keeping_arguments
from pycrorm_async.plan.errors import PerformNotAsync, ResourcesNotAMethod
from pycrorm_async.plan.execution.node_execution import as_node, is_node
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.resources import NOTHING, Resource
from pycrorm_async.plan.task_tree import NodeKind

__all__ = ["Designator", "ActionAbstract", "BaseMotion"]


class Designator(Composable, ABC):
    """The root of everything performable. Descend from `ActionAbstract` or `BaseMotion`.

    Class attributes:
        kind: what its nodes are.
        dtype: its name in a memory, by default from the class' name, also for a class that descends from a
            named one: two types never share a name by accident. Set it to keep a name when a class is renamed.
        aliases: a tuple of the names it had before; what was recorded under these is asked for with it. Not inherited.
        concept: the SOMA concept it stands for, if one is known.
        orm_class: a mapped class of one's own to ask for it with.

    Raises:
        PerformNotAsync: at the definition of a class whose `perform` is not a coroutine function.
        ResourcesNotAMethod: at the definition of a class that has a field of that name.
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
        if inspect.isfunction(initialise) and "__dataclass_fields__" not in own and not _is_ours(cls):
            cls.__init__ = keeping_arguments(initialise)  # type: ignore[method-assign]  # as `perform` below
        perform = own.get("perform")
        if perform is None or is_node(perform):  # dataclass(slots=True) makes the class anew, hook and all
            return
        if not inspect.iscoroutinefunction(perform):
            raise PerformNotAsync(cls.__qualname__)
        cls.perform = as_node(perform)  # type: ignore[assignment]  # the hook takes the place of the method

    @classmethod
    def _name_in_memory(cls) -> str:
        return cls.__name__

    @abstractmethod
    async def perform(self) -> Any:
        """Do it; return when it is done. Raises a `PlanFailure` when it cannot be done."""

    def resources(self) -> frozenset[Resource]:
        """The parts of the robot it needs for itself from its start to its end; those of its parts are their affair."""
        return NOTHING


def _is_ours(designator: type) -> bool:
    return designator.__module__.startswith("pycrorm_async.")


class ActionAbstract(Designator):
    """An action: something a plan wants done, by motions and other actions."""

    kind: ClassVar[NodeKind] = "action"

    @classmethod
    def _name_in_memory(cls) -> str:
        """`FaceAtPerformable` and `FaceAtActionPerformable` are both `FaceAtAction`."""
        stem = cls.__name__.removesuffix("Performable")
        return stem if stem.endswith("Action") else f"{stem}Action"


class BaseMotion(Designator):
    """A motion: something a robot's controllers do at once. Its fields are checked when it is built.

    Raises:
        ResolutionError: naming the fields that are missing or of another type than declared.
    """

    kind: ClassVar[NodeKind] = "motion"

    def __post_init__(self) -> None:
        check_properties(self)
