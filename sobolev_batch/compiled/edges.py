"""The compiled loop over pairs of a point and a triangle: see `potentials`, whose array code says the same."""

import math
from typing import Any

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.compiled import loop, part


@loop
def add_potentials(
    out: Reals,
    points: Reals,
    corners: Reals,
    signs: Reals,
    rows: Indices,
    columns: Indices,
    tables: Any,
    panels: Any,
    limits: Reals,
    nodes: Reals,
    ends: Indices,
) -> None:
    """Add the potential of each triangle, times its sign, at the point that it is paired with, to (n, orders).

    The limits are those of `potentials`, farness and size for each rule, and the nodes those of all rules: barycentric
    coordinates and weight, from one of the ends to the next.
    """
    cutoff, values = tables[0], tables[6]
    for pair in range(len(rows)):
        row, triangle, sign = rows[pair], corners[columns[pair]], signs[columns[pair]]
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        ax, ay, az = triangle[0, 0] - x, triangle[0, 1] - y, triangle[0, 2] - z
        bx, by, bz = triangle[1, 0] - x, triangle[1, 1] - y, triangle[1, 2] - z
        cx, cy, cz = triangle[2, 0] - x, triangle[2, 1] - y, triangle[2, 2] - z
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        doubled = math.sqrt(nx * nx + ny * ny + nz * nz)
        mx, my, mz = (ax + bx + cx) / 3, (ay + by + cy) / 3, (az + bz + cz) / 3
        distance = math.sqrt(mx * mx + my * my + mz * mz)
        square = (ax - mx) ** 2 + (ay - my) ** 2 + (az - mz) ** 2
        square = max(square, (bx - mx) ** 2 + (by - my) ** 2 + (bz - mz) ** 2)
        radius = math.sqrt(max(square, (cx - mx) ** 2 + (cy - my) ** 2 + (cz - mz) ** 2))
        rule = -1
        for number in range(len(limits)):
            if radius < limits[number, 0] * distance and radius * cutoff < limits[number, 1]:
                rule = number
        if rule >= 0:
            for node in range(ends[rule], ends[rule + 1]):
                p, q, r = nodes[node, 0], nodes[node, 1], nodes[node, 2]
                dx, dy, dz = p * ax + q * bx + r * cx, p * ay + q * by + r * cy, p * az + q * bz + r * cz
                place = _place(dx * dx + dy * dy + dz * dz, tables)
                weight = sign * doubled / 2 * nodes[node, 3]
                for order in range(out.shape[1]):
                    out[row, order] += weight * _looked_up(values, place, order)
            continue
        # See `_square_on_longest`.
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
        if vv > uu:
            ux, uy, uz, uu = vx, vy, vz, vv
        if ww > uu:
            ux, uy, uz, uu = wx, wy, wz, ww
        nx, ny, nz = nx / doubled, ny / doubled, nz / doubled
        part_along = (nx * ux + ny * uy + nz * uz) / uu
        nx, ny, nz = nx - part_along * ux, ny - part_along * uy, nz - part_along * uz
        height = nx * ax + ny * ay + nz * az
        if abs(height) >= tables[1]:
            continue
        _add_edge(out, row, sign, ax, ay, az, bx, by, bz, nx, ny, nz, height, tables, panels)
        _add_edge(out, row, sign, bx, by, bz, cx, cy, cz, nx, ny, nz, height, tables, panels)
        _add_edge(out, row, sign, cx, cy, cz, ax, ay, az, nx, ny, nz, height, tables, panels)


@loop
def _place(square: float, tables: Any) -> Any:
    """Return the entry of a table nearest to d², and the weights of those before and behind it."""
    cutoff, reach, start, step, values = tables[0], tables[1], tables[2], tables[3], tables[6]
    relative = math.sqrt(min(max(square, (tables[7] / cutoff) ** 2), reach * reach)) * cutoff / tables[8]
    place = ((math.log(relative) if relative < 1 else relative - 1) - start) / step
    place = max(min(place, len(values) - 1.5001), 0.0)
    # NaN has no entry, and stays what it is.
    entry = int(place + 0.5) if place > 1 else 1
    low, high = 0.5 - (place - entry), 0.5 + (place - entry)
    return entry, low * low / 2, high * high / 2


@part
def _looked_up(table: Reals, place: Any, order: int) -> Any:
    """Return the value of a table at a place: see `Kernels.looked_up`."""
    entry, low, high = place
    middle = table[entry, order]
    return middle + low * (table[entry - 1, order] - middle) + high * (table[entry + 1, order] - middle)


@loop
def _add_edge(
    out: Reals, row: int, sign: float,
    px: float, py: float, pz: float, qx: float, qy: float, qz: float,
    nx: float, ny: float, nz: float, height: float, tables: Any, panels: Any,
) -> None:  # fmt: skip
    """Add what one edge from p to q contributes to a potential at the origin."""
    ux, uy, uz = qx - px, qy - py, qz - pz
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    offset = nx * (py * uz - pz * uy) + ny * (pz * ux - px * uz) + nz * (px * uy - py * ux)
    first, last = px * ux + py * uy + pz * uz, qx * ux + qy * uy + qz * uz
    if offset == 0:
        return
    sign = math.copysign(sign, sign * offset)
    if first * last > 0:
        near, far = min(abs(first), abs(last)), max(abs(first), abs(last))
        _add_span(out, row, sign, offset, height, near, far, tables, panels)
    else:
        _add_span(out, row, sign, offset, height, 0.0, abs(last), tables, panels)
        _add_span(out, row, sign, offset, height, 0.0, abs(first), tables, panels)


@loop
def _add_span(
    out: Reals, row: int, sign: float, offset: float, height: float, near: float, far: float, tables: Any, panels: Any
) -> None:
    """Add the integral between two distances from the foot on an edge's line."""
    reach, totals, drops = tables[1], tables[4], tables[5]
    longest_t, longest, last_t, nodes = panels
    q, square = max(abs(offset), tables[7] * reach), height * height
    farthest = math.sqrt(max(reach * reach - square - q * q, 0.0))
    begin, end = min(near, farthest), min(far, farthest)
    level = _place(square, tables)
    outside = math.atan2(far, q) - math.atan2(end, q) if far > end else 0.0
    if near > begin:
        outside -= math.atan2(near, q) - math.atan2(begin, q)
    low, last = min(math.asinh(begin / q), last_t), min(math.asinh(end / q), last_t)
    for order in range(out.shape[1]):
        out[row, order] += sign * outside * (totals[order] - _looked_up(drops, level, order))
    angle, half = 0.0, nodes.shape[1] // 2
    while low < last:
        widest = math.exp(low)
        high = min(last, low + min(longest_t, math.log1p(2 * longest / (q * (widest + 1 / widest)))))
        middle = math.exp((low + high) / 2)
        for node in range(half):
            # The nodes of a panel lie in pairs about its middle.
            factor = math.exp((high - low) / 2 * nodes[0, half + node])
            for growth in (middle * factor, middle / factor):
                widening = (growth + 1 / growth) / 2
                weight = sign * nodes[1, half + node] / 2 * (high - low) / widening
                place = _place(square + (q * widening) ** 2, tables)
                angle += weight
                for order in range(out.shape[1]):
                    out[row, order] += weight * _looked_up(drops, place, order)
        low = high
    for order in range(out.shape[1]):
        out[row, order] -= angle * _looked_up(drops, level, order)
