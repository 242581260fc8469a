"""The search for the best common subgraphs of one pair of frames (numba kernels).

As in the paper (section 4.2) every pair of boxes seeds a star: if box m of ego and box n of other are one object,
their headings and positions fix the relative pose, and every other pair that agrees with it joins the subgraph. What
differs is how agreement is measured (`evidence`), and that the best stars are refitted to all their members, because
a heading that is wrong by 2 degrees moves a member 50 m away by 1.7 m.

Three passes keep it fast: all seeds are scored against a raster of nearest boxes; the best are matched and refitted
exactly; those that end in the same pose are one. A star's pose is written down at a pivot, the centre of the matched
boxes in both frames, where its translation and rotation errors are independent; nothing here depends on where either
frame's origin lies.

A star is a record (`STAR`) and a row of pairs. The kernels change both in place, which numba compiles and runs
several times faster than passing tuples of arrays around. Mind that numba's records are bare pointers: the array a
record lies in must be used after the record's last use, or it is freed too early.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.alignment.evidence import VX, VY, YAW, NoiseModel, X, Y, pair_evidence, wrap, wrap_half_turn
from cobevglue.typing import FloatArray, IntArray

__all__ = [
    "SAME_ANGLE",
    "SAME_DISTANCE",
    "STAR",
    "add_star",
    "copy_pairs",
    "fit_pose",
    "match_boxes",
    "most_pairs",
    "place_box",
    "refine",
    "same_pose",
    "search",
]

STAR = np.dtype(
    [
        ("ego_x", "f8"),  # the pivot in ego's frame [m] ...
        ("ego_y", "f8"),
        ("other_x", "f8"),  # ... and in other's: ego = ego_xy + R(yaw) (other - other_xy)
        ("other_y", "f8"),
        ("yaw", "f8"),
        ("position_variance", "f8"),  # of ego_x and of ego_y [m^2]
        ("yaw_variance", "f8"),  # [rad^2]
        (
            "other_vx",
            "f8",
        ),  # velocity of the pivot in other's frame, by which the pose depends on the time offset [m/s]
        ("other_vy", "f8"),
        ("offset", "f8"),  # time offset of other's list [s] and its variance [s^2] ...
        ("offset_variance", "f8"),
        ("prior_offset", "f8"),  # ... before any pair was matched ...
        ("prior_offset_variance", "f8"),
        ("measured_offset", "f8"),  # ... and from the pairs alone
        ("measured_offset_variance", "f8"),
        ("yaw_per_offset", "f8"),  # how the fitted yaw changes with the assumed offset, negated [rad/s]
        ("evidence", "f8"),  # of all its pairs [nats]
        ("pairs", "i8"),  # how many; which ones stand in an array of row numbers beside the record
    ],
    align=True,
)

_GATE = 3.0
"""A pair farther apart than this many standard deviations is not a match."""
_SAME_VEHICLE = 1.0
"""Centres of two vehicles are farther apart than this [m]."""
_HEADING_WEIGHT = 0.67
"""Headings enter the fit with their noise widened by 1/0.67: their errors within a frame are not independent."""
_SEED_HEADING_STD = math.radians(4.0)
_SEED_HEADING_GAIN = 1.6
"""Evidence of a perfect heading agreement, as a ratio: what `pair_evidence` gives at zero difference, rounded."""
_SEED_PAIRS = 900
"""Above this many pairs only the boxes of other with the rarest sizes seed stars (never fewer than `_FEWEST_SEEDS`)."""
_FEWEST_SEEDS = 24
_LEAVES = 16
"""A seed's rough score counts this many of its nearest neighbours: far ones hang on the seed's heading too much."""
_LEAST_SIZE_EVIDENCE = -3.0
"""Boxes of more different sizes than this do not seed a star."""
_RASTER_CELL, _RASTER_REACH, _RASTER_MOST_CELLS = 1.5, 4.5, 256
"""Cell [m], how far from a box its cells reach [m], and cells per axis at most."""
SAME_DISTANCE, SAME_ANGLE = 2.0, math.radians(8.0)
"""Poses that agree this closely at the pivot are one hypothesis [m, rad]."""
_SAME_SEED_ANGLE = 0.35
"""A matched pair whose headings turn by nearly the star's yaw would be refined to the same star again [rad]."""


