"""Loops of the tracer: hits in double precision, rays to lights, the rays that come next.

Every loop works on arrays of rays and is free of state, so that blocks of rays may go to any
thread.  Random numbers are hashes of a ray's key: they depend on the ray, not on the order of work.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = [
    "AREA",
    "AREA_BOTH_SIDES",
    "COMPLEX_SHADOW",
    "DIRECTIONAL",
    "FAINT",
    "INSHADOW",
    "LINEAR",
    "LINEAR_LAMBERTIAN",
    "NOT_INSHADOW",
    "POINT",
    "add_share",
    "agree_of_corners",
    "agreement",
    "assume",
    "begin",
    "child_keys",
    "count_spared",
    "gather_light",
    "interpolate",
    "light_rays",
    "light_targets",
    "lobe",
    "locate",
    "mirror",
    "next_rays",
    "refract",
    "scale_rows",
    "sent_unlit",
    "uniform",
    "unit_rays",
]

NOT_INSHADOW, INSHADOW, COMPLEX_SHADOW = 0, 1, 2
"""Woo's three states of a point and a light."""

POINT, DIRECTIONAL, LINEAR, LINEAR_LAMBERTIAN, AREA, AREA_BOTH_SIDES = range(6)
"""Laws by which a light's samples shine; a spot is a point with a cone."""

