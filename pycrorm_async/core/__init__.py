"""Choose the compiled core, where it is built, or the Python code beside it, which does the same and is the reference.

`_core.c` appends records to a mapped segment, reads them back and makes the values of their rows; `build.py` compiles
it when the package is installed. `Tail.append` and `take_records` do the cases that need no decision, as many as they
can, and return; the caller does the others. Those of the Python core do none. So the callers hold the rules once, and
run the same with both.

`PYCRORM_PURE=1` chooses Python. So does a Python without the interpreter lock, which the compiled core relies on.
"""

import hashlib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from struct import Struct
from types import BuiltinMethodType, MethodWrapperType, ModuleType, NoneType
from typing import TYPE_CHECKING, Any, Final


def _load() -> tuple[ModuleType | None, str]:
    """Return the compiled core, or None and the reason."""
    if os.environ.get("PYCRORM_PURE", "0") not in ("", "0"):
        return None, "PYCRORM_PURE is set"
    if "t" in sys.abiflags:
        return None, "this Python runs without the interpreter lock"
    try:
        compiled = importlib.import_module(f"{__name__}._core")
    except ImportError as error:
        return None, str(error) if error.path else "it was installed without a C compiler"
    source = Path(__file__).with_name("_core.c")  # which a wheel does not have
    if source.exists() and hashlib.sha256(source.read_bytes()).hexdigest() != compiled.SOURCE:
        return None, "_core.c was changed and not compiled again, with `python pycrorm_async/core/build.py`"
    return compiled, ""


_compiled, PURE_REASON = _load()
IS_COMPILED: Final = _compiled is not None


ATOMIC: Final = (BuiltinMethodType, MethodWrapperType)
"""Types of callables that run no Python, so that no signal handler, finalizer or other thread runs meanwhile."""


def description() -> str:
    """State in one sentence which core runs, and why it is not the compiled one."""
    if IS_COMPILED:
        return "This installation records and reads with the compiled core."
    return f"This installation records and reads with Python alone, which takes longer for each event: {PURE_REASON}."


class PythonTail:
    """The end of the records in the current segment, and what an append needs.

    Attributes:
        open: the open episodes; the sequence, wall time and monotonic time of the last record of each.
        position: of the last record.
        owner: the id of the thread that changes this state in several steps; 0 while no thread does.
        _has_atomic_clock: whether the clocks run no Python, as the system's; an append may be interrupted in others.
    """

    open: dict[Any, tuple[int, int, int]]
    position: int
    owner: int = 0
    _buffer: Any  # the mapping of the current segment; None when it is closed
    _offset: int
    _end: int
    _ordinary_end: int
    _salt: int
    _span_count: int
    _span_checksum: int
    _events_max: int
    _quiet: bool
    _wall_ns: Callable[[], int]
    _monotonic_ns: Callable[[], int]
    _has_atomic_clock: bool
    _refusal: Callable[[], Exception] | None
    _wake: Callable[[], None]

    def append(self, heading: tuple[Any, str, int], payload: bytes, reserved: bool) -> int | None:  # noqa: ARG002, FBT001
        """Append an event of an open episode that fits; return its sequence, or None if another case applies."""
        return None


def _take_nothing(*arguments: Any) -> tuple[int, int, int]:
    return arguments[1], arguments[3], arguments[5]


def _event_values(records: Sequence[Sequence[Any]], number: int) -> tuple[Any, ...]:
    return tuple([value for each in records for value in (number, *each[2:-1], each[-1].decode())])


def _copy_rows(records: Sequence[Sequence[Any]], number: int, sizes: Sequence[int]) -> bytes:
    kinds = ["iq"[each == 8] for each in sizes]
    start, end = Struct(">hi{}i{}i".format(*kinds)), Struct(">i{}i{}i{}i".format(*kinds[3:]))
    rows: list[bytes] = []
    for _, _, sequence, kind, version, wall_ns, monotonic_ns, payload in records:
        name = kind.encode()
        rows += (start.pack(len(sizes), sizes[0], number, sizes[1], sequence, len(name)), name)
        times = (sizes[4], wall_ns, sizes[5], monotonic_ns)
        rows += (end.pack(sizes[3], version, *times, len(payload)), payload)
    return b"".join(rows)


def _row_values(rows: list[Any], null: Any) -> tuple[Any, ...]:
    # Three rows show whether others are worth a search; a value that is not found is bound as it is.
    kinds = {type(each) for row in (rows[0], rows[len(rows) // 2], rows[-1]) for each in row} if rows else set()
    values = chain.from_iterable(rows)
    if bool in kinds:
        return tuple([null if each is None else 0 if each is False else 1 if each is True else each for each in values])
    return tuple([null if each is None else each for each in values] if NoneType in kinds else values)


if TYPE_CHECKING:
    Tail = PythonTail
else:
    Tail = getattr(_compiled, "Tail", PythonTail)

take_records: Final[Callable[..., tuple[int, int, int]]] = getattr(_compiled, "take_records", _take_nothing)
"""Append records to a list, up to the first frame that needs a decision; return offset, position and total behind them.

The arguments are the buffer, the offset, the segment's salt, the position of the record before, the last position, the
bytes of the payloads so far and at most, the names of event types by their bytes, the class `Record`, the list or None;
and for a scan, else None: the open episodes, which the call updates, and a list to which it appends the checksums.
"""

event_values: Final[Callable[[list[Any], int], tuple[Any, ...]]] = getattr(_compiled, "event_values", _event_values)
"""Return the values of the rows of these records, one row after the other: the number, then those from the sequence on,
with the payload as text."""

copy_rows: Final[Callable[[list[Any], int, Sequence[int]], bytes]] = getattr(_compiled, "copy_rows", _copy_rows)
"""Return the rows of these records in PostgreSQL's binary format of COPY: the columns of `event_values`, which have
these sizes in bytes; -1 is that of a text."""

row_values: Final[Callable[[list[Any], Any], tuple[Any, ...]]] = getattr(_compiled, "row_values", _row_values)
"""Return the values of rows of equal length, one row after the other, with `null` for None and 0 and 1 for booleans.

The Python core may leave some None and booleans as they are, which a driver stores alike and binds more slowly."""
