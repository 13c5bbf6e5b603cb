"""Read a URDF once for every use: its links, joints and shapes, and the frames to which the joints lead.

A `Model` is what this package understands of a URDF: engines load it (`world.engines`), chains, descriptions of
robots, boxes, pages and exports are computed from it. Each number is parsed or refused with its element and its word,
and each element that has no effect is named in `Model.left_out`.

>>> model = read_model(urdf)
>>> along(model.path("l_gripper_tool_frame"), {"torso_lift_joint": 0.1})  # the tool in the root link

A joint with <mimic> follows its leader: its position is multiplier * leader + offset wherever the leader's position is
known. A continuous joint is endless whatever its <limit> says; <limit> without lower and upper means 0 and 0. An axis
has length one. A floating or planar joint does not move.
"""

import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring
from xml.sax.saxutils import quoteattr

from pycrorm_async.errors import CallerError
from pycrorm_async.world import pose as poses

Triple = tuple[float, float, float]


class UrdfFault(ValueError):
    """A URDF cannot be read; the message names the element and the word."""


class Bounds(NamedTuple):
    """The closed range of a joint; infinite for a continuous one."""

    lower: float
    upper: float


ENDLESS = Bounds(-math.inf, math.inf)


class Mimic(NamedTuple):
    """The leader of a joint, which follows no other joint, and the line on which the follower's position lies."""

    joint: str
    multiplier: float
    offset: float


class Joint(NamedTuple):
    """One joint; `kind` is FIXED if it cannot move."""

    name: str
    kind: poses.JointType
    parent: str
    child: str
    origin: poses.Pose
    rpy: Triple
    """The rotation of `origin` as the model has it, which no conversion rounds."""
    axis: poses.Vector
    """Of length one, in the child's frame."""
    bounds: Bounds
    mimic: Mimic | None = None
    soft: Bounds | None = None
    """The soft limits of <safety_controller>."""

    def position(self, positions: Mapping[str, float]) -> float:
        """Return the joint's position; joints that are left out are at 0, and followers where their leader is."""
        if self.kind is poses.JointType.FIXED:
            return 0.0
        if self.mimic is not None and (self.mimic.joint in positions or self.name not in positions):
            return positions.get(self.mimic.joint, 0.0) * self.mimic.multiplier + self.mimic.offset
        return positions.get(self.name, 0.0)

    @property
    def moves_freely(self) -> bool:
        """Whether the joint moves and follows no other."""
        return self.kind is not poses.JointType.FIXED and self.mimic is None


class Shape(NamedTuple):
    """One shape of a link: box (three edges), cylinder or capsule (radius, length), sphere (radius), mesh (scale)."""

    kind: str
    sizes: tuple[float, ...]
    file: str
    """The name of the mesh file; empty for other kinds."""
    xyz: Triple
    rpy: Triple
    color: tuple[float, ...] | None


class Link(NamedTuple):
    """The shapes and the mass of a link."""

    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]
    mass_kg: float | None


@dataclass(frozen=True, eq=False)
class Model:
    """The links and joints of a URDF, each by its name in the order of the file.

    Attributes:
        root: the first link without a joint above it.
        left_out: elements without an effect on poses or shapes that they should have, with their reasons.
        unapplied: standard elements that a kinematic world does not use, with their number.
        unlimited: joints that need limits and have none.
    """

    name: str
    root: str
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    left_out: tuple[str, ...]
    unapplied: Mapping[str, int]
    unlimited: tuple[str, ...]

    @cached_property
    def paths(self) -> Mapping[str, tuple[Joint, ...]]:
        """For each link the joints from the root to it; parents before their children."""
        below: dict[str, list[Joint]] = {}
        for joint in self.joints.values():
            below.setdefault(joint.parent, []).append(joint)
        paths: dict[str, tuple[Joint, ...]] = {self.root: ()}
        pending = [self.root]
        for link in pending:
            for joint in below.get(link, ()):
                if joint.child not in paths:
                    paths[joint.child] = (*paths[link], joint)
                    pending.append(joint.child)
        return paths

    def path(self, link: str) -> tuple[Joint, ...]:
        """Return the joints from the root to a link (empty: the root). Raises `CallerError` for an unknown link."""
        if link and link not in self.paths:
            raise CallerError(f"the model {self.name!r} has no link {link!r}: correct the robot's description")
        return self.paths[link or self.root]

    def divided(self, base_link: str, tool_link: str) -> tuple[tuple[Joint, ...], tuple[Joint, ...]]:
        """Return the joints from the root to the base link (empty: the root), and those from there to the tool.

        Raises `CallerError` if the model has no such links, or the tool link is not below the base link.
        """
        above, path = self.path(base_link), self.path(tool_link)
        if path[: len(above)] != above:
            raise CallerError(f"{tool_link!r} is not below {base_link!r}: correct the robot's description")
        return above, path[len(above) :]

    def below(self, link: str) -> tuple[Joint, ...]:
        """Return the joints that a link carries, parents first."""
        above = self.path(link)
        return tuple(path[-1] for path in self.paths.values() if len(path) > len(above) and path[: len(above)] == above)

    @property
    def mass_kg(self) -> float | None:
        """The sum of the masses of all links; None if no link has one, or if it is 0: the model leaves them out."""
        mass = sum(link.mass_kg or 0.0 for link in self.links.values())
        return mass if 0 < mass < math.inf else None


