"""Describe ways to pick an object up by the numbers that success depends on: the features "grasp-polar", version 4.

>>> features_of([PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.1, torso=0.2)], PickUpContext(height=0.9))

The robot's place is given in polar coordinates as seen from the object, its angle measured from the side that the hand
comes from. The right arm is the mirror image of the left one, so that its angles change sign and both arms share their
experience. Only the height of the object over the lifted torso counts for the arm, so that raising the torso and
lowering the object are the same. What is not known is NaN, such as the surface below an object in the air.

| feature | unit | meaning |
|---|---|---|
| `top` | | 1 for the grasp from above, else 0 |
| `distance` | m | from the object's origin to the robot's base, along the floor |
| `angle` | rad | of the base as seen from the object, from the side that the hand comes from; mirrored |
| `ahead`, `aside` | m | `distance` times the cosine and the sine of `angle` |
| `height` | m | of the object's origin over the lifted torso |
| `width`, `depth` | m | of the object's box along the direction in which the fingers close, and along the fingers |
| `origin_height` | m | of the object's origin over its underside |
| `object_height` | m | of the origin over the robot's base link, where the object stands on a surface |
| `edge_distance` | m | from the object's origin to the edge of that surface on the robot's side |
| `edge_to_base`, `edge_to_grasp` | rad | of the edge's normal, from the base and from the hand's side; mirrored |
| `base_clearance` | m | from that edge to the middle of the base; negative above the surface |
| `wrist_ahead`, `wrist_aside` | m | of the wrist, from the base that faces the object; aside is to the arm's side |
| `reach`, `reach_angle` | m, rad | along the floor, from the shoulder to the wrist, and its angle from straight ahead |
| `stretch`, `elevation` | m, rad | from the shoulder to the wrist, and its angle from the floor |
| `surface` | m | the height of the surface over the lifted torso |
| `shoulder_clearance`, `wrist_clearance` | m | from the edge to shoulder and wrist; negative above the surface |
| `arm_above` | m | along the floor, the part of the line from shoulder to wrist that is above the surface |
| `elbow_over` | m | the height of the elbow over the surface, if the elbow hangs |
| `elbow_clearance` | m | from the edge to that elbow; negative above the surface |
| `forearm_over` | m | the height over the surface of the lowest point of the forearm that is above the table |

Version 2 added the rows from `wrist_ahead` on: the limit of an arm's reach is one threshold of `stretch`, where trees
need many of distance, angle and height. Version 3 added those from `surface` on, by which an arm clears a table, and
version 4 those from `elbow_over` on, because at high tables the forearm meets the edge. Later versions have the
features of the earlier ones first, so that models of these are evaluated too. Shoulder and wrist are taken to be where
a PR2 has them, and the elbow as far from both, whatever the robot: with shoulder and wrist a few centimetres off a
model is half a point worse.

All functions are pure: they know no world. `move_and_pick_up.context_of` reads a `PickUpContext` from the world.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.policy import ARMS, GRASPS, Floats, PickUpChoice
from pycrorm_async.world.pose import Arms, Grasp, rotated
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS

if TYPE_CHECKING:
    import pandas as pd

GRASP_POLAR: Final = "grasp-polar"
"""The name of the features, written into policy files."""
GRASP_POLAR_VERSION: Final = 4
"""Raised when features are added, behind the others; a model of a later version is refused."""
SHOULDER_M: Final = (0.188, 0.8)
"""The place of a PR2's shoulders: to the sides of the base's middle, and over the lifted torso."""
WRIST_M: Final = 0.18
"""The distance of a PR2's wrist behind the middle of its fingers."""
ARM_M: Final = (0.4, 0.321)
"""The lengths of a PR2's upper arm, from shoulder to elbow, and of its forearm, from elbow to wrist."""
FEATURES: Final = (
    "top", "distance", "angle", "ahead", "aside", "height",
    "width", "depth", "origin_height",
    "object_height", "edge_distance", "edge_to_base", "edge_to_grasp", "base_clearance",
    "wrist_ahead", "wrist_aside", "reach", "reach_angle", "stretch", "elevation",
    "surface", "shoulder_clearance", "wrist_clearance", "arm_above",
    "elbow_over", "elbow_clearance", "forearm_over",
)  # fmt: skip

