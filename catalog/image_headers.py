"""What the bytes of an image file tell before it is decoded: format, size, EXIF time, and whether it is whole."""

import io
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

from .tiff_directory import Directory, exif_fields, first_directory

# EXIF (at most 64 KiB) and colour profiles come before the size of a JPEG.
HEADER_BYTES = 256 * 1024
# Cameras put padding and thumbnails behind the end marker.
TAIL_BYTES = 64 * 1024

_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_SEQUENTIAL, _HUFFMAN_TABLES, _END, _SCAN = (0xC0, 0xC1), 0xC4, 0xD9, 0xDA
_BETWEEN_SCANS = {_HUFFMAN_TABLES, _SCAN, 0xDB, 0xDC, 0xDD, 0xFE}
_ZEROS = bytes(64)
_TIME, _SUBSECONDS, _OFFSET = 0x9003, 0x9291, 0x9011
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_STRIPS = ((273, 279), (324, 325))


class Header(NamedTuple):
    """What a file is.

    Attributes
    ----------
    width, height : pixels as stored, EXIF rotation ignored; 0 where unreadable.
    exif_time : EXIF DateTimeOriginal with sub-seconds and offset, in ISO 8601; empty if it has none.
    fault : why it is no complete image; empty if it is one.
    """

    width: int
    height: int
    exif_time: str
    fault: str


def read_header(head: bytes, tail: bytes, whole: BinaryIO) -> Header:
    """Read a header.

    Parameters
    ----------
    head, tail : first and last bytes of the file (HEADER_BYTES and TAIL_BYTES, or the whole of a smaller one).
    whole : the file, open, for TIFF and what of a JPEG's header lies behind head.
    """
    if not head:
        return Header(0, 0, "", "file is empty")
    if head[:2] == b"\xff\xd8":
        return _jpeg(head, tail, whole)
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return _png(head, tail)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return _tiff(whole)
    return Header(0, 0, "", "not a JPEG, PNG or TIFF image")


def _jpeg(head: bytes, tail: bytes, whole: BinaryIO) -> Header:
    def at(place: int, count: int) -> bytes:
        if place + count <= len(head):
            return head[place : place + count]
        whole.seek(place)
        return whole.read(count)

    width, height, exif, position = 0, 0, b"", 2
    while len(start := at(position, 4)) == 4 and start[0] == 0xFF:
        marker, length = start[1], int.from_bytes(start[2:], "big")
        if marker == 0xFF:  # padding
            position += 1
            continue
        if marker in _START_OF_FRAME and len(body := at(position + 4, 5)) == 5:
            height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
        if marker == 0xE1 and at(position + 4, 6) == b"Exif\0\0":
            exif = exif or at(position + 10, length - 8)
        position += 2 + length
        if marker == _SCAN:
            break
    if not width:
        return Header(0, 0, "", "file is truncated or damaged (no JPEG frame header)")
    # In the compressed data a 0xff is always followed by a zero; a thumbnail in the header has an end of its own.
    body = head[position:] if len(head) < HEADER_BYTES else tail
    fault = "" if b"\xff\xd9" in body else "file is truncated (no JPEG end marker)"
    return Header(width, height, _exif_time(io.BytesIO(exif)), fault)


def damage(content: bytes) -> str:
    """What is wrong with the compressed data of a JPEG file; empty if nothing is seen.

    Decoders go on behind damage, with all that follows in a wrong place. Bytes that were overwritten hold markers that
    have no place there; blocks that never reached the disk are zeros, which are no more than code of plain image only
    where all tables say so.
    """
    fault = "file is damaged (bytes in its middle are not of the image)"
    scan, sequential, plain = 0, False, True
    for place, marker, body in _segments(content):
        if marker == _END:
            return fault if sequential and not plain and content.find(_ZEROS, scan, place) >= 0 else ""
        if scan and marker not in _BETWEEN_SCANS:
            return fault
        sequential |= marker in _SEQUENTIAL
        if marker == _HUFFMAN_TABLES:
            plain &= _zeros_are_plain(body)
        if marker == _SCAN:
            scan = scan or place
    return "file is truncated (no JPEG end marker)"


def _segments(content: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Place, marker and body of each segment of a JPEG file and of whatever looks like one in its compressed data."""
    data = np.frombuffer(content, np.uint8)
    places = np.flatnonzero(data[:-1] == 0xFF)
    marker = data[places + 1]
    position = 2
    for place in places[(marker != 0) & (marker != 0xFF) & ((marker < 0xD0) | (marker > 0xD7))].tolist():
        if place >= position:
            position = place + 2 + int.from_bytes(content[place + 2 : place + 4], "big")
            yield place, content[place + 1], content[place + 4 : position]


def _zeros_are_plain(tables: bytes) -> bool:
    """Whether the code of zeros alone, which comes first in each of some Huffman tables, is the end of a block."""
    while len(tables) > 17:
        if tables[0] >> 4 and tables[17]:
            return False
        tables = tables[17 + sum(tables[1:17]) :]
    return True


def _png(head: bytes, tail: bytes) -> Header:
    if len(head) < 33 or head[12:16] != b"IHDR":
        return Header(0, 0, "", "file is truncated or damaged (no PNG header)")
    width, height = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    place = head.find(b"eXIf")
    exif = b"" if place < 4 else head[place + 4 : place + 4 + int.from_bytes(head[place - 4 : place], "big")]
    fault = "" if b"IEND\xaeB`\x82" in tail else "file is truncated (no PNG end marker)"
    return Header(width, height, _exif_time(io.BytesIO(exif)), fault)


def _tiff(file: BinaryIO) -> Header:
    size = file.seek(0, io.SEEK_END)
    try:
        fields, _ = first_directory(file)
    except ValueError:
        return Header(0, 0, "", "file is truncated or damaged (no TIFF directory)")
    width, height = _numbers(fields, _TIFF_WIDTH), _numbers(fields, _TIFF_HEIGHT)
    if not width or not height:
        return Header(0, 0, "", "file is truncated or damaged (no TIFF image size)")
    ends = [
        offset + length
        for offsets, lengths in _TIFF_STRIPS
        for offset, length in zip(_numbers(fields, offsets), _numbers(fields, lengths), strict=False)
    ]
    fault = "file is truncated (pixels beyond its end)" if max(ends, default=0) > size else ""
    return Header(width[0], height[0], _exif_time(file), fault)


def _numbers(fields: Directory, tag: int) -> tuple[int, ...]:
    value = fields.get(tag, ())
    return value if isinstance(value, tuple) else ()


def _exif_time(block: BinaryIO) -> str:
    """ISO 8601 time of a TIFF file or an EXIF block; empty if it has none."""
    fields = exif_fields(block)
    texts = [str(fields.get(tag, "")).strip() for tag in (_TIME, _SUBSECONDS, _OFFSET)]
    date, _, time = texts[0].partition(" ")
    if not time:
        return ""
    offset = texts[2] if any(map(str.isdigit, texts[2])) else "Z"  # cameras write an unknown one as blanks and a colon
    return f"{date.replace(':', '-')}T{time}{'.' + texts[1] if texts[1].isdigit() else ''}{offset}"
