"""Make a small NEEM in the schema of KnowRob, with every wart that was counted in real ones."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

SOMA = "http://www.ease-crc.org/ont/SOMA.owl#"
DUL = "http://www.ontologydesignpatterns.org/ont/dul/DUL.owl#"
RDFS = "http://www.w3.org/2000/01/rdf-schema#"
TYPE = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type"
PR2 = "http://knowrob.org/kb/PR2.owl#PR2_0"
MILK = "http://knowrob.org/kb/IAI-kitchen.owl#Milk_ABCDEFGH"
BOWL = "http://knowrob.org/kb/IAI-kitchen.owl#Bowl_ABCDEFGH"
BEGIN_S = 1_556_700_000.25
META = {
    "_id": "5fd0c0ffee",
    "name": "Breakfast",
    "description": "the PR2 sets a table",
    "keywords": ["kitchen", "pr2", 7],
    "url": "https://example.org/neem",
    "created_at": "2019-05-01T08:40:00+00:00",
    "created_by": "ada",
}


def action(name: str, task: str, begin: Any, end: Any, **facts: Any) -> list[dict[str, Any]]:
    """Return the triples of one action; `facts` are its children, state, failure, participants."""
    a, t, i = f"{SOMA}{name}", f"{SOMA}{task}_{name[-8:]}", f"{SOMA}TimeInterval_{name[-8:]}"
    rows = [
        (a, TYPE, f"{DUL}Action"),
        (a, f"{DUL}executesTask", t),
        (t, TYPE, f"{SOMA}{task}"),
        (t, TYPE, "http://www.w3.org/2002/07/owl#NamedIndividual"),
        (a, f"{SOMA}isPerformedBy", PR2),
    ]
    if begin is not None:
        rows += [(a, f"{DUL}hasTimeInterval", i), (i, f"{SOMA}hasIntervalBegin", begin)]
        rows += [(i, f"{SOMA}hasIntervalEnd", end)]
    rows += [
        (a, f"{DUL}{facts.get('constituent', 'hasConstituent')}", f"{SOMA}{each}") for each in facts.get("below", ())
    ]
    rows += [(a, f"{DUL}hasParticipant", each) for each in facts.get("participants", ())]
    if "state" in facts:
        rows.append((a, f"{SOMA}hasExecutionState", f"{SOMA}ExecutionState_{facts['state']}"))
    if "failure" in facts:
        rows.append((a, f"{DUL}satisfies", f"{SOMA}{facts['failure']}"))
    return [{"s": s, "p": p, "o": o, "p*": [p], "o*": [o], "graph": "user"} for s, p, o in rows]


def statements() -> list[dict[str, Any]]:
    """Return the documents of the collection of triples."""
    at = BEGIN_S
    rows = [
        *action("Action_ROOTAAAA", "PhysicalTask", at, "Infinity", below=["Action_DRIVEAAA", "Action_PICKAAAA"]),
        *action("Action_DRIVEAAA", "Navigating", str(at + 1), str(at + 3.5), state="Succeeded", participants=["NIL"]),
        *action(
            "Action_PICKAAAA", "PickingUp", at + 4, at + 9, state="Failed", participants=[MILK],
            below=["Action_GRIPAAAA", "Action_POKEAAAA"], constituent="hasPhase",
            failure="CRAMManipulationPoseUnreachable_QWERTZUI",
        ),
        *action("Action_GRIPAAAA", "Gripping", at + 5, at + 6, participants=[MILK, "NIL", BOWL]),
        *action("Action_POKEAAAA", "Accessing", at + 6, at + 20),  # ends after its parent
        *action("Action_NEVERAAA", "LookingAt", at + 7, 1.7976931348623157e308, state="Active"),  # of no parent
        *action("Action_UNTIMEDA", "Cutting", None, None),
    ]  # fmt: skip
    facts = [
        (f"{SOMA}Episode_AAAAAAAA", TYPE, f"{SOMA}Episode"),
        (f"{SOMA}Episode_AAAAAAAA", f"{DUL}includesAction", f"{SOMA}Action_ROOTAAAA"),
        (PR2, TYPE, f"{DUL}PhysicalAgent"),
        (MILK, TYPE, f"{SOMA}Milk"),
        (BOWL, TYPE, f"{SOMA}Bowl"),
        (BOWL, f"{SOMA}hasPositionData", "1.5 -2.0 0.85"),
        (BOWL, f"{SOMA}hasOrientationData", "[0.0, 0.0, 1.0, 0.0]"),
        (MILK, f"{DUL}hasRole", f"{SOMA}Item_ABCDEFGH"),
        (f"{SOMA}Item_ABCDEFGH", TYPE, f"{SOMA}Item"),
        (f"{SOMA}PickingUp_PICKAAAA", f"{DUL}hasParameter", f"{SOMA}GraspType_ABCDEFGH"),
        (f"{SOMA}GraspType_ABCDEFGH", f"{DUL}classifies", f"{SOMA}TopGrasp_ABCDEFGH"),
        (f"{SOMA}Action_PICKAAAA", f"{DUL}hasRegion", f"{SOMA}TopGrasp_ABCDEFGH"),
        (f"{SOMA}Action_PICKAAAA", f"{RDFS}label", "lang(en,'pick it up')"),
    ]
    rows += [{"s": s, "p": p, "o": o, "graph": "user"} for s, p, o in facts]
    rows += [
        {
            "s": f"{DUL}Action",
            "p": "http://www.w3.org/2000/01/rdf-schema#subClassOf",
            "o": f"{DUL}Event",
            "graph": "DUL",
        },
        {"s": f"{SOMA}Milk", "p": f"{RDFS}label", "graph": "user"},  # neither o nor v
        {"s": f"{SOMA}Action_DRIVEAAA", "p": f"{RDFS}comment", "v": "to the table"},
    ]
    return rows


def moves(hours_off: int = 0, count: int = 60, jump_at: int | None = None) -> list[dict[str, Any]]:
    """Return the documents of tf: the robot drives 1 cm each 0.1 s, with a camera and the milk on it."""
    start = datetime.fromtimestamp(BEGIN_S, UTC) + timedelta(hours=hours_off)
    documents = []
    for index in range(count):
        stamp = start + timedelta(seconds=index / 10)
        if jump_at is not None and index >= jump_at:
            stamp -= timedelta(hours=1)
        for parent, child, x, z in (
            ("map", "base_footprint", index / 100, 0.0),
            ("base_footprint", "camera", 0.25, 1.5),
            ("base_footprint", "Milk_ABCDEFGH", 0.5, 0.75),
        ):
            documents.append(
                {
                    "header": {"seq": index, "stamp": stamp, "frame_id": parent},
                    "child_frame_id": child,
                    "transform": {
                        "translation": {"x": x, "y": 0.0, "z": z},
                        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    },
                    "__topic": "tf",
                }
            )
    return documents


# === files ====================================================================================================


def bson_file(file: Path, documents: Iterable[dict[str, Any]]) -> Path:
    """Write documents as mongodump does."""
    import bson

    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(
        b"".join(bson.encode({"_id": bson.ObjectId(), **each} if "_id" not in each else each) for each in documents)
    )
    return file


def neem_folder(folder: Path, tf: list[dict[str, Any]] | None = None) -> Path:
    """Write a NEEM as `memorize` of KnowRob does."""
    bson_file(folder / "triples/roslog/triples.bson", statements())
    (folder / "triples/roslog/triples.metadata.json").write_text("{}")
    bson_file(folder / "tf/roslog/tf.bson", moves() if tf is None else tf)
    bson_file(folder / "annotations/roslog/annotations.bson", [{"s": f"{SOMA}Milk", "p": "comment", "v": "a drink"}])
    bson_file(folder / "inferred/roslog/inferred.bson", [{"query": "x", "module": "y", "predicate": "z"}])
    bson_file(folder / "meta/roslog/meta.bson", [META])
    return folder


def exported_folder(folder: Path) -> Path:
    """Write the collections as mongoexport does: lines of extended JSON, with decimals and dates."""
    folder.mkdir(parents=True)
    lines = [
        {"_id": {"$oid": "5fd0c0ffee5fd0c0ffee5fd0"}, **each, "o": {"$numberDecimal": str(each["o"])}}
        if isinstance(each.get("o"), float) and each["o"] < 1e300
        else {"_id": {"$oid": "5fd0c0ffee5fd0c0ffee5fd0"}, **each}
        for each in statements()
    ]
    (folder / "triples.json").write_text("".join(f"{json.dumps(each)}\n" for each in lines))
    stamped = [
        {**each, "header": {**each["header"], "stamp": {"$date": each["header"]["stamp"].isoformat()}}}
        for each in moves()
    ]
    (folder / "tf.json").write_text("".join(f"{json.dumps(each)}\n" for each in stamped))
    (folder / "meta.json").write_text(json.dumps([META]))
    return folder


def interchange_file(file: Path) -> Path:
    """Write the triples as the interchange format of the handbook has them: one list, no class of any ontology."""
    rows = [
        {key: each[key] for key in ("s", "p", "o", "v") if key in each}
        for each in statements()
        if each.get("graph") != "DUL"
    ]
    file.write_text(json.dumps(rows, indent=1))
    return file


def json_ld_file(file: Path) -> Path:
    """Write the triples as JSON-LD with prefixes."""
    nodes: dict[str, dict[str, Any]] = {}
    for each in statements():
        if each.get("graph") == "DUL" or not {"o", "v"} & each.keys():
            continue
        node = nodes.setdefault(each["s"], {"@id": each["s"].replace(SOMA, "soma:")})
        value: Any = each["o"] if "o" in each else each["v"]
        if each["p"] == TYPE:
            node.setdefault("@type", []).append(value.replace(SOMA, "soma:"))
        else:
            key = each["p"].replace(SOMA, "soma:").replace(DUL, "dul:")
            is_iri = isinstance(value, str) and value.startswith("http")
            node.setdefault(key, []).append({"@id": value.replace(DUL, "dul:")} if is_iri else {"@value": value})
    file.write_text(json.dumps({"@context": {"soma": SOMA, "dul": DUL}, "@graph": list(nodes.values())}))
    return file
