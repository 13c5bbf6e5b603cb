"""Map the public views to classes with the thesis' names, which editors can complete.

`select(PickUpAction)`, `select(Action)`, `select(TaskTreeNode)` … are ordinary SQLAlchemy. In a session of a memory the
attributes that a query does not load are loaded when they are read (`orm.base`).

Mapping a class takes 5 ms, so a class is mapped with its module when it is first used. The classes of single types
(`actions`) are also mapped when the first row of any action, motion or expression is read (`rows.ClassOfRow`).
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.orm.actions import *  # noqa: F403
    from pycrorm_async.orm.base import Base as Base
    from pycrorm_async.orm.episodes import *  # noqa: F403
    from pycrorm_async.orm.rows import *  # noqa: F403
    from pycrorm_async.orm.views import *  # noqa: F403

_NAMES = {
    "base": "Base",
    "episodes": "ProcessMetaData EpisodeTag EpisodeRobot Position Quaternion Pose RobotState",
    "rows": (
        "Concept ConceptAncestor ObjectConcept Object ObjectDescription ObjectPart BelieveObject LocatedObject"
        " ObjectRemoval Attachment JointChange TaskTreeNode LocationResolution LocationCandidate LocationRefusal"
        " Detection StateSample Observation ObservationValue DesignatorType Designator ParameterItem Action Motion"
        " Language"
    ),
    "actions": (
        "NavigateAction ParkArmsAction MoveTorsoAction SetGripperAction ReleaseAction GripAction PickUpAction"
        " PlaceAction TransportAction LookAtAction DetectAction OpenAction CloseAction GraspingAction FaceAtAction"
        " MoveAndPickUpAction BatchRolloutAction LearnPolicyAction MoveMotion MoveTCPMotion LookingMotion"
        " MoveGripperMotion MoveArmJointsMotion MoveJointsMotion DetectingMotion OpeningMotion ClosingMotion"
        " WorldStateDetectingMotion AccessingMotion Sequential TryInOrder Parallel TryAll Repeat Monitor Code"
        " Retry"
    ),
    "views": "PickUpWithContextView RootFailure SpatialRelation",
}

__all__ = [each for names in _NAMES.values() for each in names.split()]
if not TYPE_CHECKING:  # which would take any other name for one of this package
    __getattr__ = lazy_names(__name__, _NAMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
