"""Read what was observed as pictures: encoded images, arrays as images or depth maps, arrays and PCD files as points.

An observation refers to its large contents as blobs (`Blob`, arrays of more than 64 elements). `contents_in` finds the
references, `kind_of` says what a content can be shown as, and the others read it. What cannot be read raises
`ValueError` with the reason. Pillow is needed only to make a large encoded image smaller.
"""

import asyncio
import io
import struct
import warnings
import zlib
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import PycrormError
from pycrorm_async.events.types import BLOB_KEY, Observed
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.record.camera import image_type as image_type
from pycrorm_async.record.values import NPY
from pycrorm_async.store.log import EventLog

Kind = Literal["image", "depth", "points"]

_PCD_TYPES: Final = ("application/pcd", "application/x-pcd", "model/pcd", "text/x-pcd", "image/x-pcd")
_SMALL_BYTES: Final = 12_000
"""An encoded image of at most so many bytes is its own thumbnail."""
_ITEMS_MAX: Final = 8
"""Bounds the numbers of a list that have curves: as many as a wrench, a quaternion or the joints of an arm have."""
_SIDE_LEAST: Final = 8
"""A table with fewer rows or columns is shown as numbers, not as a picture."""
_COLUMNS_OF_POINTS: Final = range(3, 8)
_PIXELS_MAX: Final = 50_000_000
"""Bounds the pixels of an encoded image that is decoded, because a small file can claim any number of them."""
_HEADER_MAX: Final = 4_096
"""Bounds the header of a PCD file."""
_POINTS_MAX: Final = 20_000_000
_FARTHEST_M: Final = 1e6
"""Points that are farther from the origin along an axis are left out, because 32 bits hold no millimetres there."""
_CHANNELS: Final = {1: 0, 3: 2, 4: 6}
"""PNG's colour types by the number of channels."""
_VIRIDIS: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Colours from near to far: five anchors of matplotlib's map viridis (CC0), whose lightness rises evenly."""


class Content(NamedTuple):
    """A content of an observation.

    Attributes:
        path: keys and indices that lead to it, joined by dots; empty if it is the whole observation.
        hash, media_type, size: of its blob.
        around: the entries beside it, such as the `encoding` of an image or the `pose` of a point cloud.
    """

    path: str
    hash: str
    media_type: str
    size: int
    shape: tuple[int, ...] | None
    dtype: str | None
    around: Mapping[str, Any]

    @property
    def kind(self) -> Kind | None:
        """What it can be shown as, by its media type and its shape; None for anything else."""
        if self.media_type.startswith("image/") and self.media_type not in _PCD_TYPES:
            return "image"
        if self.media_type in _PCD_TYPES:
            return "points"
        return None if self.media_type != NPY or self.shape is None else _kind_of(self.shape, self.dtype or "")


def _kind_of(shape: tuple[int, ...], dtype: str) -> Kind | None:
    is_table = len(shape) == 2
    if is_table and shape[1] in _COLUMNS_OF_POINTS and dtype.startswith("float"):
        return "points"
    if min(shape[:2], default=0) < _SIDE_LEAST:
        return None
    if is_table:
        return "image" if dtype == "uint8" else "depth"
    return "image" if len(shape) == 3 and shape[2] in _CHANNELS and dtype == "uint8" else None


def contents_in(values: Any, path: str = "", around: Mapping[str, Any] | None = None) -> Iterator[Content]:
    """Yield the contents that the values of an observation refer to."""
    if isinstance(values, Mapping):
        match values:
            case {"$blob": str() as name, "media_type": str() as media_type, "size": int() as size}:
                shape, dtype = values.get("shape"), values.get("dtype")
                described = tuple(map(int, shape)) if shape else None
                yield Content(path, name, media_type, size, described, dtype, around or {})
                return
        for key, each in values.items():
            yield from contents_in(each, f"{path}.{key}" if path else key, values)
    elif isinstance(values, list):
        for index, each in enumerate(values):
            yield from contents_in(each, f"{path}.{index}" if path else str(index))


