"""Let a package import its modules when their names are first read, so that a program loads only what it uses.

A package lists its names by module. Importing the package loads none of them; reading a name loads its module, and the
next reading finds the name in the package.

>>> __getattr__ = lazy_names(__name__, {"reading": "Reading memory_html", "success": "plot_success"})
"""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(package: str, names_by_module: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package; the names of a module are divided by spaces.

    No name may be that of a module of the package, because importing the module would replace it.
    """
    modules = {name: module for module, names in names_by_module.items() for name in names.split()}

    def __getattr__(name: str) -> Any:  # noqa: N807  a module's own
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{modules[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return __getattr__
