"""What people ask: mapped classes with the thesis' names, complete in an editor. All of them stand on views.

`select(PickUpAction)`, `select(Action)`, `select(TaskTreeNode)` … are ordinary SQLAlchemy; everything an object names
is loaded with it.
"""

from pycrorm_async.orm.actions import (
    CloseAction,
    DetectAction,
    FaceAtAction,
    GraspingAction,
    GripAction,
    LookAtAction,
    MoveAndPickUpAction,
    MoveTorsoAction,
    NavigateAction,
    OpenAction,
    ParkArmsAction,
    PickUpAction,
    PlaceAction,
    ReleaseAction,
    SetGripperAction,
    TransportAction,
)
from pycrorm_async.orm.base import Base, Pose, Position, ProcessMetaData, Quaternion, RobotState
from pycrorm_async.orm.designators import Action, Designator, Motion, ParameterItem
from pycrorm_async.orm.motions import (
    AccessingMotion,
    ClosingMotion,
    DetectingMotion,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    OpeningMotion,
    WorldStateDetectingMotion,
)
from pycrorm_async.orm.objects import (
    Attachment,
    BelieveObject,
    JointChange,
    Object,
    ObjectPart,
    ObjectRemoval,
)
from pycrorm_async.orm.tree import LocationCandidate, LocationResolution, TaskTreeNode
from pycrorm_async.orm.views import PickUpWithContextView

__all__ = [
    "Base",
    "ProcessMetaData",
    "Position",
    "Quaternion",
    "Pose",
    "RobotState",
    "Object",
    "ObjectPart",
    "BelieveObject",
    "ObjectRemoval",
    "Attachment",
    "JointChange",
    "TaskTreeNode",
    "LocationResolution",
    "LocationCandidate",
    "Designator",
    "ParameterItem",
    "Action",
    "NavigateAction",
    "ParkArmsAction",
    "MoveTorsoAction",
    "SetGripperAction",
    "ReleaseAction",
    "GripAction",
    "PickUpAction",
    "PlaceAction",
    "TransportAction",
    "LookAtAction",
    "DetectAction",
    "OpenAction",
    "CloseAction",
    "GraspingAction",
    "FaceAtAction",
    "MoveAndPickUpAction",
    "Motion",
    "MoveMotion",
    "MoveTCPMotion",
    "LookingMotion",
    "MoveGripperMotion",
    "MoveArmJointsMotion",
    "MoveJointsMotion",
    "DetectingMotion",
    "OpeningMotion",
    "ClosingMotion",
    "WorldStateDetectingMotion",
    "AccessingMotion",
    "PickUpWithContextView",
]