PLACE: Final = ("robot_in_object_x", "robot_in_object_y")
FORMER_PLACE: Final = ("object_x", "object_y")
"""Former names of the columns in `PLACE`."""
NEAR_SURFACE_M: Final = 0.03
"""The greatest distance in m between the underside of an object and the surface that it stands on."""
CIRCUMSTANCES: Final = ("width", "depth", "origin_height", "edge_distance", "edge_angle")
"""Optional columns of a frame: features that a way to pick up records, and the angle of the edge's outward normal in
the object's frame, rad."""


class Edge(NamedTuple):
    """An edge of the surface that an object stands on.

    Attributes:
        distance: from the object's origin, m.
        angle: of the outward normal in the object's own frame, rad.
    """

    distance: float
    angle: float


def edges_around(x: float, y: float, low: Sequence[float], high: Sequence[float], turned: float) -> Iterator[Edge]:
    """Yield the edges of a rectangle around a point of its axes, which are turned by `turned` rad from the object's."""
    for axis, (at, angle) in enumerate(((x, 0.0), (y, math.pi / 2))):
        yield Edge(high[axis] - at, turned + angle)
        yield Edge(at - low[axis], turned + angle + math.pi)


@dataclass(frozen=True)
class PickUpContext:
    """The circumstances of a pick-up that the robot does not choose.

    Attributes:
        height: of the object's origin over the robot's base link, m.
        torso: height of the lifted torso for choices that leave it as it is, m.
        size: edge lengths of the object's box along its own axes, m; None if it is not known.
        origin_height: height of the object's origin over its underside, m.
        torso_limits: the lowest and the highest torso, m; None for a robot without one.
        edges: of the surface that the object stands on, a convex polygon; empty for an object in the air.
    """

    height: float
    torso: float = 0.0
    torso_limits: tuple[float, float] | None = None
    size: tuple[float, float, float] | None = None
    origin_height: float = math.nan
    edges: tuple[Edge, ...] = ()

    def circumstances(self, choices: Sequence[PickUpChoice]) -> dict[str, Floats]:
        """Return the columns `CIRCUMSTANCES` of these choices, each of shape (choices,); NaN where not known."""
        count = len(choices)
        columns = {name: np.full(count, np.nan) for name in CIRCUMSTANCES}
        columns["origin_height"][:] = self.origin_height
        if self.size is not None and count:
            grasps = [each.grasp for each in choices]
            columns["width"] = np.abs(_axes(grasps, "closing")) @ np.array(self.size)
            columns["depth"] = np.abs(_axes(grasps, "fingers")) @ np.array(self.size)
        if self.edges and count:
            distance, angle = np.array(self.edges).T
            x, y = _places(choices)
            beyond = np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle)) - distance
            nearest = beyond.argmax(axis=1)
            columns["edge_distance"], columns["edge_angle"] = distance[nearest], angle[nearest]
        return columns


def features_of(choices: Sequence[PickUpChoice], context: PickUpContext) -> Floats:
    """Return the features of the choices, shape (choices, features), columns in the order of `FEATURES`."""
    x, y = _places(choices)
    torso = np.array([context.torso if each.torso is None else each.torso for each in choices], dtype=np.float64)
    return _features(
        [each.arm for each in choices],
        [each.grasp for each in choices],
        x,
        y,
        context.height - torso,
        np.full(len(choices), context.height),
        context.circumstances(choices),
    )


