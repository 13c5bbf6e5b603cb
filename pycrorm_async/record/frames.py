"""`FramePlaces` knows where frames are, so that a pose in one of them is recorded in the map."""

from typing import Final

from msgspec.structs import replace

from pycrorm_async.events.types import PoseValue
from pycrorm_async.world.pose import product, rotated

MAP: Final = "map"
"""The frame in which places of one episode are compared."""
_DEPTH_MAX: Final = 256
"""Bounds the frames between one and the map, so that a circle of frames ends."""
_FRAMES_MAX: Final = 10_000
"""Bounds the frames kept; further ones are not known, and poses in them keep their frame."""


class FramePlaces:
    """The latest place of each frame, and the frame that it is relative to."""

    def __init__(self) -> None:
        self._places: dict[str, PoseValue] = {}

    def place(self, frame: str, pose: PoseValue) -> None:
        """Note where a frame is. The map itself has no place."""
        if frame != MAP and (frame in self._places or len(self._places) < _FRAMES_MAX):
            self._places[frame] = pose

    def place_of(self, frame: str) -> PoseValue:
        """Return the latest place of a frame. Raises `KeyError` for one that was never placed."""
        return self._places[frame]

    def in_map(self, pose: PoseValue) -> PoseValue:
        """Return the pose in the map; the same one if the places of its frame and of those above are not all known."""
        composed = self.in_root(pose)
        return composed if composed.frame == MAP else pose

    def in_root(self, pose: PoseValue) -> PoseValue:
        """Return the pose in the topmost frame above its own that is known; the same one in a circle of frames."""
        composed = pose
        for _ in range(_DEPTH_MAX):
            above = self._places.get(composed.frame) if composed.frame != MAP else None
            if above is None:
                return composed
            turned = rotated(above.orientation, composed.position)
            x, y, z = (place + way for place, way in zip(above.position, turned, strict=True))
            qx, qy, qz, qw = product(above.orientation, composed.orientation)
            composed = replace(composed, position=(x, y, z), orientation=(qx, qy, qz, qw), frame=above.frame)
        return pose