def along(joints: Sequence[Joint], positions: Mapping[str, float]) -> poses.Pose:
    """Return the frame of the last joint's child link in the first joint's parent link, at these positions."""
    x = y = z = 0.0
    turn = poses.Quaternion(0.0, 0.0, 0.0, 1.0)
    for each in joints:
        step = poses.rotated(turn, each.origin.position)
        x, y, z, turn = x + step.x, y + step.y, z + step.z, poses.product(turn, each.origin.orientation)
        position = each.position(positions)
        if each.kind is poses.JointType.PRISMATIC:
            step = poses.rotated(turn, [position * along for along in each.axis])
            x, y, z = x + step.x, y + step.y, z + step.z
        elif position:
            turn = poses.product(turn, about(each.axis, position))
    return poses.Pose((x, y, z), turn)


def about(axis: Sequence[float], angle: float) -> poses.Quaternion:
    """Return the rotation by an angle, rad, about an axis of length one."""
    x, y, z = axis
    sine = math.sin(angle / 2)
    return poses.Quaternion(x * sine, y * sine, z * sine, math.cos(angle / 2))


def origin(xyz: Sequence[float], rpy: Sequence[float]) -> poses.Pose:
    """Return the pose at a position, turned by roll, pitch and yaw as in URDF."""
    roll, pitch, yaw = rpy
    return poses.Pose(
        xyz, poses.product(poses.product(about((0, 0, 1), yaw), about((0, 1, 0), pitch)), about((1, 0, 0), roll))
    )


# === writing ==================================================================================================


def joint_lines(joint: Joint) -> list[str]:
    """Return the element of a joint, without <mimic>, a tag a line.

    A revolute joint without limits is continuous; other infinite limits are `COORDINATE_MAX`.
    """
    lower, upper = (min(max(each, -poses.COORDINATE_MAX), poses.COORDINATE_MAX) for each in joint.bounds)
    endless = joint.kind is poses.JointType.REVOLUTE and math.isinf(joint.bounds.upper - joint.bounds.lower)
    return [
        f"<joint name={quoteattr(joint.name)} type='{'continuous' if endless else joint.kind.name.lower()}'>",
        f"<parent link={quoteattr(joint.parent)}/>",
        f"<child link={quoteattr(joint.child)}/>",
        f"<origin xyz='{digits(joint.origin.position)}' rpy='{digits(joint.rpy)}'/>",
        f"<axis xyz='{digits(joint.axis)}'/>",
        f"<limit lower='{lower!r}' upper='{upper!r}' effort='100' velocity='3'/>",
        "</joint>",
    ]


def digits(numbers: Sequence[float]) -> str:
    """Return the numbers with all their digits, as an attribute has them."""
    return " ".join(repr(float(each)) for each in numbers)


# === files ====================================================================================================


