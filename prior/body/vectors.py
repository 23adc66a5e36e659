"""Vectors (x, y, z) and rotation matrices (3, 3) for compiled loops.

Vectors are tuples, because each assignment of an array to a part of another adds a second of compilation.
"""

from __future__ import annotations

import math

from steadypose.prior.compiled import njit


@njit(cache=True)
def point(points, joint):
    return points[joint, 0], points[joint, 1], points[joint, 2]


@njit(cache=True)
def difference(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def middle_of(points, joints):
    (ax, ay, az), (bx, by, bz) = point(points, joints[0]), point(points, joints[1])
    return (ax + bx) / 2.0, (ay + by) / 2.0, (az + bz) / 2.0


@njit(cache=True)
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def apart(points, a, b):
    """Distance between two joints of ``points`` (J, 3); NaN if either is unobserved."""
    between = difference(point(points, a), point(points, b))
    return math.sqrt(dot(between, between))


@njit(cache=True)
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def normalised(v):
    length = max(math.sqrt(dot(v, v)), 1e-9)
    return v[0] / length, v[1] / length, v[2] / length


@njit(cache=True)
def rotated(m, v):
    """``m @ v``"""
    return (
        m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2],
        m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2],
        m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2],
    )


@njit(cache=True)
def rotated_back(m, v):
    """``m.T @ v``"""
    return (
        m[0, 0] * v[0] + m[1, 0] * v[1] + m[2, 0] * v[2],
        m[0, 1] * v[0] + m[1, 1] * v[1] + m[2, 1] * v[2],
        m[0, 2] * v[0] + m[1, 2] * v[1] + m[2, 2] * v[2],
    )


@njit(cache=True)
def write_product(a, b, out):
    """Write ``a @ b``, both (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def write_relative(a, b, out):
    """Write ``a.T @ b``, both (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@njit(cache=True)
def frame_axes(left, up):
    """Return forward, left and up of a right-handed frame: y along ``left``, z in the plane of ``left`` and ``up``."""
    y = normalised(left)
    x = normalised(cross(y, up))
    return x, y, cross(x, y)


@njit(cache=True)
def write_rotation(axis, sine, cosine, rest, out):
    """Write Rodrigues' rotation.

    It is the sum of ``sine`` times the cross product with ``axis``, ``cosine`` times the identity, and ``rest`` times
    the outer product of ``axis`` with itself.
    """
    for i in range(3):
        for j in range(3):
            out[i, j] = rest * axis[i] * axis[j]
        out[i, i] += cosine
    out[0, 1] -= sine * axis[2]
    out[0, 2] += sine * axis[1]
    out[1, 0] += sine * axis[2]
    out[1, 2] -= sine * axis[0]
    out[2, 0] -= sine * axis[1]
    out[2, 1] += sine * axis[0]


@njit(cache=True)
def write_swing(a, b, out):
    """Write the smallest rotation (3, 3) that turns direction ``a`` into ``b``."""
    a, b = normalised(a), normalised(b)
    cosine = dot(a, b)
    if cosine < -1.0 + 1e-8:  # opposite directions have no unique smallest rotation; use any half turn
        other = (1.0, 0.0, 0.0) if abs(a[0]) < 0.9 else (0.0, 1.0, 0.0)
        write_rotation(normalised(cross(a, other)), 0.0, -1.0, 2.0, out)
    else:
        write_rotation(cross(a, b), 1.0, cosine, 1.0 / (1.0 + cosine), out)
