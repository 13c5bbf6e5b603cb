"""Keep the import paths of modules that have moved, until the next release.

`sys.modules` has an entry for each former path. When a name is read from it, it imports the module of today and warns
(`DeprecationWarning`) with the new path. Python looks into `sys.modules` first, so a path such as
`plan.motions.simulated_robot` can be imported although `plan.motions` is a module today.
"""

import sys
import warnings
from importlib import import_module
from types import ModuleType
from typing import Any, Final

_PACKAGE: Final = "pycrorm_async"
_FORMER_PATHS: Final = {
    "events.codec": "events.envelope events.upcasters",
    "events.fields": "events.tags",
    "events.types": "events.blobs events.values",
    "integrations.callbacks": "integrations.callback_values",
    "memory": "memory_reading sync_memory",
    "orm.actions": "orm.language orm.motions",
    "orm.base": "orm.types",
    "orm.rows": "orm.designators orm.objects orm.perception orm.tree",
    "plan.actions": "plan.actions.basic plan.actions.manipulation plan.actions.transport",
    "plan.execution": "plan.execution.observer",
    "plan.failures": "plan.errors plan.exceptions",
    "plan.motions": "plan.motions.motions plan.motions.simulated_robot",
    "query.sql": "query.sql.read_only",
    "record": "recording",
    "record.executives": "recording.activations recording.runs recording.value_changes",
    "record.recording": "recording.recording",
    "store.postgresql": "store.postgresql.roles",
    "world.pose": "world.enums world.errors",
    "world.urdf": "world.robots.robot_description",
}
"""Former paths by today's: those that documentation named, and modules that listed their public names."""


class _FormerModule(ModuleType):
    """The module at a former path: its names are those of today's."""

    def __init__(self, name: str, today: str) -> None:
        super().__init__(name, f"Deprecated: import from {today}.")
        self._today = today

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # read by programs that look through all modules
            raise AttributeError(name)
        former = sys.modules.get(f"{self.__name__}.{name}")
        if isinstance(former, _FormerModule):
            return former
        warnings.warn(f"{self.__name__} has moved: import from {self._today}", DeprecationWarning, stacklevel=2)
        return getattr(import_module(self._today), name)


def keep_former_paths() -> None:
    """Make the former paths importable."""
    for today, paths in _FORMER_PATHS.items():
        for path in paths.split():
            name = f"{_PACKAGE}.{path}"
            sys.modules[name] = _FormerModule(name, f"{_PACKAGE}.{today}")
