"""Read the collections of a NEEM: from BSON dumps, from lines of JSON, from JSON-LD, and from the interchange JSON.

A NEEM is a folder with the dumps of its collections, as KnowRob's `memorize` makes it (`triples/roslog/triples.bson`);
a folder with the collections of several NEEMs, whose names begin with the id of each; or one file. The kind of a
collection is the end of its name: `triples`, `tf`, `annotations`, `inferred`, `meta`. Files may be gzip files.

| file | holds |
|---|---|
| `.bson` | documents of a dump by mongodump |
| JSON lines | documents in MongoDB's extended JSON, by mongoexport, one in each line or as one list |
| interchange JSON | a list of `{s, p, o, since?, until?}` |
| JSON-LD | nodes with `@id`; terms and prefixes of its own `@context`, none of the web |
"""

import gzip
import json
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import IO, Any, Final, Literal, NamedTuple, cast

from pycrorm_async.errors import FilesError, MissingExtra
from pycrorm_async.events.codec import clean
from pycrorm_async.export.neem_vocabulary import RDF_TYPE
from pycrorm_async.imports.intake import WrongFormat

Kind = Literal["triples", "tf", "annotations", "inferred", "meta"]
KINDS: Final[tuple[Kind, ...]] = ("triples", "tf", "annotations", "inferred", "meta")
_SUFFIXES: Final = (".bson", ".json", ".jsonl", ".ndjson", ".jsonld")
_NAME: Final = re.compile(r"(?:(?P<neem>.*)_)?(?P<kind>triples|tf|annotations|inferred|meta)")
_LINES_MAX: Final = 2**24
"""Bounds the bytes of one line of JSON: a document of MongoDB has at most 16 MiB."""
_UNIT: Final = 1e-6
"""The length of a quaternion that differs from 1 by less is that of rounding, and kept."""
_MILLISECONDS: Final = 1e11
"""Times from this number on are in ms, smaller ones in s: it is the year 5138 in s, and 1973 in ms."""
_Documents = Iterator[Mapping[str, Any]]


class FileCut(FilesError):
    """A file ends in the middle of a document, or is damaged; what stands before is imported."""


class Triple(NamedTuple):
    """A statement of a NEEM: subject, predicate and object; the ontology it belongs to, None for a recorded fact."""

    s: str
    p: str
    o: Any
    graph: str | None = None


class Transform(NamedTuple):
    """Where a frame was: UTC in ns, its parent, itself, position in m, quaternion xyzw.

    `is_own`: whether our export wrote it, of an object of our memory, with its time in ns.
    """

    at: int
    parent: str
    child: str
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    is_own: bool = False


@dataclass
class NeemFiles:
    """The files of one NEEM, by kind."""

    name: str
    files: dict[Kind, list[Path]] = field(default_factory=dict)

    def of(self, kind: Kind) -> list[Path]:
        """Return the files of a kind, in order."""
        return sorted(self.files.get(kind, []))


def neems_in(path: Path) -> list[NeemFiles]:
    """Find the NEEMs in a folder, or the one in a file. Raises `WrongFormat`."""
    if path.is_file():
        match = _NAME.fullmatch(_stem(path))
        kind: Any = match["kind"] if match else "triples"
        return [NeemFiles((match and match["neem"]) or path.name, {kind: [path]})]
    neems: dict[str, NeemFiles] = {}
    for file in sorted(path.rglob("*")):
        match = _NAME.fullmatch(_stem(file)) if file.is_file() and _is_data(file) else None
        if match is None and file.is_file() and _is_data(file) and file.parent == path:
            match = _NAME.fullmatch("triples")
        if match is not None:
            name = match["neem"] or ""
            kind = cast("Kind", match["kind"])
            neems.setdefault(name, NeemFiles(name)).files.setdefault(kind, []).append(file)
    shared = neems.get("")
    found = [each for each in neems.values() if "triples" in each.files or "tf" in each.files]
    if not found:
        raise WrongFormat(f"{path} has no collection of a NEEM, such as triples.bson")
    for each in found:
        each.name = each.name or path.name
        if shared is not None and each is not shared and "meta" in shared.files:  # of all NEEMs in one dump
            each.files.setdefault("meta", shared.files["meta"])
    return found


def _stem(file: Path) -> str:
    name = file.name.removesuffix(".gz")
    return name.removesuffix(".metadata.json") if name.endswith(".metadata.json") else name.rpartition(".")[0]


def _is_data(file: Path) -> bool:
    name = file.name.removesuffix(".gz")
    return name.endswith(_SUFFIXES) and not name.endswith(".metadata.json") and file.stat().st_size > 0


# === documents ================================================================================================


def documents(path: Path, *, plainly: bool = True) -> _Documents:
    """Yield the documents of a file, one after the other; without `plainly` those of BSON with the types of `bson`.

    Raises `WrongFormat`, `FileCut` and `MissingExtra`.
    """
    name = path.name.removesuffix(".gz")
    with _opened(path) as file:
        if name.endswith(".bson"):
            yield from _bson_documents(path, file, plainly=plainly)
        else:
            yield from _json_documents(path, file)


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    with path.open("rb") as raw:
        if raw.read(2) != b"\x1f\x8b":
            raw.seek(0)
            yield raw
            return
        raw.seek(0)
        with gzip.open(raw) as file:
            try:
                yield file  # type: ignore[misc]
            except (EOFError, zlib.error, gzip.BadGzipFile):
                raise FileCut("cannot be decompressed to its end; what stands before is imported") from None


