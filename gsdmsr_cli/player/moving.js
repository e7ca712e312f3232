// How splats move: curves at a time, what bodies do at it, and which bodies a splat follows.

export const BODY = 20; // numbers of a body at a time: five texels, see bodiesAt

/** Return the values (R) of curves at t in [0, 1]; curves is a part with T rows, R columns. */
export function curvesAt({ rows, columns, values }, t) {
  const found = new Float32Array(columns);
  if (rows < 2) return found.map((_, r) => values[r]);
  const u = Math.min(Math.max(t, 0), 1) * (rows - 1);
  const i = Math.min(Math.floor(u), rows - 2);
  const f = u - i;
  const at = (row, r) => values[row * columns + r];
  const slope = (row, r) => {
    if (row === 0) return at(1, r) - at(0, r);
    if (row === rows - 1) return at(row, r) - at(row - 1, r);
    return (at(row + 1, r) - at(row - 1, r)) / 2;
  };
  const f2 = f * f;
  const f3 = f2 * f;
  for (let r = 0; r < columns; r++) {
    found[r] = (2 * f3 - 3 * f2 + 1) * at(i, r) + (f3 - 2 * f2 + f) * slope(i, r)
      + (3 * f2 - 2 * f3) * at(i + 1, r) + (f3 - f2) * slope(i + 1, r);
  }
  return found;
}

/** Write the channels of all rows of a name at t, row by row; 0 where the file has none. */
function channelsAt(parts, name, channels, t, out) {
  const curves = parts.get(`curves/${name}`);
  if (!curves) return out.fill(0);
  const values = curvesAt(curves, t);
  const { values: shares } = parts.get(`shares/${name}`);
  for (let i = 0, next = 0; i < out.length; i++) {
    let sum = 0;
    for (let r = 0; r < values.length; r++) sum += shares[next++] * values[r];
    out[i] = sum;
  }
  return out;
}

/**
 * Return what the bodies do at t, BODY numbers each.
 *
 * Those of a body are the quaternion that it turns by, less the identity; the rows of a matrix
 * (3, 4) that gives how far a place (x, y, z, 1) moves; what is added to log scales, and 0.
 */
export function bodiesAt(parts, t) {
  const { rows, values: points } = parts.get("points");
  const offset = channelsAt(parts, "body/offset", 3, t, new Float64Array(3 * rows));
  const turn = channelsAt(parts, "body/turn", 4, t, new Float64Array(4 * rows));
  const growth = channelsAt(parts, "body/growth", 3, t, new Float64Array(3 * rows));
  const out = new Float32Array(BODY * rows);
  for (let b = 0; b < rows; b++) {
    const q = [1 + turn[4 * b], turn[4 * b + 1], turn[4 * b + 2], turn[4 * b + 3]];
    const length = Math.hypot(...q) || 1;
    const [w, x, y, z] = q.map((value) => value / length);
    out.set([w - 1, x, y, z], BODY * b);
    const less = [ // R - I
      [-2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), -2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), -2 * (x * x + y * y)],
    ];
    for (let k = 0; k < 3; k++) {
      const [p, r, s] = less[k];
      const fixed = p * points[3 * b] + r * points[3 * b + 1] + s * points[3 * b + 2];
      out.set([p, r, s, offset[3 * b + k] - fixed], BODY * b + 4 + 4 * k);
      out[BODY * b + 16 + k] = growth[3 * b + k];
    }
  }
  return out;
}

/**
 * Return which bodies the moving splats follow: pairs of a body's number and its weight.
 *
 * A splat has as many pairs as neighbours, at least one; the weights add up to 1.
 */
export function followedBodies({ header, parts }) {
  const { moving, bodies } = header;
  if (!bodies.neighbours) {
    const { values } = parts.get("body");
    return Float32Array.from({ length: 2 * moving }, (_, i) => (i % 2 ? 1 : values[i / 2]));
  }
  const near = nearest(parts.get("means").values, moving, parts.get("points").values, bodies.neighbours);
  return withWeights(near, parts.get("log_radii").values, bodies.neighbours);
}

/** Turn pairs of a body and its squared distance into pairs of a body and its weight, in place. */
function withWeights(near, logRadii, neighbours) {
  for (let first = 0; first < near.length; first += 2 * neighbours) {
    const end = first + 2 * neighbours;
    let most = -Infinity;
    for (let i = first; i < end; i += 2) {
      near[i + 1] *= -0.5 * Math.exp(-2 * logRadii[near[i]]);
      most = Math.max(most, near[i + 1]);
    }
    let sum = 0;
    for (let i = first; i < end; i += 2) sum += near[i + 1] = Math.exp(near[i + 1] - most);
    for (let i = first; i < end; i += 2) near[i + 1] /= sum;
  }
  return near;
}

/**
 * Return the nearest `wanted` points of each of the first `count` queries: pairs of a point's
 * number and its squared distance.
 *
 * Points are visited outwards from a query along x, until none that is left can be nearer.
 */
export function nearest(queries, count, points, wanted) {
  const order = Uint32Array.from({ length: points.length / 3 }, (_, i) => i)
    .sort((a, b) => points[3 * a] - points[3 * b]);
  const sorted = Float32Array.from({ length: points.length }, (_, i) => (
    points[3 * order[Math.floor(i / 3)] + (i % 3)]));
  const found = new Float32Array(2 * wanted * count);
  const who = new Int32Array(wanted);
  const distance = new Float64Array(wanted);
  for (let n = 0; n < count; n++) {
    const [x, y, z] = [queries[3 * n], queries[3 * n + 1], queries[3 * n + 2]];
    distance.fill(Infinity);
    let right = firstFrom(sorted, order.length, x);
    let left = right - 1;
    const last = wanted - 1;
    while (left >= 0 || right < order.length) {
      const before = left >= 0 ? x - sorted[3 * left] : Infinity;
      const after = right < order.length ? sorted[3 * right] - x : Infinity;
      const i = before < after ? left-- : right++;
      const along = Math.min(before, after);
      if (along * along > distance[last]) break;
      const [dy, dz] = [y - sorted[3 * i + 1], z - sorted[3 * i + 2]];
      const squared = along * along + dy * dy + dz * dz;
      if (squared >= distance[last]) continue;
      let k = last;
      for (; k > 0 && distance[k - 1] > squared; k--) {
        distance[k] = distance[k - 1];
        who[k] = who[k - 1];
      }
      distance[k] = squared;
      who[k] = i;
    }
    for (let k = 0; k < wanted; k++) {
      found[2 * (wanted * n + k)] = order[who[k]];
      found[2 * (wanted * n + k) + 1] = distance[k];
    }
  }
  return found;
}

/** Return the number of the first of `count` points, sorted along x, that is not left of x. */
function firstFrom(sorted, count, x) {
  let [low, high] = [0, count];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[3 * middle] < x) low = middle + 1;
    else high = middle;
  }
  return low;
}
