"""Refuse file systems on which a spool is not durable, before creating any file there.

A segment gets all its blocks before it is mapped, so that a full disk raises an error during allocation and never a
SIGBUS during a write. A copy-on-write file system breaks this: rewriting a page takes a new block, and when none is
free the kernel kills the process. This was observed on btrfs, with allocated files and with files of zeros. Files with
copy-on-write disabled (`chattr +C`) keep their blocks only until a snapshot, and mapped ones only since Linux 6.17. On
a network file system a lock may be lost while its holder lives, and a full disk shows only when pages are written back;
no network file system was tested.
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
"""Name of the file system and the reason for refusing it, by the `f_type` of statfs(2)."""


def check_file_system(spool: Path) -> None:
    """Raise `SpoolUnavailable` if the spool is, or would be created, on a refused file system."""
    ancestor = spool.absolute()
    while not ancestor.exists() and ancestor != ancestor.parent:
        ancestor = ancestor.parent
    name, reason = _REFUSED.get(file_system_type(ancestor), ("", ""))
    if name:
        raise SpoolUnavailable(
            spool,
            f"lies on {name}, where {reason}: name a folder on ext4, XFS or tmpfs with `--spool` (in a program:"
            " `Memory.open(url, spool=...)`)",
        )


def file_system_type(path: Path) -> int:
    """Return the `f_type` of the file system that holds this path; 0 if statfs fails."""
    buffer = ctypes.create_string_buffer(512)  # larger than struct statfs on any machine
    if ctypes.CDLL(None).statfs(os.fsencode(path), buffer) != 0:
        return 0
    return int.from_bytes(buffer.raw[: ctypes.sizeof(ctypes.c_long)], sys.byteorder) & 0xFFFFFFFF
