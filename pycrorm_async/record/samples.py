"""`SampleBlocks` collects the samples of streams, such as joint states, into blocks, each a table of numbers.

A block is an observation with the name of its stream, whose value `data` is a blob: a file of numpy (`.npy`) with a
structured array of the column `ns` (UTC in ns since 1970) and one float64 column for each channel. So a number takes 8
bytes, and its time the share of 8 more; `numpy.load` reads a block without this package.

A block is written when it is full, when it spans `_SPAN_NS`, and at the end of the episode. Until then its samples are
in the memory of the process only.
"""

import io
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import Blob
from pycrorm_async.record.values import SAMPLES, clean, clean_repr, cut

TIME: Final = "ns"
"""The column of a block with the times."""
_NUMBERS_MAX: Final = 8_192
"""Bounds the numbers of a block: 64 KiB, so that what else an observation takes is a hundredth of it."""
_SPAN_NS: Final = 5_000_000_000
"""Bounds the time that a block spans, and so what the death of a process can take of a stream."""
_CHANNELS_MAX: Final = 4_096
"""Bounds the channels of a stream, whose names each block has."""
_NAME_MAX: Final = 200


class SampleBlock:
    """The samples of one stream that are not written yet."""

    def __init__(self, channels: tuple[str, ...]) -> None:
        self._columns = column_names(channels)
        self._parts: list[NDArray[np.float64]] = []
        self._times: list[NDArray[np.int64]] = []
        self.count = 0
        self.node: Hashable | None = None

    def add(self, values: NDArray[np.float64], times: NDArray[np.int64]) -> None:
        """Add some samples, one in each row."""
        self._parts.append(values)
        self._times.append(times)
        self.count += len(times)

    @property
    def is_full(self) -> bool:
        """Whether the block is to be written."""
        if self.count * len(self._columns) >= _NUMBERS_MAX:
            return True
        return bool(self._times) and int(self._times[-1][-1]) - int(self._times[0][0]) >= _SPAN_NS

    def take(self) -> dict[str, Any]:
        """Return what is observed of the samples, and keep them no longer."""
        values, times = np.concatenate(self._parts), np.concatenate(self._times)
        table = np.empty(len(times), dtype=[(TIME, "<i8"), *((name, "<f8") for name in self._columns)])
        table[TIME] = times
        for index, name in enumerate(self._columns):
            table[name] = values[:, index]
        content = io.BytesIO()
        np.lib.format.write_array(content, table, version=(3, 0), allow_pickle=False)
        self._parts, self._times, self.count = [], [], 0
        return {
            "samples": len(times),
            "channels": len(self._columns),
            "data": Blob(content.getvalue(), SAMPLES),
        }


def column_names(channels: Sequence[str]) -> list[str]:
    """Return different names of columns, that a file of numpy can have."""
    names: list[str] = []
    taken = {TIME}
    for channel in channels:
        name = wanted = cut(clean(channel), _NAME_MAX) or "_"
        count = 1
        while name in taken:
            count += 1
            name = f"{wanted}_{count}"
        taken.add(name)
        names.append(name)
    return names


def sampled_values(
    channels: Sequence[str], values: Any, at: Any
) -> tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.int64]]:
    """Copy samples: the channels, a row of numbers for each sample, and the times. Raises `CallerError`."""
    names = tuple(channels) if not isinstance(channels, str) else ()
    if not 0 < len(names) <= _CHANNELS_MAX or not all(isinstance(each, str) for each in names):
        raise CallerError(f"channels must be 1 to {_CHANNELS_MAX:,} names, got {clean_repr(channels)}")
    try:
        times = np.array(at, dtype=np.int64, ndmin=1)
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise CallerError(f"samples must be numbers, and their times ns: {error}") from None
    if numbers.ndim == 1:
        numbers = numbers[np.newaxis] if len(times) == 1 else numbers[:, np.newaxis]
    if times.ndim != 1 or numbers.shape != (len(times), len(names)):
        shape = " x ".join(map(str, numbers.shape))
        raise CallerError(f"{len(times)} samples of {len(names)} channels are needed, got {shape} numbers")
    return names, numbers, times


class SampleBlocks:
    """The blocks of one episode's streams."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[str, tuple[str, ...]], SampleBlock] = {}

    def add(
        self,
        name: str,
        channels: tuple[str, ...],
        values: NDArray[np.float64],
        times: NDArray[np.int64],
        node: Hashable | None,
    ) -> list[tuple[Hashable | None, dict[str, Any]]]:
        """Add samples; return the blocks to be written before later calls: their node, and what is observed."""
        if len(times) == 0:
            return []
        block = self._blocks.get((name, channels))
        if block is None:
            block = self._blocks[name, channels] = SampleBlock(channels)
        full = []
        if block.count and block.node != node:
            full.append((block.node, block.take()))
        block.node = node
        block.add(values, times)
        if block.is_full:
            full.append((node, block.take()))
        return full

    def take_all(self) -> list[tuple[str, Hashable | None, dict[str, Any]]]:
        """Return all blocks with samples: the name of the stream, the node, and what is observed."""
        return [(name, each.node, each.take()) for (name, _), each in self._blocks.items() if each.count]


def table_of(content: bytes) -> Mapping[str, NDArray[Any]]:
    """Return the columns of a block, by name. Raises `ValueError` for a content that is none."""
    table = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    return {name: table[name] for name in table.dtype.names or ()}
