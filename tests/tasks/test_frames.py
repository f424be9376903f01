import pickle

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.tasks.frames import MapFrame

# at the western edge of zone 32 the meridian convergence is -2 degrees
EDGE = MapFrame(pyproj.CRS("EPSG:32632").to_wkt(), 43.0421, 6.0127)


@given(st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(-40, 2)))
@settings(deadline=None, max_examples=50)
def test_local_and_map_round_trip(point):
    X = np.array([point])
    np.testing.assert_allclose(EDGE.local_from_map(EDGE.map_from_local(X)), X, atol=1e-6)


def test_true_north_is_not_grid_north():
    north = np.diff(EDGE.map_from_local(np.array([[0.0, 0, 0], [0, 10, 0]])), axis=0)[0]
    convergence = np.degrees(np.arctan2(north[0], north[1]))
    factors = pyproj.Proj("EPSG:32632").get_factors(6.0127, 43.0421)
    assert abs(convergence + factors.meridian_convergence) < 1e-3
    assert abs(np.hypot(north[0], north[1]) / 10 - factors.meridional_scale) < 1e-6


@pytest.mark.parametrize(
    ("code", "latitude", "longitude"), [(27700, 50.1, -5.0), (23031, 43.0, 3.1), (27572, 47.0, 2.5)]
)
def test_maps_of_another_datum_than_navigations(code, latitude, longitude):
    frame = MapFrame(pyproj.CRS(f"EPSG:{code}").to_wkt(), latitude, longitude)
    expected = pyproj.Transformer.from_crs(4326, code, always_xy=True).transform(longitude, latitude)
    np.testing.assert_allclose(frame.map_from_local(np.zeros((1, 3)))[0, :2], expected, atol=1e-3)


def test_rotation_to_the_map_turns_by_the_convergence():
    X = EDGE.map_from_local(np.zeros((1, 3)))[0]
    R = EDGE.R_map_local(X)
    step = np.diff(EDGE.map_from_local(np.array([[0.0, 0, 0], [3, 4, 0]])), axis=0)[0]
    np.testing.assert_allclose(R @ [0.6, 0.8, 0], step / np.linalg.norm(step), atol=1e-6)


def test_affine_is_the_frame_around_its_place():
    centre = EDGE.map_from_local(np.array([[20.0, -30, -12]]))[0]
    affine = EDGE.affine_at(centre)
    near = centre + np.array([[0, 0, 0], [12, -9, 1.5], [-15, 8, -2]])
    np.testing.assert_allclose(near @ affine.matrix.T + affine.offset, EDGE.local_from_map(near), atol=5e-5)


def test_curvature_of_the_earth():
    up = EDGE.map_from_local(np.array([[250.0, 0, 0]]))[0, 2]
    assert 0.8 * 250**2 / (2 * 6.378e6) < up < 1.2 * 250**2 / (2 * 6.378e6)


def test_without_navigation_the_map_is_the_local_frame():
    frame, X = MapFrame(None), np.array([[1.0, 2, 3]])
    np.testing.assert_array_equal(frame.map_from_local(X), X)
    np.testing.assert_array_equal(frame.local_from_map(X), X)


def test_frames_travel_to_workers():
    X = np.array([[1.0, 2, 3]])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(EDGE)).map_from_local(X), EDGE.map_from_local(X))


@pytest.mark.parametrize(("crs", "latitude", "longitude"), [("EPSG:32631", 43.04, 6.01), ("EPSG:3031", -77.0, 166.0)])
def test_around_a_place_the_map_is_good_to_micrometres(crs, latitude, longitude):
    frame = MapFrame(crs, latitude, longitude)
    near = np.array([320.0, -150.0, -40.0])
    X = near + np.random.default_rng(0).uniform(-10, 10, (200, 3))
    off = frame.map_around(X, near) - frame.map_from_local(X)
    assert 0 < np.abs(off).max() < 2e-5
    inner = np.abs(X - near).max(1) < 3
    assert np.abs(off[inner]).max() < 3e-6
    np.testing.assert_array_equal(MapFrame(None).map_around(X, near), X)
    assert frame.map_around(X[:0], near).shape == (0, 3)
