"""Load the plan function that `PLAN.py[:function]` names."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.errors import CallerError


class PlanNotLoadable(CallerError):
    """The plan file or its function cannot be used; the message is one line."""


class LoadedPlan(NamedTuple):
    """A plan: an async function that takes the memory or no argument, its file, and the hash of that file."""

    name: str
    function: Callable[..., Awaitable[Any]]
    takes_memory: bool
    path: Path
    sha256: str

    @property
    def description(self) -> str:
        """Return the first line of the function's docstring, or the plan's name."""
        documentation = inspect.getdoc(self.function)
        return documentation.splitlines()[0] if documentation else self.name


def load_plan(reference: str) -> LoadedPlan:
    """Import `path.py` and return its function; without `:function`, the function `plan`. Raises `PlanNotLoadable`."""
    path_text, _, function_name = reference.rpartition(":") if ".py:" in reference else (reference, "", "")
    function_name = function_name or "plan"
    path = Path(path_text)
    if path.is_dir():
        raise PlanNotLoadable(f"{path_text!r} is a folder: name the plan file in it")
    if not path.is_file():
        raise PlanNotLoadable(f"the plan file {path_text!r} does not exist")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    module = _import_file(path)
    function = getattr(module, function_name, None)
    if function is None:
        functions = [name for name, each in vars(module).items() if inspect.iscoroutinefunction(each)]
        hint = f"; its async functions: {', '.join(functions)}" if functions else "; it has no async function"
        raise PlanNotLoadable(f"{path} has no function {function_name!r}{hint}")
    if not inspect.iscoroutinefunction(function):
        raise PlanNotLoadable(f"{path}:{function_name} is not an async function: write `async def {function_name}()`")
    required = [
        each
        for each in inspect.signature(function).parameters.values()
        if each.default is each.empty and each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
    ]
    if len(required) > 1:
        names = ", ".join(each.name for each in required)
        raise PlanNotLoadable(f"{path}:{function_name} takes {names}: a plan takes the memory or no argument")
    return LoadedPlan(f"{path.name}:{function_name}", function, bool(required), path, sha256)


def _import_file(path: Path) -> Any:
    name = path.stem
    if name in sys.modules or name in sys.stdlib_module_names:
        raise PlanNotLoadable(f"{path} has the name of a standard or already loaded module: rename the file")
    specification = importlib.util.spec_from_file_location(name, path.resolve())
    if specification is None or specification.loader is None:
        raise PlanNotLoadable(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    sys.path.insert(0, str(path.resolve().parent))
    try:
        specification.loader.exec_module(module)
    except SystemExit as error:
        del sys.modules[name]
        raise PlanNotLoadable(f"{path} exits the program when it is imported (exit code {error.code})") from error
    except Exception as error:
        del sys.modules[name]
        frames = traceback.extract_tb(error.__traceback__)
        line = getattr(error, "lineno", None) or next(
            (frame.lineno for frame in reversed(frames) if frame.filename == str(path.resolve())), None
        )
        where = f"{path}:{line}" if line else str(path)
        raise PlanNotLoadable(f"{where} cannot be imported: {type(error).__name__}: {error}") from error
    return module
