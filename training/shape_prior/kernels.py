"""Compiled kernels: solids become a field on the rays of the input camera, crossings, colors and an outline."""

import math
from typing import no_type_check

import numpy as np

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.shape_prior.frustum import FAR, NEAR, TAN_HALF_FOV
from training.shape_prior.solids import BOX, CARVE, CONE, CYLINDER, ELLIPSOID, PAINT, PLATE, TORUS, UNION
from training.shape_prior.texture import (
    AMBIENT,
    BELLY,
    CHECKER,
    CLOUDS,
    DIFFUSE,
    GRAIN,
    HEMISPHERE,
    OCCLUSION,
    RIM,
    SPECULAR,
    SPOTS,
    STRIPES,
    TOON,
    VERTICAL,
)

OPTIONS = {"cache": True, "fastmath": {"nsz", "contract", "reassoc", "arcp"}, "error_model": "numpy", "nogil": True}
EMPTY = 1.0  # of the field where no solid is near
MARGIN = 0.045  # world units around a solid in which its distance is known, at least
MOST_SOLIDS = 128  # bits of the two words that say which solids are near a ray
INTERVALS = 5  # of matter along a ray; further ones are merged into the last


@njit(**OPTIONS)
@no_type_check
def distance(kind, row, x, y, z):
    """Signed distance, about, from a point to a solid; negative inside."""
    dx, dy, dz = x - row[0], y - row[1], z - row[2]
    u = row[3] * dx + row[4] * dy + row[5] * dz
    v = row[6] * dx + row[7] * dy + row[8] * dz
    w = row[9] * dx + row[10] * dy + row[11] * dz
    if kind == ELLIPSOID:
        return _ellipsoid(u, v, w, row[12], row[13], row[14])
    if kind == CONE:
        length, first, second, flat = row[15], row[16], row[17], row[18]
        share = min(max((v + length) / (2 * length), 0.0), 1.0)
        along = v - (2 * share - 1) * length
        across = w / flat
        off = math.sqrt(u * u + along * along + across * across) - (first + share * (second - first))
        return off * min(1.0, flat)
    if kind in (BOX, CYLINDER):
        rounding = row[15]
        grow = 1 + row[16] * min(max(v / row[18], -1.0), 1.0)
        if kind == BOX:
            qu, qw = abs(u) - row[17] * grow + rounding, abs(w) - row[19] * grow + rounding
        else:
            qu = math.sqrt(u * u + (w * row[17] / row[19]) ** 2) - row[17] * grow + rounding
            qw = -1.0
            if row[19] < row[17]:
                qu *= row[19] / row[17]
        qv = abs(v) - row[18] + rounding
        outside = math.sqrt(max(qu, 0.0) ** 2 + max(qv, 0.0) ** 2 + max(qw, 0.0) ** 2)
        return outside + min(max(qu, qv, qw), 0.0) - rounding
    if kind == TORUS:
        ring = math.sqrt(u * u + w * w) - row[15]
        return math.sqrt(ring * ring + v * v) - row[16]
    if kind == PLATE:
        flat = _quadrilateral(u, v, row)
        return max(flat, abs(w) - row[14]) if flat < 0 else math.sqrt(flat * flat + max(abs(w) - row[14], 0.0) ** 2)
    body = abs(_ellipsoid(u, v, w, row[17], row[18], row[19])) - row[15]
    return max(body, row[16] * row[18] - v)


@njit(**OPTIONS)
@no_type_check
def _ellipsoid(u, v, w, a, b, c):
    u, v, w = u / a, v / b, w / c
    reach = math.sqrt(u * u + v * v + w * w)
    steep = math.sqrt((u / a) ** 2 + (v / b) ** 2 + (w / c) ** 2) + 1e-9
    return max(reach * (reach - 1) / steep, -min(a, b, c))


@njit(**OPTIONS)
@no_type_check
def _quadrilateral(u, v, row):
    """Signed distance in the plane to the polygon of the four corners."""
    nearest = 1e9
    inside = False
    px, py = row[21], row[22]
    for corner in range(4):
        qx, qy = row[15 + 2 * corner], row[16 + 2 * corner]
        ex, ey, wx, wy = px - qx, py - qy, u - qx, v - qy
        share = min(max((wx * ex + wy * ey) / (ex * ex + ey * ey + 1e-12), 0.0), 1.0)
        nearest = min(nearest, (wx - ex * share) ** 2 + (wy - ey * share) ** 2)
        if (qy > v) != (py > v) and u < (px - qx) * (v - qy) / (py - qy) + qx:
            inside = not inside
        px, py = qx, qy
    return -math.sqrt(nearest) if inside else math.sqrt(nearest)