def urdf_text(name: str, description: str | Path, packages: Mapping[str, str | Path] = MappingProxyType({})) -> str:
    """Read and check a URDF and return its text with the absolute path of every mesh that exists.

    Args:
        name: the object's name, used in the error message, and for the link of a mesh file.
        description: URDF text (it begins with "<"), the path of a .urdf file, or that of a mesh file, which becomes an
            object of one link.
        packages: folders of ROS packages by their names.

    `package://x/y` is searched in the folder `packages["x"]`, as `x/y` in the file's folder and those above it, in the
    one of them whose package.xml has that name, and in the packages that ROS_PACKAGE_PATH and AMENT_PREFIX_PATH list.
    Other relative names start at the file's folder. For URDF text, which has no file, the current folder takes that
    place. A name may be percent-encoded.

    Raises:
        DescriptionNotLoadable: the URDF has a fault, which the message names. Two roots or two joints of one name would
            end the process inside Bullet.
    """
    is_text = isinstance(description, str) and description.lstrip(_BEFORE).startswith("<")
    if not is_text and not isinstance(description, str | os.PathLike):
        raise poses.DescriptionNotLoadable(name, f"it must be URDF text or a path, got {description!r:.100}")
    path, place = Path() if is_text else Path(description), "" if is_text else f"{description}: "
    try:
        if is_text:
            text, folder = str(description), Path.cwd()
        elif path.suffix.lower() in MESH_SUFFIXES:
            text, folder = _around_mesh(name, path.resolve()), path.resolve().parent
        else:
            text, folder = _decoded(path.read_bytes()), path.resolve().parent
    except (OSError, ValueError) as reason:
        raise poses.DescriptionNotLoadable(name, f"{path} cannot be read: {reason}") from reason
    try:
        robot, is_repaired = _parsed(text)
        _check_tree(robot)
        meshes = [*robot.iter("mesh")]
        missing: list[UrdfFault] = []
        for link in robot.findall("link"):
            for kind in ("visual", "collision"):
                for mesh in link.iterfind(f"{kind}/geometry/mesh"):
                    try:
                        mesh.set("filename", str(_find_mesh(mesh.get("filename", ""), folder, packages)))
                    except UrdfFault as fault:
                        if kind == "collision":
                            missing.append(UrdfFault(f"collision of link {link.get('name')!r}: {fault}"))
        text = tostring(robot, encoding="unicode") if meshes or is_repaired else text
        unlimited = [UrdfFault(f"joint {each!r} does not specify limits") for each in read_model(text).unlimited]
        for each in (*unlimited, *missing):
            raise each
    except (ParseError, UrdfFault) as fault:
        raise poses.DescriptionNotLoadable(name, f"{place}{fault}") from fault
    return text


MESH_SUFFIXES = (".stl", ".obj", ".dae", ".glb", ".ply", ".off")


def _around_mesh(name: str, path: Path) -> str:
    shape = f"<geometry><mesh filename={quoteattr(str(path))}/></geometry>"
    link = f"<visual>{shape}</visual><collision>{shape}</collision>"
    return f"<robot name={quoteattr(name)}><link name={quoteattr(name)}>{link}</link></robot>"


def _decoded(content: bytes) -> str:
    """Return the text of a file, in UTF-8 unless it is not, whatever its header declares, as URDF parsers read it."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        declared = re.match(rb"\s*<\?xml[^>]*encoding=[\"']([\w.-]+)", content)
        name = declared[1].decode() if declared else "latin-1"
        return content.decode("latin-1" if name.lower().startswith("utf") else name)


def _find_mesh(reference: str, folder: Path, packages: Mapping[str, str | Path]) -> Path:
    """Return the path of a mesh file. Raises `UrdfFault` if it does not exist."""
    scheme, mark, rest = reference.partition("://")
    package, _, inside = rest.lstrip("/").partition("/")
    hint = ""
    if mark and scheme in ("package", "model"):
        folders = [folder, *folder.parents]
        places = [Path(packages[package])] if package in packages else [above / package for above in folders]
        named = (above for above in folders if _is_package(above, package))
        groups = places, named, _ros_packages(package)
        candidates: Iterator[Path] = (each / inside for group in groups for each in group)
        hint = "" if package in packages else f"; name its folder with packages={{{package!r}: …}}"
    else:
        candidates = iter([folder / (rest if mark and scheme == "file" else reference)])
    tried: list[str] = []
    for candidate in candidates:
        for path in (candidate, Path(unquote(str(candidate)))):
            if path.is_file():
                return path.absolute()
        tried.append(str(candidate))
    raise UrdfFault(f"mesh {reference} is not at {' nor at '.join(tried[:3])}{hint}")


def _ros_packages(package: str) -> Iterator[Path]:
    """Yield the folders of a package that the variables of ROS list."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / "share" / package
    for place in map(Path, filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))):
        if place.name == package:
            yield place
        yield place / package
        for depth in ("*", "*/*"):  # a workspace with repositories of several packages
            yield from (each.parent for each in place.glob(f"{depth}/{package}/package.xml"))
        for depth in ("*", "*/*", "*/*/*"):  # a folder may have another name than its package
            yield from (each.parent for each in place.glob(f"{depth}/package.xml") if _is_package(each.parent, package))


