"""What must hold of a URDF before Bullet sees it, because Bullet dies of some faults instead of naming them.

Two roots or two joints of one name end the process inside Bullet; a mesh that is missing is named by Bullet only on
stdout; an origin that is not finite puts links nowhere. So the tree of links, the names, the mesh files and the origins
are checked here; the rest is left to Bullet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

from pycrorm_async.world.errors import DescriptionNotLoadable
from pycrorm_async.world.pose import COORDINATE_MAX

__all__ = ["urdf_text"]


def urdf_text(name: str, description: str | Path) -> str:
    """The URDF as text with every mesh as an absolute path, checked.

    Args:
        name: of the object it is for; only for the message.
        description: URDF text (it begins with "<"), or the path of a .urdf file. `package://x/y` is looked for as
            `x/y` in the folders above the file; other relative names start at the file's folder.

    Raises:
        DescriptionNotLoadable: with the reason.
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
            mesh.set("filename", str(_found(mesh.get("filename", ""), folder)))
    except (ParseError, _Fault) as fault:
        raise DescriptionNotLoadable(name, str(fault)) from fault
    return tostring(robot, encoding="unicode") if meshes else text


class _Fault(Exception):
    """What is wrong; never seen outside, where it becomes a `DescriptionNotLoadable`."""


def _found(reference: str, folder: Path) -> Path:
    """Where a mesh file is; raises `_Fault` if it is nowhere."""
    if reference.startswith("package://"):
        relative = reference.removeprefix("package://")
        places = [above / relative for above in (folder, *folder.parents)]
    else:
        places = [folder / reference.removeprefix("file://")]
    for place in places:
        if place.is_file():
            return place
    raise _Fault(f"mesh {reference} is not at {' nor at '.join(map(str, places[:3]))}")


def _check(robot: Element) -> None:
    """One tree of uniquely named links under <robot>."""
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
        parent, child = _end(joint, "parent"), _end(joint, "child")
        for end in (parent, child):
            if end not in links:
                raise _Fault(f"joint {joint.get('name')!r} names a link {end!r} that is not there")
        if child in above:
            raise _Fault(f"link {child!r} has two parents")
        above[child] = parent
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        raise _Fault(f"it must have one root link, and has {len(roots)}: {', '.join(roots) or 'a circle'}")
    for link in links:
        _climb(link, above)
    for element in robot.iter():
        for value in _numbers(element):
            if not abs(value) <= COORDINATE_MAX:
                raise _Fault(
                    f"<{element.tag}> holds {value:g}; numbers must be finite, and none above {COORDINATE_MAX:g}"
                )


def _numbers(element: Element) -> Iterator[float]:
    """What is given of places and directions; words that are no numbers are Bullet's affair."""
    for word in f"{element.get('xyz', '')} {element.get('rpy', '')}".split():
        try:
            yield float(word)
        except ValueError:
            continue


def _climb(link: str, above: dict[str, str]) -> None:
    passed = {link}
    while link in above:
        link = above[link]
        if link in passed:
            raise _Fault(f"links are joined in a circle at {link!r}")
        passed.add(link)


def _unique(kind: str, names: Iterable[str]) -> None:
    for each, count in Counter(names).items():
        if not each:
            raise _Fault(f"a {kind} has no name")
        if count > 1:
            raise _Fault(f"{count} {kind}s are named {each!r}")


def _end(joint: Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")