def _bson_documents(path: Path, file: IO[bytes], *, plainly: bool) -> _Documents:
    try:
        import bson
        from bson.codec_options import CodecOptions, DatetimeConversion
        from bson.errors import InvalidBSON
    except ImportError:
        raise MissingExtra("files of BSON need pymongo: pip install 'pycrorm-async[neem]'") from None
    options: Any = CodecOptions(
        datetime_conversion=DatetimeConversion.DATETIME_MS, unicode_decode_error_handler="replace"
    )
    count = 0
    while head := file.read(4):
        size = int.from_bytes(head, "little") if len(head) == 4 else 0
        if len(head) == 4 and not 5 <= size <= _LINES_MAX:
            if count == 0:
                raise WrongFormat(f"{path} is no file of BSON")
            raise FileCut(f"is damaged after {count:,} documents; these are imported")
        body = file.read(size - 4) if size else b""
        if len(body) < size - 4 or size == 0:
            raise FileCut(f"ends in the middle of document {count + 1:,}; those before are imported")
        try:
            document = bson.decode(head + body, options)
            document = plain(document) if plainly else document
        except (InvalidBSON, RecursionError, ValueError) as error:
            if count == 0:
                raise WrongFormat(f"{path} is no file of BSON: {error}") from None
            raise FileCut(f"is damaged at document {count + 1:,}; those before are imported") from None
        yield document
        count += 1


def _json_documents(path: Path, file: IO[bytes]) -> _Documents:
    first = file.readline(_LINES_MAX)
    while first and not first.strip():
        first = file.readline(_LINES_MAX)
    document = _line(first)
    if isinstance(document, dict) and not {"@graph", "@context", "@id"} & document.keys():
        yield document
        yield from _json_lines(file)
        return
    text = (first + file.read()).decode(errors="replace")
    try:
        whole, cut = plain(json.loads(text)), False
    except (ValueError, RecursionError):
        whole, cut = _whole_items(path, text), True
    if isinstance(whole, dict) and not {"@graph", "@context", "@id"} & whole.keys():
        yield whole
    elif isinstance(whole, list) and not any(isinstance(each, dict) and "@id" in each for each in whole):
        yield from (each for each in whole if isinstance(each, dict))
    else:
        yield from json_ld(whole)
    if cut:
        raise FileCut("ends in the middle of a document of JSON; those before are imported")


def _json_lines(file: IO[bytes]) -> _Documents:
    count = 1
    while line := file.readline(_LINES_MAX):
        if not line.strip():
            continue
        document = _line(line)
        if not isinstance(document, dict):
            raise FileCut(f"ends in the middle of document {count + 1:,}; those before are imported")
        yield document
        count += 1


def _line(line: bytes) -> Any:
    try:
        return plain(json.loads(line))
    except (ValueError, RecursionError):
        return None


def _whole_items(path: Path, text: str) -> list[Any]:
    """Return the whole items of a list that is cut. Raises `WrongFormat` if there are none."""
    decoder, items, position = json.JSONDecoder(), list[Any](), text.find("[") + 1
    while position:
        try:
            item, position = decoder.raw_decode(text, re.compile(r"[\s,]*").match(text, position).end())  # type: ignore[union-attr]
            items.append(plain(item))
        except (ValueError, RecursionError):
            break
    if not items:
        raise WrongFormat(f"{path} is no NEEM in JSON")
    return items


def plain(value: Any) -> Any:
    """Return a document with numbers, texts and times in ms in place of MongoDB's types, also of extended JSON."""
    kind = type(value)
    if kind in (str, int, float, bool) or value is None:
        return value
    if isinstance(value, Mapping):
        if len(value) == 1:
            [(key, inner)] = value.items()
            if key[:1] == "$":
                return _extended(key, inner)
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if kind.__name__ == "Decimal128":
        return float(value.to_decimal())
    if kind.__name__ == "DatetimeMS":
        return int(value)
    return int(value) if isinstance(value, int) else str(value)


def _extended(key: str, inner: Any) -> Any:
    if key == "$date":
        if isinstance(inner, str):
            return _milliseconds(inner)
        return plain(inner)
    try:
        if key in ("$numberDecimal", "$numberDouble"):
            return float(Decimal(str(inner)))
        if key in ("$numberLong", "$numberInt"):
            return int(inner)
    except (ArithmeticError, TypeError, ValueError):
        return str(inner)
    return str(inner) if not isinstance(inner, Mapping) else plain(dict(inner))


def _milliseconds(text: str) -> Any:
    from datetime import UTC, datetime

    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return text
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(moment.timestamp() * 1000)


# === JSON-LD ==================================================================================================


