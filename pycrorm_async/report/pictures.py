"""Put pictures of what was observed into the document of a page: a thumbnail each, the whole content, or none.

A page has at most 200 thumbnails and 20 point clouds, chosen evenly over the episode for each camera. The others are
counted. Contents are stored once, by their hash.
"""

import asyncio
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from pycrorm_async.query import observed_images
from pycrorm_async.query.observed_images import Content
from pycrorm_async.store.log import EventLog

Images = Literal["none", "thumbs", "full"]
"""What a page has of observed images: nothing, thumbnails, or the whole content."""

_SHOWN_MAX: Final = {"image": 200, "points": 20}
"""Bounds the pictures of a page."""
_FEW: Final = 40
_SIDE_OF_FEW, _SIDE_OF_MANY = 320, 192
"""The longer side of a thumbnail, in pixels, on a page with few of them and with many."""
_BYTES_MAX: Final[Mapping[Images, int]] = {"none": 0, "thumbs": 4_500_000, "full": 24_000_000}
"""Bounds the bytes of all pictures of a page; in base64 they take a third more."""
_POINTS_MAX: Final = 8_000
"""Bounds the points of a cloud; every n-th is drawn."""


class ObservedContent(NamedTuple):
    """A content that was observed: at which event, by which node, and the name of the observation."""

    at: int
    node: int
    name: str
    content: Content

    @property
    def camera(self) -> str:
        """The name of the observation, and the path in it."""
        return f"{self.name} {self.content.path}".rstrip()


async def pictures_of(log: EventLog, observed: Sequence[ObservedContent], images: Images) -> dict[str, Any]:
    """Return `pictures`, in the order of their events, their `contents`, and the number of those that are left out."""
    shown = [] if images == "none" else _chosen(observed)
    maker = _Maker(log, images, _SIDE_OF_FEW if len(shown) <= _FEW else _SIDE_OF_MANY)
    pictures = [await maker.entry(each) for each in shown]
    return {"pictures": pictures, "contents": maker.contents, "unpictured": len(observed) - len(shown)}


def _chosen(observed: Sequence[ObservedContent]) -> list[ObservedContent]:
    """Return those that are shown: of each camera as many, evenly over the episode, its last one among them."""
    chosen: list[ObservedContent] = []
    for is_cloud, bound in ((False, _SHOWN_MAX["image"]), (True, _SHOWN_MAX["points"])):
        cameras: dict[str, list[ObservedContent]] = {}
        for each in observed:
            if (each.content.kind == "points") is is_cloud:
                cameras.setdefault(each.camera, []).append(each)
        for taken in list(cameras.values())[:bound]:
            share = min(len(taken), bound // min(len(cameras), bound))
            chosen += [taken[(index + 1) * len(taken) // share - 1] for index in range(share)]
    return sorted(chosen, key=lambda each: each.at)


class _Maker:
    """Makes the pictures of one page, within its bound of bytes."""

    def __init__(self, log: EventLog, images: Images, side: int) -> None:
        self._log, self._images, self._side = log, images, side
        self._left = _BYTES_MAX[images]
        self._numbers: dict[str, int] = {}
        self._texts: dict[str, str] = {}
        self.contents: list[Any] = []

    async def entry(self, observed: ObservedContent) -> dict[str, Any]:
        content = observed.content
        entry: dict[str, Any] = {
            "at": observed.at,
            "node": observed.node,
            "camera": observed.camera,
            "kind": content.kind,
            "bytes": content.size,
            "hash": content.hash,
        }
        try:
            if content.hash not in self._numbers:
                await self._make(content)
        except ValueError as reason:
            return {**entry, "fault": str(reason)}
        return {**entry, "content": self._numbers[content.hash], "text": self._texts[content.hash]}

    async def _make(self, content: Content) -> None:
        if self._left <= 0:
            raise ValueError("the page has as many bytes of pictures as it can hold")
        data = await observed_images.read_content(self._log, content)
        make = self._cloud if content.kind == "points" else self._picture
        made, size, text = await asyncio.to_thread(make, content, data)
        self._left -= size
        self._numbers[content.hash] = len(self.contents)
        self._texts[content.hash] = text
        self.contents.append(made)

    def _picture(self, content: Content, data: bytes) -> tuple[str, int, str]:
        return observed_images.picture_of(content, data, self._side, self._left if self._images == "full" else 0)

    def _cloud(self, content: Content, data: bytes) -> tuple[dict[str, Any], int, str]:
        """Return a cloud as the ends of its box and 16 bits for each coordinate, its size, and the number of points."""
        points = observed_images.points_of(content, data)
        if not len(points):
            raise ValueError("it has no finite point")
        drawn = points[:: -(-len(points) // _POINTS_MAX)]
        low, high = drawn.min(axis=0), drawn.max(axis=0)
        scaled = ((drawn - low) / np.where(high > low, high - low, 1) * 65_535).round().astype("<u2").tobytes()
        ends = {"low": low.astype(float).round(4).tolist(), "high": high.astype(float).round(4).tolist()}
        return {**ends, "points": b64encode(scaled).decode()}, len(scaled), f"{len(points):,} points"
