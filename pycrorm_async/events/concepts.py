"""List the ontology's classes that recorded tasks and objects are instances of, with their superclasses.

Facts of SOMA 2.1.0 (SOMA-ACT, SOMA-OBJ and SOMA-HOME, http://www.ease-crc.org/ont/SOMA.owl) and of DOLCE+DnS Ultralite
3.32 (DUL), limited to what the built-in designators and object types use. Two concepts of PyCRAM's designators are not
in SOMA 2.1.0; their superclasses here are ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

__all__ = ["Concept", "CONCEPTS", "CONCEPT_OF_OBJECT_TYPE", "ancestors"]

_SOMA, _DUL, _PYCRAM = "SOMA 2.1.0", "DUL 3.32", "PyCRAM"


class Concept(NamedTuple):
    """The superclasses of a concept, and the ontology that defines it."""

    parents: tuple[str, ...]
    source: str = _SOMA


CONCEPTS: dict[str, Concept] = {
    # tasks
    "Task": Concept((), _DUL),
    "PhysicalTask": Concept(("Task",)),
    "MentalTask": Concept(("Task",)),
    "InformationAcquisition": Concept(("MentalTask",)),
    "Perceiving": Concept(("InformationAcquisition", "PhysicalTask")),
    "CheckingObjectPresence": Concept(("Perceiving",)),
    "LookingFor": Concept(("Perceiving",)),
    "LookingAt": Concept(("PhysicalTask",)),
    "Navigating": Concept(("PhysicalTask",)),
    "AssumingPose": Concept(("PhysicalTask",)),
    "AssumingArmPose": Concept(("AssumingPose",)),
    "ParkingArms": Concept(("AssumingArmPose",)),
    "SettingGripper": Concept(("AssumingPose",)),
    "MoveTorso": Concept(("AssumingPose",), _PYCRAM),
    "Manipulating": Concept(("PhysicalTask",)),
    "Grasping": Concept(("Manipulating",)),
    "Holding": Concept(("Manipulating",)),
    "PickingUp": Concept(("Manipulating",)),
    "Releasing": Concept(("Manipulating",)),
    "Accessing": Concept(("Manipulating",), _PYCRAM),
    "Placing": Concept(("PhysicalTask",)),
    "Actuating": Concept(("PhysicalTask",)),
    "Opening": Concept(("Actuating",)),
    "Closing": Concept(("Actuating",)),
    "ModifyingPhysicalObject": Concept(("PhysicalTask",)),
    "PhysicalAcquiring": Concept(("ModifyingPhysicalObject",)),
    "Fetching": Concept(("PhysicalAcquiring",)),
    "Transporting": Concept(("ModifyingPhysicalObject",)),
    # objects
    "PhysicalObject": Concept((), _DUL),
    "PhysicalAgent": Concept(("PhysicalObject",), _DUL),
    "NaturalPerson": Concept(("PhysicalAgent",), _DUL),
    "PhysicalPlace": Concept(("PhysicalObject",), _DUL),
    "PhysicalArtifact": Concept(("PhysicalObject",), _DUL),
    "DesignedArtifact": Concept(("PhysicalArtifact",), _DUL),
    "DesignedContainer": Concept(("DesignedArtifact",)),
    "Box": Concept(("DesignedContainer",)),
    "CerealBox": Concept(("Box",)),
    "Can": Concept(("DesignedContainer",)),
    "Pack": Concept(("DesignedContainer",)),
    "MilkPack": Concept(("Pack",)),
    "DesignedTool": Concept(("DesignedArtifact",)),
    "Tableware": Concept(("DesignedTool",)),
    "Crockery": Concept(("Tableware",)),
    "Bowl": Concept(("Crockery",)),
    "Cup": Concept(("Crockery",)),
    "Cutlery": Concept(("Tableware",)),
    "Spoon": Concept(("Cutlery",)),
}

CONCEPT_OF_OBJECT_TYPE = {
    "METALMUG": "Cup",
    "PRINGLES": "Can",
    "MILK": "MilkPack",
    "SPOON": "Spoon",
    "BOWL": "Bowl",
    "BREAKFAST_CEREAL": "CerealBox",
    "JEROEN_CUP": "Cup",
    "ROBOT": "PhysicalAgent",
    "ENVIRONMENT": "PhysicalPlace",
    "GENERIC_OBJECT": "PhysicalObject",
    "HUMAN": "NaturalPerson",
}
"""The concept of each object type, by the name of its member."""


def ancestors(concept: str) -> Iterator[str]:
    """Yield the concept itself and all its superclasses, each once, the nearest first."""
    pending, seen = [concept], {concept}
    for each in pending:
        yield each
        for parent in CONCEPTS[each].parents if each in CONCEPTS else ():
            if parent not in seen:
                seen.add(parent)
                pending.append(parent)
