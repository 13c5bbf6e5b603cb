"""A description in place of a resolved designator: one line states that `.resolve()` is missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    CostmapLocation,
    NavigateAction,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    PickUpActionPerformable,
)
from pycrorm_async.world import Arms, Grasp, Pose

MILK = ObjectDesignatorDescription(names=["milk"])


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda: NavigateAction([Pose()]).perform(),  # type: ignore[attr-defined]  # the fault here
            "NavigateAction is a description and has no 'perform': resolve it first, as in NavigateAction(…).resolve()",
        ),
        (
            lambda: NavigateAction([Pose()]).target_location,  # type: ignore[attr-defined]  # the fault here
            "NavigateAction is a description and has no 'target_location'",
        ),
        (
            lambda: MILK.pose,  # type: ignore[attr-defined]  # the fault here
            "is a description and has no 'pose': resolve it first, as in ObjectDesignatorDescription(…).resolve()",
        ),
        (
            lambda: CostmapLocation(Pose()).pose,  # type: ignore[attr-defined]  # the fault here
            "CostmapLocation is a description and has no 'pose': resolve it first",
        ),
        (
            lambda: PickUpActionPerformable(MILK, Arms.LEFT, Grasp.FRONT),  # type: ignore[arg-type]  # the fault here
            "object_designator: expected ObjectDesignator | Object, got ObjectDesignatorDescription",
        ),
        (
            lambda: NavigateActionPerformable(CostmapLocation(Pose())),  # type: ignore[arg-type]  # the fault here
            "(call its .resolve() first)",
        ),
    ],
)
def test_a_missing_resolve_is_named(use: Callable[[], Any], message: str) -> None:
    with pytest.raises(CallerError) as refused:
        use()
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_another_attribute_that_is_missing_is_an_ordinary_attribute_error() -> None:
    for described in (NavigateAction([Pose()]), MILK, CostmapLocation(Pose())):
        with pytest.raises(AttributeError, match="object has no attribute 'colour'"):
            described.colour  # type: ignore[union-attr]  # noqa: B018  the fault here
        assert not hasattr(described, "perform")
