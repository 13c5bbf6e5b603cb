"""Observed contents as pictures: images, depth maps and point clouds, and what is none of them."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pycrorm_async.events.types import BLOB_KEY
from pycrorm_async.query.observed_images import (
    Content,
    array_of,
    colored,
    contents_in,
    image_type,
    pixels_of,
    png_of,
    points_of,
    smaller,
)
from pycrorm_async.record.values import NPY

POINTS = np.array([[1, 2, 3], [np.nan, 0, 0], [1e30, 0, 0], [-1, 0.5, 4]], np.float32)


def npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def reference(media_type: str, array: NDArray[Any] | None = None) -> dict[str, Any]:
    described = {} if array is None else {"dtype": str(array.dtype), "shape": list(array.shape)}
    return {BLOB_KEY: "0" * 64, "media_type": media_type, "size": 3, **described}


def content_of(values: Any) -> Content:
    [content] = contents_in(values)
    return content


def pcd(form: str, body: bytes) -> bytes:
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z\nSIZE 4 4 4 4\nTYPE U F F F\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\n"
    )
    return f"{header}POINTS 4\nDATA {form}\n".encode() + body


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (np.zeros((48, 64, 3), np.uint8), "image"),
        (np.zeros((48, 64), np.uint8), "image"),
        (np.zeros((48, 64), np.float32), "depth"),
        (np.zeros((48, 64), np.uint16), "depth"),
        (np.zeros((500, 3), np.float64), "points"),
        (np.zeros((500, 3), np.int32), None),
        (np.zeros(500), None),
        (np.zeros((48, 64, 5), np.uint8), None),
        (np.zeros((0, 64, 3), np.uint8), None),
    ],
)
def test_an_array_is_an_image_a_depth_map_or_points_by_its_shape(array: NDArray[Any], kind: str | None) -> None:
    assert content_of({"deep": [1, reference(NPY, array)]}).path == "deep.1"
    assert content_of(reference(NPY, array)).kind == kind


def test_a_png_has_the_pixels_and_a_depth_map_its_colours() -> None:
    depth = np.array([[0.5, 1.5], [np.nan, 1.0]], np.float32)
    pixels = colored(depth)
    assert pixels.tolist() == [[[68, 1, 84], [253, 231, 37]], [[0, 0, 0], [33, 145, 140]]]
    encoded = png_of(pixels)
    assert image_type(encoded) == "image/png"
    length = struct.unpack(">I", encoded[33:37])[0]
    assert encoded[37:41] == b"IDAT"
    assert zlib.decompress(encoded[41 : 41 + length]) == b"\0" + pixels[0].tobytes() + b"\0" + pixels[1].tobytes()
    assert smaller(np.zeros((480, 641, 3), np.uint8), 320).shape == (160, 214, 3)


def test_a_dict_that_only_looks_like_a_reference_is_none() -> None:
    assert list(contents_in({BLOB_KEY: "x", "size": 3})) == []
    assert list(contents_in([{BLOB_KEY: 1}, {"a": {BLOB_KEY: None, "media_type": "image/png", "size": 1}}])) == []


def test_pixels_of_bgr_are_turned_to_rgb() -> None:
    image = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    content = content_of({"encoding": "bgr8", "image": reference(NPY, image)})
    assert pixels_of(content, npy(image)).tolist() == image[:, :, ::-1].tolist()


def test_points_of_an_array_and_of_pcd_files_are_the_same_and_are_placed_by_a_pose() -> None:
    finite = [[1, 2, 3], [-1, 0.5, 4]]
    rows = "".join(f"7 {x} {y} {z}\n" for x, y, z in POINTS)
    packed = b"".join(struct.pack("<Ifff", 7, *each) for each in POINTS.tolist())
    for content, data in (
        (content_of(reference(NPY, POINTS)), npy(POINTS)),
        (content_of(reference("application/x-pcd")), pcd("ascii", rows.encode())),
        (content_of(reference("application/x-pcd")), pcd("binary", packed)),
    ):
        assert content.kind == "points"
        assert points_of(content, data).tolist() == finite
    half = 0.5**0.5
    posed = {"pose": {"position": [10, 0, 0], "orientation": [0, 0, half, half]}, "cloud": reference(NPY, POINTS)}
    turned = points_of(content_of(posed), npy(POINTS))  # by 90 degrees about z
    assert turned.round(5).tolist() == [[8, 1, 3], [9.5, -1, 4]]


@pytest.mark.parametrize(
    "data",
    [
        pcd("ascii", b"1 2\n"),
        pcd("binary", b""),
        b"\nDATA ascii\n",
        pcd("ascii", b"").replace(b"POINTS 4", b"POINTS 99999999999"),
        pcd("binary", b"").replace(b"SIZE 4 4 4 4", b"SIZE 4 4 4 9"),
    ],
)
def test_a_file_that_is_no_cloud_has_a_reason_and_no_traceback(data: bytes) -> None:
    content = content_of(reference("application/x-pcd"))
    if data == pcd("binary", b""):
        assert points_of(content, data).tolist() == []
    else:
        with pytest.raises(ValueError, match="PCD"):
            points_of(content, data)


@pytest.mark.parametrize("number", [None, "x", {}, 10**400])
def test_a_pose_without_numbers_is_a_reason(number: Any) -> None:
    for pose in (
        {"position": [0, 0, 0], "orientation": [0, 0, 0, number]},
        {"position": [number, 0, 0], "orientation": [0, 0, 0, 1]},
    ):
        content = content_of({"pose": pose, "cloud": reference(NPY, POINTS)})
        if number is None:
            assert points_of(content, npy(POINTS)).tolist() == []
        else:
            with pytest.raises(ValueError, match="the pose beside it has no numbers"):
                points_of(content, npy(POINTS))


def headed(header: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


@pytest.mark.parametrize(
    "data",
    [
        b"",
        npy(np.zeros(9))[:90],
        npy(np.array(["text"])),
        b"PK\x03\x04 no archive",
        headed(b"{'descr': ("),
        headed(b"{'descr': '<f4', 'fortran_order': False, 'shape': (%d, 3), }" % 10**30),
    ],
)
def test_a_content_that_is_no_array_and_no_image_has_a_reason(data: bytes) -> None:
    with pytest.raises(ValueError, match="it is no array"):
        array_of(data)
    with pytest.raises(ValueError, match="no PNG"):
        image_type(data)


def test_a_small_file_that_claims_many_pixels_is_refused() -> None:
    pytest.importorskip("PIL")
    from pycrorm_async.query.observed_images import jpeg_of

    bomb = png_of(np.zeros((1, 1, 3), np.uint8))
    for side in (100_000, 10_000):
        header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        crc = struct.pack(">I", zlib.crc32(b"IHDR" + header))
        with pytest.raises(ValueError, match=r"pixels|decompression"):
            jpeg_of(bomb[:16] + header + crc + bomb[33:], 100)
    with pytest.raises(ValueError, match="it cannot be decoded"):
        jpeg_of(b"\xff\xd8\xffnot really", 100)


def test_an_encoded_image_of_16_bits_is_a_depth_map() -> None:
    image = pytest.importorskip("PIL.Image")
    from pycrorm_async.query.observed_images import jpeg_of

    file, depth = io.BytesIO(), np.zeros((64, 64), np.uint16)
    depth[:, 32:] = 4_000
    image.fromarray(depth).save(file, "PNG")
    seen = np.asarray(image.open(io.BytesIO(jpeg_of(file.getvalue(), 32)))).astype(int)
    assert seen.shape == (32, 32, 3)
    assert np.abs(seen[16, 4] - [68, 1, 84]).max() < 12
    assert np.abs(seen[16, 28] - [253, 231, 37]).max() < 12