FAINT = 16.0
"""Highlights below exp(-FAINT), 1e-7, of their peak are left out."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_HALF_BITS = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@njit(nogil=True, cache=True, inline="always")
def _hash(key, salt):
    # SplitMix64 (G. Steele, D. Lea and C. Flood, OOPSLA 2014), of key and salt.
    x = np.uint64(key) + _GOLDEN * np.uint64(salt + 1)
    x = (x ^ (x >> _HALF_BITS[0])) * _MIX_1
    x = (x ^ (x >> _HALF_BITS[1])) * _MIX_2
    return x ^ (x >> _HALF_BITS[2])


@njit(nogil=True, cache=True)
def uniform(key, salt):
    """A number in [0, 1) from a key and a salt."""
    return float(_hash(key, salt) >> _HALF_BITS[3]) * (1.0 / 9007199254740992.0)


@njit(nogil=True, cache=True)
def child_keys(keys, salt, copies):
    """Keys (n * copies,) of the rays that follow from rays with ``keys`` (n,)."""
    found = np.empty(keys.shape[0] * copies, dtype=np.uint64)
    for i in range(keys.shape[0]):
        for j in range(copies):
            found[i * copies + j] = _hash(keys[i], salt + 16 * j)
    return found


@njit(nogil=True, cache=True)
def locate(
    rows, origins, directions, polygons, first_triangle, triangles, corner_normals, must_contain, near,
    t, points, facing, shading, front,
):  # fmt: skip
    """Where each ray of ``rows`` meets the polygon it is said to meet, and the normals there.

    Every polygon is a fan of ``triangles[first_triangle[p]:first_triangle[p + 1]]``; the one that
    contains the crossing best decides.  With ``must_contain`` a ray that crosses outside the
    polygon, or before ``near``, gets ``t`` infinite; otherwise the crossing is moved onto the plane.
    ``facing`` is the unit normal of the triangle and ``shading`` the interpolated one (the same
    where ``corner_normals`` is empty), both turned toward the ray's origin; ``front`` says whether
    the front side is seen.
    """
    smooth = corner_normals.shape[0] > 0
    for i in rows:
        p = polygons[i]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        best = -math.inf
        t[i] = math.inf
        chosen = -1
        b1 = b2 = 0.0
        for k in range(first_triangle[p], first_triangle[p + 1]):
            tri = triangles[k]
            ax, ay, az = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
            bx, by, bz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
            px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
            determinant = ax * px + ay * py + az * pz
            if determinant == 0.0:
                continue
            ox, oy, oz = origins[i, 0] - tri[0, 0], origins[i, 1] - tri[0, 1], origins[i, 2] - tri[0, 2]
            u = (ox * px + oy * py + oz * pz) / determinant
            qx, qy, qz = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
            v = (dx * qx + dy * qy + dz * qz) / determinant
            inside = min(u, v, 1.0 - u - v)
            if inside > best:
                best = inside
                chosen = k
                b1, b2 = u, v
                t[i] = (bx * qx + by * qy + bz * qz) / determinant
        if chosen < 0 or (must_contain and (best < 0.0 or not t[i] > near)):
            t[i] = math.inf
            continue
        tri = triangles[chosen]
        ax, ay, az = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
        bx, by, bz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        front[i] = nx * dx + ny * dy + nz * dz < 0.0
        if not front[i]:
            scale = -scale
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        facing[i, 0], facing[i, 1], facing[i, 2] = nx, ny, nz
        points[i, 0] = origins[i, 0] + t[i] * dx
        points[i, 1] = origins[i, 1] + t[i] * dy
        points[i, 2] = origins[i, 2] + t[i] * dz
        if smooth:
            u, v = max(b1, 0.0), max(b2, 0.0)
            total = max(u + v, 1.0)
            u, v = u / total, v / total
            w = 1.0 - u - v
            normals = corner_normals[chosen]
            sx = w * normals[0, 0] + u * normals[1, 0] + v * normals[2, 0]
            sy = w * normals[0, 1] + u * normals[1, 1] + v * normals[2, 1]
            sz = w * normals[0, 2] + u * normals[1, 2] + v * normals[2, 2]
            length = math.sqrt(sx * sx + sy * sy + sz * sz)
            if length > 0.0:
                if not front[i]:
                    length = -length
                nx, ny, nz = sx / length, sy / length, sz / length
        shading[i, 0], shading[i, 1], shading[i, 2] = nx, ny, nz


@njit(nogil=True, cache=True)
def light_targets(law, corners, cumulative, normals, keys, salt, count, jitter, targets, axes):
    """Places (m, count, 3) on a linear or area light, and the light's direction or normal there.

    ``m`` is 1, or the number of ``keys`` with ``jitter``, which moves the whole pattern along (and
    around the ends of) the light by a random number a key.  Linear: middles of equal parts.
    Area: a Hammersley set over the triangles ``corners`` (t, 3, 3), by ``cumulative`` area.
    """
    for i in range(targets.shape[0]):
        shift_u = uniform(keys[i], salt) if jitter else 0.5
        shift_v = uniform(keys[i], salt + 1) if jitter else 0.0
        for k in range(count):
            u = (k + shift_u) / count
            if law < AREA:
                for c in range(3):
                    targets[i, k, c] = corners[0, 0, c] + u * (corners[0, 1, c] - corners[0, 0, c])
                    axes[i, k, c] = normals[0, c]
                continue
            # Van der Corput's radical inverse of k, in base 2.
            v, base, rest = 0.5 / count, 0.5, k
            while rest > 0:
                v += base * (rest & 1)
                rest >>= 1
                base *= 0.5
            v = (v + shift_v) % 1.0
            tri = min(np.searchsorted(cumulative, u, side="right"), cumulative.shape[0] - 1)
            below = cumulative[tri - 1] if tri > 0 else 0.0
            u = min(max((u - below) / (cumulative[tri] - below), 0.0), 1.0)
            root = math.sqrt(u)
            wb, wc = root * (1.0 - v), root * v
            for c in range(3):
                a = corners[tri, 0, c]
                targets[i, k, c] = a + wb * (corners[tri, 1, c] - a) + wc * (corners[tri, 2, c] - a)
                axes[i, k, c] = normals[tri, c]


@njit(nogil=True, cache=True)
def assume(agreed, pixel, node, corner_state, light, assumed):
    """State of each point for one light, where its pixel's corners agree; COMPLEX_SHADOW elsewhere."""
    for i in range(agreed.shape[0]):
        assumed[i] = corner_state[pixel[i], node[i], light] if agreed[i] else COMPLEX_SHADOW