@njit(**OPTIONS)
@no_type_check
def fill(labels, numbers, field, near):
    """Join the solids on all rays.

    Args:
        labels: kind, operation and material of every solid.
        numbers: the rows of `packed`, in world units.
        field: filled with the signed distance at the middle of every cell, row, column, depth; `EMPTY` far away.
        near: filled with two words of bits per ray: the solids that may touch it.
    """
    size, bins = field.shape[1], field.shape[2]
    step = (FAR - NEAR) / bins
    field[:] = EMPTY
    near[:] = 0
    for solid in range(len(labels)):
        kind, operation = labels[solid, 0], labels[solid, 1]
        row = numbers[solid]
        blend = row[-1]
        margin = max(MARGIN, blend)
        left, right, top, bottom = _window(row, margin, size)
        bit = np.uint64(1) << np.uint64(solid & 63)
        word = solid >> 6
        for j in range(top, bottom):
            vy = (1 - 2 * (j + 0.5) / size) * TAN_HALF_FOV
            for i in range(left, right):
                vx = (2 * (i + 0.5) / size - 1) * TAN_HALF_FOV
                enter, leave = _span(row, vx, vy, margin)
                if enter > leave:
                    continue
                first, last = max(0, int((enter - NEAR) / step)), min(bins, int((leave - NEAR) / step) + 1)
                if first >= last:
                    continue
                near[j, i, word] |= bit
                if operation == PAINT:
                    continue
                cells = field[j, i]
                for d in range(first, last):
                    t = NEAR + (d + 0.5) * step
                    s = distance(kind, row, vx * t, vy * t, RADIUS - t)
                    f = cells[d]
                    if operation == CARVE:
                        cells[d] = max(f, -s)
                    elif blend > 1e-6:
                        h = max(blend - abs(f - s), 0.0) / blend
                        cells[d] = min(f, s) - h * h * blend * 0.25
                    else:
                        cells[d] = min(f, s)


@njit(**OPTIONS)
@no_type_check
def _window(row, margin, size):
    """Columns and rows of the picture that a solid's box may cover."""
    low_x, high_x, low_y, high_y = 1e9, -1e9, 1e9, -1e9
    for corner in range(8):
        a = (row[12] + margin) * (1 if corner & 1 else -1)
        b = (row[13] + margin) * (1 if corner & 2 else -1)
        c = (row[14] + margin) * (1 if corner & 4 else -1)
        x = row[0] + a * row[3] + b * row[6] + c * row[9]
        y = row[1] + a * row[4] + b * row[7] + c * row[10]
        t = max(RADIUS - row[2] - a * row[5] - b * row[8] - c * row[11], 0.3)
        low_x, high_x = min(low_x, x / t), max(high_x, x / t)
        low_y, high_y = min(low_y, y / t), max(high_y, y / t)
    scale = 0.5 * size / TAN_HALF_FOV
    left, right = int(0.5 * size + low_x * scale), int(0.5 * size + high_x * scale) + 1
    top, bottom = int(0.5 * size - high_y * scale), int(0.5 * size - low_y * scale) + 1
    return max(0, left), min(size, right), max(0, top), min(size, bottom)


@njit(**OPTIONS)
@no_type_check
def _span(row, vx, vy, margin):
    """Distances between which a ray is in a solid's box; the first is the greater if it never is."""
    enter, leave = NEAR, FAR
    dx, dy, dz = -row[0], -row[1], RADIUS - row[2]
    for axis in range(3):
        a, b, c = row[3 + 3 * axis], row[4 + 3 * axis], row[5 + 3 * axis]
        start = a * dx + b * dy + c * dz
        speed = a * vx + b * vy - c
        half = row[12 + axis] + margin
        if abs(speed) < 1e-7:
            if abs(start) > half:
                return 1.0, 0.0
            continue
        one, two = (-half - start) / speed, (half - start) / speed
        enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter, leave


