"""Make a small file of each format, for what must be so of all of them."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin

from tests.imports import neems
from tests.imports import test_bags as bags
from tests.imports import test_btlog as btlogs
from tests.imports import test_lerobot as data_sets
from tests.imports import test_pycram_orm as orms
from tests.imports import test_traces as traces


def trace_file(file: Path, steps: int = 20) -> Path:
    """Write spans, instants and counters of Chrome."""
    events = [
        {"ph": "B", "name": "fetch milk", "ts": 1, "args": {"tries": 2}},
        *({"ph": "X", "name": "Drive", "ts": 10 * n, "dur": 5, "args": {"n": n}} for n in range(1, steps)),
        {"ph": "i", "name": "bump", "ts": 13, "args": {"force": 3}},
        {"ph": "C", "name": "volts", "ts": 14, "args": {"cell": 4.1}},
        {"ph": "E", "ts": 10 * steps, "args": {"found": True}},
    ]
    file.write_text(traces.trace_of(*events))
    return file


def otlp_file(file: Path) -> Path:
    """Write two traces of OpenTelemetry, one in each line."""
    fell = {
        "name": "exception",
        "timeUnixNano": str(traces.AT + 1),
        "attributes": [{"key": "exception.type", "value": {"stringValue": "GripLost"}}],
    }
    with file.open("w") as lines:
        for trace in ("AA", "BB"):
            spans = [
                {
                    "traceId": trace, "spanId": f"0{n}", "parentSpanId": f"0{n // 2}", "name": "serve",
                    "startTimeUnixNano": str(traces.AT + n), "endTimeUnixNano": str(traces.AT + 10 - n),
                    "status": {"code": n % 3}, "events": [fell],
                }
                for n in range(1, 5)
            ]  # fmt: skip
            lines.write(json.dumps({"resourceSpans": [{"scopeSpans": [{"spans": spans}]}]}) + "\n")
    return file


def btlog_file(file: Path) -> Path:
    """Write the log of FileLogger2."""
    file.write_bytes(btlogs.btlog(btlogs.TRANSITIONS))
    return file


def btlog_database(file: Path) -> Path:
    """Write the log of SqliteLogger."""
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("CREATE TABLE Definitions (session_id, xml_tree)")
        database.execute("CREATE TABLE Transitions (timestamp, session_id, node_uid, state)")
        database.execute("INSERT INTO Definitions VALUES (1, ?)", (btlogs.XML,))
        rows = [(btlogs.START_US + each[0], 1, *each[1:]) for each in btlogs.TRANSITIONS]
        database.executemany("INSERT INTO Transitions VALUES (?, ?, ?, ?)", rows)
    return file


def mcap_file(file: Path) -> Path:
    """Write a bag as MCAP, in many chunks."""
    [source] = bags.bag(file.with_suffix(""), bags.a_drive()).glob("*.mcap")
    bags.in_small_chunks(source, file)
    return file


SAMPLES: Mapping[str, tuple[str, Callable[[Path], Path]]] = {
    "trace": ("trace", lambda folder: trace_file(folder / "run.json")),
    "otlp": ("trace", lambda folder: otlp_file(folder / "spans.jsonl")),
    "btlog": ("btlog", lambda folder: btlog_file(folder / "run.btlog")),
    "sqlite-logger": ("btlog", lambda folder: btlog_database(folder / "run.db3")),
    "mcap": ("mcap", lambda folder: mcap_file(folder / "drive.mcap")),
    "db3": ("rosbag2", lambda folder: bags.bag(folder / "bag", bags.a_drive(), StoragePlugin.SQLITE3)),
    "neem-bson": ("neem", lambda folder: neems.neem_folder(folder / "bson")),
    "neem-json": ("neem", lambda folder: neems.exported_folder(folder / "json")),
    "neem-json-ld": ("neem", lambda folder: neems.json_ld_file(folder / "neem.jsonld")),
    "neem-interchange": ("neem", lambda folder: neems.interchange_file(folder / "neem.json")),
    "lerobot-2": ("lerobot", lambda folder: data_sets.version_2(folder / "set2")),
    "lerobot-3": ("lerobot", lambda folder: data_sets.version_3(folder / "set3")),
    "pycrorm": ("pycrorm", lambda folder: orms.orm_database(folder / "orm.db")),
}
"""A format, and a function that writes a sample of it in a folder, by the name of the sample."""