@njit(nogil=True, cache=True)
def light_rays(
    law, targets, axes, scale, cosine_cut, spot_exponent, falls, highlight, power, offset, centre, unit,
    points, facing, shading, mirrored, exponent, lit, assumed, reflectance, specular, surface,
    leaving, samples_seen, out_of_cone, ray_origin, ray_along, ray_weight, ray_shine, ray_owner,
):  # fmt: skip
    """Shadow rays from points to one light, and the light that is assumed to arrive without any.

    ``targets`` and ``axes`` (1 or n, K, 3): the light's samples.  ``assumed`` (n,): a state a
    point; NOT_INSHADOW adds to ``leaving`` (n, bands) without a ray, INSHADOW adds nothing,
    COMPLEX_SHADOW makes a ray.  ``samples_seen`` counts the samples above the horizon;
    ``out_of_cone`` marks points that a spot does not reach.  Rays are made in Embree's unit
    coordinates (``centre``, ``unit``).  Returns how many.
    """
    rays = 0
    bands = power.shape[0]
    for i in range(points.shape[0]):
        samples_seen[i] = 0
        out_of_cone[i] = False
        if not lit[i]:
            continue
        nx, ny, nz = shading[i, 0], shading[i, 1], shading[i, 2]
        gx, gy, gz = facing[i, 0], facing[i, 1], facing[i, 2]
        row = i if targets.shape[0] > 1 else 0
        direct = shine = 0.0
        for k in range(targets.shape[1]):
            ax, ay, az = axes[row, k, 0], axes[row, k, 1], axes[row, k, 2]
            if law == DIRECTIONAL:
                lx, ly, lz = targets[row, k, 0], targets[row, k, 1], targets[row, k, 2]
                distance = 1.0
            else:
                lx = targets[row, k, 0] - points[i, 0]
                ly = targets[row, k, 1] - points[i, 1]
                lz = targets[row, k, 2] - points[i, 2]
                distance = math.sqrt(lx * lx + ly * ly + lz * lz)
                if distance == 0.0:
                    continue
                lx, ly, lz = lx / distance, ly / distance, lz / distance
            cosine = nx * lx + ny * ly + nz * lz
            # Where the interpolated normal faces a light that its triangle turns away from, the ray
            # meets that triangle.
            if cosine <= 0.0:
                continue
            weight = scale
            if falls and law != DIRECTIONAL:
                weight /= distance * distance
            if law == POINT and cosine_cut > -1.0:
                along = -(ax * lx + ay * ly + az * lz)
                if along < cosine_cut or along <= 0.0:
                    out_of_cone[i] = True
                    continue
                weight *= along**spot_exponent
            elif law == LINEAR_LAMBERTIAN:
                along = ax * lx + ay * ly + az * lz
                weight *= math.sqrt(max(1.0 - along * along, 0.0))
            elif law >= AREA:
                along = -(ax * lx + ay * ly + az * lz)
                if law == AREA_BOTH_SIDES and along < 0.0:
                    ax, ay, az, along = -ax, -ay, -az, -along
                if along <= 0.0:
                    continue
                weight *= along
            samples_seen[i] += 1
            if assumed[i] == INSHADOW:
                continue
            lobe_weight = 0.0
            if highlight and exponent[surface[i]] >= 0.0:
                toward = mirrored[i, 0] * lx + mirrored[i, 1] * ly + mirrored[i, 2] * lz
                e = exponent[surface[i]]
                # Most points lie far outside the lobe; cos^e <= exp(-e (1 - cos)) spares the power.
                if toward > 0.0 and e * (1.0 - toward) < FAINT:
                    lobe_weight = weight * (e + 1.0) / (2.0 * math.pi) * toward**e
            if assumed[i] == NOT_INSHADOW:
                direct += weight * cosine
                shine += lobe_weight
                continue
            sx, sy, sz = points[i, 0] + offset * gx, points[i, 1] + offset * gy, points[i, 2] + offset * gz
            if law == DIRECTIONAL:
                reach = 4.0 / unit  # beyond the scene from anywhere in it
                tx, ty, tz = reach * lx, reach * ly, reach * lz
            else:
                tx, ty, tz = targets[row, k, 0] - sx, targets[row, k, 1] - sy, targets[row, k, 2] - sz
                if law >= AREA:  # end in front of the light's own polygon
                    tx, ty, tz = tx + offset * ax, ty + offset * ay, tz + offset * az
            ray_origin[rays, 0] = (sx - centre[0]) * unit
            ray_origin[rays, 1] = (sy - centre[1]) * unit
            ray_origin[rays, 2] = (sz - centre[2]) * unit
            ray_along[rays, 0], ray_along[rays, 1], ray_along[rays, 2] = tx * unit, ty * unit, tz * unit
            ray_weight[rays] = weight * cosine
            ray_shine[rays] = lobe_weight
            ray_owner[rays] = i
            rays += 1
        if assumed[i] == NOT_INSHADOW:
            for b in range(bands):
                diffuse = reflectance[i, b] / math.pi * direct
                leaving[i, b] += (diffuse + specular[surface[i], b] * shine) * power[b]
    return rays


