"""The directories of a TIFF file, which is also what an EXIF block is.

Our own forty lines, because Pillow's reader warns instead of failing and is not made for headers alone.
"""

import struct
from typing import BinaryIO

# Field types that sizes, offsets and times are written in: format and bytes of one value.
_TYPES = {1: ("B", 1), 2: ("c", 1), 3: ("H", 2), 4: ("L", 4), 13: ("L", 4)}
_LARGEST_FIELD = 16 * 1024 * 1024

Directory = dict[int, tuple[int, ...] | str]


def first_directory(file: BinaryIO) -> tuple[Directory, str]:
    """The first directory of a file, and its byte order for `directory_at`.

    Raises
    ------
    ValueError
        If it is not TIFF or not whole.
    """
    file.seek(0)
    head = file.read(8)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
    if order is None or len(head) < 8:
        raise ValueError("not a TIFF file")
    return directory_at(file, order, struct.unpack(order + "L", head[4:])[0]), order


def directory_at(file: BinaryIO, order: str, offset: int) -> Directory:
    """The fields of the directory at an offset: whole numbers as tuples, texts as str; other types are left out."""
    file.seek(offset)
    (count,) = struct.unpack(order + "H", _exactly(file, 2))
    entries = _exactly(file, 12 * count)
    fields: Directory = {}
    for i in range(count):
        tag, kind, length, value = struct.unpack(order + "HHL4s", entries[12 * i : 12 * i + 12])
        if kind not in _TYPES:
            continue
        letter, width = _TYPES[kind]
        size = length * width
        if size > 4:
            file.seek(struct.unpack(order + "L", value)[0])
            value = _exactly(file, size)
        fields[tag] = _text(value[:size]) if letter == "c" else struct.unpack(f"{order}{length}{letter}", value[:size])
    return fields


def _text(value: bytes) -> str:
    return value.split(b"\0")[0].decode("latin-1").strip()


def _exactly(file: BinaryIO, size: int) -> bytes:
    if size > _LARGEST_FIELD:
        raise ValueError("a field larger than any of an image's directory")
    content = file.read(size)
    if len(content) != size:
        raise ValueError("the directory goes on beyond the end of the file")
    return content


def exif_fields(file: BinaryIO) -> Directory:
    """The EXIF directory of a TIFF file or of an EXIF block (without its "Exif" mark); empty if there is none."""
    try:
        fields, order = first_directory(file)
        pointer = fields.get(0x8769)
        return directory_at(file, order, pointer[0]) if isinstance(pointer, tuple) else {}
    except (ValueError, struct.error, IndexError):
        return {}
