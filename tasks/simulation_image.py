"""Simulated photographs: seabed under strobe and laser cross, through water, as a camera records it.

Light is linear and a share of the sensor's full scale; colours are red, green, blue.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Laser, LaserPlane
from ..schemas.mission import Role
from ..schemas.scene import LaserScene, LightScene, SensorScene
from .simulation_laser import View, sheet_light
from .simulation_navigation import Cameras
from .simulation_terrain import Terrain, cast_image, occluded, sample_normals
from .simulation_texture import MEAN_ALBEDO, sample

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

# 532 nm as the three channels see it.
_LASER_RGB = np.array([0.1, 1.0, 0.15], np.float32)
_GREEN = 1
# Speckle's grains: sigma in pixels, and the standard deviation of white noise after that blur.
_GRAIN_PX, _GRAIN_STD = 0.8, 0.354


class World(NamedTuple):
    """What there is to see.

    Attributes
    ----------
    terrain : its shape.
    normals : (n, n, 3) upward unit normals at the terrain's nodes.
    texture : (m, m, 3) albedo 0..255, row 0 north, over the terrain's square.
    laser : the cross, camera frame, or None.
    nominal_m : range at which light levels are stated.
    """

    terrain: Terrain
    normals: Array32
    texture: NDArray[np.uint8]
    laser: Laser | None
    nominal_m: float


class Optics(NamedTuple):
    """How it is lit and recorded: the scene's sections of the same names."""

    laser: LaserScene
    light: LightScene
    sensor: SensorScene


class _Seen(NamedTuple):
    """The seabed in the pixels of an image: range (H, W); local and camera frame points; normals; albedo (H, W, 3)."""

    range_m: Array32
    X_local: Array32
    X_camera: Array32
    normal: Array32
    albedo: Array32


def render(
    world: World, view: View, pose: Cameras, optics: Optics, role: Role, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """One image (H, W, 3), red green blue.

    Parameters
    ----------
    world : seabed and laser.
    view : the camera's rays.
    pose : one pose, R_local_camera (1, 3, 3) and C_local (1, 3).
    optics : light, water and sensor.
    role : combined has strobe and laser, texture the strobe only, laser the laser only.
    rng : draws speckle and noise.
    """
    R, C = pose.R_local_camera[0].astype(np.float32), pose.C_local[0]
    seen = _look(world, view, R, C)
    image = _seabed(world, seen, R, C, optics.light, strobe=role != "laser")
    if world.laser is not None and role != "texture":
        _add_laser(image, world, view, seen, R, C, optics, rng)
    return _record(image, optics.sensor, rng)


def _look(world: World, view: View, R: Array32, C: Array) -> _Seen:
    direction = view.direction @ R.T
    # a flat port's rays start beside the centre of projection
    origin = (view.origin @ R.T + C).astype(np.float32)
    range_m = cast_image(world.terrain, origin, direction)
    X = np.asarray(origin + range_m[..., None] * direction, np.float32)
    X_camera = np.asarray(view.origin + range_m[..., None] * view.direction, np.float32)
    normal = sample_normals(world.terrain, world.normals, X[..., 0], X[..., 1])
    albedo = sample(world.texture, world.terrain.half_m, X[..., 0], X[..., 1])
    return _Seen(range_m, X, X_camera, normal, albedo)


def _seabed(world: World, seen: _Seen, R: Array32, C: Array, light: LightScene, strobe: bool) -> Array32:
    """Light of the seabed and of the water before it."""
    lamp = C + R @ np.asarray(light.strobe_position_m)
    decay = np.asarray(light.attenuation_per_m, np.float32)
    to_lamp = lamp.astype(np.float32) - seen.X_local
    way = np.sqrt(np.einsum("ijk,ijk->ij", to_lamp, to_lamp))
    level = np.full_like(way, light.strobe * strobe)
    if light.falloff:
        incidence = np.clip(np.einsum("ijk,ijk->ij", to_lamp, seen.normal) / way, 0, None)
        level *= incidence * (world.nominal_m / way) ** 2
    nominal = 2 * world.nominal_m * decay[_GREEN]
    image = level[..., None] * np.exp(nominal - (way + seen.range_m)[..., None] * decay)
    image += light.ambient * np.exp(world.nominal_m * decay[_GREEN] - seen.range_m[..., None] * decay)
    image *= seen.albedo / np.float32(MEAN_ALBEDO)
    if strobe:
        veil = -np.expm1(-light.backscatter_per_m * seen.range_m)
        image += light.strobe * veil[..., None] * np.asarray(light.backscatter, np.float32)
    return image


def _add_laser(
    image: Array32,
    world: World,
    view: View,
    seen: _Seen,
    R: Array32,
    C: Array,
    optics: Optics,
    rng: np.random.Generator,
) -> None:
    """Adds the light of both sheets to an image, in place."""
    assert world.laser is not None
    emitter = np.asarray(world.laser.origin)
    for sheet in world.laser.sheets:
        pixels, profile = sheet_light(view, seen.range_m, sheet, R[2].astype(float), optics.laser.width_px)
        X = seen.X_local.reshape(-1, 3)[pixels]
        lit = ~occluded(world.terrain, X, R @ emitter + C)
        pixels, profile = pixels[lit], profile[lit]
        way = np.linalg.norm(seen.X_camera.reshape(-1, 3)[pixels] - emitter, axis=1)
        path = way + seen.range_m.ravel()[pixels]
        nominal_way = _nominal_way(world.laser.sheets, emitter, world.nominal_m)
        loss = np.exp(optics.light.attenuation_per_m[_GREEN] * (nominal_way + world.nominal_m - path))
        albedo = seen.albedo.reshape(-1, 3)[pixels, _GREEN] / MEAN_ALBEDO
        light = optics.laser.brightness * profile * albedo * loss * nominal_way / way
        light *= _speckle(image.shape[:2], optics.laser.speckle, rng).ravel()[pixels]
        image.reshape(-1, 3)[pixels] += light[:, None].astype(np.float32) * _LASER_RGB


def _nominal_way(sheets: Sequence[LaserPlane], emitter: Array, range_m: float) -> float:
    """Metres from the emitter to the crossing of the sheets at a depth of range_m."""
    A = np.array([sheet.normal[:2] for sheet in sheets])
    b = np.array([sheet.offset - sheet.normal[2] * range_m for sheet in sheets])
    return float(np.linalg.norm(np.append(np.linalg.solve(A, b), range_m) - emitter))


def _speckle(shape: tuple[int, int], strength: float, rng: np.random.Generator) -> Array32:
    """Factors (H, W) of mean 1, positive, in grains about two pixels wide."""
    grain = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), _GRAIN_PX)
    variance = np.float32(np.log1p(strength**2))
    return np.exp(np.sqrt(variance) / np.float32(_GRAIN_STD) * grain - variance / 2)


def _record(image: Array32, sensor: SensorScene, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Levels 0..255 of light: shot and read noise, saturation, gamma."""
    variance = np.full_like(image, sensor.read_noise**2)
    if sensor.full_well:
        variance += np.clip(image, 0, None) / np.float32(sensor.full_well)
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape, np.float32)
    level = np.power(np.clip(noisy, 0, 1), np.float32(1 / sensor.gamma))
    return (255 * level + 0.5).astype(np.uint8)