def json_ld(document: Any) -> _Documents:
    """Yield the triples of a document of JSON-LD, whose terms its own context defines."""
    context: dict[str, Any] = {}
    nodes: Iterable[Any] = document if isinstance(document, list) else [document]
    for each in nodes:
        if isinstance(each, Mapping):
            _read_context(each.get("@context"), context)
            graph = each.get("@graph")
            for node in graph if isinstance(graph, list) else [each]:
                yield from _node_triples(node, context, 0)


def _read_context(given: Any, context: dict[str, Any]) -> None:
    for each in given if isinstance(given, list) else [given]:
        if isinstance(each, Mapping):
            context.update(each)


def _iri(term: Any, context: Mapping[str, Any], *, is_key: bool = False) -> str:
    text = str(term)
    defined = context.get(text)
    if isinstance(defined, Mapping):
        defined = defined.get("@id")
    if isinstance(defined, str) and defined != text:
        return _iri(defined, {key: each for key, each in context.items() if key != text})
    prefix, colon, rest = text.partition(":")
    space = context.get(prefix)
    if isinstance(space, Mapping):
        space = space.get("@id")
    if colon and not rest.startswith("//") and isinstance(space, str):
        return space + rest
    if is_key and not colon and isinstance(context.get("@vocab"), str):
        return f"{context['@vocab']}{text}"
    return text


def _node_triples(node: Any, context: Mapping[str, Any], depth: int) -> _Documents:
    if not isinstance(node, Mapping) or "@id" not in node or depth > 50:
        return
    s = _iri(node["@id"], context)
    for key, given in node.items():
        if key == "@type":
            for each in given if isinstance(given, list) else [given]:
                yield {"s": s, "p": RDF_TYPE, "o": _iri(each, context, is_key=True)}
        elif not key.startswith("@"):
            p, term = _iri(key, context, is_key=True), context.get(key)
            is_iri = isinstance(term, Mapping) and term.get("@type") == "@id"
            for each in given if isinstance(given, list) else [given]:
                if isinstance(each, Mapping) and "@id" in each:
                    yield {"s": s, "p": p, "o": _iri(each["@id"], context)}
                    yield from _node_triples(each, context, depth + 1)
                elif isinstance(each, Mapping):
                    yield {"s": s, "p": p, "o": each.get("@value")}
                else:
                    yield {"s": s, "p": p, "o": _iri(each, context) if is_iri else each}


# === triples and transforms ===================================================================================


def triples(path: Path, left_out: Any) -> Iterator[Triple]:
    """Yield the triples of a file; `left_out` is called with what is none, and the reason."""
    for document in documents(path):
        s, p = document.get("s"), document.get("p")
        o = document["o"] if "o" in document else document.get("v")
        if not isinstance(s, str) or not isinstance(p, str) or not s or not p:
            left_out("documents", "they are no triples: subject or predicate is missing")
        elif o is None:
            left_out("triples", "they have neither `o` nor `v`")
        else:
            graph = document.get("graph")
            value = clean(o) if isinstance(o, str) else o
            yield Triple(
                clean(s), clean(p), value, graph if isinstance(graph, str) and graph not in ("user", "common") else None
            )


def transforms(path: Path, left_out: Any) -> Iterator[Transform]:
    """Yield the transforms of a file; `left_out` is called with what is none, and the reason."""
    for document in documents(path, plainly=False):
        try:
            try:
                transform = _transform(document)
            except TypeError:  # a number of MongoDB's own, such as a decimal
                transform = _transform(plain(document))
        except (KeyError, TypeError, ValueError, OverflowError):
            left_out("transforms", "they lack a frame, a number or a time")
            continue
        x, y, z = transform.position
        norm = math.hypot(*transform.orientation)
        if not (0.5 < norm < 2) or not abs(x) + abs(y) + abs(z) < 1e9 or not 0 <= transform.at < 2**63:
            left_out("transforms", "they have no rotation, or a number out of range")
        elif abs(norm - 1) < _UNIT:
            yield transform
        else:
            qx, qy, qz, qw = (each / norm for each in transform.orientation)
            yield transform._replace(orientation=(qx, qy, qz, qw))


def _transform(document: Mapping[str, Any]) -> Transform:
    header, transform = document["header"], document["transform"]
    place, turn, stamp, own = transform["translation"], transform["rotation"], header["stamp"], document.get("__ns")
    if isinstance(own, int):
        at = own
    elif isinstance(stamp, Mapping):
        at = int(stamp.get("secs", stamp.get("sec"))) * 10**9 + int(stamp.get("nsecs", stamp.get("nanosec", 0)))
    elif isinstance(stamp, float) and stamp < _MILLISECONDS:
        at = round(stamp * 1e6) * 1000
    else:
        at = int(stamp) * 1_000_000
    return Transform(
        at,
        str(header["frame_id"]).strip("/"),
        str(document["child_frame_id"]).strip("/"),
        (float(place["x"]), float(place["y"]), float(place["z"])),
        (float(turn["x"]), float(turn["y"]), float(turn["z"]), float(turn["w"])),
        isinstance(own, int),
    )