def _is_package(folder: Path, name: str) -> bool:
    """Return whether a folder has a package.xml with this name of a package."""
    try:
        text = (folder / "package.xml").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return re.search(rf"<name>\s*{re.escape(name)}\s*</name>", text) is not None


# === parsing ==================================================================================================

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_PREFIX = re.compile(r"(?:</?|\s)([A-Za-z_][\w.-]*):[\w.-]+")
_STRAY = "stray:"


def parsed_urdf(text: str) -> Element:
    """Parse the text of a URDF, also with what other programs accept. Raises `ParseError`.

    These are white space before the header, zeros at the end, prefixes that no element declares, a default namespace,
    and `--` within a comment.
    """
    return _parsed(text)[0]


def parsed_srdf(name: str, srdf: str | Path) -> Element:
    """Parse an SRDF, its text or the path of its file. Raises `CallerError`."""
    try:
        is_text = isinstance(srdf, str) and srdf.lstrip(_BEFORE).startswith("<")
        robot = parsed_urdf(str(srdf) if is_text else _decoded(Path(srdf).read_bytes()))
        _check_expanded(robot)
        if robot.tag != "robot":
            raise UrdfFault(f"its root element is <{robot.tag}>, not <robot>")
    except (OSError, SyntaxError, ValueError) as fault:
        raise CallerError(f"the SRDF of {name!r} cannot be read: {fault}") from fault
    return robot


_BEFORE = "\ufeff \t\r\n"
"""What may stand before the first element."""


def _parsed(text: str) -> tuple[Element, bool]:
    """Return the root element, and whether a plain parser refuses the text or reads other elements."""
    stripped = text.strip(_BEFORE + "\x00")
    try:
        robot, is_repaired = fromstring(stripped), stripped != text.rstrip()  # noqa: S314  the caller's own file, or recorded
    except ParseError:
        bare = _COMMENT.sub("", stripped)
        declared = {*re.findall(r"xmlns:([\w.-]+)", bare), "xml", "xmlns"}
        names = sorted({*_PREFIX.findall(bare)} - declared)
        declarations = "".join(f' xmlns:{each}="{_STRAY}{each}"' for each in names)
        root = re.compile(r"<[A-Za-z_][\w.:-]*")
        robot, is_repaired = fromstring(root.sub(lambda tag: tag[0] + declarations, bare, count=1)), True  # noqa: S314
    namespace, mark, _ = robot.tag.rpartition("}")
    if mark:
        is_repaired = True
        for each in robot.iter():
            if isinstance(each.tag, str):
                each.tag = each.tag.removeprefix(namespace + mark)
    return robot, is_repaired


def _check_tree(robot: Element) -> None:
    """Raise `UrdfFault` unless <robot> holds one tree of links with unique names."""
    if robot.tag != "robot":
        raise UrdfFault(f"its root element is <{robot.tag}>, not <robot>")
    _check_expanded(robot)
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = robot.findall("joint")
    if not links:
        raise UrdfFault("it has no link")
    _unique("link", links)
    _unique("joint", [joint.get("name", "") for joint in joints])
    names = set(links)
    above: dict[str, str] = {}
    for joint in joints:
        parent, child = _joined_link(joint, "parent"), _joined_link(joint, "child")
        for end in (parent, child):
            if end not in names:
                raise UrdfFault(f"joint {joint.get('name')!r} names a link {end!r} that does not exist")
        if child in above:
            raise UrdfFault(f"link {child!r} has two parents")
        above[child] = parent
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        raise UrdfFault(f"it must have one root link, and has {len(roots)}: {', '.join(roots) or 'a cycle'}")
    for link in links:
        passed = [link]
        while passed[-1] in above:
            passed.append(above[passed[-1]])
            if len(passed) > len(links):
                raise UrdfFault(f"links are joined in a cycle at {link!r}")


