// Vectors of three numbers, and quaternions wxyz, as arrays.

export const add = (a, b) => a.map((value, i) => value + b[i]);
export const subtract = (a, b) => a.map((value, i) => value - b[i]);
export const times = (factor, a) => a.map((value) => factor * value);
export const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
export const mix = (a, b, f) => a.map((value, i) => value + f * (b[i] - value));

/** Return a vector or quaternion of length 1, or null for one of no length. */
export function unit(a) {
  const length = Math.hypot(...a);
  return length > 1e-12 && Number.isFinite(length) ? times(1 / length, a) : null;
}

export function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

/** Return the quaternion that turns by `second` first. */
export function product([a, b, c, d], [w, x, y, z]) {
  return [
    a * w - b * x - c * y - d * z,
    a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x,
    a * z + b * y - c * x + d * w,
  ];
}

/** Return the quaternion that turns by an angle about an axis of length 1. */
export function turnAbout(axis, angle) {
  return [Math.cos(angle / 2), ...times(Math.sin(angle / 2), axis)];
}

/** Return a vector turned by a quaternion of length 1. */
export function turned([w, ...v], a) {
  const twice = times(2, cross(v, a));
  return add(add(a, times(w, twice)), cross(v, twice));
}

/** Return the quaternion of the rotation with these three columns. */
export function fromColumns([a, b, c], [d, e, f], [g, h, i]) {
  const candidates = [ // each column of the matrix 4 q q^T; the longest is the safest
    [1 + a + e + i, f - h, g - c, b - d],
    [f - h, 1 + a - e - i, d + b, g + c],
    [g - c, d + b, 1 - a + e - i, h + f],
    [b - d, g + c, h + f, 1 - a - e + i],
  ];
  return unit(candidates.reduce((best, q) => (Math.hypot(...q) > Math.hypot(...best) ? q : best)));
}

/** Return a quaternion a share f of the way from a to b. */
export function between(a, b, f) {
  const nearer = dot(a, b) < 0 ? times(-1, b) : b;
  return unit(mix(a, nearer, f)) ?? b;
}