def numbers_in(name: str, values: Any) -> list[tuple[str, float]]:
    """Return the numbers of an observation, two levels deep, by name."""
    if isinstance(values, bool):
        return []
    if isinstance(values, int | float):
        return [(name, float(values))]
    if isinstance(values, dict) and BLOB_KEY not in values and name.count(".") < 2:
        return [pair for key, each in values.items() for pair in numbers_in(f"{name}.{key}", each)]
    if isinstance(values, list) and len(values) <= _ITEMS_MAX and name.count(".") < 2:
        return [pair for index, each in enumerate(values) for pair in numbers_in(f"{name}.{index}", each)]
    return []


# === images ===================================================================================================


def array_of(content: bytes) -> NDArray[Any]:
    """Return a recorded array. Raises `ValueError`."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # noqa: BLE001  numpy raises many kinds for a header that is damaged
        raise ValueError(f"it is no array: {error}") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("it is no array of numbers")
    return array


def pixels_of(content: Content, data: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a recorded array, height x width x channels. Raises `ValueError`.

    A depth map is coloured.
    """
    array = array_of(data)
    kind = _kind_of(array.shape, str(array.dtype))
    if kind == "depth":
        return colored(array)
    if kind != "image":
        raise ValueError(f"an array of shape {array.shape} is no image")
    pixels = array.reshape(*array.shape[:2], -1)
    is_bgr = pixels.shape[2] > 1 and str(content.around.get("encoding", "")).startswith("bgr")
    return pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]] if is_bgr else pixels


def range_of(depth: NDArray[Any]) -> tuple[float, float]:
    """Return the least and the greatest finite value of an array. Raises `ValueError` if it has none."""
    finite = depth[np.isfinite(depth)]
    if not finite.size:
        raise ValueError("it has no finite number")
    return float(finite.min()), float(finite.max())