def _check_expanded(robot: Element) -> None:
    """Raise `UrdfFault` if this is the source of a URDF, in which xacro has elements to expand.

    Without the namespace xacro could not read the file either, so that a stray element is only left out.
    """
    for each in robot.iter():
        namespace, mark, tag = str(each.tag).rpartition("}")
        if mark and "xacro" in namespace and not namespace[1:].startswith(_STRAY) and tag not in ("property", "arg"):
            raise UrdfFault(f"it holds <xacro:{tag}>: expand it with xacro")


def _unique(kind: str, names: Iterable[str]) -> None:
    for each, count in Counter(names).items():
        if not each:
            raise UrdfFault(f"a {kind} has no name")
        if count > 1:
            raise UrdfFault(f"{count} {kind}s are named {each!r}")


def _joined_link(joint: Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


# === reading ==================================================================================================

_KINDS = {
    "revolute": poses.JointType.REVOLUTE,
    "continuous": poses.JointType.CONTINUOUS,
    "prismatic": poses.JointType.PRISMATIC,
    "fixed": poses.JointType.FIXED,
    "floating": poses.JointType.FIXED,
    "planar": poses.JointType.FIXED,
}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(inf|infinity|nan)", re.IGNORECASE | re.ASCII)
_SIZES = {
    "box": (("size", 3),),
    "cylinder": (("radius", 1), ("length", 1)),
    "capsule": (("radius", 1), ("length", 1)),
    "sphere": (("radius", 1),),
}
_CHECKED = {
    "limit": ("effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "calibration": ("rising", "falling", "reference_position"),
    "safety_controller": ("k_position", "k_velocity"),
}
"""Numbers that are read only to refuse other words."""
_UNAPPLIED = ("dynamics", "calibration", "transmission", "gazebo", "sensor")
_ZERO: Triple = (0.0, 0.0, 0.0)


@lru_cache(maxsize=64)
def read_model(text: str) -> Model:
    """Return the model of a URDF. Raises `UrdfFault` for a word where a number belongs, `ParseError`."""
    robot = parsed_urdf(text)
    if robot.tag != "robot":
        raise UrdfFault(f"its root element is <{robot.tag}>, not <robot>")
    left_out: list[str] = []
    colors: dict[str, tuple[float, ...]] = {}
    for each in robot.iter("material"):
        color = _rgba(each, f"material {each.get('name', '')!r}")
        if color is not None:
            colors.setdefault(each.get("name", ""), color)
    links = {each.get("name", ""): _link(each, colors, left_out) for each in robot.findall("link")}
    unlimited: list[str] = []
    joints = {each.get("name", ""): _joint(each, left_out, unlimited) for each in robot.findall("joint")}
    joints = {name: _following(joint, joints, left_out) for name, joint in joints.items()}
    children = {joint.child for joint in joints.values()}
    root = next((link for link in links if link not in children), None)
    if root is None:
        raise UrdfFault("it has no root link")
    tags = [str(each.tag).removeprefix("{" + _STRAY).replace("}", ":") for each in robot.iter()]
    unapplied = Counter(tag for tag in tags if tag in _UNAPPLIED or ":" in tag)
    return Model(robot.get("name", ""), root, links, joints, tuple(left_out), unapplied, tuple(unlimited))


def _link(link: Element, colors: Mapping[str, tuple[float, ...]], left_out: list[str]) -> Link:
    owner = f"link {link.get('name', '')!r}"
    mass = None
    for inertial in link.findall("inertial"):
        _origin(inertial, f"{owner} inertial")
        for each in inertial.findall("inertia"):
            for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
                _number(each, name, owner, 0.0)
        for each in inertial.findall("mass"):
            mass = _number(each, "value", owner, 0.0)
    shapes = {
        kind: tuple(
            shape
            for each in link.findall(kind)
            if (shape := _shape(each, f"{owner} {kind}", colors, left_out)) is not None
        )
        for kind in ("collision", "visual")
    }
    return Link(shapes["collision"], shapes["visual"], mass)


def _shape(element: Element, owner: str, colors: Mapping[str, tuple[float, ...]], left_out: list[str]) -> Shape | None:
    xyz, rpy = _origin(element, owner)
    material = element.find("material")
    color = None if material is None else _rgba(material, owner) or colors.get(material.get("name", ""))
    shape = next(iter(element.iterfind("geometry/*")), None)
    if shape is None:
        left_out.append(f"{owner}: it has no geometry")
        return None
    file = shape.get("filename", "") if shape.tag == "mesh" else ""
    if shape.tag == "mesh":
        sizes = _numbers(shape, "scale", 3, owner, (1.0, 1.0, 1.0))
    elif shape.tag in _SIZES:
        sizes = tuple(number for name, count in _SIZES[shape.tag] for number in _numbers(shape, name, count, owner))
    else:
        left_out.append(f"{owner}: <{shape.tag}> is no shape of URDF")
        return None
    if not all(map(math.isfinite, sizes)):
        raise UrdfFault(f"{owner}: <{shape.tag}> holds {[*sizes]}; numbers must be finite")
    return Shape(shape.tag, sizes, file, xyz, rpy, color)


def _joint(element: Element, left_out: list[str], unlimited: list[str]) -> Joint:
    name, word = element.get("name", ""), element.get("type", "")
    owner = f"joint {name!r}"
    if word not in _KINDS:
        raise UrdfFault(f"{owner} has the type {word!r}; types are {', '.join(_KINDS)}")
    kind = _KINDS[word]
    if word in ("floating", "planar"):
        left_out.append(f"{owner}: its type {word} does not move here")
    xyz, rpy = _origin(element, owner)
    axis, limit, mimic, safety = (element.find(tag) for tag in ("axis", "limit", "mimic", "safety_controller"))
    direction = (1.0, 0.0, 0.0) if axis is None else _numbers(axis, "xyz", 3, owner, (1.0, 0.0, 0.0))
    length = math.hypot(*direction)
    if not 0 < length < math.inf and kind is not poses.JointType.FIXED:
        raise UrdfFault(f'{owner}: <axis xyz="{" ".join(map(str, direction))}"> has no direction')
    x, y, z = (each / (length or 1.0) for each in direction)
    for each in element:
        for attribute in _CHECKED.get(str(each.tag), ()):
            _number(each, attribute, owner, 0.0)
    follows = soft = None
    if mimic is not None:
        line = _number(mimic, "multiplier", owner, 1.0), _number(mimic, "offset", owner, 0.0)
        if not all(map(math.isfinite, line)):
            raise UrdfFault(f"{owner}: <mimic> holds {line[0]:g} and {line[1]:g}; numbers must be finite")
        follows = Mimic(mimic.get("joint", ""), *line)
    if safety is not None:
        soft = Bounds(_number(safety, "soft_lower_limit", owner, 0.0), _number(safety, "soft_upper_limit", owner, 0.0))
    if limit is None and mimic is None and kind in (poses.JointType.REVOLUTE, poses.JointType.PRISMATIC):
        unlimited.append(name)
    bounds = _bounds(owner, kind, limit, left_out, follows=mimic is not None)
    return Joint(
        name,
        kind,
        _joined_link(element, "parent"),
        _joined_link(element, "child"),
        origin(xyz, rpy),
        rpy,
        poses.Vector(x, y, z),
        bounds,
        follows,
        soft if soft is not None and soft.lower < soft.upper else None,
    )


def _bounds(owner: str, kind: poses.JointType, limit: Element | None, left_out: list[str], *, follows: bool) -> Bounds:
    """Return the limits of a joint; a follower without any gets those of its leader. Raises `UrdfFault`."""
    if limit is None:
        return ENDLESS
    bounds = Bounds(*(_number(limit, each, owner, 0.0) for each in ("lower", "upper")))
    is_empty = not {"lower", "upper"} & {*limit.keys()}
    if kind in (poses.JointType.CONTINUOUS, poses.JointType.FIXED) or (is_empty and follows):
        return ENDLESS
    if bounds.lower > bounds.upper:
        left_out.append(f"{owner}: its limits {bounds.lower:g} to {bounds.upper:g} are none")
        return ENDLESS
    if not abs(min(max(0.0, bounds.lower), bounds.upper)) <= poses.COORDINATE_MAX:
        raise UrdfFault(f"{owner}: <limit> leaves it no position below {poses.COORDINATE_MAX:g}")
    if is_empty:
        left_out.append(f"{owner}: its <limit> has neither lower nor upper, so that it cannot move")
    return bounds


_ROUNDED = 1e-3
"""Limits of leaders and followers, rad or m, that differ by no more are rounded ones."""


def _following(joint: Joint, joints: Mapping[str, Joint], left_out: list[str]) -> Joint:
    """Return the joint with the leader that follows no other, and its limits, if it has none, from those of the leader.

    Raises `UrdfFault` for a leader that does not exist, and for joints that follow each other.
    """
    if joint.mimic is None:
        return joint
    leader, multiplier, offset = joint.mimic
    passed = {joint.name}
    while True:
        if leader not in joints or leader in passed:
            fault = "follow each other" if leader in passed else f"name a joint {leader!r} that does not exist"
            raise UrdfFault(f"joint {joint.name!r}: <mimic> joints {fault}")
        passed.add(leader)
        above = joints[leader].mimic
        if above is None:
            break
        leader, multiplier, offset = above.joint, multiplier * above.multiplier, multiplier * above.offset + offset
    bounds = joint.bounds
    if joint.kind in (poses.JointType.REVOLUTE, poses.JointType.PRISMATIC) and multiplier:
        lower, upper = sorted(multiplier * each + offset for each in joints[leader].bounds)
        if bounds == ENDLESS:
            bounds = Bounds(lower, upper)
        elif lower < bounds.lower - _ROUNDED or upper > bounds.upper + _ROUNDED:
            left_out.append(
                f"joint {joint.name!r}: its limits {bounds.lower:g} to {bounds.upper:g} do not hold, because it follows"
                f" {leader!r} from {lower:g} to {upper:g}"
            )
    return joint._replace(mimic=Mimic(leader, multiplier, offset), bounds=bounds)


def _rgba(material: Element, owner: str) -> tuple[float, ...] | None:
    color = material.find("color")
    return None if color is None else _numbers(color, "rgba", 4, owner)


def _origin(element: Element, owner: str) -> tuple[Triple, Triple]:
    each = element.find("origin")
    if each is None:
        return _ZERO, _ZERO
    xyz, rpy = _numbers(each, "xyz", 3, owner, _ZERO), _numbers(each, "rpy", 3, owner, _ZERO)
    for value in (*xyz, *rpy):
        if not abs(value) <= poses.COORDINATE_MAX:
            raise UrdfFault(
                f"{owner}: <origin> holds {value:g}; numbers must be finite, and none above {poses.COORDINATE_MAX:g}"
            )
    return xyz, rpy  # type: ignore[return-value]  # three numbers each


def _number(element: Element, attribute: str, owner: str, default: float) -> float:
    return _numbers(element, attribute, 1, owner, (default,))[0]


def _numbers(
    element: Element, attribute: str, count: int, owner: str, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """Return the numbers of an attribute, which white space or commas part. Raises `UrdfFault`."""
    text = element.get(attribute)
    if text is None:
        if default is None:
            raise UrdfFault(f"{owner}: {element.tag} requires a {attribute}")
        return default
    at = f'{owner}: <{element.tag} {attribute}="{text}">'
    hint = ": expand the file with xacro" if "${" in text or "$(" in text else ""
    words = text.replace(",", " ").split()
    try:
        numbers = tuple(map(number_of, words))
    except ValueError as fault:
        raise UrdfFault(f"{at}: {fault}{hint}") from None
    if len(words) != count:
        raise UrdfFault(f"{at} has {len(words)} numbers instead of {count}{hint}")
    if element.tag != "origin" and any(map(math.isnan, numbers)):
        raise UrdfFault(f"{at}: numbers must be finite")
    return numbers


def number_of(word: str) -> float:
    """Return the number that a word is in a URDF; Python accepts more. Raises `ValueError`."""
    if not _NUMBER.fullmatch(word.strip()):
        raise ValueError(f"{word!r} is not a number")
    return float(word)
