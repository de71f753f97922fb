"""Geodesy against formulas that share nothing with it: arc lengths by quadrature, exact rational steps, round trips."""

from __future__ import annotations

import math
import random

import pytest

from edge_agent.geodesy import A_M, B_M, E2, F, Frame, ecef_to_geodetic, geodetic_to_ecef

PLACES = [
    (0.0, 0.0, 0.0),
    (51.034, 13.7396, 160.441),
    (-33.86, 151.21, 25.0),
    (64.1, -21.9, 4000.0),
    (89.9999, 10.0, 5.0),
    (-90.0, 0.0, -100.0),
    (35.0, 180.0, 8848.0),
    (12.5, -179.999999, -400.0),
]
AZIMUTHS = [0.0, 37.5, 90.0, 180.0, 271.25, -45.0]


def close(a: tuple[float, ...], b: tuple[float, ...], tolerance: float) -> bool:
    return all(abs(x - y) <= tolerance for x, y in zip(a, b, strict=True))


def test_ecef_of_known_points() -> None:
    assert close(geodetic_to_ecef(0.0, 0.0, 0.0), (A_M, 0.0, 0.0), 1e-9)
    assert close(geodetic_to_ecef(0.0, 90.0, 10.0), (0.0, A_M + 10.0, 0.0), 1e-8)
    assert close(geodetic_to_ecef(90.0, 0.0, 0.0), (0.0, 0.0, B_M), 1e-8)
    # the official semi-minor axis of WGS84
    assert abs(B_M - 6356752.314245179) < 1e-8


@pytest.mark.parametrize("place", PLACES)
def test_ecef_lies_on_the_ellipsoid_along_its_normal(place: tuple[float, float, float]) -> None:
    lat, lon, h = place
    x, y, z = geodetic_to_ecef(lat, lon, 0.0)
    assert abs((x * x + y * y) / A_M**2 + z * z / B_M**2 - 1.0) < 1e-15 * 4
    normal = (x / A_M**2, y / A_M**2, z / B_M**2)
    length = math.sqrt(sum(c * c for c in normal))
    raised = tuple(p + h * c / length for p, c in zip((x, y, z), normal, strict=True))
    assert close(geodetic_to_ecef(lat, lon, h), raised, 2e-9)


@pytest.mark.parametrize("place", PLACES)
def test_geodetic_round_trip(place: tuple[float, float, float]) -> None:
    lat, lon, h = ecef_to_geodetic(*geodetic_to_ecef(*place))
    assert abs(lat - place[0]) * 111e3 < 5e-9
    turn = math.remainder(lon - place[1], 360.0)
    assert abs(turn) * 111e3 * math.cos(math.radians(place[0])) < 5e-9
    assert abs(h - place[2]) < 5e-9


def test_the_centre_of_the_earth_is_refused() -> None:
    with pytest.raises(ValueError, match="surface"):
        ecef_to_geodetic(0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="surface"):
        ecef_to_geodetic(math.nan, 0.0, 0.0)


@pytest.mark.parametrize("place", PLACES[1:5])
def test_enu_against_radii_of_curvature(place: tuple[float, float, float]) -> None:
    """Small steps in latitude, longitude, height are M dphi, N cos(phi) dlambda, dh to second order."""
    lat, lon, h = place
    frame = Frame(place)
    s = math.sin(math.radians(lat))
    m = A_M * (1 - E2) / (1 - E2 * s * s) ** 1.5 + h
    n = (A_M / math.sqrt(1 - E2 * s * s) + h) * math.cos(math.radians(lat))
    step = 1e-7  # about a centimetre
    assert close(frame.enu(lat + step, lon, h), (0.0, m * math.radians(step), 0.0), 5e-9)
    assert close(frame.enu(lat, lon + step, h), (n * math.radians(step), 0.0, 0.0), 5e-9)
    assert close(frame.enu(lat, lon, h + 0.25), (0.0, 0.0, 0.25), 5e-9)


