"""Normal equations and scores of a pose, block by block.

The elements near a block of points are laid side by side first. The rest has no branch and reads memory in order, which
compilers vectorise. A block is one array of columns of a fixed length: compilers have to know that the written columns
are not those read.
"""

# mypy: ignore-errors
from __future__ import annotations

import numba
import numpy as np

from gapr_core.registration.fit.surface_kernels import (
    ELEMENT_RADIUS,
    FAST,
    distance,
    element_near,
    moved,
    padded,
    tukey,
)

B = 128  # points of a block, and so the length of each of its columns; a multiple of `surface_kernels.WIDE`

# Where a column of a block begins: a moved point, its offset from the element near it, this element (normal, shape,
# variance: see `surface_kernels.residual`), the point's trust. The rows of the normal equations come behind: six
# derivatives, and the residual.
X, Y, Z, DX, DY, DZ, NX, NY, NZ, XX, XY, XZ, YY, YZ, ZZ, VARIANCE, TRUST, ROWS = (B * column for column in range(18))
RESIDUAL = ROWS + 6 * B
END = ROWS + 7 * B


@numba.njit(**FAST)
def accumulate(
    T, points, trust, middle, elements, nearest, origin, per_cell, spacing, limit, variance, H, g, front=0.0
):
    """Fill the normal equations H twist = g, weighted; twist = x y z rx ry rz about the moved middle.

    `limit` is Tukey's, `front` that of points outside of the surface, if it is another one.
    """
    front = front if front > 0.0 else limit
    centre = moved(T, middle)
    block, reach = np.empty(END), ELEMENT_RADIUS * spacing
    H[:], g[:] = 0.0, 0.0
    for start in range(0, len(points), B):
        stop = min(start + B, len(points))
        count = gather(T, points, trust, start, stop, elements, nearest, origin, per_cell, block)
        fill_rows(block, count, centre, reach, limit, front, variance)
        add_up(block, count, H, g)
    for a in range(6):
        for b in range(a):
            H[b, a] = H[a, b]


@numba.njit(**FAST)
def mean_square(T, points, trust, elements, nearest, origin, per_cell, spacing, limit):
    """Compute the mean squared distance of the moved points to the surface, truncated; `trust` does not count."""
    block, reach, total = np.empty(END), ELEMENT_RADIUS * spacing, 0.0
    for start in range(0, len(points), B):
        stop = min(start + B, len(points))
        count = gather(T, points, trust, start, stop, elements, nearest, origin, per_cell, block)
        total += squares(block, count, reach, limit) + (stop - start - count) * limit * limit
    return total / len(points)


@numba.njit(**FAST)
def gather(T, points, trust, start, stop, elements, nearest, origin, per_cell, block):
    """Lay side by side each moved point, its offset from the element near it, this element, and its trust.

    Points with none near are left out; returns the number of the others.
    """
    count = np.int64(0)  # a plain 0 would make Numba compile its callees once more
    for p in range(start, stop):
        x, y, z = moved(T, points[p])
        q = element_near(x, y, z, nearest, origin, per_cell)
        if q < 0:
            continue
        e = elements[q]
        block[X + count], block[Y + count], block[Z + count] = x, y, z
        block[DX + count], block[DY + count], block[DZ + count] = x - e[0], y - e[1], z - e[2]
        block[NX + count], block[NY + count], block[NZ + count] = e[3], e[4], e[5]
        block[XX + count], block[XY + count], block[XZ + count] = e[6], e[7], e[8]
        block[YY + count], block[YZ + count], block[ZZ + count] = e[9], e[10], e[11]
        block[VARIANCE + count], block[TRUST + count] = e[12], trust[p]
        count += 1
    return count


@numba.njit(inline="always", **FAST)
def distance_of(block, c, reach, variance):
    """Compute the `distance` of point c of a block."""
    return distance(
        block[DX + c], block[DY + c], block[DZ + c],
        block[NX + c], block[NY + c], block[NZ + c],
        block[XX + c], block[XY + c], block[XZ + c],
        block[YY + c], block[YZ + c], block[ZZ + c],
        reach, variance,
    )  # fmt: skip


@numba.njit(**FAST)
def fill_rows(block, count, centre, reach, limit, front, variance):
    """Fill the rows: derivatives of the residuals by the twist about `centre` (3), and the residuals.

    Both are times root w: w is the trust times Tukey's weight, and the noise's share in the variance if that is given.
    """
    noise, known = (variance, 1.0) if variance > 0.0 else (1.0, 0.0)
    cx, cy, cz = centre
    for c in range(count):
        r, nx, ny, nz, aside = distance_of(block, c, reach, variance)
        total = noise + known * block[VARIANCE + c]
        root = np.sqrt(block[TRUST + c] * tukey(r * r + aside * aside, front if r > 0.0 else limit) * noise / total)
        nx, ny, nz = root * nx, root * ny, root * nz
        x, y, z = block[X + c] - cx, block[Y + c] - cy, block[Z + c] - cz
        block[ROWS + c], block[ROWS + B + c], block[ROWS + 2 * B + c] = nx, ny, nz
        block[ROWS + 3 * B + c] = y * nz - z * ny
        block[ROWS + 4 * B + c] = z * nx - x * nz
        block[ROWS + 5 * B + c] = x * ny - y * nx
        block[RESIDUAL + c] = root * r


@numba.njit(**FAST)
def add_up(block, count, H, g):
    """Add the products of the rows to the lower triangle of H (6, 6) and to g (6,).

    Rows are padded with zeros, so that the compiler takes several columns at a time.
    """
    columns = padded(count)
    for a in range(7):
        for c in range(count, columns):
            block[ROWS + a * B + c] = 0.0
    for a in range(6):
        total = 0.0
        for c in range(columns):
            total -= block[ROWS + a * B + c] * block[RESIDUAL + c]
        g[a] += total
        for b in range(a + 1):
            total = 0.0
            for c in range(columns):
                total += block[ROWS + a * B + c] * block[ROWS + b * B + c]
            H[a, b] += total


@numba.njit(**FAST)
def squares(block, count, reach, limit):
    """Sum the squared distances of a block's points, each truncated."""
    total = 0.0
    for c in range(count):
        r, _, _, _, aside = distance_of(block, c, reach, 0.0)
        total += min(limit * limit, r * r + aside * aside)
    return total
