"""Declare the descriptions of objects: the URDF and its meshes, each once, before the first object made from it.

A description is parsed, hashed and compressed once, and again only when a mesh file has changed since. For every
further object the plan pays for a lookup, and for a `stat` of each mesh file.
"""

import base64
import hashlib
import os
import zlib
from collections.abc import Collection, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from pycrorm_async.events.codec import Heading, NotEncodable, encode, fingerprint
from pycrorm_async.events.types import BlobReference, BoxValue, DescriptionDeclared, LinkBoxValue, MeshValue
from pycrorm_async.record.values import MissingValues, clean, clean_repr, cut, message_of
from pycrorm_async.settings import Settings
from pycrorm_async.world import model_boxes
from pycrorm_async.world.bounding_boxes import BoundingBox
from pycrorm_async.world.pose import DescriptionNotLoadable
from pycrorm_async.world.urdf_model import UrdfFault, read_model, urdf_text

_KNOWN_CHARACTERS_MAX = 2**24
"""Bounds the characters of the descriptions kept, because a program may generate any number; then all are dropped."""
_REASON_MAX = 500
"""Bounds the characters of the reason why a description or a mesh is missing."""
_HEADING = Heading(None, DescriptionDeclared.__name__, DescriptionDeclared.version)
_OWNER = DescriptionDeclared.__name__

_MEDIA_TYPES = {".stl": "model/stl", ".obj": "model/obj", ".dae": "model/vnd.collada+xml"}

_Stats = tuple[tuple[int, int, int, int] | None, ...]


class DescriptionSink(Protocol):
    """Takes encoded events and blobs; the `Emitter` implements it."""

    def put_payload(self, heading: Heading, payload: bytes) -> int: ...

    def put_blob(self, content: bytes, media_type: str) -> BlobReference:
        """Raises `ValueError` with the reason if it refuses the blob."""
        ...


class Described(Protocol):
    """An object with a description; `world.objects.Object` is one."""

    @property
    def description_text(self) -> str: ...
    @property
    def links(self) -> Collection[str]: ...
    def box_in_link(self, link: str) -> BoundingBox | None:
        """Return the box around the collision shapes of a link, in its frame; None if it has none."""
        ...

    def visual_boxes(self, links: Collection[str]) -> Mapping[str, BoundingBox]:
        """Return the boxes around the visual shapes of these links, in their frames, as far as they are known."""
        ...


class _ReadDescription:
    """A description that no world has loaded; the boxes around its shapes are computed from their files."""

    def __init__(self, text: str) -> None:
        self.description_text = text

    @cached_property
    def links(self) -> Mapping[str, BoundingBox]:
        return model_boxes.shape_boxes(self.description_text, visual=False)

    def box_in_link(self, link: str) -> BoundingBox | None:
        return self.links.get(link)

    def visual_boxes(self, links: Collection[str]) -> Mapping[str, BoundingBox]:
        return model_boxes.shape_boxes(self.description_text, visual=True, links=links)


class _DeclaredDescription(NamedTuple):
    """The encoded declaration of a description, and the reasons, by field, why some of it is missing."""

    fingerprint: str
    payload: bytes
    missing: tuple[tuple[str, str], ...]