@kernel(error_model="numpy")
def most_pairs(ego: FloatArray, other: FloatArray, noise: NoiseModel) -> int:
    """How many pairs a star can have."""
    return min(len(ego), len(other)) if noise.one_to_one else len(ego) + len(other)


@kernel(error_model="numpy")
def place_box(star, cos, sin, box):
    """Where a star's pose and time offset put one of other's boxes.

    Args:
        star: a `STAR` record.
        cos: of its yaw.
        sin: of its yaw.
        box: (7,) with velocity.

    Returns:
        x and y from the pivot along the axes of other's frame, and in ego's frame [m].
    """
    dx = box[X] - star.offset * box[VX] - star.other_x
    dy = box[Y] - star.offset * box[VY] - star.other_y
    return dx, dy, star.ego_x + cos * dx - sin * dy, star.ego_y + sin * dx + cos * dy


@kernel(error_model="numpy")
def match_boxes(ego, other, sizes, star, pairs, noise) -> None:
    """Find the pairs that agree with a star's pose, one-to-one, best evidence first.

    The tolerance grows with the distance from the pivot, as far as the star's yaw is uncertain, and along the velocity
    of a moving box, as far as the time offset is.

    Args:
        ego: (M, 5) boxes.
        other: (N, 7) boxes.
        sizes: (M, N) from `size_evidence`.
        star: a `STAR` record; its pose is read, its evidence and number of pairs are written.
        pairs: (>= `most_pairs`, 2) rows of ego and other, written.
        noise: the noise model.
    """
    m_count, n_count = len(ego), len(other)
    cos, sin = math.cos(star.yaw), math.sin(star.yaw)
    gain = np.empty(4 * (m_count + n_count))
    row = np.empty((len(gain), 2), np.int64)
    found = 0
    for n in range(n_count):
        dx, dy, x, y = place_box(star, cos, sin, other[n])
        ux, uy = other[n, VX] - star.other_vx, other[n, VY] - star.other_vy
        vx, vy = cos * ux - sin * uy, sin * ux + cos * uy
        variance = noise.position_std**2 + star.position_variance
        if noise.use_range_tolerance:
            variance += (dx * dx + dy * dy) * star.yaw_variance
        # Variance is rank one in addition: offset_variance v v^T, inverted by Sherman and Morrison.
        variance_along = variance + star.offset_variance * (vx * vx + vy * vy)
        share, spread = star.offset_variance / variance_along, math.sqrt(variance * variance_along)
        reach = _GATE * _GATE * variance_along
        for m in range(m_count):
            ex, ey = ego[m, X] - x, ego[m, Y] - y
            squared = ex * ex + ey * ey
            if squared >= reach:
                continue
            squared = (squared - share * (ex * vx + ey * vy) ** 2) * spread / variance
            if squared < _GATE * _GATE * spread and found < len(gain):
                heading = ego[m, YAW] - other[n, YAW] - star.yaw
                evidence = pair_evidence(squared, heading, spread, noise) + sizes[m, n]
                if evidence > 0.0:
                    place = found
                    while place > 0 and gain[place - 1] < evidence:
                        gain[place] = gain[place - 1]
                        row[place, 0] = row[place - 1, 0]
                        row[place, 1] = row[place - 1, 1]
                        place -= 1
                    gain[place] = evidence
                    row[place, 0] = m
                    row[place, 1] = n
                    found += 1
    ego_taken, other_taken = np.zeros(m_count, np.bool_), np.zeros(n_count, np.bool_)
    kept, total = 0, 0.0
    for i in range(found):
        m, n = row[i, 0], row[i, 1]
        if kept == len(pairs):
            break
        if noise.one_to_one:
            repeated = ego_taken[m] or other_taken[n]
            for k in range(kept):
                # Two boxes in one place are one vehicle detected twice: its evidence counts once.
                dx, dy = ego[pairs[k, 0], X] - ego[m, X], ego[pairs[k, 0], Y] - ego[m, Y]
                repeated = repeated or dx * dx + dy * dy < _SAME_VEHICLE**2
            if repeated:
                continue
        ego_taken[m] = other_taken[n] = True
        pairs[kept, 0] = m
        pairs[kept, 1] = n
        total += gain[i]
        kept += 1
    star.evidence = total
    star.pairs = kept


