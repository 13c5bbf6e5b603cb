"""Refuse file systems on which the promises of a spool do not hold, before anything is made there.

A segment has all its blocks before it is mapped, so that a full disk is an error while making it, and never a SIGBUS
while writing to it. A file system that copies on write breaks that: it takes a new block each time a page is written
again, and where it has none the kernel kills the process. On btrfs this was seen with allocated files and with files
full of zeros. Files that are not copied (`chattr +C`) keep their blocks only until a snapshot, and only from Linux 6.17
on for mapped files. On a network file system a lock may be lost while its holder lives, and a full disk shows when
pages are written back; none was tested.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

from pycrorm_async.errors import SpoolUnavailable

__all__ = ["check_file_system", "file_system_type"]

_COPIES: Final = "a full disk kills the process that records there"
_NETWORK: Final = "a lock or a record may be lost there with the connection"
_REFUSED: Final[Mapping[int, tuple[str, str]]] = MappingProxyType(
    {
        0x9123683E: ("btrfs", _COPIES),
        0xCA451A4E: ("bcachefs", _COPIES),
        0x2FC12FC1: ("ZFS", _COPIES),
        0x3434: ("NILFS", _COPIES),
        0x6969: ("NFS", _NETWORK),
        0x517B: ("SMB", _NETWORK),
        0xFF534D42: ("CIFS", _NETWORK),
        0xFE534D42: ("SMB", _NETWORK),
        0x00C36400: ("Ceph", _NETWORK),
        0x5346414F: ("AFS", _NETWORK),
    }
)
"""By the `f_type` of statfs(2)."""


def check_file_system(spool: Path) -> None:
    """Raise `SpoolUnavailable` for a spool, which need not exist yet, that would lie on one of these."""
    place = spool.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    name, reason = _REFUSED.get(file_system_type(place), ("", ""))
    if name:
        raise SpoolUnavailable(
            spool,
            f"lies on {name}, where {reason}: name a folder on ext4, XFS or tmpfs with `--spool` (in a program:"
            " `Memory.open(url, spool=...)`)",
        )


def file_system_type(path: Path) -> int:
    """The `f_type` of the file system that holds this path; 0 where the system does not say."""
    buffer = ctypes.create_string_buffer(512)  # larger than struct statfs on any machine
    if ctypes.CDLL(None).statfs(os.fsencode(path), buffer) != 0:
        return 0
    return int.from_bytes(buffer.raw[: ctypes.sizeof(ctypes.c_long)], sys.byteorder) & 0xFFFFFFFF
