"""Positions on the WGS84 ellipsoid to metres about a reference, east-north-up and in the structure's axes.

Scalars and `math` only: a fix costs a few microseconds and no array. Degrees at the border, radians inside. Everything
is the exact transformation, no flat-earth approximation; double precision leaves at most 5e-9 m near the reference (one
unit in the last place of an ECEF coordinate is 9.3e-10 m, of a latitude of 50 deg 7.9e-10 m).

Structure axes: x points to `azimuth_deg` clockwise from true north, y 90 deg left of x, z up; azimuth 90 makes them
east, north, up exactly. Formulas: B. Hofmann-Wellenhof et al., GNSS (2008), section 8.2 (geodetic to ECEF and ENU);
B. R. Bowring, Survey Review 23 (1976) (ECEF to geodetic), iterated to the last bit.
Left out: datum shifts, plate motion, deflection of the vertical (up is the ellipsoid's normal).
"""

from __future__ import annotations

import math
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]

A_M = 6378137.0
"""Semi-major axis of WGS84 [m]."""
F = 1.0 / 298.257223563
"""Flattening of WGS84."""
B_M = A_M * (1.0 - F)
E2 = F * (2.0 - F)
"""First eccentricity squared."""
_EP2 = E2 / (1.0 - E2)


def geodetic_to_ecef(lat_deg: float, lon_deg: float, h_m: float) -> Vector:
    """Earth-centred x, y, z [m] of latitude, longitude [deg] and ellipsoidal height [m]."""
    lat = math.radians(lat_deg)
    lon = math.radians(lon_deg)
    s = math.sin(lat)
    n = A_M / math.sqrt(1.0 - E2 * s * s)
    p = (n + h_m) * math.cos(lat)
    return p * math.cos(lon), p * math.sin(lon), (n * (1.0 - E2) + h_m) * s


def ecef_to_geodetic(x_m: float, y_m: float, z_m: float) -> Vector:
    """Latitude, longitude [deg] and ellipsoidal height [m] of earth-centred x, y, z [m].

    Bowring's formula in the reduced latitude, iterated until nothing changes (two or three rounds near the ground).
    Raises ValueError within 50 km of the earth's centre, where latitude means nothing.
    """
    p = math.hypot(x_m, y_m)
    if not math.hypot(p, z_m) > 50e3:
        raise ValueError(f"({x_m}, {y_m}, {z_m}) m is not a place near the surface of the earth")
    beta = math.atan2(z_m * A_M, p * B_M)
    lat = 0.0
    for _ in range(8):
        s = math.sin(beta)
        c = math.cos(beta)
        before = lat
        lat = math.atan2(z_m + _EP2 * B_M * s * s * s, p - E2 * A_M * c * c * c)
        if abs(lat - before) < 1e-16:
            break
        beta = math.atan2((1.0 - F) * math.sin(lat), math.cos(lat))
    s = math.sin(lat)
    h = p * math.cos(lat) + z_m * s - A_M * math.sqrt(1.0 - E2 * s * s)
    return math.degrees(lat), math.degrees(math.atan2(y_m, x_m)), h


