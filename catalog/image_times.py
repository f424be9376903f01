"""When each image was taken: from its name, its EXIF block or a table."""

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

from ..schemas.mission import ExifTimestamps, FilenameTimestamps, Timestamps
from ..schemas.timestamps import name_regex, parse_time, time_in_name


class ImageTime(NamedTuple):
    """Time of one image.

    Attributes
    ----------
    ns : nanoseconds since 1970 UTC, or None.
    fault : why there is none; empty if there is one.
    """

    ns: int | None
    fault: str


def image_times(
    source: Timestamps, images: Sequence[str], exif: Sequence[str], table: Mapping[str, int] | None
) -> list[ImageTime]:
    """Times of images.

    Parameters
    ----------
    source : how mission.yaml says that times are given.
    images : paths relative to the mission folder.
    exif : EXIF time of each image in ISO 8601, empty if it has none.
    table : the table's times, by image path or bare file name; None without a table.
    """
    if isinstance(source, FilenameTimestamps):
        regex = name_regex(source.pattern)
        fault = f"no time in the file name (pattern {source.pattern})"
        return [_time(time_in_name(regex, PurePosixPath(image).stem), fault) for image in images]
    if isinstance(source, ExifTimestamps):
        return [_time(parse_time(text) if text else None, "no EXIF DateTimeOriginal") for text in exif]
    fault = f"not listed in {source.path}"
    known = table or {}
    return [_time(known.get(image, known.get(PurePosixPath(image).name)), fault) for image in images]


def _time(ns: int | None, fault: str) -> ImageTime:
    return ImageTime(ns, "" if ns is not None else fault)
