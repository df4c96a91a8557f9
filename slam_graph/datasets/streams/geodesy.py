# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Latitude, longitude and height on WGS84, and the local world whose axes point east, north, up."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray

SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)
_ITERATIONS = 6
"""Each makes the latitude 150 times better; the first is 0.2° off at most."""

Datum = tuple[float, float, float]
"""Latitude, longitude (degrees) and height above the ellipsoid (m) of an origin."""


def earth_centred(geodetic: FloatArray) -> FloatArray:
    """Positions (N, 3) in the axes of the earth (ECEF), m.

    Args:
        geodetic: (N, 3) latitude and longitude in degrees, height above the ellipsoid in m.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height = geodetic[:, 2]
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    return np.column_stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (normal * (1.0 - _ECCENTRICITY_2) + height) * np.sin(latitude),
        ]
    )


def geodetic_of(positions: FloatArray) -> FloatArray:
    """The inverse of `earth_centred`, not at the poles."""
    x, y, z = positions.T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1.0 - _ECCENTRICITY_2))
    for _ in range(_ITERATIONS):
        sine = np.sin(latitude)
        normal = SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * sine**2)
        latitude = np.arctan2(z + _ECCENTRICITY_2 * normal * sine, across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * sine**2)
    height = across * cosine + (z + _ECCENTRICITY_2 * normal * sine) * sine - normal
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height])


def local_axes(datum: Datum) -> FloatArray:
    """Rotation (3, 3) local_R_earth: rows are east, north and up at a datum."""
    latitude, longitude = np.radians(datum[:2])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def local_positions(geodetic: FloatArray, datum: Datum) -> FloatArray:
    """Positions (N, 3) east, north and up of a datum, m, of (N, 3) latitude, longitude, height."""
    from_origin = earth_centred(geodetic) - earth_centred(np.array([datum]))
    return np.asarray(from_origin @ local_axes(datum).T)


def geodetic_positions(local: FloatArray, datum: Datum) -> FloatArray:
    """The inverse of `local_positions`."""
    return geodetic_of(local @ local_axes(datum) + earth_centred(np.array([datum])))