class Descriptions:
    """The descriptions that one memory has declared.

    The queue repeats the latest descriptions at the start of each segment, in at most an eighth of it. This class keeps
    the names of the latest ones up to half of that (`_put`), and puts any other again before an object refers to it. So
    each segment with an object also has the object's description.
    """

    def __init__(self, sink: DescriptionSink, settings: Settings, missing: MissingValues) -> None:
        self._sink = sink
        self._missing = missing
        self._record_bytes_max = settings.record_bytes_max
        self._blob_bytes_max = settings.blob_bytes_max
        self._with_files = settings.record_meshes == "files"
        self._put_bytes_max = settings.segment_bytes // 16
        self._files: dict[str, tuple[str, ...]] = {}
        self._known: dict[tuple[str, _Stats], _DeclaredDescription] = {}
        self._known_characters = 0
        self._put: dict[str, int] = {}
        self._put_bytes = 0

    def declare(self, described: Described) -> str | None:
        """Put the object's description into the queue unless it is there, and return its fingerprint.

        An exception is counted as a missing value, because adding an object must not fail; it returns None then.
        """
        try:
            return self._declare(described)
        except Exception as error:  # noqa: BLE001  a setter of the world must not fail because of a memory
            self._missing.note("ObjectAdded", "description", _reason(error))
            return None

    def declare_text(self, urdf: str) -> str | None:
        """Declare a description that no world has loaded, and return its fingerprint; None if it fails."""
        return self.declare(_ReadDescription(urdf))

    def urdf_of(self, name: str, urdf: Any) -> str | None:
        """Return the text of a URDF with the paths of its meshes, as a world reads it; faults are counted as missing.

        The text is kept where a world would refuse it, because an executive may have loaded it elsewhere.
        """
        text = urdf if isinstance(urdf, str) and urdf.lstrip().startswith("<") else None
        if text is not None and "<mesh" not in text:
            return text
        try:
            return urdf_text(name, text or Path(urdf))
        except (DescriptionNotLoadable, TypeError) as error:
            if text is None:  # declaring a text counts the mesh that does not exist, or the fault of the XML
                self._missing.note("ObjectAdded", "urdf", f"{clean_repr(urdf)}: {message_of(error)}")
            return text

    def mass_of(self, urdf: str, object_type: str) -> float | None:
        """Return the mass of a described object, as `Object.mass_kg`; None for a robot or an environment."""
        return model_boxes.described_mass_kg(urdf) if object_type not in ("ROBOT", "ENVIRONMENT") else None

    def _declare(self, described: Described) -> str:
        text = described.description_text
        if self._known_characters > _KNOWN_CHARACTERS_MAX:
            self._files.clear()
            self._known.clear()
            self._known_characters = 0
        files = self._files.get(text)
        if files is None:
            files = self._files[text] = model_boxes.mesh_files(text)
            self._known_characters += len(text)
        key = text, tuple(map(_stat, files)) if files else ()
        declared = self._known.get(key)
        if declared is None:
            declared = self._known[key] = self._encoded(described, files)
        name = declared.fingerprint
        if name not in self._put:
            self._sink.put_payload(_HEADING, declared.payload)
            self._note_put(name, len(declared.payload))
            for field, reason in declared.missing:
                self._missing.note(_OWNER, field, reason)
        return name

    def _note_put(self, name: str, size: int) -> None:
        self._put[name] = size
        self._put_bytes += size
        while self._put_bytes > self._put_bytes_max and len(self._put) > 1:
            self._put_bytes -= self._put.pop(next(iter(self._put)))

    def _encoded(self, described: Described, files: tuple[str, ...]) -> _DeclaredDescription:
        text = described.description_text
        meshes = {file: self._mesh(Path(file)) for file in files}
        meshed = model_boxes.meshed_links(text) if files else ()
        solid = {link: box for link in described.links if (box := described.box_in_link(link)) is not None}
        seen = described.visual_boxes([link for link in meshed if link not in solid])
        boxes = {link: _box_value(box) for link in meshed if (box := solid.get(link) or seen.get(link)) is not None}
        try:
            left_out = read_model(text).left_out
            placed = tuple(LinkBoxValue(*each) for each in model_boxes.link_boxes(text, solid))
        except UrdfFault as fault:  # the text is recorded nevertheless
            left_out, placed = (str(fault),), ()
        text, textures = model_boxes.without_textures(text)
        if meshes:
            text = model_boxes.with_mesh_files(text, {file: mesh.reference for file, mesh in meshes.items()})
        packed = base64.b64encode(zlib.compress(text.encode())).decode()
        event = DescriptionDeclared(packed, tuple(dict.fromkeys(meshes.values())), boxes, placed)
        missing = [("meshes", f"{mesh.name}: {mesh.missing}") for mesh in event.meshes if mesh.missing is not None]
        if left_out:
            missing.append(("urdf", cut(clean("; ".join(left_out)), _REASON_MAX)))
        bare = [clean(link) for link in meshed if link not in boxes]
        if bare and not self._with_files:
            missing.append(("boxes", cut(f"the meshes of these links have none: {', '.join(bare)}", _REASON_MAX)))
        missing += [("textures", f"{clean(texture)}: textures are not recorded") for texture in textures]
        try:
            payload = encode(event, bytes_max=self._record_bytes_max)
        except NotEncodable as error:
            missing = [("urdf", _reason(error))]
            payload = encode(DescriptionDeclared(missing=missing[0][1]))
        return _DeclaredDescription(fingerprint(payload, _OWNER), payload, tuple(missing))

    def _mesh(self, file: Path) -> MeshValue:
        """Hash a mesh file, and put its content as a blob if the settings ask for files."""
        name = clean(file.name)
        try:
            with file.open("rb") as opened:
                digest = hashlib.file_digest(opened, "sha256").hexdigest()
                size = opened.tell()
                if not self._with_files:
                    return MeshValue(name, digest, size)
                if size > self._blob_bytes_max:
                    reason = f"it takes {size:,} bytes, {self._blob_bytes_max:,} are allowed (blob_bytes_max)"
                    return MeshValue(name, digest, size, missing=reason)
                opened.seek(0)
                content = opened.read()
        except OSError as error:
            return MeshValue(name, missing=cut(clean(error.strerror or type(error).__name__), _REASON_MAX))
        try:
            blob = self._sink.put_blob(content, _MEDIA_TYPES.get(file.suffix.lower(), "application/octet-stream"))
        except ValueError as error:
            return MeshValue(name, digest, size, missing=_reason(error))
        return MeshValue(name, blob.hash, blob.size, blob)


def _stat(file: str) -> tuple[int, int, int, int] | None:
    """Return inode, size and times of a file, of which any change alters one: programs cannot set the last of them."""
    try:
        status = os.stat(file)  # noqa: PTH116  a fifth of the time of Path.stat
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _box_value(box: BoundingBox) -> BoxValue:
    low, high = (tuple(round(value, 6) for value in corner) for corner in box)
    return BoxValue((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def _reason(error: BaseException) -> str:
    return cut(clean(message_of(error)), _REASON_MAX)