@kernel(error_model="numpy")
def fit_pose(ego, other, star, pairs, noise) -> None:
    """Refit a star's pose to its pairs: Procrustes on the centres (paper, Eq. 7), blended with the headings.

    In the plane the SVD of the paper reduces to one arctangent. Headings count modulo pi around the star's yaw, as
    measurements of direction with a robust weight; with few or close centres they decide, with many they hardly
    matter. Other's boxes are moved by the time offset; where they have different velocities, one Gauss-Newton step
    fits yaw and offset together, the latter with its prior. Writes the pivot, the yaw, the offset and the variances.
    """
    k = star.pairs
    ex = ey = ox = oy = ux = uy = 0.0
    for i in range(k):
        m, n = pairs[i, 0], pairs[i, 1]
        ex += ego[m, X] / k
        ey += ego[m, Y] / k
        ox += other[n, X] / k
        oy += other[n, Y] / k
        ux += other[n, VX] / k
        uy += other[n, VY] / k
    variance = noise.position_std**2
    heading_variance = (noise.heading_std / _HEADING_WEIGHT) ** 2
    c = s = information = 0.0
    for i in range(k):
        m, n = pairs[i, 0], pairs[i, 1]
        ax, ay = ego[m, X] - ex, ego[m, Y] - ey
        bx = other[n, X] - ox - star.offset * (other[n, VX] - ux)
        by = other[n, Y] - oy - star.offset * (other[n, VY] - uy)
        c += (bx * ax + by * ay) / variance
        s += (bx * ay - by * ax) / variance
        information += (bx * bx + by * by) / variance
        turn = ego[m, YAW] - other[n, YAW] - star.yaw
        turn = wrap_half_turn(turn) if noise.use_flips else wrap(turn)
        weight = 1.0 / (heading_variance * (1.0 + (0.5 * turn / noise.heading_std) ** 2))
        c += weight * math.cos(star.yaw + turn)
        s += weight * math.sin(star.yaw + turn)
        information += weight
    star.yaw = math.atan2(s, c)

    cos, sin = math.cos(star.yaw), math.sin(star.yaw)
    offset_information = mixed = pull = 0.0
    for i in range(k):
        m, n = pairs[i, 0], pairs[i, 1]
        ux_n, uy_n = other[n, VX] - ux, other[n, VY] - uy
        bx, by = other[n, X] - ox - star.offset * ux_n, other[n, Y] - oy - star.offset * uy_n
        ax, ay = ego[m, X] - ex, ego[m, Y] - ey
        rx, ry = cos * ax + sin * ay - bx, cos * ay - sin * ax - by  # the residual along other's axes
        offset_information += (ux_n * ux_n + uy_n * uy_n) / variance
        mixed += (by * ux_n - bx * uy_n) / variance
        pull -= (rx * ux_n + ry * uy_n) / variance
    star.yaw_per_offset = mixed / information
    offset_information -= mixed * mixed / information  # of the offset with an unknown yaw
    star.measured_offset, star.measured_offset_variance = star.offset, np.inf
    if star.prior_offset_variance > 0.0 and offset_information > 1e-9:
        star.measured_offset += pull / offset_information
        star.measured_offset_variance = 1.0 / offset_information
        gain = star.prior_offset_variance / (star.prior_offset_variance + star.measured_offset_variance)
        offset = star.prior_offset + gain * (star.measured_offset - star.prior_offset)
        star.yaw -= star.yaw_per_offset * (offset - star.offset)
        star.offset = offset
        star.offset_variance = gain * star.measured_offset_variance
    star.ego_x, star.ego_y, star.other_vx, star.other_vy = ex, ey, ux, uy
    star.other_x, star.other_y = ox - star.offset * ux, oy - star.offset * uy
    star.position_variance = variance / k
    star.yaw_variance = 1.0 / information + star.yaw_per_offset**2 * star.offset_variance