def colored(depth: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the pixels of a depth map: dark blue is the least value, yellow the greatest, black what is not finite."""
    low, high = range_of(depth)
    share = (depth.astype(np.float32) - np.float32(low)) / np.float32((high - low) or 1.0)
    levels = (np.clip(np.nan_to_num(share, nan=0.0), 0, 1) * 255).round().astype(np.uint8)
    anchors = np.array(_VIRIDIS, float)
    at = np.linspace(0, 1, len(anchors))
    table = np.stack([np.interp(np.linspace(0, 1, 256), at, anchors[:, each]) for each in range(3)], axis=-1)
    pixels: NDArray[np.uint8] = table.round().astype(np.uint8)[levels]  # a map may have 64 million values
    pixels[~np.isfinite(depth)] = 0
    return pixels


def smaller(pixels: NDArray[Any], side: int) -> NDArray[Any]:
    """Return every n-th pixel, so that neither side is longer than `side`."""
    step = max(1, -(-max(pixels.shape[:2]) // side))
    return pixels[::step, ::step]


def png_of(pixels: NDArray[np.uint8], level: int = 6) -> bytes:
    """Encode pixels, height x width x 1, 3 or 4 channels, as PNG (ISO/IEC 15948)."""
    height, width, channels = pixels.shape
    header = struct.pack(">IIBBBBB", width, height, 8, _CHANNELS[channels], 0, 0, 0)
    rows = np.zeros((height, 1 + width * channels), np.uint8)  # each begins with its filter: none
    rows[:, 1:] = pixels.reshape(height, -1)
    body = zlib.compress(rows.tobytes(), level)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(each)) + name + each + struct.pack(">I", zlib.crc32(name + each)) for name, each in chunks
    )


def rgb_of(content: Content, data: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a content of the kind `image`, height x width x 3, without opacity.

    Raises `ValueError` for what is no image, and for one of 16 bits, which holds depths; `ImportError` without Pillow
    for an encoded one.
    """
    if not content.media_type.startswith("image/"):
        pixels = pixels_of(content, data)
        return np.ascontiguousarray(
            np.broadcast_to(pixels, (*pixels.shape[:2], 3)) if pixels.shape[2] == 1 else pixels[..., :3]
        )
    from PIL import Image

    try:
        opened = _opened(data)
        if opened.mode[0] in "IF":
            raise ValueError("it has 16 bits a pixel, as depths have")
        return np.asarray(opened.convert("RGB"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"it cannot be decoded: {error}") from None


def resized(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return pixels, height x width x 3, scaled to a width and a height. Needs Pillow."""
    from PIL import Image

    return np.asarray(Image.fromarray(pixels).resize(size))


def _opened(data: bytes) -> Any:
    """Return an encoded image, not yet decoded, as Pillow has it. Raises `ValueError` for too many pixels."""
    from PIL import Image

    image_type(data)
    with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
        opened = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "GIF", "WEBP"))
    if opened.width * opened.height > _PIXELS_MAX:
        raise ValueError(f"it has {opened.width} x {opened.height} pixels, more than {_PIXELS_MAX:,}")
    return opened


def jpeg_of(image: bytes | NDArray[np.uint8], side: int) -> bytes:
    """Return a smaller JPEG of an encoded image or of pixels; one of 16 bits is coloured as a depth map.

    Raises `ValueError` for what is no image, and for one of more than 50 million pixels; `ImportError` without Pillow.
    """
    from PIL import Image

    try:
        if isinstance(image, bytes):
            opened = _opened(image)
            opened.draft("RGB", (side, side))
            if opened.mode[0] == "I":  # 16 bits are the depths of a camera
                opened = Image.fromarray(colored(smaller(np.asarray(opened), side)))
        else:
            opened = Image.fromarray(image[..., 0] if image.shape[2] == 1 else image)
        opened.thumbnail((side, side))
        file = io.BytesIO()
        opened.convert("RGB").save(file, "JPEG", quality=72)
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"it cannot be decoded: {error}") from None
    return file.getvalue()


PICTURES_MAX: Final = 24
"""Bounds the pictures of a task tree or a moment, which a notebook keeps with the cell."""
_PICTURE_SIDE: Final = 160
_CONTENT_MAX: Final = 64_000_000
"""Bounds the bytes of a content that is read for a picture of it."""


class ObservedPicture(NamedTuple):
    """A picture of what was observed.

    Attributes:
        node, sequence: the id of the node that observed it, and the event.
        name: of the observation, and the path in it.
        address: of a `data:` URL with the picture; empty if there is none.
        text: the range of a depth map; without an address, the reason.
    """

    node: int | None
    sequence: int
    name: str
    address: str
    text: str


def picture_of(content: Content, data: bytes, side: int, room: int = 0) -> tuple[str, int, str]:
    """Return a `data:` URL with a picture of a content, its size in bytes, and a text about it.

    It is whole if it takes at most `room` bytes, or is a small file; else its longer side has at most `side` pixels.
    The text is `whole`, or the range of a depth map, or both. Raises `ValueError` with the reason if there is none.
    """
    if content.media_type.startswith("image/"):
        media_type, text = image_type(data), ""
        if len(data) <= max(_SMALL_BYTES, room):
            made, text = data, "whole"
        else:
            media_type, made = "image/jpeg", _small_jpeg(data, side)
    else:
        array = array_of(data)
        is_depth = _kind_of(array.shape, str(array.dtype)) == "depth"
        pixels = pixels_of(content, data)
        low, high = range_of(array)
        text = f"{low:.4g} to {high:.4g}" if is_depth else ""
        if pixels.nbytes <= room:
            media_type, made = "image/png", png_of(pixels)
            text = ", ".join(filter(None, ("whole", text)))
        elif is_depth:
            media_type, made = "image/png", png_of(smaller(pixels, side // 2))
        else:
            media_type, made = "image/jpeg", _small_jpeg(pixels, side)
    return f"data:{media_type};base64,{b64encode(made).decode()}", len(made), text


def _small_jpeg(image: bytes | NDArray[np.uint8], side: int) -> bytes:
    try:
        return jpeg_of(image, side)
    except ImportError:
        raise ValueError("a smaller one needs Pillow: pip install 'pycrorm-async[pictures]'") from None


async def read_content(log: EventLog, content: Content) -> bytes:
    """Return the bytes of a content. Raises `ValueError` for one that is missing or too large to be shown."""
    if content.size > _CONTENT_MAX:
        raise ValueError(f"it has {content.size:,} bytes, more than {_CONTENT_MAX:,}")
    with log.translated():
        data = await log.blobs.read_blob(content.hash)
    if data is None:
        raise ValueError("its content is not in the log")
    return data


async def read_pictures(
    log: EventLog, episode: int, observed: Sequence[tuple[str, int, int | None]]
) -> tuple[ObservedPicture, ...]:
    """Return pictures of observations of an episode, given by name, event and node; of many every n-th of each name."""
    pictures: list[ObservedPicture] = []
    chosen = sorted(observed, key=lambda each: each[:2])[:: -(-len(observed) // PICTURES_MAX) or 1]
    for name, sequence, node in sorted(chosen, key=lambda each: each[1]):
        for stored in await log.events(episode, after=sequence - 1, limit=1):
            try:
                happening = happening_of(stored)
            except PycrormError as fault:
                pictures.append(ObservedPicture(node, sequence, name, "", str(fault)))
                continue
            for each in contents_in(happening.values) if isinstance(happening, Observed) else ():
                if each.kind in ("image", "depth") and len(pictures) < PICTURES_MAX:
                    try:
                        data = await read_content(log, each)
                        address, _, text = await asyncio.to_thread(picture_of, each, data, _PICTURE_SIDE)
                    except ValueError as reason:
                        address, text = "", str(reason)
                    pictures.append(ObservedPicture(node, sequence, f"{name} {each.path}".rstrip(), address, text))
    return tuple(pictures)


# === point clouds =============================================================================================


def points_of(content: Content, data: bytes) -> NDArray[np.float32]:
    """Return the finite points of a cloud, n x 3, m. Raises `ValueError`.

    A `pose` (`PoseValue`) beside the cloud is the place of its frame, so that the points are in that of the pose.
    """
    table = _pcd(data) if content.media_type in _PCD_TYPES else array_of(data)
    if table.ndim != 2 or table.shape[1] < 3:
        raise ValueError(f"an array of shape {table.shape} has no points")
    points = table[:, :3].astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    match content.around.get("pose"):
        case {"position": [_, _, _] as position, "orientation": [_, _, _, _] as orientation}:
            try:
                place, (*axis, w) = np.array(position, float), np.array(orientation, float)
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"the pose beside it has no numbers: {error}") from None
            turned = np.cross(axis, points)
            points = points + 2 * (w * turned + np.cross(axis, turned)) + place
    return points[(np.abs(points) < _FARTHEST_M).all(axis=1)].astype(np.float32)


def _pcd(data: bytes) -> NDArray[Any]:
    """Return x, y and z of a file of the Point Cloud Library, format 0.7, as text or binary. Raises `ValueError`."""
    head = data[:_HEADER_MAX]
    begin = head.find(b"\nDATA ")
    end = head.find(b"\n", begin + 1)
    if begin < 0 or end < 0:
        raise ValueError("it has no header of a PCD file")
    lines = [each.split() for each in head[:begin].decode("latin-1").splitlines() if not each.startswith("#")]
    fields = {name: rest for name, *rest in filter(None, lines)}
    try:
        counts = [int(each) for each in fields.get("COUNT", ["1"] * len(fields["FIELDS"]))]
        kinds = [f"<{kind.lower()}{size}" for kind, size in zip(fields["TYPE"], fields["SIZE"], strict=True)]
        described = list(zip(fields["FIELDS"], kinds, [(each,) for each in counts], strict=True))
        number = _counted(int(fields["POINTS"][0]))
        places = [fields["FIELDS"].index(axis) for axis in "xyz"]
        form, body = head[begin + 6 : end].strip(), data[end + 1 :]
        if form == b"ascii":
            columns = [sum(counts[:each]) for each in places]
            rows = [line.split() for line in body.decode("latin-1").splitlines()[:number] if line.strip()]
            return np.array([[float(row[each]) for each in columns] for row in rows]).reshape(-1, 3)
        _refuse_other_forms(form)
        names = [(f"{index}", kind, count) for index, (_, kind, count) in enumerate(described)]
        records = np.frombuffer(body, np.dtype(names), count=min(number, len(body) // np.dtype(names).itemsize))
        return np.stack([records[str(each)][:, 0].astype(np.float64) for each in places], axis=1)
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ValueError(f"it is no PCD file that can be read: {error}") from None


def _counted(number: int) -> int:
    if not 0 <= number <= _POINTS_MAX:
        raise ValueError(f"it has {number:,} points, more than {_POINTS_MAX:,}")
    return number


def _refuse_other_forms(form: bytes) -> None:
    if form != b"binary":
        raise ValueError(f"its data are {form.decode('latin-1')[:40]}, and only ascii and binary are read")