def features_of_frame(frame: pd.DataFrame) -> Floats:
    """Return the features of recorded pick-ups, shape (rows, features).

    Args:
        frame: `arm` and `grasp` as names, the robot's place in the object's frame (`PLACE`, m) and `height`, that of
            the object over the lifted torso, m; optionally `torso_height`, m, and the columns `CIRCUMSTANCES`.

    Raises `CallerError` for a required column that is missing, a label that is not an arm or grasp, and a number that
    is missing or infinite in a required column.
    """
    arms = [Arms[name] for name in labels(frame, "arm", [each.name for each in ARMS])]
    grasps = [Grasp[name] for name in labels(frame, "grasp", [each.name for each in GRASPS])]
    x, y = (
        numbers(frame, own if own in frame.columns else former) for own, former in zip(PLACE, FORMER_PLACE, strict=True)
    )
    height = numbers(frame, "height")
    known = {
        name: numbers(frame, name, optional=True) if name in frame.columns else np.full(len(frame), np.nan)
        for name in (*CIRCUMSTANCES, "torso_height")
    }
    return _features(arms, grasps, x, y, height, height + known.pop("torso_height"), known)


def _features(
    arms: Sequence[Arms],
    grasps: Sequence[Grasp],
    x: Floats,
    y: Floats,
    height: Floats,
    object_height: Floats,
    known: Mapping[str, Floats],
) -> Floats:
    side = np.array([-1.0 if arm is Arms.RIGHT else 1.0 for arm in arms])
    top = np.array([float(grasp is Grasp.TOP) for grasp in grasps])
    distance, bearing = np.hypot(x, y), np.arctan2(y, x)
    hand = np.array([_SIDES[grasp] for grasp in grasps])
    angle = side * _turned(bearing - hand)
    edge_distance, edge_angle = known["edge_distance"], known["edge_angle"]
    behind, (aside_m, shoulder_m) = WRIST_M * (1 - top), SHOULDER_M
    wrist_ahead, wrist_aside = distance - behind * np.cos(angle), behind * np.sin(angle)
    reach, up = np.hypot(wrist_ahead, wrist_aside - aside_m), height + WRIST_M * top - shoulder_m
    edge_to_base = side * _turned(edge_angle - bearing)
    base_clearance = distance * np.cos(edge_to_base) - edge_distance
    shoulder_clearance = base_clearance - aside_m * np.sin(edge_to_base)
    wrist_clearance = behind * np.cos(edge_to_base + angle) - edge_distance
    with np.errstate(divide="ignore", invalid="ignore"):  # a line along the edge is above the surface or is not
        share_above = np.clip(wrist_clearance / (wrist_clearance - shoulder_clearance), 0.0, 1.0)
    surface = np.where(np.isnan(edge_distance), np.nan, height - known["origin_height"])
    elbow_ahead, elbow_up = _hanging_elbow(reach, up)
    elbow_over, wrist_over = shoulder_m + elbow_up - surface, shoulder_m + up - surface
    with np.errstate(divide="ignore", invalid="ignore"):
        elbow_clearance = shoulder_clearance + (wrist_clearance - shoulder_clearance) * elbow_ahead / reach
        from_wrist = np.clip(wrist_clearance / (wrist_clearance - elbow_clearance), 0.0, 1.0)
    lowest = wrist_over + from_wrist * np.minimum(elbow_over - wrist_over, 0.0)
    features = {
        "top": top,
        "distance": distance,
        "angle": angle,
        "ahead": distance * np.cos(angle),
        "aside": distance * np.sin(angle),
        "height": height,
        **{name: known[name] for name in ("width", "depth", "origin_height")},
        # In the air the height over the floor does not count; a tree would split it by chance and extrapolate badly.
        "object_height": np.where(np.isnan(edge_distance), np.nan, object_height),
        "edge_distance": edge_distance,
        "edge_to_base": edge_to_base,
        "edge_to_grasp": side * _turned(edge_angle - hand),
        "base_clearance": base_clearance,
        "wrist_ahead": wrist_ahead,
        "wrist_aside": wrist_aside,
        "reach": reach,
        "reach_angle": np.arctan2(wrist_aside - aside_m, wrist_ahead),
        "stretch": np.hypot(reach, up),
        "elevation": np.arctan2(up, reach),
        "surface": surface,
        "shoulder_clearance": shoulder_clearance,
        "wrist_clearance": wrist_clearance,
        "arm_above": reach * share_above,
        "elbow_over": elbow_over,
        "elbow_clearance": elbow_clearance,
        "forearm_over": np.where(wrist_clearance < 0, lowest, wrist_over),
    }
    return np.column_stack([features[name] for name in FEATURES])