@kernel(error_model="numpy")
def refine(ego, other, sizes, star, pairs, noise, rounds) -> None:
    """Match and refit by turns, starting from the star's pose; ends without pairs when nothing agrees."""
    for i in range(rounds + 1):
        if i > 0:
            fit_pose(ego, other, star, pairs, noise)
            # The residuals' spread is in the noise model already: only the turn about the pivot is left uncertain.
            star.position_variance = 0.0
        match_boxes(ego, other, sizes, star, pairs, noise)
        if star.pairs == 0:
            return


@kernel(error_model="numpy")
def same_pose(a, b, distance, angle) -> bool:
    """Whether two records' poses put a's pivot within `distance` [m] and differ by less than `angle` [rad]."""
    if abs(wrap(a.yaw - b.yaw)) > angle:
        return False
    cos, sin = math.cos(b.yaw), math.sin(b.yaw)
    dx, dy = a.other_x - b.other_x, a.other_y - b.other_y
    x, y = b.ego_x + cos * dx - sin * dy, b.ego_y + sin * dx + cos * dy
    return (x - a.ego_x) ** 2 + (y - a.ego_y) ** 2 < distance * distance


@kernel(error_model="numpy")
def copy_pairs(target, source, count) -> None:
    """Copy the first `count` pairs."""
    # Loops, here and elsewhere: numba compiles slices and array expressions far more slowly, and runs them no faster.
    for k in range(count):
        target[k, 0] = source[k, 0]
        target[k, 1] = source[k, 1]


@kernel(error_model="numpy")
def _same_star(a, a_pairs, b, b_pairs) -> bool:
    """Whether two stars have one pose, or the same pairs, at different time offsets for example."""
    if same_pose(a, b, SAME_DISTANCE, SAME_ANGLE):
        return True
    if a.pairs != b.pairs or a.pairs < 2:
        return False
    for i in range(a.pairs):
        found = False
        for k in range(b.pairs):
            found = found or (a_pairs[i, 0] == b_pairs[k, 0] and a_pairs[i, 1] == b_pairs[k, 1])
        if not found:
            return False
    return True


@kernel(error_model="numpy")
def add_star(stars, rows, count, star, pairs) -> int:
    """Add a star to the first `count` of `stars` and return their new number.

    Of stars with one pose or the same pairs the best stays. The last record of `stars` is scratch and never filled.
    """
    for i in range(count):
        if stars[i].evidence >= star.evidence and _same_star(stars[i], rows[i], star, pairs):
            return count
    kept = 0
    for i in range(count):
        if not _same_star(stars[i], rows[i], star, pairs):
            if kept < i:
                stars[kept] = stars[i]
                copy_pairs(rows[kept], rows[i], stars[i].pairs)
            kept += 1
    if kept < len(stars) - 1:
        stars[kept] = star
        copy_pairs(rows[kept], pairs, star.pairs)
        kept += 1
    return kept


@kernel(error_model="numpy")
def _nearest_raster(ego):
    """Which ego box is nearest to each cell: (cells, cells) rows or -1, with origin x, y and the cell [m]."""
    low_x = high_x = ego[0, X]
    low_y = high_y = ego[0, Y]
    for m in range(1, len(ego)):
        low_x, high_x = min(low_x, ego[m, X]), max(high_x, ego[m, X])
        low_y, high_y = min(low_y, ego[m, Y]), max(high_y, ego[m, Y])
    low_x, low_y = low_x - _RASTER_REACH, low_y - _RASTER_REACH
    width, height = high_x + _RASTER_REACH - low_x, high_y + _RASTER_REACH - low_y
    cell = max(_RASTER_CELL, max(width, height) / _RASTER_MOST_CELLS)
    columns, rows = int(width / cell) + 1, int(height / cell) + 1
    nearest = np.empty((columns, rows), np.int32)
    for i in range(columns):
        for j in range(rows):
            nearest[i, j] = -1
    gap = np.empty((columns, rows), np.float32)
    reach = int(_RASTER_REACH / cell) + 1
    for m in range(len(ego)):
        u, v = (ego[m, X] - low_x) / cell, (ego[m, Y] - low_y) / cell
        for i in range(max(0, int(u) - reach), min(columns, int(u) + reach + 1)):
            for j in range(max(0, int(v) - reach), min(rows, int(v) + reach + 1)):
                squared = (i + 0.5 - u) ** 2 + (j + 0.5 - v) ** 2
                if nearest[i, j] < 0 or squared < gap[i, j]:
                    nearest[i, j] = m
                    gap[i, j] = squared
    return nearest, low_x, low_y, cell


