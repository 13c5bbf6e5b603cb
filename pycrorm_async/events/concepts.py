"""List the ontology's classes that recorded tasks and objects are instances of, with their superclasses.

The classes are those of SOMA 2.1.0 and of DOLCE+DnS Ultralite (DUL) as published with it: owl/2.1.0/SOMA-HOME.owl,
which contains the classes of SOMA-ACT and SOMA-OBJ, and owl/2.1.0/DUL.owl of https://github.com/ease-crc/soma. The list
is limited to what the built-in designators and object types use. The superclasses are the named ones; an intersection
counts as each of its named classes. Classes without a superclass here have one in DUL. The code calls a class of the
ontology a *concept*. Two concepts of PyCRAM's designators are not in SOMA 2.1.0; this project chose their superclasses.
"""

from collections.abc import Iterator
from typing import NamedTuple

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
    "Agent": Concept((), _DUL),
    "Person": Concept(("Agent",), _DUL),
    "PhysicalAgent": Concept(("Agent", "PhysicalObject"), _DUL),
    "NaturalPerson": Concept(("Person", "PhysicalAgent"), _DUL),
    "PhysicalPlace": Concept(("PhysicalObject",), _DUL),
    "PhysicalArtifact": Concept(("PhysicalObject",), _DUL),
    "DesignedArtifact": Concept(("PhysicalArtifact",), _DUL),
    "DesignedContainer": Concept(("DesignedArtifact",)),
    "Box": Concept(("DesignedContainer",)),
    "CerealBox": Concept(("Box",)),
    "Pack": Concept(("DesignedContainer",)),
    "MilkPack": Concept(("Pack",)),
    "DesignedTool": Concept(("DesignedArtifact",)),
    "Tableware": Concept(("DesignedTool",)),
    "Crockery": Concept(("DesignedContainer", "Tableware")),
    "Bowl": Concept(("Crockery",)),
    "Cup": Concept(("Crockery",)),
    "Cutlery": Concept(("Tableware",)),
    "Spoon": Concept(("Cutlery",)),
}

CONCEPT_OF_OBJECT_TYPE = {
    "METALMUG": "Cup",
    "PRINGLES": "DesignedContainer",
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
"""The concept of each object type, by the name of its member in `world.enums.ObjectType`."""


def ancestors(concept: str) -> Iterator[str]:
    """Yield the concept itself and all its superclasses, each once, the nearest first."""
    pending, seen = [concept], {concept}
    for each in pending:
        yield each
        for parent in CONCEPTS[each].parents if each in CONCEPTS else ():
            if parent not in seen:
                seen.add(parent)
                pending.append(parent)
