"""Microfacet reflection, compiled by numba.

GGX distribution (Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206) with height-correlated Smith
masking (Heitz 2014, JCGT 3(2)) and Schlick's Fresnel term (1994, doi:10.1111/1467-8659.1330233), as
in the Principled model (Burley 2012). Normals are drawn by their visibility (Heitz 2018, JCGT
7(4)).
`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit, prange

from lightsim.render.transport.kernels import GOLDEN_2D

# Least cosine of the viewing direction, a guard: shading normals may lean away from the camera.
_GRAZING = 1e-3


@njit(cache=True, nogil=True)
@no_type_check
def _basis(n):
    """Return the tangents of a normal (Duff et al. 2017, JCGT 6(1))."""
    x, y, z = np.float64(n[0]), np.float64(n[1]), np.float64(n[2])
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@njit(cache=True, nogil=True)
@no_type_check
def _local(v, n, t, s):
    """Return a vector in the basis (t, s, n)."""
    x = v[0] * t[0] + v[1] * t[1] + v[2] * t[2]
    y = v[0] * s[0] + v[1] * s[1] + v[2] * s[2]
    return x, y, v[0] * n[0] + v[1] * n[1] + v[2] * n[2]


@njit(cache=True, nogil=True)
@no_type_check
def _smith(x, y, z, alpha):
    """Return Smith's Lambda of GGX (Heitz 2014, JCGT 3(2))."""
    slope = alpha * alpha * (x * x + y * y) / (z * z)
    return 0.5 * (np.sqrt(1.0 + slope) - 1.0)


@njit(cache=True, nogil=True)
@no_type_check
def _visible_normal(x, y, z, alpha, u, v):
    """Return a microfacet normal, drawn in proportion to its projected area towards (x, y, z)."""
    # Stretch to the hemisphere of roughness 1 (Heitz 2018, section 3).
    sx, sy, sz = alpha * x, alpha * y, z
    length = np.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx / length, sy / length, sz / length
    flat = sx * sx + sy * sy
    ax, ay = (-sy / np.sqrt(flat), sx / np.sqrt(flat)) if flat > 1e-12 else (1.0, 0.0)
    bx, by, bz = -sz * ay, sz * ax, sx * ay - sy * ax
    radius, angle = np.sqrt(u), 2.0 * np.pi * v
    p, q = radius * np.cos(angle), radius * np.sin(angle)
    mix = 0.5 * (1.0 + sz)
    q = (1.0 - mix) * np.sqrt(max(0.0, 1.0 - p * p)) + mix * q
    r = np.sqrt(max(0.0, 1.0 - p * p - q * q))
    hx, hy, hz = p * ax + q * bx + r * sx, p * ay + q * by + r * sy, q * bz + r * sz
    # Back to the ellipsoid.
    hx, hy, hz = alpha * hx, alpha * hy, max(1e-6, hz)
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    return hx / length, hy / length, hz / length


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def reflected_rays(normals, towards_camera, alphas, shifts, part, directions, weights):
    """Write reflected directions of each point: its part of a pattern that several points complete.

    `part` is (part of each point, number of parts, directions in each part). `weights` has two
    factors of each ray's radiance: that of the reflectance F0 at normal incidence, and an added
    constant (Schlick: F = F0 (1 - s) + s).
    """
    which, parts, count = part
    total = parts * count
    for p in prange(normals.shape[0]):
        n = normals[p]
        t, s = _basis(n)
        x, y, z = _local(towards_camera[p], n, t, s)
        z = max(z, _GRAZING)
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        alpha = alphas[p]
        masked = _smith(x, y, z, alpha)
        for k in range(count):
            m = k * parts + which[p]
            u = (shifts[p, 0] + (m + 0.5) / total) % 1.0
            v = (shifts[p, 1] + (m + 1) * GOLDEN_2D[1]) % 1.0
            # Reflected directions below the surface lose their energy, as in single scattering.
            hx, hy, hz = _visible_normal(x, y, z, alpha, u, v)
            cosine = x * hx + y * hy + z * hz
            lx, ly, lz = 2 * cosine * hx - x, 2 * cosine * hy - y, 2 * cosine * hz - z
            weights[p, k, 0] = weights[p, k, 1] = 0.0
            if lz <= 0.0:
                lx, ly, lz = 0.0, 0.0, 1.0
            else:
                ratio = (1.0 + masked) / (1.0 + masked + _smith(lx, ly, lz, alpha))
                grazing = (1.0 - min(cosine, 1.0)) ** 5
                weights[p, k, 0], weights[p, k, 1] = ratio * (1.0 - grazing), ratio * grazing
            for i in range(3):
                directions[p, k, i] = lx * t[i] + ly * s[i] + lz * n[i]


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def reflectance(normals, towards_camera, towards_light, alphas, out):
    """Write GGX without Fresnel, times the light's cosine, for one light direction; and Schlick's
    s.

    `out[:, 0]` is D G / (4 cos_view), `out[:, 1]` is s.
    """
    for p in prange(normals.shape[0]):
        n = normals[p]
        t, s = _basis(n)
        x, y, z = _local(towards_camera[p], n, t, s)
        lx, ly, lz = _local(towards_light[p], n, t, s)
        out[p, 0] = out[p, 1] = 0.0
        if lz <= 0.0:
            continue
        z = max(z, _GRAZING)
        hx, hy, hz = x + lx, y + ly, z + lz
        length = np.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        squared = alphas[p] * alphas[p]
        # 1 - hz^2 from the tangential part: the plain difference loses all digits at hz = 1.
        denominator = hx * hx + hy * hy + squared * hz * hz
        density = squared / (np.pi * denominator * denominator)
        masked = 1.0 + _smith(x, y, z, alphas[p]) + _smith(lx, ly, lz, alphas[p])
        out[p, 0] = density / (4.0 * z * masked)
        out[p, 1] = (1.0 - min(max(lx * hx + ly * hy + lz * hz, 0.0), 1.0)) ** 5


@njit(cache=True, nogil=True)
@no_type_check
def _bilinear(image, u, v, channel):
    """Look up an equirectangular image at fractions (u, v); wraps around in azimuth."""
    height, width = image.shape[0], image.shape[1]
    x = u * width - 0.5
    y = min(max(v * height - 0.5, 0.0), height - 1.0)
    j, i = int(np.floor(x)), int(y)
    fx, fy = x - j, y - i
    below = min(i + 1, height - 1)
    left, right = j % width, (j + 1) % width
    top = (1.0 - fx) * image[i, left, channel] + fx * image[i, right, channel]
    low = (1.0 - fx) * image[below, left, channel] + fx * image[below, right, channel]
    return (1.0 - fy) * top + fy * low


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def reflected_light(directions_uv, face_rows, weights, f0, sky, radiosity, out):
    """Write the radiance that each point reflects: the weighted mean over its rays of sky and
    faces."""
    count = face_rows.shape[1]
    for p in prange(face_rows.shape[0]):
        total = np.zeros(3)
        for k in range(count):
            f = face_rows[p, k]
            for i in range(3):
                weight = f0[p, i] * weights[p, k, 0] + weights[p, k, 1]
                if f >= 0:
                    total[i] += weight * radiosity[f, i]
                else:
                    u = (directions_uv[p, k, 0] + 0.5) / 65536.0
                    v = (directions_uv[p, k, 1] + 0.5) / 65536.0
                    total[i] += weight * _bilinear(sky, u, v, i)
        for i in range(3):
            out[p, i] = total[i] / count