def test_meridian_arc_by_quadrature() -> None:
    """Chord sums over 1 km north, metre by metre, equal the integral of the radius of curvature."""
    lat0, lon0 = 47.5, 19.0
    steps = 1000
    d = 0.009 / steps
    travelled = 0.0
    for i in range(steps):
        e, n, u = Frame((lat0 + i * d, lon0, 0.0)).enu(lat0 + (i + 1) * d, lon0, 0.0)
        travelled += math.sqrt(e * e + n * n + u * u)
    integral = 0.0
    for i in range(steps):
        s = math.sin(math.radians(lat0 + (i + 0.5) * d))
        integral += A_M * (1 - E2) / (1 - E2 * s * s) ** 1.5 * math.radians(d)
    assert abs(travelled - integral) < 1e-6


@pytest.mark.parametrize("azimuth", AZIMUTHS)
@pytest.mark.parametrize("place", PLACES)
def test_enu_round_trip_is_far_below_a_micrometre(place: tuple[float, float, float], azimuth: float) -> None:
    rng = random.Random(7)
    frame = Frame(place, azimuth)
    for reach in (0.01, 1.0, 300.0):
        for _ in range(20):
            enu = tuple(rng.uniform(-reach, reach) for _ in range(3))
            assert close(frame.enu(*frame.geodetic(enu)), enu, 1e-8)  # type: ignore[arg-type]
            assert close(frame.to_enu(frame.to_structure(enu)), enu, 1e-12)  # type: ignore[arg-type]


def test_the_reference_is_the_origin() -> None:
    for place in PLACES:
        assert Frame(place, 17.0).structure(*place) == (0.0, 0.0, 0.0)


def test_azimuth_turns_the_axes() -> None:
    at = (51.0, 13.7, 100.0)
    assert Frame(at, 90.0).to_structure((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert Frame(at, 0.0).to_structure((1.0, 2.0, 3.0)) == (2.0, -1.0, 3.0)  # x north, y west
    assert Frame(at, 180.0).to_structure((1.0, 2.0, 3.0)) == (-2.0, 1.0, 3.0)
    assert Frame(at, 450.0).to_structure((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    east_of_north = math.radians(30.0)
    along = (math.sin(east_of_north), math.cos(east_of_north), 0.0)
    assert close(Frame(at, 30.0).to_structure(along), (1.0, 0.0, 0.0), 1e-15)


def test_std_and_covariance_agree_with_each_other() -> None:
    at = (51.0, 13.7, 100.0)
    e, n, u = 0.003, 0.007, 0.02
    diagonal = ((e * e, 0.0, 0.0), (0.0, n * n, 0.0), (0.0, 0.0, u * u))
    for azimuth in AZIMUTHS:
        frame = Frame(at, azimuth)
        c = frame.covariance_to_structure(diagonal)
        std = frame.std_to_structure((e, n, u))
        assert close(tuple(math.sqrt(c[i][i]) for i in range(3)), std, 1e-15)
        assert abs(c[0][1] - c[1][0]) < 1e-18
        assert abs(c[0][0] + c[1][1] - e * e - n * n) < 1e-16  # the trace stays
    assert Frame(at, 90.0).std_to_structure((e, math.nan, u))[0] == e


def test_full_covariance_is_rotated_as_its_samples_are() -> None:
    """R (sum v v') R' is the sum of (R v)(R v)' for any vectors v."""
    rng = random.Random(3)
    frame = Frame((47.0, 8.0, 400.0), 63.0)
    vectors = [(rng.gauss(0, 1), rng.gauss(0, 2), rng.gauss(0, 3)) for _ in range(5)]

    def moment(vs: list[tuple[float, float, float]]) -> tuple[tuple[float, float, float], ...]:
        return tuple(tuple(sum(v[i] * v[j] for v in vs) for j in range(3)) for i in range(3))  # type: ignore[return-value]

    got = frame.covariance_to_structure(moment(vectors))  # type: ignore[arg-type]
    want = moment([frame.to_structure(v) for v in vectors])
    for row, right in zip(got, want, strict=True):
        assert close(row, right, 1e-12)


@pytest.mark.parametrize("reference", [(91.0, 0.0, 0.0), (0.0, 400.0, 0.0), (0.0, 0.0, math.nan), (math.nan, 0.0, 0.0)])
def test_a_reference_off_the_earth_is_refused(reference: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="reference"):
        Frame(reference)


def test_an_azimuth_must_be_a_number() -> None:
    with pytest.raises(ValueError, match="azimuth"):
        Frame((0.0, 0.0, 0.0), math.inf)


def test_flattening() -> None:
    assert abs(1.0 / F - 298.257223563) < 1e-12
