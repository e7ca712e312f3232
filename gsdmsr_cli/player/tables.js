// Puts what a file holds into tables as the graphics card reads them: four numbers a texel.

import { curvesAt, followedBodies } from "./moving.js";

/** What splats' own curves change, in the order in which a splat's shares lie in `own`. */
export const OWN = ["splat/offset", "splat/turn", "splat/growth", "splat/opacity"];

/** Return how many curves there are of each kind that a splat may have of its own. */
export function curveCounts(parts) {
  const count = (name) => parts.get(`curves/${name}`)?.columns ?? 0;
  return { own: OWN.map(count), colours: count("splat/sh") };
}

/** Return the tables of a decoded file by name; those that it does not need are null. */
export function makeTables(file) {
  const { header, parts } = file;
  const { own, colours } = curveCounts(parts);
  const moves = header.moving > 0;
  return {
    geometry: geometry(parts, header.splats),
    rest: parts.has("sh_rest") ? asTexels(toRgb(parts.get("sh_rest").values)) : null,
    lives: moves ? parts.get("lives")?.values ?? null : null,
    followed: moves && header.bodies ? followedBodies(file) : null,
    own: moves && own.some(Boolean) ? ownShares(parts, header.moving, own) : null,
    colours: moves && colours ? colourShares(parts, header) : null,
  };
}

/** Four texels a splat: mean and opacity, quaternion wxyz, log scales, colour of degree 0. */
function geometry(parts, count) {
  const [means, quats, scales, opacities] = ["means", "quats", "log_scales", "opacities"]
    .map((name) => parts.get(name).values);
  const colours = toRgb(parts.get("sh_0").values);
  const table = new Float32Array(16 * count);
  for (let i = 0, at = 0; i < count; i++, at += 16) {
    const [x, y, z] = [quats[3 * i], quats[3 * i + 1], quats[3 * i + 2]];
    for (let k = 0; k < 3; k++) {
      table[at + k] = means[3 * i + k];
      table[at + 8 + k] = scales[3 * i + k];
      table[at + 12 + k] = colours[3 * i + k];
    }
    table[at + 3] = opacities[i];
    table[at + 4] = Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z));
    table[at + 5] = x;
    table[at + 6] = y;
    table[at + 7] = z;
  }
  return table;
}

/** Return triples of Y, Co, Cg as red, green, blue. */
function toRgb(values) {
  const found = new Float32Array(values.length);
  for (let i = 0; i < values.length; i += 3) {
    const [y, co, cg] = [values[i], values[i + 1], values[i + 2]];
    found[i] = y - cg + co;
    found[i + 1] = y + cg;
    found[i + 2] = y - cg - co;
  }
  return found;
}

/** Return triples with a 0 behind each. */
function asTexels(triples) {
  const found = new Float32Array(triples.length / 3 * 4);
  for (let i = 0, j = 0; i < triples.length; i += 3, j += 4) {
    found[j] = triples[i];
    found[j + 1] = triples[i + 1];
    found[j + 2] = triples[i + 2];
  }
  return found;
}

/** A texel for each curve of a splat, kind after kind: its share of up to four channels. */
function ownShares(parts, moving, counts) {
  const texels = counts.reduce((sum, count) => sum + count, 0);
  const table = new Float32Array(4 * texels * moving);
  let first = 0;
  OWN.forEach((name, kind) => {
    const curves = counts[kind];
    if (!curves) return;
    const { columns, values } = parts.get(`shares/${name}`);
    for (let i = 0; i < moving; i++) {
      for (let c = 0; c < columns; c++) {
        const texel = texels * i + first + (c % curves);
        table[4 * texel + Math.floor(c / curves)] = values[columns * i + c];
      }
    }
    first += curves;
  });
  return table;
}

/** A texel for each coefficient of each curve of a splat. */
function colourShares(parts, { moving, sh_degree: degree }) {
  const { columns, values } = parts.get("shares/splat/sh");
  const coefficients = (degree + 1) ** 2;
  const curves = columns / coefficients / 3;
  const triples = new Float32Array(columns * moving);
  let next = 0;
  for (let i = 0; i < moving; i++) {
    for (let r = 0; r < curves; r++) {
      for (let c = 0; c < 3 * coefficients; c++) triples[next++] = values[columns * i + c * curves + r];
    }
  }
  return asTexels(toRgb(triples));
}

/** Return the values at t of all curves that a splat may have of its own, in the tables' order. */
export function ownCurvesAt(parts, t) {
  return [...OWN, "splat/sh"].map((name) => parts.get(`curves/${name}`))
    .flatMap((curves) => (curves ? [...curvesAt(curves, t)] : []));
}