@njit(**OPTIONS)
@no_type_check
def cross(field, counts, depths, coverage, nearest):
    """Find where rays enter and leave matter.

    Args:
        field: of `fill`.
        counts: filled with the number of crossings of every ray: even, at most 2 x INTERVALS.
        depths: filled with their distances, from the camera on.
        coverage: filled with the share of every pixel that matter covers.
        nearest: filled with the distance at which a ray comes nearest to matter.
    """
    size, bins = field.shape[1], field.shape[2]
    step = (FAR - NEAR) / bins
    for j in range(field.shape[0]):
        for i in range(size):
            cells = field[j, i]
            found = 0
            before, least, at = EMPTY, EMPTY, 0
            for d in range(bins):
                f = cells[d]
                if f < least:
                    least, at = f, d
                if (f < 0) != (before < 0):
                    a, b = min(max(before, -step), step), min(max(f, -step), step)
                    t = NEAR + (d - 0.5 + a / (a - b)) * step
                    if found == 2 * INTERVALS:
                        found -= 2 if f < 0 else 1
                        if f < 0:
                            found += 1
                            before = f
                            continue
                    depths[j, i, found] = max(t, NEAR)
                    found += 1
                before = f
            if before < 0 and found % 2 == 1:
                depths[j, i, found] = FAR
                found += 1
            counts[j, i] = found
            t = NEAR + (at + 0.5) * step
            nearest[j, i] = t
            pixel = 2 * TAN_HALF_FOV * t / size
            coverage[j, i] = min(max(0.5 - least / pixel, 0.0), 1.0)


@njit(**OPTIONS)
@no_type_check
def shade(labels, numbers, materials, light, to_object, field, near, counts, depths, coverage, nearest, colors, parts):
    """Color all crossings, and the rims where a ray only grazes matter.

    Args:
        labels: as in `fill`.
        numbers: as in `fill`.
        materials: a row of numbers per material; see `texture`.
        light: direction and numbers of `texture`.
        to_object: 3 x 4, from the world to object space.
        field: of `fill`.
        near: of `fill`.
        counts: of `cross`.
        depths: of `cross`.
        coverage: of `cross`.
        nearest: of `cross`.
        colors: filled with the color in [0, 1] of every crossing.
        parts: filled with the solid that is seen first, -1 where nothing is.
    """
    size = field.shape[1]
    row_out = np.zeros(3, np.float32)
    for j in range(field.shape[0]):
        vy = (1 - 2 * (j + 0.5) / size) * TAN_HALF_FOV
        for i in range(size):
            parts[j, i] = -1
            if coverage[j, i] <= 0:
                continue
            vx = (2 * (i + 0.5) / size - 1) * TAN_HALF_FOV
            for k in range(max(1, counts[j, i])):
                t = depths[j, i, k] if counts[j, i] else nearest[j, i]
                part = _shade_point(
                    labels, numbers, materials, light, to_object, field, near[j, i], vx, vy, t, k == 0, row_out
                )
                colors[j, i, k, 0], colors[j, i, k, 1], colors[j, i, k, 2] = row_out[0], row_out[1], row_out[2]
                if k == 0:
                    parts[j, i] = part


