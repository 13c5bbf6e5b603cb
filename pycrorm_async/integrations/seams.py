"""`Seams` replace methods of another library's classes, and restore them whichever way the block ends."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial, wraps
from inspect import Signature, signature
from typing import Any, Protocol

from pycrorm_async.recording.recording import Recording


class _Observer(Protocol):
    seams: Seams


class Seams:
    """The methods replaced and the callbacks added since `is_on` was set; `remove` removes all of them.

    A method that another library has replaced in turn is not restored; the seam inside it then only calls the original.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.is_on = False
        self._undo = ExitStack()

    def remove(self) -> None:
        """Remove all seams; those that still run in other threads do nothing from now on."""
        self.is_on = False
        self._undo.close()

    def around(self, owner: type, name: str, perform: Callable[..., Any]) -> None:
        """Call `perform(call, subject, *args)` in place of a method, where `call()` performs the method itself.

        Arguments that the caller passes by name reach `perform` by position, as far as they have one.
        """
        original = vars(owner)[name]
        parameters = signature(original)

        def seam(subject: Any, *args: Any, **kwargs: Any) -> Any:
            call = partial(original, subject, *args, **kwargs)
            if kwargs:
                args, kwargs = _by_position(parameters, subject, args, kwargs)
            return perform(call, subject, *args, **kwargs) if self.is_on else call()

        self._replace(owner, name, seam)

    def after(self, owner: type, name: str, report: Callable[..., Any]) -> None:
        """Call `report(subject, *args)` after a method; named arguments are passed by position where they have one."""
        original = vars(owner)[name]
        parameters = signature(original)

        def seam(subject: Any, *args: Any, **kwargs: Any) -> Any:
            result = original(subject, *args, **kwargs)
            if kwargs:
                args, kwargs = _by_position(parameters, subject, args, kwargs)
            if self.is_on:
                report(subject, *args, **kwargs)
            return result

        self._replace(owner, name, seam)

    def _replace(self, owner: type, name: str, method: Callable[..., Any]) -> None:
        original = vars(owner)[name]
        seam = wraps(original)(method)

        def restore() -> None:
            if vars(owner).get(name) is seam:
                setattr(owner, name, original)

        setattr(owner, name, seam)
        self._undo.callback(restore)

    def callback(self, add: Callable[[Any], None], remove: Callable[[Any], None], callback: Callable[..., Any]) -> None:
        """Add a callback; remove it with the seams, unless another library has removed it."""
        add(callback)
        self._undo.callback(_without_fault, remove, callback)


def _by_position(
    parameters: Signature, subject: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Move named arguments to their positions; return them unchanged if they do not fit the method."""
    try:
        bound = parameters.bind(subject, *args, **kwargs)
    except TypeError:
        return args, kwargs
    return bound.args[1:], bound.kwargs


def _without_fault(remove: Callable[[Any], None], callback: Callable[..., Any]) -> None:
    with suppress(ValueError, KeyError):
        remove(callback)


def guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    """Count the exceptions of an observer's method, so that none reaches the plan; do nothing without the seams."""

    @wraps(method)
    def call(self: _Observer, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs) if self.seams.is_on else None
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.seams.recording.note_fault(f"{type(self).__name__}.{method.__name__}", error)
            return None

    return call
