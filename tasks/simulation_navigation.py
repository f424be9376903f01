"""Simulated survey: where the vehicle is, when it takes images, and what its navigation says.

Positions are those of the navigation reference point in the local frame (x east, y north, z up), attitudes as
FORMATS defines them ("level", "vehicle"). The motion is a smooth function of time, so that images and navigation
samples are drawn from the same trajectory, each at its own times.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Mount
from ..schemas.mission import Role
from ..schemas.scene import NavigationScene, SurveyScene
from .rotations import R_LOCAL_LEVEL, R_level_vehicle, R_vehicle_camera

Array = NDArray[np.float64]

# How long the vehicle sails straight before the first and after the last station of a line, at least.
LEAD_S = 3.0
# Root mean square sway at wobble 1: across, up (metres), roll, pitch, heading (degrees); and its periods.
_SWAY = np.array([0.02, 0.03, 0.6, 0.6, 1.1])
_SWAY_PERIOD_S = (10.0, 40.0)
_SWAY_WAVES = 3
_ALTIMETER_NOISE_M = 0.01


class Plan(NamedTuple):
    """A lawnmower pattern of the camera: parallel lines joined by half circles.

    Attributes
    ----------
    survey : speed, heading and number of lines.
    line_m : length of a line between its first and last station, metres.
    spacing_m : distance of neighbouring lines, metres.
    lead_m : how far the vehicle sails straight before the first and after the last station of a line, metres.
    z_m : level of the reference point, local frame, metres.
    camera_m : where the camera sits, forward and to starboard of the reference point, metres.
    image_time_s : (n,) exposures, seconds from the start of navigation.
    image_role : n roles, as mission.yaml names them.
    sway : (5, waves, 3) amplitude, radians per second and phase of what is added across, up, in roll, pitch, heading.
    """

    survey: SurveyScene
    line_m: float
    spacing_m: float
    lead_m: float
    z_m: float
    camera_m: tuple[float, float]
    image_time_s: Array
    image_role: tuple[Role, ...]
    sway: Array


class States(NamedTuple):
    """The vehicle at n times.

    Attributes
    ----------
    time_s : (n,) seconds from the start of navigation.
    X_local : (n, 3) the navigation reference point, metres.
    attitude_deg : (n, 3) roll, pitch, heading; heading from true north.
    """

    time_s: Array
    X_local: Array
    attitude_deg: Array


class Cameras(NamedTuple):
    """Poses of the camera at n times.

    Attributes
    ----------
    R_local_camera : (n, 3, 3).
    C_local : (n, 3) centres of projection, metres.
    """

    R_local_camera: Array
    C_local: Array


def plan(
    survey: SurveyScene,
    images: int,
    footprint_m: tuple[float, float],
    z_m: float,
    camera_m: tuple[float, float],
    rng: np.random.Generator,
    period_m: float = 0.0,
) -> Plan:
    """Lines and exposures.

    Parameters
    ----------
    survey : number of lines, overlap, sidelap, speed and roles.
    images : exposures in all, shared out over the lines.
    footprint_m : an image's extent on the datum across and along the line, metres.
    z_m : level of the reference point, local frame, metres.
    camera_m : where the camera sits, forward and to starboard of the reference point, metres.
    rng : draws the sway.
    period_m : distance after which stations and sway repeat themselves, along and across the lines; overlap and
        sidelap are changed a little to allow it. 0: never.
    """
    pair = 2 if survey.roles == "pairs" else 1
    stations = [len(part) for part in np.array_split(np.arange(-(-images // pair)), survey.lines)]
    step, spacing = footprint_m[1] * (1 - survey.overlap), footprint_m[0] * (1 - survey.sidelap)
    if period_m:  # there and back again within a period
        step, spacing = period_m / round(period_m / step), period_m / (2 * round(period_m / (2 * spacing)))
    line = step * (max(stations) - 1)
    leg = line + 2 * LEAD_S * survey.speed_m_s + np.pi * spacing / 2
    if period_m:
        leg = period_m * np.ceil(leg / period_m)
    lead = float(leg - line - np.pi * spacing / 2) / 2
    way = [k * leg + lead + step * np.arange(n) for k, n in enumerate(stations)]
    time, roles = _exposures(np.concatenate(way) / survey.speed_m_s, survey)
    size = (len(_SWAY), _SWAY_WAVES)
    amplitude = survey.wobble * _SWAY[:, None] * np.sqrt(2 / _SWAY_WAVES) * np.ones(size)
    frequency = 2 * np.pi / rng.uniform(*_SWAY_PERIOD_S, size)
    if period_m:
        slowest = 2 * np.pi * survey.speed_m_s / period_m
        frequency = slowest * np.maximum(1, np.round(frequency / slowest))
    sway = np.stack([amplitude, frequency, rng.uniform(0, 2 * np.pi, size)], -1)
    return Plan(survey, line, spacing, lead, z_m, camera_m, time[:images], roles[:images], sway)


def _exposures(station_time_s: NDArray, survey: SurveyScene) -> tuple[NDArray, tuple[Role, ...]]:
    if survey.roles != "pairs":
        role: Role = survey.roles
        return station_time_s, tuple(role for _ in station_time_s)
    time = np.concatenate([station_time_s, station_time_s + survey.pair_delay_s])
    both: tuple[Role, Role] = ("texture", "laser")
    order = np.argsort(time, kind="stable")
    return time[order], tuple(both[int(k) // len(station_time_s)] for k in order)


def trajectory(plan: Plan, time_s: Array) -> States:
    """The true motion at times (n,), seconds from the start of navigation."""
    survey = plan.survey
    radius = plan.spacing_m / 2
    straight = plan.line_m + 2 * plan.lead_m
    way = np.asarray(time_s, float) * survey.speed_m_s
    line = np.clip(way // (straight + np.pi * radius), 0, survey.lines - 1)
    way = way - line * (straight + np.pi * radius)
    last = line == survey.lines - 1
    turn = np.where(last, 0, np.clip((way - straight) / radius, 0, None))
    forward = np.where(last, way, np.minimum(way, straight)) - straight / 2 + radius * np.sin(turn)
    there = np.where(line % 2 == 0, 1.0, -1.0)
    sway = _sway(plan, time_s)
    ahead, aside = plan.camera_m  # the reference point is that far behind the camera, and to its port
    along = there * forward - ahead * there * np.cos(turn) + aside * np.sin(turn)
    across = (line - (survey.lines - 1) / 2) * plan.spacing_m + radius * (1 - np.cos(turn)) + sway[0]
    across -= ahead * np.sin(turn) + aside * there * np.cos(turn)
    bow = np.radians(survey.heading_deg)
    X = np.column_stack(
        [
            along * np.sin(bow) + across * np.cos(bow),
            along * np.cos(bow) - across * np.sin(bow),
            plan.z_m + sway[1] + survey.altitude_step_m * (line + turn / np.pi),
        ]
    )
    heading = survey.heading_deg + np.where(there > 0, 0, 180) + there * np.degrees(turn) + sway[4]
    return States(np.asarray(time_s, float), X, np.column_stack([sway[2], sway[3], heading % 360]))


def _sway(plan: Plan, time_s: Array) -> Array:
    amplitude, frequency, phase = np.moveaxis(plan.sway[..., None], 2, 0)
    return (amplitude * np.sin(frequency * time_s + phase)).sum(axis=1)


def cameras(states: States, mount: Mount) -> Cameras:
    """Camera poses of vehicle states: lever arm and mount angles applied."""
    R_local_vehicle = R_LOCAL_LEVEL @ R_level_vehicle(*states.attitude_deg.T)
    centre = states.X_local + R_local_vehicle @ np.asarray(mount.translation)
    return Cameras(R_local_vehicle @ R_vehicle_camera(*mount.rotation), centre)


def sample_times(plan: Plan, rate_hz: float) -> Array:
    """Times of navigation samples, seconds: from the start to a lead after the last image."""
    return np.arange(0, plan.image_time_s[-1] + LEAD_S + 1 / rate_hz, 1 / rate_hz)


def measured(true: States, scene: NavigationScene, rng: np.random.Generator) -> States:
    """What the navigation says of true states.

    Depth and attitude are wrong by a constant, drawn for the mission, and by white noise, which together have the
    stated sigma. The position starts wrong by the stated sigma in each axis and drifts from there as a random walk,
    as dead reckoning does, with a little white noise.
    """
    count, sigma = len(true.time_s), scene.sigma
    constant = np.sqrt(1 - scene.noise_share**2)
    spread = scene.error_scale * np.array([sigma.depth, sigma.roll, sigma.pitch, sigma.heading])
    other = spread * (constant * rng.standard_normal(4) + scene.noise_share * rng.standard_normal((count, 4)))
    steps = np.sqrt(np.diff(true.time_s, prepend=true.time_s[0]))[:, None] * rng.standard_normal((count, 2))
    level = sigma.horizontal * rng.standard_normal(2) + scene.drift_m_per_sqrt_s * np.cumsum(steps, axis=0)
    level += scene.horizontal_noise_m * rng.standard_normal((count, 2))
    X = true.X_local + np.column_stack([scene.error_scale * level, -other[:, 0]])
    attitude = true.attitude_deg + other[:, 1:]
    attitude[:, 2] %= 360
    return States(true.time_s, X, attitude)


def measured_altitude(true: States, seabed_z: NDArray, scene: NavigationScene, rng: np.random.Generator) -> Array:
    """The altimeter's reading (n,), metres, over a seabed at seabed_z (n,) below the reference point."""
    noise = scene.error_scale * _ALTIMETER_NOISE_M * rng.standard_normal(len(true.time_s))
    return true.X_local[:, 2] - seabed_z + noise
