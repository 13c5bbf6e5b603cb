"""Each segment begins with the designator types in use and with the latest descriptions, within an eighth of it."""

from __future__ import annotations

from pathlib import Path

from pycrorm_async.events.codec import Heading
from pycrorm_async.queue.appender import Capacity, Declarations
from pycrorm_async.queue.format import DECLARATION
from pycrorm_async.queue.scan import survey
from tests.queue.factories import DECLARED, RECORDER, SMALL, FolderWriter, node, recover, started

DESCRIBED = Heading(None, "DescriptionDeclared", 1)
EIGHTH = SMALL.segment_bytes // 8


def description(number: int, size: int = 400) -> bytes:
    return b'{"urdf":"%s"}' % (b"%d " % number).ljust(size, b"=")


def declared_in_segments(writer: FolderWriter) -> list[list[bytes]]:
    """The payloads of the declarations in each segment."""
    segments: dict[int, list[bytes]] = {}
    survey_result = survey(
        writer.folder,
        RECORDER,
        on_frame=lambda number, frame: segments.setdefault(number, []).append(
            frame.payload if frame.kind == DECLARATION else b""
        ),
    )
    assert survey_result.damage is None
    return [[each for each in payloads if each] for payloads in segments.values()]


async def test_the_latest_descriptions_are_repeated_and_every_designator_type(tmp_path: Path) -> None:
    writer = FolderWriter(tmp_path)
    put = writer.appender.put
    put(started(1), b"{}", True)
    put(DECLARED, b'{"dtype":"A"}', True)
    many = 2 * EIGHTH // 400
    for number in range(many):
        put(DESCRIBED, description(number), True)
        if number == many // 2:
            put(DECLARED, b'{"dtype":"B"}', True)
    put(DESCRIBED, description(0), True)  # is used again
    segments = len(writer.appender.begun)
    while len(writer.appender.begun) == segments:
        put(node(1), b"n" * 1_000, True)
    last = declared_in_segments(writer)[-1]
    described = [each for each in last if each.startswith(b'{"urdf"')]
    assert [each for each in last if each not in described] == [b'{"dtype":"A"}', b'{"dtype":"B"}']
    latest = [*range(many - len(described) + 1, many), 0]
    assert sorted(described) == sorted(description(number) for number in latest)
    assert EIGHTH - 600 < sum(64 + len(each) + 24 for each in described) <= EIGHTH
    records = await recover(writer.folder)
    assert [each.type for each in records[:3]] == ["EpisodeStarted", "DesignatorTypeDeclared", "DescriptionDeclared"]


def test_a_description_larger_than_an_eighth_is_not_repeated_and_counted() -> None:
    capacity = Capacity.of(SMALL)
    declarations = Declarations(capacity.descriptions_bytes_max)
    payload = description(1, EIGHTH)
    declarations.add(payload, name=b"DescriptionDeclared", version=1, payload=payload, room=10 * EIGHTH)
    assert (declarations.bytes, declarations.unrepeated) == (0, 1)
    declarations.add(payload, name=b"DesignatorTypeDeclared", version=1, payload=payload, room=10 * EIGHTH)
    assert (declarations.bytes, declarations.unrepeated) == (64 + len(payload), 1)


def test_a_description_that_is_put_again_is_dropped_later() -> None:
    size = 64 + len(b"DescriptionDeclared") + len(description(1))
    declarations = Declarations(3 * size)
    for number in (1, 2, 3, 1, 4):
        body = b"DescriptionDeclared" + description(number)
        declarations.add(body, name=b"DescriptionDeclared", version=1, payload=description(number), room=10 * size)
    in_use = {each.payload for each in declarations._frames.values()}
    assert in_use == {description(number) for number in (3, 1, 4)}


def test_the_bytes_of_the_descriptions_are_counted_exactly() -> None:
    declarations = Declarations(1_000)
    for number in range(50):
        payload = description(number % 7, 100 + 40 * (number % 3))
        declarations.add(payload, name=b"DescriptionDeclared", version=1, payload=payload, room=5_000)
        assert declarations.bytes == sum(64 + len(body) for body in declarations._frames)
        assert 0 < declarations.bytes <= 1_000
        assert payload in declarations._frames