@njit(**OPTIONS)
@no_type_check
def _shade_point(labels, numbers, materials, light, to_object, field, near, vx, vy, t, first, out):
    x, y, z = vx * t, vy * t, RADIUS - t
    best, second = -1, -1
    s1, s2 = 1e9, 1e9
    carve, hollow = -1, -1e9
    for solid in range(len(labels)):
        if not near[solid >> 6] >> np.uint64(solid & 63) & np.uint64(1):
            continue
        operation = labels[solid, 1]
        if operation == UNION:
            s = distance(labels[solid, 0], numbers[solid], x, y, z)
            if s < s1:
                second, s2, best, s1 = best, s1, solid, s
            elif s < s2:
                second, s2 = solid, s
        elif operation == CARVE:
            s = -distance(labels[solid, 0], numbers[solid], x, y, z)
            if s > hollow:
                carve, hollow = solid, s
    if best < 0:
        out[:] = 0.5
        return -1
    pixel = 2 * TAN_HALF_FOV * t / field.shape[1]
    inside = carve >= 0 and hollow > s1 + 0.5 * pixel
    owner = carve if inside else best
    nx, ny, nz = _normal(labels[owner, 0], numbers[owner], x, y, z)
    if inside:
        nx, ny, nz = -nx, -ny, -nz
    share = 0.0
    if not inside and second >= 0:
        blend = max(numbers[best, -1], numbers[second, -1])
        if s2 - s1 < blend:
            smooth = 0.5 * (1 - (s2 - s1) / blend)
            mx, my, mz = _normal(labels[second, 0], numbers[second], x, y, z)
            nx, ny, nz = nx + smooth * (mx - nx), ny + smooth * (my - ny), nz + smooth * (mz - nz)
        share = 0.5 * max(0.0, 1 - (s2 - s1) / pixel)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    px = to_object[0, 0] * x + to_object[0, 1] * y + to_object[0, 2] * z + to_object[0, 3]
    py = to_object[1, 0] * x + to_object[1, 1] * y + to_object[1, 2] * z + to_object[1, 3]
    pz = to_object[2, 0] * x + to_object[2, 1] * y + to_object[2, 2] * z + to_object[2, 3]
    up = to_object[1, 0] * nx + to_object[1, 1] * ny + to_object[1, 2] * nz
    red, green, blue = _albedo(materials[labels[owner, 2]], px, py, pz, up)
    if share > 0 and labels[second, 2] != labels[owner, 2]:
        r, g, b = _albedo(materials[labels[second, 2]], px, py, pz, up)
        red, green, blue = red + share * (r - red), green + share * (g - green), blue + share * (b - blue)
    for solid in range(len(labels)):
        if labels[solid, 1] == PAINT and near[solid >> 6] >> np.uint64(solid & 63) & np.uint64(1):
            s = distance(labels[solid, 0], numbers[solid], x, y, z)
            share = min(max(0.5 - s / pixel, 0.0), 1.0)
            if share > 0:
                r, g, b = _albedo(materials[labels[solid, 2]], px, py, pz, up)
                red, green, blue = red + share * (r - red), green + share * (g - green), blue + share * (b - blue)
    lit, gloss = _light(light, nx, ny, nz, x, y, z, first)
    if light[OCCLUSION] > 0:
        lit *= 1 - light[OCCLUSION] * _occlusion(field, x + 0.09 * nx, y + 0.09 * ny, z + 0.09 * nz)
    out[0] = min(max(red * lit + gloss, 0.0), 1.0)
    out[1] = min(max(green * lit + gloss, 0.0), 1.0)
    out[2] = min(max(blue * lit + gloss, 0.0), 1.0)
    return owner


@njit(**OPTIONS)
@no_type_check
def _normal(kind, row, x, y, z):
    e = 2e-3
    nx = distance(kind, row, x + e, y, z) - distance(kind, row, x - e, y, z)
    ny = distance(kind, row, x, y + e, z) - distance(kind, row, x, y - e, z)
    nz = distance(kind, row, x, y, z + e) - distance(kind, row, x, y, z - e)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
    return nx / norm, ny / norm, nz / norm


@njit(**OPTIONS)
@no_type_check
def _light(light, nx, ny, nz, x, y, z, first):
    """Factor of the albedo, and the specular term of surfaces that the camera sees."""
    facing = light[0] * nx + light[1] * ny + light[2] * nz
    lit = max(facing, 0.0)
    if light[TOON] > 0:
        lit = math.floor(lit * light[TOON] + 0.5) / light[TOON]
    lit = light[AMBIENT] + light[HEMISPHERE] * (0.5 + 0.5 * ny) + light[DIFFUSE] * lit
    if not first:
        return lit, 0.0
    vx, vy, vz = -x, -y, RADIUS - z
    norm = math.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx / norm, vy / norm, vz / norm
    hx, hy, hz = light[0] + vx, light[1] + vy, light[2] + vz
    norm = math.sqrt(hx * hx + hy * hy + hz * hz) + 1e-9
    gloss = light[SPECULAR] * max((hx * nx + hy * ny + hz * nz) / norm, 0.0) ** 24
    edge = 1 - max(vx * nx + vy * ny + vz * nz, 0.0)
    return lit, gloss + light[RIM] * edge * edge * edge