@njit(nogil=True, cache=True)
def gather_light(
    rays, through, ray_weight, ray_shine, ray_owner, power, reflectance, specular, surface, assumed, out_of_cone,
    leaving, state,
):  # fmt: skip
    """Add what shadow rays let through (rays, 1 or bands), and say in which state each point is found."""
    bands, colours = power.shape[0], through.shape[1]
    direct, shine = np.empty(colours), np.empty(colours)
    for i in range(state.shape[0]):
        state[i] = assumed[i]
        if assumed[i] == COMPLEX_SHADOW and not out_of_cone[i]:
            state[i] = INSHADOW  # below the horizon, until a ray says otherwise
    r = 0
    while r < rays:
        owner = ray_owner[r]
        open_rays = shut_rays = 0
        first = r
        direct[:] = 0.0
        shine[:] = 0.0
        while r < rays and ray_owner[r] == owner:
            clear = shut = True
            for c in range(colours):
                passed = through[r, c]
                clear = clear and passed == 1.0
                shut = shut and passed == 0.0
                direct[c] += ray_weight[r] * passed
                shine[c] += ray_shine[r] * passed
            open_rays += clear
            shut_rays += shut
            r += 1
        for b in range(bands):
            c = b if colours > 1 else 0
            diffuse = reflectance[owner, b] / math.pi * direct[c]
            leaving[owner, b] += (diffuse + specular[surface[owner], b] * shine[c]) * power[b]
        if open_rays == r - first:
            state[owner] = NOT_INSHADOW
        elif shut_rays == r - first:
            state[owner] = INSHADOW
        else:
            state[owner] = COMPLEX_SHADOW


@njit(nogil=True, cache=True)
def count_spared(assumed, lit, seen, sample, saved):
    """Add to each sample the shadow rays that assumed states spared; returns the points and rays."""
    points = rays = 0
    for i in range(assumed.shape[0]):
        if lit[i] and assumed[i] != COMPLEX_SHADOW and seen[i] > 0:
            points += 1
            rays += seen[i]
            saved[sample[i]] += seen[i]
    return points, rays


@njit(nogil=True, cache=True)
def unit_rays(origins, directions, centre, unit):
    """Rays (n, 3) as float32 in Embree's unit coordinates; directions keep their length."""
    start = np.empty(origins.shape, dtype=np.float32)
    along = np.empty(origins.shape, dtype=np.float32)
    for i in range(origins.shape[0]):
        for c in range(3):
            start[i, c] = (origins[i, c] - centre[c]) * unit
            along[i, c] = directions[i, c]
    return start, along


@njit(nogil=True, cache=True)
def begin(surface, front, both_sides, reflectances, lit, reflectance):
    """For each hit, whether its side is lit, and its reflectance."""
    for i in range(surface.shape[0]):
        s = surface[i]
        lit[i] = front[i] or both_sides[s]
        for b in range(reflectances.shape[1]):
            reflectance[i, b] = reflectances[s, b]


@njit(nogil=True, cache=True)
def scale_rows(rows, factors, reflectance):
    """Multiply some hits' reflectance by ``factors`` (rows, bands or 1)."""
    last = factors.shape[1] - 1
    for place in range(rows.shape[0]):
        for b in range(reflectance.shape[1]):
            reflectance[rows[place], b] *= factors[place, min(b, last)]


@njit(nogil=True, cache=True)
def sent_unlit(surface, lit, reflectance, radiances, ambient, leaving):
    """What each hit sends of itself and of the ambient light; nothing from a side that is not lit."""
    for i in range(surface.shape[0]):
        for b in range(radiances.shape[1]):
            leaving[i, b] = radiances[surface[i], b] + reflectance[i, b] * ambient[b] if lit[i] else 0.0


@njit(nogil=True, cache=True)
def agreement(pixel, node, surface, shading, corner_surface, corner_normals, cosine, agreed):
    """Whether each hit lies on the surface that its pixel's corners share, with a normal like theirs."""
    for i in range(surface.shape[0]):
        agreed[i] = node[i] >= 0 and corner_surface[pixel[i], max(node[i], 0)] == surface[i]
        if agreed[i] and corner_normals.shape[0] > 0:
            for c in range(4):
                n = corner_normals[pixel[i], node[i], c]
                if n[0] * shading[i, 0] + n[1] * shading[i, 1] + n[2] * shading[i, 2] < cosine:
                    agreed[i] = False


