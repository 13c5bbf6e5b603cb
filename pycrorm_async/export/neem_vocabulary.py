"""Name the classes and relations of NEEMs, which the import reads and the export writes.

Relations are compared by the part of their IRI behind `#` or the last `/`, because older NEEMs have those of KnowRob's
ontology where newer ones have those of SOMA and DUL. Sources: the NEEM handbook (ease-crc/soma, docs/NEEM-handbook),
SOMA 2.1.0 and the vocabulary of KnowRob (src/neems).
"""

import re
from collections.abc import Mapping
from typing import Final

from pycrorm_async.events.types import NodeStatus

SOMA: Final = "http://www.ease-crc.org/ont/SOMA.owl#"
DUL: Final = "http://www.ontologydesignpatterns.org/ont/dul/DUL.owl#"
RDF_TYPE: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type"
RDFS: Final = "http://www.w3.org/2000/01/rdf-schema#"
OWN: Final = "urn:pycrorm:neem#"
"""The beginning of the IRIs that the export adds: what our memory knows, and the vocabulary has no relation for."""

CLASSES_OF_NO_USE: Final = frozenset({"NamedIndividual", "Thing", "Entity", "Object", "Resource"})
"""Classes that are those of nearly everything, so that they say nothing about an individual."""
INVERSES: Final[Mapping[str, str]] = {
    "isExecutedIn": "executesTask",
    "isConstituentOf": "hasConstituent",
    "isPhaseOf": "hasConstituent",
    "isTimeIntervalOf": "hasTimeInterval",
    "isParticipantIn": "hasParticipant",
    "isRoleOf": "hasRole",
    "isParameterFor": "hasParameter",
    "isClassifiedBy": "classifies",
    "isSatisfiedBy": "satisfies",
    "isRegionFor": "hasRegion",
    "isActionPerformedBy": "isPerformedBy",
    "hasSetting": "isSettingFor",
}
"""The relations that are read with subject and object exchanged. `classifies` leads from a concept to what it is of."""
SYNONYMS: Final[Mapping[str, str]] = {
    "hasPhase": "hasConstituent",
    "hasSubevent": "hasConstituent",
    "subAction": "hasConstituent",
    "subEvent": "hasConstituent",
    "includesEvent": "includesAction",
    "isSettingFor": "includesAction",
    "startTime": "hasIntervalBegin",
    "endTime": "hasIntervalEnd",
    "performedBy": "isPerformedBy",
    "objectActedOn": "hasParticipant",
    "isOccurrenceOf": "executesTask",
}
"""Relations with the same meaning for an import."""
STATUSES: Final[Mapping[str, NodeStatus]] = {
    "Succeeded": "SUCCEEDED",
    "Failed": "FAILED",
    "Cancelled": "CANCELLED",
    "Active": "UNKNOWN",
    "Paused": "UNKNOWN",
    "Pending": "UNKNOWN",
}
"""The status of a node by the end of the name of its execution state. One that was active when recording ended, or
waited, never reported how it ended."""
STATES: Final[Mapping[str, str]] = {
    "SUCCEEDED": "Succeeded",
    "FAILED": "Failed",
    "ERROR": "Failed",
    "CANCELLED": "Cancelled",
    "INTERRUPTED": "Cancelled",
    "RUNNING": "Active",
}
"""The execution state by status; LOST and UNKNOWN have none."""
DTYPES: Final[Mapping[str, str]] = {
    "Navigating": "NavigateAction",
    "LookingAt": "LookAtAction",
    "Perceiving": "DetectAction",
    "Detecting": "DetectAction",
    "LookingFor": "DetectAction",
    "PickingUp": "PickUpAction",
    "Placing": "PlaceAction",
    "PuttingDown": "PlaceAction",
    "Grasping": "GraspingAction",
    "Reaching": "GraspingAction",
    "Holding": "GripAction",
    "Gripping": "GripAction",
    "Releasing": "ReleaseAction",
    "SettingGripper": "SetGripperAction",
    "ParkingArms": "ParkArmsAction",
    "MoveTorso": "MoveTorsoAction",
    "Opening": "OpenAction",
    "Closing": "CloseAction",
    "Transporting": "TransportAction",
}
"""The type of nodes by the name of a task's class, also of classes that SOMA does not have any more. The nodes of other
classes have a type of the class' name."""
TASKS: Final[Mapping[str, str]] = {
    "NavigateAction": "Navigating",
    "LookAtAction": "LookingAt",
    "FaceAtAction": "LookingAt",
    "DetectAction": "Perceiving",
    "PickUpAction": "PickingUp",
    "PlaceAction": "Placing",
    "GraspingAction": "Grasping",
    "GripAction": "Holding",
    "ReleaseAction": "Releasing",
    "SetGripperAction": "SettingGripper",
    "ParkArmsAction": "ParkingArms",
    "OpenAction": "Opening",
    "CloseAction": "Closing",
    "TransportAction": "Transporting",
}
"""The class of a task by the type of nodes; other types are of `PhysicalTask`."""
_SUFFIX: Final = re.compile(r"_[A-Z0-9]{4,}$|_[0-9]+$")


def local(iri: str) -> str:
    """Return the part of an IRI behind `#`, or behind the last `/` without one.

    >>> local("http://www.ease-crc.org/ont/SOMA.owl#PickingUp_AXVWKTEB")
    'PickingUp_AXVWKTEB'
    """
    return iri[max(iri.rfind("#"), iri.rfind("/")) + 1 :] or iri


def class_name(iri: str) -> str:
    """Return the name of the class that an individual is named after, without its suffix.

    >>> class_name("http://www.ease-crc.org/ont/SOMA.owl#CRAMNavigationPoseUnreachable_QWERTZUI")
    'CRAMNavigationPoseUnreachable'
    """
    return _SUFFIX.sub("", local(iri)) or local(iri)


def relation(iri: str) -> tuple[str, bool]:
    """Return the name by which a relation is read, and whether subject and object are exchanged."""
    name = local(iri)
    inverse = INVERSES.get(name)
    name = inverse if inverse is not None else name
    return SYNONYMS.get(name, name), inverse is not None