class Frame:
    """A reference point and the direction of the structure's x axis, with what depends on them alone precomputed.

    `reference_llh` = latitude, longitude [deg], ellipsoidal height [m]; ValueError where it is no place on earth.
    """

    __slots__ = ("_cos", "_rotation", "_sin", "azimuth_deg", "origin_ecef_m", "reference_llh")

    def __init__(self, reference_llh: Vector, azimuth_deg: float = 90.0) -> None:
        lat_deg, lon_deg, h_m = reference_llh
        if not (-90.0 <= lat_deg <= 90.0 and -360.0 <= lon_deg <= 360.0 and -1e5 < h_m < 1e7):
            raise ValueError(
                f"reference {reference_llh}: latitude -90..90 deg, longitude -180..180 deg, height in metres"
            )
        if not math.isfinite(azimuth_deg):
            raise ValueError(f"azimuth {azimuth_deg}: degrees clockwise from true north")
        self.reference_llh = reference_llh
        self.azimuth_deg = azimuth_deg
        self.origin_ecef_m = geodetic_to_ecef(lat_deg, lon_deg, h_m)
        sp, cp = math.sin(math.radians(lat_deg)), math.cos(math.radians(lat_deg))
        sl, cl = math.sin(math.radians(lon_deg)), math.cos(math.radians(lon_deg))
        self._rotation: Matrix = ((-sl, cl, 0.0), (-sp * cl, -sp * sl, cp), (cp * cl, cp * sl, sp))
        self._sin, self._cos = _sin_cos_deg(azimuth_deg)

    def enu(self, lat_deg: float, lon_deg: float, h_m: float) -> Vector:
        """East, north, up [m] of a position about the reference."""
        x, y, z = geodetic_to_ecef(lat_deg, lon_deg, h_m)
        x0, y0, z0 = self.origin_ecef_m
        x -= x0
        y -= y0
        z -= z0
        e, n, u = self._rotation
        return (e[0] * x + e[1] * y, n[0] * x + n[1] * y + n[2] * z, u[0] * x + u[1] * y + u[2] * z)

    def structure(self, lat_deg: float, lon_deg: float, h_m: float) -> Vector:
        """x, y, z [m] of a position in structure axes about the reference."""
        return self.to_structure(self.enu(lat_deg, lon_deg, h_m))

    def geodetic(self, enu_m: Vector) -> Vector:
        """Inverse of `enu`: latitude, longitude [deg], ellipsoidal height [m] of an offset from the reference."""
        a, b, c = enu_m
        e, n, u = self._rotation
        x0, y0, z0 = self.origin_ecef_m
        return ecef_to_geodetic(
            x0 + (e[0] * a + n[0] * b + u[0] * c),
            y0 + (e[1] * a + n[1] * b + u[1] * c),
            z0 + (n[2] * b + u[2] * c),
        )

    def to_structure(self, enu: Vector) -> Vector:
        """Rotate a vector (metres, m/s, m/s2) from east, north, up to structure axes."""
        e, n, u = enu
        return self._sin * e + self._cos * n, -self._cos * e + self._sin * n, u

    def to_enu(self, xyz: Vector) -> Vector:
        """Inverse of `to_structure`."""
        x, y, z = xyz
        return self._sin * x - self._cos * y, self._cos * x + self._sin * y, z

    def std_to_structure(self, std_enu: Vector) -> Vector:
        """Standard deviations along x, y, z of independent ones along east, north, up. NaN where one is needed."""
        e, n, u = std_enu
        if self._cos == 0.0:
            return e, n, u  # also keeps a NaN north from spoiling a known east
        if self._sin == 0.0:
            return n, e, u
        s, c = self._sin, self._cos
        return math.hypot(s * e, c * n), math.hypot(c * e, s * n), u

    def covariance_to_structure(self, cov_enu: Matrix) -> Matrix:
        """R C R' for a full (3, 3) covariance in east, north, up."""
        rows = [self.to_structure(row) for row in cov_enu]  # C R'
        columns = [self.to_structure((rows[0][j], rows[1][j], rows[2][j])) for j in range(3)]
        return (
            (columns[0][0], columns[1][0], columns[2][0]),
            (columns[0][1], columns[1][1], columns[2][1]),
            (columns[0][2], columns[1][2], columns[2][2]),
        )


def _sin_cos_deg(angle_deg: float) -> tuple[float, float]:
    """Sine and cosine of degrees, exact at whole quarter turns."""
    angle = math.remainder(angle_deg, 360.0)
    quarter = round(angle / 90.0)
    rest = math.radians(angle - 90.0 * quarter)
    s, c = math.sin(rest), math.cos(rest)
    return ((s, c), (c, -s), (-s, -c), (-c, s))[quarter % 4]
