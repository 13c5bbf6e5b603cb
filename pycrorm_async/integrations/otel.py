"""Send the nodes of a memory to a collector of OpenTelemetry, as they end: `python -m pycrorm_async.integrations.otel`.

`SpanFollower` reads the log, so that it runs in a process of its own, beside any number of robots, and the times are
those of the events. Each episode is a trace and each node a span, as `pycrorm export --format otlp` writes them, sent
by OTLP over HTTP in JSON, which needs no further package. A collector that is not there is tried again, and nothing is
read on before it has taken what was sent.
"""

import argparse
import asyncio
import os
import sys
from collections.abc import Callable, Mapping
from typing import Final
from urllib import error, request

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged, PycrormError
from pycrorm_async.events.ids import SEQUENCE_MAX
from pycrorm_async.events.types import EpisodeEnded, NodeEnded
from pycrorm_async.export.traces import TracedEpisode, encoded, otlp_document
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow

_POLL_S: Final = 0.5
"""The seconds between two looks for new events."""
_TIMEOUT_S: Final = 10.0
"""Bounds one request."""
_RETRY_S_MAX: Final = 30.0
"""Bounds the pause before the next attempt, which doubles from half a second on."""
_SPANS_MAX: Final = 500
"""Bounds the spans of one request, whose size a collector limits to some megabytes."""


class SpanFollower:
    """Sends the spans of the nodes that end from now on.

    Args:
        log: of the memory.
        send: sends one document; returns once the collector has taken it.

    Attributes:
        sent: the number of spans that the collector has taken.
    """

    def __init__(self, log: EventLog, send: Callable[[bytes], object]) -> None:
        self.sent = 0
        self._log, self._send = log, send
        self._episodes: dict[int, tuple[TracedEpisode, int]] = {}
        self._heads: dict[int, int] = {}

    async def skip(self) -> None:
        """Leave out the nodes that have ended so far, but not those that are open."""
        for row in await self._log.episodes():
            if row.ended_wall_ns is not None:
                self._heads[row.number] = row.head
            elif row.head:
                await self._read(row)
        self._heads.update({number: read for number, (_, read) in self._episodes.items()})

    async def step(self) -> None:
        """Send what has ended since the step before."""
        for row in await self._log.episodes():
            if row.head > self._heads.get(row.number, 0):
                try:
                    ended = await self._read(row)
                except (LogDamaged, DatabaseForeign) as failure:
                    sys.stderr.write(f"pycrorm: episode {row.number} is not sent further: {failure}\n")
                    self._heads[row.number] = SEQUENCE_MAX
                    continue
                episode, _ = self._episodes[row.number]
                for first in range(0, len(ended), _SPANS_MAX):
                    some = ended[first : first + _SPANS_MAX]
                    await asyncio.to_thread(self._send, encoded(otlp_document(episode, some)))
                    self.sent += len(some)
                self._heads[row.number] = row.head
                for kept in (episode.events, episode.changes, episode.observations):
                    kept.clear()  # a long episode would keep them all
                if episode.ended is not None:
                    del self._episodes[row.number]

    async def _read(self, row: EpisodeRow) -> list[int]:
        """Read the new events of an episode; return the nodes that ended in them."""
        episode, read = self._episodes.get(row.number) or (TracedEpisode(row, self._log.address), 0)
        episode.dtypes = await self._log.dtypes()
        ended: list[int] = []
        async for page in self._log.pages(row, after=read):
            for event in page:
                match episode.read(event):
                    case NodeEnded(node=node):
                        ended.append(node)
                    case EpisodeEnded():  # of a recorder that died: its open nodes are LOST without an event
                        ended += [each for each, node in episode.nodes.items() if node.status == "LOST"]
        self._episodes[row.number] = episode, row.head
        return list(dict.fromkeys(ended))


class Collector:
    """A collector that takes OTLP over HTTP; call it with a document. Any thread may call it.

    Args:
        endpoint: its address, such as `http://localhost:4318`; `/v1/traces` is added.
        headers: sent with each request.
        pause: waits for so many seconds before the next attempt.
    """

    def __init__(self, endpoint: str, headers: Mapping[str, str], pause: Callable[[float], object]) -> None:
        if not endpoint.startswith(("http://", "https://")):
            raise CallerError(f"the collector must be an address as http://localhost:4318, got {endpoint!r:.200}")
        self.address = f"{endpoint.rstrip('/')}/v1/traces"
        self._headers = {"Content-Type": "application/json", **headers}
        self._pause = pause

    def __call__(self, document: bytes) -> None:
        """Send a document, again and again until it is taken. Raises `CallerError` if the collector refuses it."""
        wait_s = 0.5
        while True:
            call = request.Request(self.address, document, self._headers)  # noqa: S310  checked above
            try:
                with request.urlopen(call, timeout=_TIMEOUT_S) as answer:  # noqa: S310  as above
                    answer.read()
                    return
            except error.HTTPError as failure:
                if failure.code not in (429, 502, 503, 504):  # those that OTLP names as temporary
                    raise CallerError(f"{self.address} refuses the spans: {failure.code} {failure.reason}") from None
                reason = f"{failure.code} {failure.reason}"
            except OSError as failure:
                reason = str(getattr(failure, "reason", failure))
            sys.stderr.write(f"pycrorm: {self.address} does not take spans ({reason}): next attempt in {wait_s:g} s\n")
            self._pause(wait_s)
            wait_s = min(2 * wait_s, _RETRY_S_MAX)


async def follow(url: str, collector: Callable[[bytes], object], *, everything: bool = False) -> None:
    """Send the nodes of a memory until cancelled; with `everything` also those that have ended before."""
    async with Reading.open(url) as reading:
        follower = SpanFollower(await reading.log(), collector)
        if not everything:
            await follower.skip()
        while True:
            await follower.step()
            await asyncio.sleep(_POLL_S)


def main(arguments: list[str] | None = None) -> int:
    """Send until Ctrl-C; return the exit code."""
    import time

    parser = argparse.ArgumentParser(prog="python -m pycrorm_async.integrations.otel", description=__doc__)
    endpoint = os.environ.get("OTEL_EXPORTER_OTLP_ENDPOINT", "http://localhost:4318")
    parser.add_argument("--collector", default=endpoint, help="or OTEL_EXPORTER_OTLP_ENDPOINT; default: %(default)s")
    parser.add_argument("--url", default="sqlite:///pycrorm.db", help="the database; default: %(default)s")
    parser.add_argument("--all", action="store_true", help="also the episodes that have ended")
    options = parser.parse_args(arguments)
    pairs = (each.partition("=") for each in os.environ.get("OTEL_EXPORTER_OTLP_HEADERS", "").split(",") if "=" in each)
    try:
        collector = Collector(options.collector, {name.strip(): value.strip() for name, _, value in pairs}, time.sleep)
        asyncio.run(follow(options.url, collector, everything=options.all))
    except PycrormError as failure:
        sys.stderr.write(f"pycrorm: {failure}\n")
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
