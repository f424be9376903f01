"""Random squares of a mosaic on one sheet, to look at for seams.

    python benchmarks/blind_squares.py VERSION SHEET.png [--seed 1] [--count 10]

Ten squares of 1 m, whole ones only, in the order of the seed; no edges of images are drawn.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window

SIDE_M = 1.0
SHOWN_PX = 480
ACROSS = 5


def squares(path: Path, seed: int, count: int) -> list[np.ndarray]:
    rng, found = np.random.default_rng(seed), []
    with rasterio.open(path) as file:
        side = round(SIDE_M / file.res[0])
        while len(found) < count:
            left, top = (int(rng.integers(0, size - side)) for size in (file.width, file.height))
            window = Window(left, top, side, side)
            if (file.read_masks(1, window=window) > 0).all():
                found.append(np.moveaxis(file.read(window=window), 0, -1)[..., ::-1])
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("version", type=Path)
    parser.add_argument("sheet", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=10)
    arguments = parser.parse_args()
    pictures = squares(arguments.version / "mosaic.tif", arguments.seed, arguments.count)
    pictures = [cv2.resize(picture, (SHOWN_PX, SHOWN_PX), interpolation=cv2.INTER_AREA) for picture in pictures]
    rows = [np.hstack(pictures[k : k + ACROSS]) for k in range(0, len(pictures), ACROSS)]
    cv2.imwrite(str(arguments.sheet), np.vstack(rows))
