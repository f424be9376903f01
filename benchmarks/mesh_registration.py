"""How well the textured mesh and the planar mosaic lie where the seabed's true texture has them.

    python benchmarks/mesh_registration.py MISSION VERSION

MISSION is a simulated mission with truth/ (texture.jpg, terrain.npz, truth.json), VERSION a folder of its products.
mesh.glb is drawn from above after the rigid motion that lays the trajectory on the true one; mosaic-planar.tif is laid
on the true texture by the similarity that most of its own features agree on, as it has no other tie to the truth. Both
are then matched with the true texture by SIFT, and the distances of the matches are printed, by the ground's slope.
"""

import argparse
import csv
import json
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import rasterio
import trimesh
from matplotlib.tri import Triangulation
from scipy.ndimage import map_coordinates

PIXEL_M = 0.004
SLOPE_DEG = 20.0
WRONG_M = 1.0  # a match so far off is a wrong one
AGREE_M = 0.05


def rigid(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t that lay points a (N, 3) on b."""
    U, _, Vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, b.mean(0) - R @ a.mean(0)


def pose(mission: Path, version: Path) -> tuple[np.ndarray, np.ndarray]:
    """From the map to the truth's frame, by the camera centres."""
    true = {frame["image"]: frame["C"] for frame in json.loads((mission / "truth/truth.json").read_text())["frames"]}
    with (version / "trajectory.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["x"] and PurePosixPath(row["image"]).name in true]
    found = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    return rigid(found, np.array([true[PurePosixPath(row["image"]).name] for row in rows]))


def mesh_from_above(version: Path, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture in grey, which pixels it has, and the true frame's x, y of its top left corner."""
    document = trimesh.load(version / "mesh.glb")
    header = (version / "mesh.ply").read_bytes()[:4000].decode("ascii", "replace")
    offset = np.array(
        next(line for line in header.splitlines() if line.startswith("comment offset")).split()[2:], float
    )
    parts = []
    for part in document.geometry.values():
        X = np.asarray(part.vertices)[:, [0, 2, 1]] * [1, -1, 1] + offset
        picture = np.asarray(part.visual.material.baseColorTexture.convert("L"))
        parts.append((X @ R.T + t, part.faces, part.visual.uv, picture))
    places = np.concatenate([X[:, :2] for X, *_ in parts])
    corner = np.array([places[:, 0].min(), places[:, 1].max()])
    width, height = np.ceil(np.ptp(places, axis=0) / PIXEL_M).astype(int) + 1
    image, known = np.zeros((height, width), np.uint8), np.zeros((height, width), bool)
    for X, faces, uv, picture in parts:
        column, row = (X[:, 0] - corner[0]) / PIXEL_M, (corner[1] - X[:, 1]) / PIXEL_M
        turned = _clockwise(column, row, faces)
        finder = Triangulation(column, row, turned[:, ::-1]).get_trifinder()
        left, top = int(column.min()), int(row.min())
        at = np.meshgrid(np.arange(left, int(column.max()) + 1) + 0.0, np.arange(top, int(row.max()) + 1) + 0.0)
        found = finder(*at)
        v, u = np.nonzero(found >= 0)
        corners = turned[:, ::-1][found[v, u]]
        w = _barycentric(column[corners], row[corners], at[0][v, u], at[1][v, u])
        place = (w[..., None] * uv[corners]).sum(1)
        x, y = place[:, 0] * picture.shape[1] - 0.5, (1 - place[:, 1]) * picture.shape[0] - 0.5  # trimesh has v up
        image[v + top, u + left] = map_coordinates(picture.astype(float), [y, x], order=1, mode="nearest")
        known[v + top, u + left] = True
    return image, known, corner


def _clockwise(x: np.ndarray, y: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces that are not folded under, all turned one way."""
    a, b, c = faces.T
    area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
    return faces[area < 0]


def _barycentric(x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    det = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    b = ((u - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (v - y[:, 0])) / det
    c = ((x[:, 1] - x[:, 0]) * (v - y[:, 0]) - (u - x[:, 0]) * (y[:, 1] - y[:, 0])) / det
    return np.stack([1 - b - c, b, c], 1)


def planar(version: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of the planar mosaic, in its own coordinates."""
    with rasterio.open(version / "mosaic-planar.tif") as file:
        shrink = PIXEL_M / file.res[0]
        shape = round(file.height / shrink), round(file.width / shrink)
        rgb = file.read(out_shape=(3, *shape), resampling=rasterio.enums.Resampling.average)
        known = file.dataset_mask(out_shape=shape) > 0
        corner = np.array([file.bounds.left, file.bounds.top]) + [PIXEL_M / 2, -PIXEL_M / 2]
    return cv2.cvtColor(np.moveaxis(rgb, 0, -1), cv2.COLOR_RGB2GRAY), known, corner


class Truth:
    """The true texture from above, and the ground's slope."""

    def __init__(self, mission: Path):
        terrain = np.load(mission / "truth/terrain.npz")
        self.height, self.half, self.cell = terrain["h"].astype(float), float(terrain["half"]), float(terrain["cell"])
        self.offset = terrain["offset"] if "offset" in terrain else np.zeros(2)
        texture = cv2.imread(str(mission / "truth/texture.jpg"), cv2.IMREAD_GRAYSCALE)
        size = round(2 * self.half / PIXEL_M)
        self.texture = cv2.resize(texture, (size, size), interpolation=cv2.INTER_AREA)
        self.corner = np.array([-self.half, self.half]) + [PIXEL_M / 2, -PIXEL_M / 2]

    def slope_deg(self, xy: np.ndarray) -> np.ndarray:
        step = 0.1
        x, y = (xy + self.offset).T

        def z(dx: float, dy: float) -> np.ndarray:
            at = [(y + dy + self.half) / self.cell, (x + dx + self.half) / self.cell]
            return map_coordinates(self.height, at, order=1, mode="nearest")

        rise = np.hypot(z(step, 0) - z(-step, 0), z(0, step) - z(0, -step)) / (2 * step)
        return np.degrees(np.arctan(rise))


def features(image: np.ndarray, corner: np.ndarray, known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2) in metres and descriptors."""
    evened = cv2.createCLAHE(4.0, (16, 16)).apply(image)
    mask = None if known is None else cv2.erode(known.astype(np.uint8), np.ones((25, 25), np.uint8))
    points, descriptors = cv2.SIFT_create(20000, contrastThreshold=0.02).detectAndCompute(evened, mask)
    uv = np.array([point.pt for point in points])
    return corner + uv * [PIXEL_M, -PIXEL_M], descriptors


def matched(found: tuple[np.ndarray, np.ndarray], true: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    pairs = cv2.BFMatcher().knnMatch(found[1], true[1], k=2)
    good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < 0.75 * b.distance]
    i, j = np.array(good).T
    return found[0][i], true[0][j]


def figures(errors: np.ndarray, steep: np.ndarray) -> dict:
    parts = {"all": np.ones(len(errors), bool), "slope": steep, "floor": ~steep}
    return {
        name: {
            "matches": int(part.sum()),
            "median_mm": round(1000 * float(np.median(errors[part])), 2),
            "p95_mm": round(1000 * float(np.percentile(errors[part], 95)), 2),
        }
        for name, part in parts.items()
        if part.sum() > 10
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mission", type=Path)
    parser.add_argument("version", type=Path)
    arguments = parser.parse_args()
    truth = Truth(arguments.mission)
    true = features(truth.texture, truth.corner)
    R, t = pose(arguments.mission, arguments.version)
    image, known, corner = mesh_from_above(arguments.version, R, t)
    a, b = matched(features(image, corner, known), true)
    error = np.linalg.norm(a - b, axis=1)
    right = error < WRONG_M
    print(json.dumps({"mesh": figures(error[right], truth.slope_deg(b[right]) > SLOPE_DEG)}))
    image, known, corner = planar(arguments.version)
    a, b = matched(features(image, corner, known), true)
    similar, _ = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=AGREE_M, maxIters=5000)
    error = np.linalg.norm(a @ similar[:, :2].T + similar[:, 2] - b, axis=1)
    right = error < WRONG_M
    print(json.dumps({"planar": figures(error[right], truth.slope_deg(b[right]) > SLOPE_DEG)}))


if __name__ == "__main__":
    main()
