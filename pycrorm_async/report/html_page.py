"""Write the document of an episode into one HTML file that opens offline and makes no request.

The Content-Security-Policy allows the page's own style and scripts by their hashes, and nothing else. Recorded text is
in the page only as JSON in which `<` is escaped, and in its title; the scripts set it as text.

A document with a `live` entry becomes a live page, which has one more module, `stream.js`, and may connect to its own
server for the parts of the document that follow.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from pycrorm_async.report.output_files import write_file

_EPISODE = (
    "dom episode bodies extent path_lines scene_camera scene_view map_view tree_view gantt_bars gantt_view"
    " similar panels playback main"
).split()
_OVERVIEW = "dom episode success overview".split()
"""The modules of each page's program, every one behind those that it imports."""
_STREAM = ("stream",)
_SELF = "'self'"
_TITLE_MAX = 200
"""Bounds the characters of the description in title and heading."""
_ESCAPES = {
    b"<": rb"\u003c",
    b">": rb"\u003e",
    b"&": rb"\u0026",
    b"\xe2\x80\xa8": rb"\u2028",
    b"\xe2\x80\xa9": rb"\u2029",
}
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_IMPORT = re.compile(r"^import \{[^}]*\} from \"\./\w+\.js\";\n", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(const|class|function) )", re.MULTILINE)


def page_of(document: Mapping[str, Any]) -> str:
    """Return the page of a document from `episode_document`."""
    episode = document["episode"]
    heading = episode["description"] or f"Episode {episode['number']}"
    scripts = (_asset("assets/three.bundle.js"), _program(*_EPISODE, *_stream_of(document)))
    return _page(document, heading, f" · episode {episode['number']}", _asset("web/episode_body.html"), scripts)


def overview_page_of(document: Mapping[str, Any]) -> str:
    """Return the page of a document from `overview_document`."""
    scripts = (_program(*_OVERVIEW, *_stream_of(document)),)
    return _page(document, document["title"], "", _asset("web/overview_body.html"), scripts)


def _stream_of(document: Mapping[str, Any]) -> tuple[str, ...]:
    return _STREAM if "live" in document else ()


def _page(document: Mapping[str, Any], heading: str, suffix: str, body: str, scripts: Sequence[str]) -> str:
    heading, style = heading[:_TITLE_MAX], _asset("web/page.css")
    policy = (
        f"default-src 'none'; script-src {' '.join(map(_hash, scripts))}; style-src {_hash(style)};"
        f" img-src data:; base-uri 'none'; form-action 'none'{'; connect-src ' + _SELF if 'live' in document else ''}"
    )
    parts = {
        "policy": policy,
        "title": html.escape(_CONTROL.sub(_visible, heading) + suffix),
        "style": style,
        "body": body.replace("{heading}", html.escape(heading)),
        "document": _safe_json(document),
        "scripts": "\n".join(f"<script>{each}</script>" for each in scripts),
    }
    return re.sub(r"\{(\w+)\}", lambda match: parts[match[1]], _asset("web/page.html"))


def _visible(control: re.Match[str]) -> str:
    """Return a sign for a control character, which would reorder or break the title of a window."""
    code = ord(control[0])
    return chr(0x2400 + code) if code < 0x20 else f"<U+{code:04X}>"


def write_page(page: str, path: Path, *, force: bool = False) -> None:
    """Write a page to a file that is complete as soon as it has its name. Raises `CallerError`, `OSError`."""
    write_file(page.encode(), path, force=force)


def _safe_json(document: Mapping[str, Any]) -> str:
    """Encode as JSON that ends no <script> element, whatever the document holds."""
    encoded = msgspec.json.encode(document)
    for each, escaped in _ESCAPES.items():
        encoded = encoded.replace(each, escaped)
    return encoded.decode()


@cache
def _program(*modules: str) -> str:
    """Return modules of the page as one, without the imports among them."""
    text = "\n".join(_EXPORT.sub("", _IMPORT.sub("", _asset(f"web/{name}.js"))) for name in modules)
    return f'"use strict";\n{{\n{text}}}\n'


@cache
def _asset(name: str) -> str:
    return resources.files("pycrorm_async.report").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