@njit(**OPTIONS)
@no_type_check
def _occlusion(field, x, y, z):
    """Share of the light that matter near a point takes away."""
    size, bins = field.shape[1], field.shape[2]
    t = RADIUS - z
    i = int((0.5 + 0.5 * x / t / TAN_HALF_FOV) * size)
    j = int((0.5 - 0.5 * y / t / TAN_HALF_FOV) * size)
    d = int((t - NEAR) / (FAR - NEAR) * bins)
    if i < 0 or j < 0 or d < 0 or i >= size or j >= size or d >= bins:
        return 0.0
    return min(max(1 - field[j, i, d] / 0.08, 0.0), 1.0)


@njit(**OPTIONS)
@no_type_check
def _albedo(material, x, y, z, up):
    """Color of a material at a point of object space, whose normal points up by `up`."""
    pattern = int(material[0])
    share = 0.0
    scale, phase, sharp = material[7], material[8], material[9]
    if material[10] > 0:
        x = abs(x)
    if pattern == STRIPES:
        along = material[11] * x + material[12] * y + material[13] * z
        along += material[14] * (_noise(x * scale * 0.3 + phase, y * scale * 0.3, z * scale * 0.3) - 0.5)
        share = 0.5 + sharp * math.sin(along * scale * 3 + phase)
    elif pattern == SPOTS:
        share = 0.5 + sharp * 3 * (material[14] - _cell(x * scale + phase, y * scale, z * scale))
    elif pattern == CLOUDS:
        share = 0.5 + sharp * 3 * (_noise(x * scale * 0.6 + phase, y * scale * 0.6, z * scale * 0.6) - material[14])
    elif pattern == VERTICAL:
        share = 0.5 + sharp * (y - phase * 0.1)
    elif pattern == BELLY:
        share = 0.5 + 3 * sharp * (-up - material[14])
    elif pattern == CHECKER:
        odd = math.floor(x * scale) + math.floor(y * scale + phase) + math.floor(z * scale)
        share = float(int(odd) & 1)
    elif pattern == GRAIN:
        share = 0.5 * _noise(x * scale * 4, y * scale * 4 + phase, z * scale * 4) + 0.5 * _noise(
            x * scale * 9, y * scale * 9, z * scale * 9 + phase
        )
    share = min(max(share, 0.0), 1.0)
    return (
        material[1] + share * (material[4] - material[1]),
        material[2] + share * (material[5] - material[2]),
        material[3] + share * (material[6] - material[3]),
    )


@njit(**OPTIONS)
@no_type_check
def _hash(i, j, k):
    h = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    h = (h ^ (h >> 13)) * 1274126177
    return ((h ^ (h >> 16)) & 0xFFFF) / 65535.0


@njit(**OPTIONS)
@no_type_check
def _noise(x, y, z):
    """Value noise in [0, 1]."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    i, j, k = int(i), int(j), int(k)
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
        total += weight * _hash(i + a, j + b, k + c)
    return total


@njit(**OPTIONS)
@no_type_check
def _cell(x, y, z):
    """Distance to the nearest of jittered points, one in each unit cell."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    least = 9.0
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                dx = a + 0.2 + 0.6 * _hash(a, b, c) - x
                dy = b + 0.2 + 0.6 * _hash(b + 7, c, a) - y
                dz = c + 0.2 + 0.6 * _hash(c, a + 13, b) - z
                least = min(least, dx * dx + dy * dy + dz * dz)
    return math.sqrt(least)


@njit(**OPTIONS)
@no_type_check
def soft_occupancy(depths, counts, occupancy):
    """Fill the share of every cell of some rays that lies in matter.

    Args:
        depths: distances of the crossings in units of the whole range, from 0 to 1.
        counts: crossings per ray.
        occupancy: filled, ray by ray.
    """
    bins = occupancy.shape[1]
    occupancy[:] = 0
    for ray in range(len(counts)):
        for k in range(0, counts[ray], 2):
            start, stop = depths[ray, k] * bins, depths[ray, k + 1] * bins
            for d in range(max(0, int(start)), min(bins, int(stop) + 1)):
                occupancy[ray, d] += max(0.0, min(stop, d + 1.0) - max(start, float(d)))
    return occupancy