@njit(nogil=True, cache=True)
def interpolate(
    rows, agreed, sample, pixel, node, surface, share, spread, values, corners, x, y, similar, leaving, left
):
    """Add radiance interpolated between corners to some hits; returns how many rows are ``left`` for rays.

    ``values`` (trees, nodes, bands) and ``corners`` (pixels, 4), rows of the trees; ``spread``
    (pixels, nodes) the corners' largest difference, NaN where one has no value.
    """
    count = 0
    bands = leaving.shape[1]
    for place in range(rows.shape[0]):
        i = rows[place]
        use = agreed[i]
        if use:
            most = 0.0
            for b in range(bands):
                most = max(most, share[surface[i], b])
            use = spread[pixel[i], node[i]] * most <= similar
        if not use:
            left[count] = i
            count += 1
            continue
        four = corners[pixel[i]]
        u, v = x[sample[i]], y[sample[i]]
        for b in range(bands):
            top = values[four[0], node[i], b] * (1.0 - u) + values[four[1], node[i], b] * u
            bottom = values[four[2], node[i], b] * (1.0 - u) + values[four[3], node[i], b] * u
            leaving[i, b] += share[surface[i], b] * (top * (1.0 - v) + bottom * v)
    return count


@njit(nogil=True, cache=True)
def agree_of_corners(surface, state, values_a, values_b, polygon, corners, out_surface, out_state, out_polygon, spread):
    """What four corners (pixels, 4) of each pixel share; see :class:`workbench.render.atomic.Guide`.

    ``spread`` (2, pixels, nodes): largest differences of ``values_a`` and of ``values_b``.
    """
    for p in range(corners.shape[0]):
        a, b, c, d = corners[p, 0], corners[p, 1], corners[p, 2], corners[p, 3]
        same = polygon[a] == polygon[b] == polygon[c] == polygon[d]
        out_polygon[p] = polygon[a] if same else -1
        for node in range(surface.shape[1]):
            met = surface[a, node]
            same = met == surface[b, node] == surface[c, node] == surface[d, node]
            out_surface[p, node] = met if same else -3
            for light in range(state.shape[2]):
                found = state[a, node, light]
                same = found == state[b, node, light] == state[c, node, light] == state[d, node, light]
                out_state[p, node, light] = found if same else COMPLEX_SHADOW
            if out_surface[p, node] < 0:
                spread[0, p, node] = spread[1, p, node] = np.nan
                continue
            spread[0, p, node] = _spread(values_a, a, b, c, d, node)
            spread[1, p, node] = _spread(values_b, a, b, c, d, node)


@njit(nogil=True, cache=True)
def _spread(values, a, b, c, d, node):
    most = 0.0
    for band in range(values.shape[2]):
        va, vb, vc, vd = values[a, node, band], values[b, node, band], values[c, node, band], values[d, node, band]
        if not (va == va and vb == vb and vc == vc and vd == vd):
            return np.nan
        most = max(most, max(va, vb, vc, vd) - min(va, vb, vc, vd))
    return most


@njit(nogil=True, cache=True)
def add_share(rows, surface, share, values, leaving):
    """Add to hits ``rows`` their surfaces' share of ``values`` (rows, bands)."""
    for place in range(rows.shape[0]):
        i = rows[place]
        for b in range(leaving.shape[1]):
            leaving[i, b] += share[surface[i], b] * values[place, b]


@njit(nogil=True, cache=True)
def next_rays(rows, points, facing, side, offset, keys, ray, sample, node, branch, branching, nodes):
    """What follows from some hits: origins off the surface, keys, samples and tree nodes, a row each.

    Origins lie toward the viewer, or (``side`` < 0) away from him.  ``branch`` is 1 for reflected
    and 2 for refracted rays; a node beyond ``nodes`` is -1.
    """
    count = rows.shape[0]
    start = np.empty((count, 3))
    new_keys, new_sample, new_node = (
        np.empty(count, keys.dtype),
        np.empty(count, sample.dtype),
        np.empty(count, node.dtype),
    )
    for place in range(count):
        i = rows[place]
        for c in range(3):
            start[place, c] = points[i, c] + side[place] * offset * facing[i, c]
        new_keys[place] = _hash(keys[ray[i]], branch)
        new_sample[place] = sample[i]
        below = branching * node[i] + branch
        new_node[place] = below if node[i] >= 0 and below < nodes else -1
    return start, new_keys, new_sample, new_node


