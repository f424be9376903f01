import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.catalog.interpolation import at_times, span
from seamosaic.schemas.mission import NavigationSigma
from seamosaic.schemas.navigation import Navigation, Tide

S = 10**9
T0 = 1_780_452_850 * S
SIGMA = NavigationSigma(horizontal=0.4, depth=0.03, roll=0.2, pitch=0.3, heading=0.8)
NAN = np.nan


def navigation(seconds, **columns) -> Navigation:
    count = len(seconds)
    base = {name: np.zeros(count) for name in ("latitude", "longitude", "depth", "roll", "pitch", "heading")}
    base["altitude"] = np.full(count, 3.0)
    sigma = columns.pop("sigma", {})
    base |= {name: np.asarray(values, float) for name, values in columns.items()}
    ns = T0 + np.round(np.asarray(seconds, float) * S).astype(np.int64)
    return Navigation(ns=ns, sigma={name: np.asarray(v, float) for name, v in sigma.items()}, **base)


def at(nav: Navigation, seconds, offset: float = 0.0, tide: Tide | None = None):
    ns = T0 + np.round(np.asarray(seconds, float) * S).astype(np.int64)
    return at_times(nav, ns, offset, SIGMA, tide)


def test_linear_between_samples() -> None:
    nav = navigation([0, 1, 3], latitude=[43, 43.1, 43.3], depth=[10, 12, 12], pitch=[-1, 1, 1])
    values = at(nav, [0, 0.25, 2, 3]).values
    np.testing.assert_allclose(values["latitude"], [43, 43.025, 43.2, 43.3])
    np.testing.assert_allclose(values["elevation"], [-10, -10.5, -12, -12])
    np.testing.assert_allclose(values["pitch"], [-1, -0.5, 1, 1])
    np.testing.assert_allclose(values["sigma_heading"], 0.8)


@pytest.mark.parametrize(
    ("name", "samples", "middle"),
    [
        ("heading", [350, 10], 0),
        ("heading", [10, 350], 0),
        ("heading", [-170, 170], 180),
        ("heading", [80, 100], 90),
        ("heading", [359, 361], 0),
        ("roll", [179, -179], -180),
        ("roll", [-4, 2], -1),
        ("longitude", [179.9, -179.9], -180),
    ],
)
def test_angles_go_the_short_way_round(name: str, samples: list[float], middle: float) -> None:
    value = at(navigation([0, 1], **{name: samples}), [0.5]).values[name][0]
    assert abs((value - middle + 180) % 360 - 180) < 1e-9
    assert (0 <= value < 360) if name == "heading" else (-180 <= value < 180)


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 360, exclude_max=True), st.floats(-100, 100), st.floats(0, 1))
def test_a_steady_turn_through_any_heading(start: float, rate: float, when: float) -> None:
    seconds = np.arange(5.0)
    nav = navigation(seconds, heading=(start + rate * seconds) % 360)
    found = at(nav, [1 + when]).values["heading"][0]
    assert abs((found - start - rate * (1 + when) + 180) % 360 - 180) < 1e-6


def test_a_missing_value_is_bridged_and_the_ends_are_not_extended() -> None:
    nav = navigation([0, 1, 2, 3], depth=[10, NAN, 12, NAN], latitude=[NAN, 1, 2, 3])
    poses = at(nav, [0.5, 1, 1.5, 2.5])
    assert poses.span == (T0 + S, T0 + 2 * S) == span(nav, 0)
    np.testing.assert_allclose(poses.values["elevation"], [NAN, -11, -11.5, NAN])


def test_time_offset_is_added_to_navigation_times_and_not_to_the_tide() -> None:
    nav = navigation([0, 10], depth=[10, 20])
    tide = Tide(np.array([T0, T0 + 100 * S]), np.array([0.0, 10.0]))
    values = at(nav, [5.0], offset=2.0, tide=tide).values
    np.testing.assert_allclose(values["elevation"], [-13 + 0.5])
    assert span(nav, 2.0) == (T0 + 2 * S, T0 + 12 * S)