def _hanging_elbow(reach: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Return how far the elbow is ahead of and above the shoulder, m, below the line to a wrist at these distances."""
    upper_m, fore_m = ARM_M
    stretch, slope = np.hypot(reach, up), np.arctan2(up, reach)
    along = np.clip((upper_m**2 - fore_m**2 + stretch**2) / (2 * np.maximum(stretch, 1e-6)), -upper_m, upper_m)
    below = np.sqrt(upper_m**2 - along**2)
    return along * np.cos(slope) + below * np.sin(slope), along * np.sin(slope) - below * np.cos(slope)


def place_of(arm: Arms, grasp: Grasp, distance: float, angle: float) -> tuple[float, float]:
    """Return x and y of the base in the object's frame, m, for the features `distance` and `angle`."""
    bearing = _SIDES[grasp] + (-angle if arm is Arms.RIGHT else angle)
    return distance * math.cos(bearing), distance * math.sin(bearing)


def robot_of(frame: pd.DataFrame) -> str | None:
    """Return the robot of recorded pick-ups; None if they name none. Raises `CallerError` if they are of several."""
    robots = set(frame["robot"].dropna()) if "robot" in frame.columns else set()
    if len(robots) > 1:
        names = ", ".join(sorted(robots))
        raise CallerError(f"the pick-ups are of several robots ({names}): select those of one (view.robot == …)")
    return robots.pop() if robots else None


def labels(frame: pd.DataFrame, name: str, members: Sequence[str]) -> list[str]:
    """Return a column of names. Raises `CallerError` if it is missing or holds a name that is not in `members`."""
    found: list[str] = _column(frame, name).tolist()
    if unknown := [label for label in found if label not in members]:
        raise CallerError(f"column {name} holds {unknown[0]!r}, which is none of {', '.join(members)}")
    return found


def numbers(frame: pd.DataFrame, name: str, *, optional: bool = False) -> Floats:
    """Return a column of numbers; with `optional` they may be missing, which gives NaN. Raises `CallerError`."""
    try:
        values = np.asarray(_column(frame, name).to_numpy(dtype=np.float64, na_value=np.nan))
    except (TypeError, ValueError):
        raise CallerError(f"column {name} holds values that are not numbers") from None
    faulty = np.isinf(values) if optional else ~np.isfinite(values)
    if missing := int(faulty.sum()):
        raise CallerError(f"column {name} has no finite number in {missing} of {len(values)} rows: drop those rows")
    return values


def _column(frame: pd.DataFrame, name: str) -> Any:
    if name not in frame.columns:
        raise CallerError(f"the frame has no column {name}: select arm, grasp, {', '.join(FORMER_PLACE)} of the view")
    return frame[name]


def _places(choices: Sequence[PickUpChoice]) -> tuple[Floats, Floats]:
    return (
        np.array([each.relative_x for each in choices], dtype=np.float64),
        np.array([each.relative_y for each in choices], dtype=np.float64),
    )


def _turned(angle: Floats) -> Floats:
    """Return the same angle in [-π, π)."""
    return np.asarray((angle + math.pi) % (2 * math.pi) - math.pi)


def _axes(grasps: Sequence[Grasp], axis: str) -> Floats:
    """Return an axis of the hand in the object's frame for each grasp, shape (grasps, 3)."""
    unit = {"fingers": (1.0, 0.0, 0.0), "closing": (0.0, 1.0, 0.0), "up": (0.0, 0.0, 1.0)}[axis]
    of_grasp = {grasp: tuple(rotated(GRASP_ORIENTATIONS[grasp], unit)) for grasp in set(grasps)}
    return np.array([of_grasp[grasp] for grasp in grasps])


def _side(grasp: Grasp) -> float:
    """Return the angle of the side that the hand comes from, in the object's frame, rad.

    The fingers point away from it; in a grasp from above they point down, and the hand's own z axis away from it.
    """
    [[x, y, _]] = _axes([grasp], "up" if grasp is Grasp.TOP else "fingers").tolist()
    return math.atan2(-y, -x)


_SIDES: Final = {grasp: _side(grasp) for grasp in GRASPS}
