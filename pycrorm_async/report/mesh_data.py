"""Read the recorded mesh files of a description into the triangles that the page draws."""

from __future__ import annotations

import asyncio
from base64 import b64encode
from typing import Any

from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.events.values import MeshValue
from pycrorm_async.query.scene.mesh_triangles import Triangles, triangles_of
from pycrorm_async.query.scene.object_model import object_model
from pycrorm_async.store.log import EventLog

_TRIANGLES_MAX = 200_000
"""Bounds the triangles of a page: they take about 5 MB."""
_NAMED_MAX = 5
"""Bounds the names of files that a note lists."""


class Meshes:
    """The meshes of one page, up to its bound."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._left = _TRIANGLES_MAX

    async def model(self, description: DescriptionDeclared) -> dict[str, Any]:
        """Return the model of a description: `meshes` has its triangles, `boxes` why others are drawn as boxes."""
        meshes: dict[str, Any] = {}
        refused: list[str] = []
        for mesh in description.meshes:
            try:
                triangles = await self._triangles(mesh)
            except ValueError as reason:
                refused.append(f"{mesh.name} ({reason})")
            else:
                self._left -= len(triangles.faces)
                meshes[mesh.reference] = _encoded(triangles)
        model = object_model(description, drawn=frozenset(meshes))
        if not description.meshes or "assumed" in model:
            return model
        return {**model, "meshes": meshes, "boxes": _note(refused)}

    async def _triangles(self, mesh: MeshValue) -> Triangles:
        """Return the triangles of a mesh file. Raises `ValueError` with the reason why it has a box instead."""
        if mesh.content is None:
            raise ValueError(mesh.missing or "its content was not recorded")
        with self._log.translated():
            content = await self._log.blobs.read_blob(mesh.content.hash)
        if content is None:
            raise ValueError("its content is not in the log")
        triangles = await asyncio.to_thread(triangles_of, mesh.name, content)
        if len(triangles.faces) > self._left:
            raise ValueError("the page has too many triangles already")
        return triangles


def _encoded(triangles: Triangles) -> dict[str, str]:
    """Return the arrays as base64 of little-endian numbers, which take half the space of digits."""
    vertices, faces = triangles.vertices.astype("<f4"), triangles.faces.astype("<u4")
    return {"vertices": b64encode(vertices.tobytes()).decode(), "faces": b64encode(faces.tobytes()).decode()}


def _note(refused: list[str]) -> str:
    if not refused:
        return ""
    others = f" and {len(refused) - _NAMED_MAX} more" if len(refused) > _NAMED_MAX else ""
    return f"{len(refused)} mesh file{'s' * (len(refused) > 1)}: {', '.join(refused[:_NAMED_MAX])}{others}"