@kernel(error_model="numpy")
def _smallest(values: FloatArray, rows: IntArray) -> None:
    """Fill `rows` with the rows of the smallest values, smallest first."""
    count = 0
    for i in range(len(values)):
        if count == len(rows) and (count == 0 or values[i] >= values[rows[count - 1]]):
            continue
        place = count if count < len(rows) else count - 1
        while place > 0 and values[rows[place - 1]] > values[i]:
            if place < len(rows):
                rows[place] = rows[place - 1]
            place -= 1
        rows[place] = i
        count = min(count + 1, len(rows))


@kernel(error_model="numpy")
def _seed_rows(sizes: FloatArray) -> IntArray:
    """The rows of other that seed stars: all, or those whose sizes agree with the fewest of ego's boxes."""
    m_count, n_count = sizes.shape
    most = max(_SEED_PAIRS // m_count, _FEWEST_SEEDS)
    if n_count <= most:
        rows = np.empty(n_count, np.int64)
        for n in range(n_count):
            rows[n] = n
        return rows
    likeness = np.zeros(n_count)
    for m in range(m_count):
        for n in range(n_count):
            likeness[n] += math.exp(sizes[m, n])
    rows = np.empty(most, np.int64)
    _smallest(likeness, rows)
    return rows


@kernel(error_model="numpy")
def _directions(boxes):
    """Cosines and sines of the headings."""
    cos, sin = np.empty(len(boxes)), np.empty(len(boxes))
    for i in range(len(boxes)):
        cos[i], sin[i] = math.cos(boxes[i, YAW]), math.sin(boxes[i, YAW])
    return cos, sin


@kernel(error_model="numpy")
def _score_seeds(ego, other, sizes, noise, offset, offset_variance):
    """Every seed's rough evidence: (S,) scores and (S, 3) ego row, other row, flipped."""
    m_count, n_count = len(ego), len(other)
    seed_rows = _seed_rows(sizes)
    nearest, low_x, low_y, cell = _nearest_raster(ego)
    columns, rows = nearest.shape
    ego_cos, ego_sin = _directions(ego)
    other_cos, other_sin = _directions(other)
    upright = math.log(2.0 * (1.0 - noise.flip_probability)) if noise.use_flips else math.log(2.0)
    turned = math.log(2.0 * noise.flip_probability) if noise.use_flips else -20.0
    heading_gain = math.log(_SEED_HEADING_GAIN)
    sharpness = 0.5 / noise.heading_std**2
    flips = 2 if noise.use_flips else 1
    score = np.empty(m_count * len(seed_rows) * flips)
    seed = np.empty((len(score), 3), np.int32)
    leaves = min(n_count - 1, _LEAVES)
    leaf_rows = np.empty(leaves, np.int64)
    gap = np.empty(n_count)
    dx, dy, constant, inverse = np.empty(leaves), np.empty(leaves), np.empty(leaves), np.empty(leaves)
    count = 0
    for n in seed_rows:
        for q in range(n_count):
            gap[q] = (other[q, X] - other[n, X]) ** 2 + (other[q, Y] - other[n, Y]) ** 2
        gap[n] = np.inf
        _smallest(gap, leaf_rows)
        for i in range(leaves):
            q = leaf_rows[i]
            ux, uy = other[q, VX] - other[n, VX], other[q, VY] - other[n, VY]
            dx[i], dy[i] = other[q, X] - other[n, X] - offset * ux, other[q, Y] - other[n, Y] - offset * uy
            variance = noise.position_std**2 + 0.5 * offset_variance * (ux * ux + uy * uy)
            if noise.use_range_tolerance:
                variance += (dx[i] ** 2 + dy[i] ** 2) * _SEED_HEADING_STD**2
            constant[i] = heading_gain - math.log(2.0 * math.pi * variance * noise.density)
            inverse[i] = 0.5 / variance
        for m in range(m_count):
            if sizes[m, n] < _LEAST_SIZE_EVIDENCE:
                continue
            for flip in range(flips):
                sign = 1.0 - 2.0 * flip
                cos = sign * (ego_cos[m] * other_cos[n] + ego_sin[m] * other_sin[n])
                sin = sign * (ego_sin[m] * other_cos[n] - ego_cos[m] * other_sin[n])
                x0, y0 = (ego[m, X] - low_x) / cell, (ego[m, Y] - low_y) / cell
                total = sizes[m, n]
                for i in range(leaves):
                    u = x0 + (cos * dx[i] - sin * dy[i]) / cell
                    v = y0 + (sin * dx[i] + cos * dy[i]) / cell
                    if u < 0.0 or v < 0.0 or u >= columns or v >= rows:
                        continue
                    p = nearest[int(u), int(v)]
                    if p < 0:
                        continue
                    q = leaf_rows[i]
                    ex, ey = (u * cell + low_x) - ego[p, X], (v * cell + low_y) - ego[p, Y]
                    gain = constant[i] + sizes[p, q] - (ex * ex + ey * ey) * inverse[i]
                    if gain > 0.0:
                        head_cos = cos * other_cos[q] - sin * other_sin[q]
                        head_sin = sin * other_cos[q] + cos * other_sin[q]
                        across = ego_cos[p] * head_sin - ego_sin[p] * head_cos
                        gain -= min(across * across * sharpness, 3.0)
                        gain += upright if ego_cos[p] * head_cos + ego_sin[p] * head_sin > 0.0 else turned
                        if gain > 0.0:
                            total += gain
                score[count] = total
                seed[count, 0] = m
                seed[count, 1] = n
                seed[count, 2] = flip
                count += 1
    return score[:count], seed[:count]


@kernel(error_model="numpy")
def search(ego, other, sizes, noise, offset, offset_variance, tries, rounds, stars, rows):
    """Find the best stars of one pair of frames, no two of them with the same pose.

    Args:
        ego: (M, 5) boxes, at least one.
        other: (N, 7) boxes, at least one.
        sizes: (M, N) from `size_evidence`.
        noise: the noise model.
        offset: prior of the time offset of other's list [s].
        offset_variance: its variance [s^2]; 0 for a known offset.
        tries: seeds refined at most.
        rounds: refits of each.
        stars: (> tries,) `STAR` records, written from the first on; the last one is scratch.
        rows: (S, >= `most_pairs`, 2) the pairs of each, written.

    Returns:
        How many were found.
    """
    score, seed = _score_seeds(ego, other, sizes, noise, offset, offset_variance)
    star, pairs = stars[len(stars) - 1], np.empty((rows.shape[1], 2), np.int64)
    partner = np.empty(len(ego), np.int64)
    for m in range(len(ego)):
        partner[m] = -1
    count = 0
    for _ in range(min(tries, len(score))):
        best = 0
        for i in range(len(score)):
            if score[i] > score[best]:
                best = i
        if score[best] == -np.inf:
            break
        score[best] = -np.inf
        m, n = seed[best, 0], seed[best, 1]
        star.offset = star.prior_offset = offset
        star.offset_variance = star.prior_offset_variance = offset_variance
        star.other_vx, star.other_vy = other[n, VX], other[n, VY]
        star.ego_x, star.ego_y = ego[m, X], ego[m, Y]
        star.other_x, star.other_y = other[n, X] - offset * star.other_vx, other[n, Y] - offset * star.other_vy
        star.yaw = ego[m, YAW] - other[n, YAW] + math.pi * seed[best, 2]
        star.position_variance, star.yaw_variance = 0.0, _SEED_HEADING_STD**2
        refine(ego, other, sizes, star, pairs, noise, rounds)
        if star.pairs == 0:
            continue
        star.yaw = wrap(star.yaw)
        for k in range(star.pairs):
            partner[pairs[k, 0]] = pairs[k, 1]
        for i in range(len(score)):
            m, n = seed[i, 0], seed[i, 1]
            if partner[m] == n:
                turn = ego[m, YAW] - other[n, YAW] + math.pi * seed[i, 2] - star.yaw
                if abs(wrap(turn)) < _SAME_SEED_ANGLE:
                    score[i] = -np.inf
        for k in range(star.pairs):
            partner[pairs[k, 0]] = -1
        count = add_star(stars, rows, count, star, pairs)
    return count