@njit(nogil=True, cache=True)
def mirror(directions, shading, facing, surface, mirrors):
    """Mirrored directions (n, 3), about the geometric normal where the other would lead inside.

    Only for hits on surfaces with ``mirrors`` set; the others' rows mean nothing.
    """
    found = np.empty_like(directions)
    for i in range(directions.shape[0]):
        if not mirrors[surface[i]]:
            continue
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        nx, ny, nz = shading[i, 0], shading[i, 1], shading[i, 2]
        gx, gy, gz = facing[i, 0], facing[i, 1], facing[i, 2]
        s = 2.0 * (dx * nx + dy * ny + dz * nz)
        x, y, z = dx - s * nx, dy - s * ny, dz - s * nz
        if x * gx + y * gy + z * gz <= 0.0:
            s = 2.0 * (dx * gx + dy * gy + dz * gz)
            x, y, z = dx - s * gx, dy - s * gy, dz - s * gz
        found[i, 0], found[i, 1], found[i, 2] = x, y, z
    return found


@njit(nogil=True, cache=True)
def refract(directions, shading, facing, front, ior):
    """Refracted directions (n, 3) by Snell's law, and whether each stayed outside (total reflection).

    ``ior`` (n,) is the index behind the front side, 1 in front of it.
    """
    found = np.empty_like(directions)
    total = np.zeros(directions.shape[0], dtype=np.bool_)
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        gx, gy, gz = facing[i, 0], facing[i, 1], facing[i, 2]
        nx, ny, nz = shading[i, 0], shading[i, 1], shading[i, 2]
        cosine = -(dx * nx + dy * ny + dz * nz)
        if cosine <= 0.0:  # the interpolated normal turns away at a silhouette
            nx, ny, nz = gx, gy, gz
            cosine = -(dx * nx + dy * ny + dz * nz)
        eta = 1.0 / ior[i] if front[i] else ior[i]
        if eta == 1.0:
            found[i, 0], found[i, 1], found[i, 2] = dx, dy, dz
            continue
        square = 1.0 - eta * eta * (1.0 - cosine * cosine)
        if square < 0.0:
            total[i] = True
            x, y, z = dx + 2.0 * cosine * nx, dy + 2.0 * cosine * ny, dz + 2.0 * cosine * nz
            if x * gx + y * gy + z * gz <= 0.0:
                s = 2.0 * (dx * gx + dy * gy + dz * gz)
                x, y, z = dx - s * gx, dy - s * gy, dz - s * gz
        else:
            s = eta * cosine - math.sqrt(square)
            x, y, z = eta * dx + s * nx, eta * dy + s * ny, eta * dz + s * nz
            if x * gx + y * gy + z * gz >= 0.0:  # bent outward again by the interpolated normal
                x, y, z = dx, dy, dz
        found[i, 0], found[i, 1], found[i, 2] = x, y, z
    return found, total


@njit(nogil=True, cache=True)
def lobe(directions, exponents, facing, keys, copies):
    """A bundle (n * copies, 3) about each direction, dense as cos^exponent of the angle to it.

    Stratified over the bundle; directions that would pass through the surface are mirrored back
    at it, so that no light is lost.  An infinite exponent leaves the direction as it is.
    """
    found = np.empty((directions.shape[0] * copies, 3))
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        gx, gy, gz = facing[i, 0], facing[i, 1], facing[i, 2]
        side = 1.0 if dx * gx + dy * gy + dz * gz > 0.0 else -1.0
        # T. Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 6(1), 2017).
        sign = math.copysign(1.0, dz)
        a = -1.0 / (sign + dz)
        b = dx * dy * a
        turn = uniform(keys[i], 7)
        for j in range(copies):
            at = i * copies + j
            if exponents[i] == math.inf:
                found[at, 0], found[at, 1], found[at, 2] = dx, dy, dz
                continue
            cosine = ((j + uniform(keys[i], 16 * j + 8)) / copies) ** (1.0 / (exponents[i] + 1.0))
            angle = 2.0 * math.pi * ((turn + j * 0.6180339887498949) % 1.0)
            sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
            u, v = sine * math.cos(angle), sine * math.sin(angle)
            x = u * (1.0 + sign * dx * dx * a) + v * b + cosine * dx
            y = u * sign * b + v * (sign + dy * dy * a) + cosine * dy
            z = -u * sign * dx - v * dy + cosine * dz
            s = x * gx + y * gy + z * gz
            if s * side <= 0.0:
                x, y, z = x - 2.0 * s * gx, y - 2.0 * s * gy, z - 2.0 * s * gz
            found[at, 0], found[at, 1], found[at, 2] = x, y, z
    return found