def test_sigma_from_columns_where_they_have_values() -> None:
    nav = navigation([0, 1], sigma={"depth": [0.1, 0.3], "roll": [NAN, NAN]})
    values = at(nav, [0.5]).values
    assert (values["sigma_depth"][0], values["sigma_roll"][0], values["sigma_pitch"][0]) == (
        pytest.approx(0.2),
        0.2,
        0.3,
    )


def test_gaps() -> None:
    seconds = [*range(20), *range(60, 80)]
    nav = navigation(seconds, altitude=np.where(np.isin(seconds, range(5, 18)), NAN, 3.0))
    poses = at(nav, [3.5, 10, 19, 30, 60, 70])
    assert poses.in_gap.tolist() == [False, False, False, True, False, False]
    # Altitude is missing for 14 s, longer than a gap; positions are not.
    np.testing.assert_array_equal(np.isnan(poses.values["altitude"]), [False, True, False, True, False, False])
    assert np.isfinite(poses.values["latitude"]).all()
    # what the vehicle did in the gap nobody knows
    for name, least in (("horizontal", 2.0), ("heading", 60.0)):
        sigma = poses.values[f"sigma_{name}"]
        assert (sigma[[0, 1, 2, 4, 5]] < 1).all()
        assert least < sigma[3] < 2 * least


def test_gaps_are_those_of_each_column() -> None:
    """Position and attitude on rows of their own; the compass fails for a minute, then position."""
    seconds = np.arange(0, 200, 0.5)
    attitude = np.arange(len(seconds)) % 2 == 1
    lost = {"heading": (seconds > 20) & (seconds < 80), "latitude": (seconds > 110) & (seconds < 170)}
    given = {name: attitude for name in ("roll", "pitch", "heading")}
    given |= {name: ~attitude for name in ("latitude", "longitude", "depth")}
    columns = {name: np.where(there & ~lost.get(name, False), 1.0, NAN) for name, there in given.items()}
    poses = at(navigation(seconds, **columns), [10, 50, 100, 140])
    assert poses.in_gap.tolist() == [False, True, False, True]
    assert (poses.values["sigma_heading"] > 60).tolist() == [False, True, False, False]
    assert (poses.values["sigma_horizontal"] > 2).tolist() == [False, False, False, True]
    assert (poses.values["sigma_depth"] < 0.05).all()


def test_slow_navigation_has_no_gaps() -> None:
    nav = navigation(np.arange(0, 200, 7.0))
    assert not at(nav, [3.5, 100.2]).in_gap.any()
    assert np.isfinite(at(nav, [3.5]).values["altitude"]).all()


def test_altitude_beyond_its_ends_is_missing() -> None:
    nav = navigation([0, 1, 2, 3], altitude=[NAN, 3, 4, NAN])
    np.testing.assert_allclose(at(nav, [0.5, 1.5, 2.5]).values["altitude"], [NAN, 3.5, NAN])
    assert np.isnan(at(navigation([0, 1], altitude=[NAN, NAN]), [0.5]).values["altitude"]).all()


def test_without_a_complete_pose_nothing_is_inside() -> None:
    poses = at(navigation([0, 1], depth=[NAN, NAN]), [0.5])
    assert np.isnan(poses.values["latitude"]).all()
    assert not poses.in_gap.any()


def test_nanoseconds_do_not_get_lost() -> None:
    nav = navigation([0, 1], depth=[0, 1e6])
    ns = np.array([T0 + 123_456_789])
    assert at_times(nav, ns, 0.0, SIGMA, None).values["elevation"][0] == pytest.approx(-123456.789, abs=1e-3)


def test_an_empty_sigma_is_that_of_the_mission() -> None:
    nav = navigation([0, 1, 2, 3], sigma={"horizontal": [2.0, 2.0, NAN, NAN]})
    np.testing.assert_allclose(at(nav, [0, 1, 1.5, 2, 3]).values["sigma_horizontal"], [2, 2, 1.2, 0.4, 0.4])
