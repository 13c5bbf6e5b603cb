"""Check a URDF before Bullet loads it, because some faults crash Bullet instead of raising an error.

Two roots or two joints of one name end the process inside Bullet. Bullet reports a missing mesh only on stdout. An
origin that is not finite gives links poses that are not finite. This module checks the tree of links, the names, the
mesh files and the origins; Bullet checks the rest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

from pycrorm_async.world.errors import DescriptionNotLoadable
from pycrorm_async.world.pose import COORDINATE_MAX


def urdf_text(name: str, description: str | Path) -> str:
    """Read and check a URDF and return its text with the absolute path of every mesh.

    Args:
        name: the object's name, used in the error message only.
        description: URDF text (it begins with "<"), or the path of a .urdf file. `package://x/y` is searched as `x/y`
            in the file's folder and those above it; other relative names start at the file's folder. For URDF text,
            which has no file, the current folder takes that place.

    Raises:
        DescriptionNotLoadable: the URDF has a fault, which the message names.
    """
    if isinstance(description, str) and description.lstrip().startswith("<"):
        text, folder = description, Path.cwd()
    else:
        path = Path(description)
        try:
            text, folder = path.read_text(encoding="utf-8"), path.resolve().parent
        except (OSError, UnicodeDecodeError, ValueError) as reason:
            raise DescriptionNotLoadable(name, f"{path} cannot be read: {reason}") from reason
    try:
        robot = fromstring(text)  # noqa: S314 the caller's own file, read in the caller's process
        _check(robot)
        meshes = list(robot.iter("mesh"))
        for mesh in meshes:
            mesh.set("filename", str(_find_mesh(mesh.get("filename", ""), folder)))
    except (ParseError, _Fault) as fault:
        raise DescriptionNotLoadable(name, str(fault)) from fault
    return tostring(robot, encoding="unicode") if meshes else text


class _Fault(Exception):
    """A fault of a URDF; `urdf_text` converts it to a `DescriptionNotLoadable`."""


def _find_mesh(reference: str, folder: Path) -> Path:
    """Return the path of a mesh file. Raises `_Fault` if it does not exist."""
    if reference.startswith("package://"):
        relative = reference.removeprefix("package://").lstrip("/")
        candidates = [above / relative for above in (folder, *folder.parents)]
    else:
        candidates = [folder / reference.removeprefix("file://")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise _Fault(f"mesh {reference} is not at {' nor at '.join(map(str, candidates[:3]))}")


def _check(robot: Element) -> None:
    """Raise `_Fault` unless <robot> holds one tree of links, unique names and finite origins."""
    if robot.tag != "robot":
        raise _Fault(f"its root element is <{robot.tag}>, not <robot>")
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = robot.findall("joint")
    if not links:
        raise _Fault("it has no link")
    _unique("link", links)
    _unique("joint", [joint.get("name", "") for joint in joints])
    above: dict[str, str] = {}
    for joint in joints:
        parent, child = joined_link(joint, "parent"), joined_link(joint, "child")
        for end in (parent, child):
            if end not in links:
                raise _Fault(f"joint {joint.get('name')!r} names a link {end!r} that does not exist")
        if child in above:
            raise _Fault(f"link {child!r} has two parents")
        above[child] = parent
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        raise _Fault(f"it must have one root link, and has {len(roots)}: {', '.join(roots) or 'a cycle'}")
    for link in links:
        _climb(link, above)
    for element in robot.iter():
        for value in _numbers(element):
            if not abs(value) <= COORDINATE_MAX:
                raise _Fault(
                    f"<{element.tag}> holds {value:g}; numbers must be finite, and none above {COORDINATE_MAX:g}"
                )


def _numbers(element: Element) -> Iterator[float]:
    """Yield the numbers of the element's origin; Bullet checks words that are not numbers."""
    for word in f"{element.get('xyz', '')} {element.get('rpy', '')}".split():
        try:
            yield float(word)
        except ValueError:
            continue


def _climb(link: str, above: dict[str, str]) -> None:
    """Raise `_Fault` if the links above this one form a cycle."""
    passed = {link}
    while link in above:
        link = above[link]
        if link in passed:
            raise _Fault(f"links are joined in a cycle at {link!r}")
        passed.add(link)


def _unique(kind: str, names: Iterable[str]) -> None:
    for each, count in Counter(names).items():
        if not each:
            raise _Fault(f"a {kind} has no name")
        if count > 1:
            raise _Fault(f"{count} {kind}s are named {each!r}")


def joined_link(joint: Element, end: str) -> str:
    """Return the name of the link at an end of a joint, `parent` or `child`; empty if the joint names none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
