// Puts what a file holds into tables as the graphics card reads them: four numbers a texel.

import { FileError, MOST_ROWS } from "./decode.js";
import { curvesAt, followedBodies } from "./moving.js";

/** What splats' own curves change but colours, in the order in which a splat's shares lie in `own`. */
export const OWN = ["splat/offset", "splat/turn", "splat/growth", "splat/opacity"];

/** Return how many curves there are that splats may have of their own: of all kinds but colours, and of colours. */
export function curveCounts(parts) {
  const count = (name) => parts.get(`curves/${name}`)?.columns ?? 0;
  return { own: OWN.map(count).reduce((sum, more) => sum + more), colours: count("splat/sh") };
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
    ...(moves && own ? ownShares(parts, header.moving) : {}),
    ...(moves && colours ? colourShares(parts, header, own) : {}),
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

/**
 * List the curves that splats have: those that they have a share of which is not 0.
 *
 * kinds are parts of shares, each with how many curves it is of and how many curves lie before them.
 * Returns which curve every entry of the list is, and for each splat where its entries of each kind end.
 */
function listCurves(kinds, moving) {
  const ends = new Float32Array(kinds.length * moving);
  let end = 0;
  for (let i = 0, k = 0; i < moving; i++) {
    for (const kind of kinds) {
      for (let r = 0; r < kind.curves; r++) if (hasShare(kind, i, r)) end++;
      ends[k++] = end;
    }
  }
  if (end > MOST_ROWS) throw new FileError("The scene moves in more ways than a page can show.");
  const which = new Float32Array(end);
  for (let i = 0, next = 0; i < moving; i++) {
    for (const kind of kinds) {
      for (let r = 0; r < kind.curves; r++) if (hasShare(kind, i, r)) which[next++] = kind.first + r;
    }
  }
  return { ends, which };
}

/** Whether one channel or more of splat i has a share of curve r. */
function hasShare({ columns, curves, values }, i, r) {
  for (let c = r; c < columns; c += curves) if (values[columns * i + c] !== 0) return true;
  return false;
}

/** A texel for each curve that a splat has, kind after kind: its share of up to four channels. */
function ownShares(parts, moving) {
  let first = 0;
  const kinds = OWN.map((name) => {
    const { columns, values } = parts.get(`shares/${name}`) ?? { columns: 0, values: null };
    const curves = parts.get(`curves/${name}`)?.columns ?? 0;
    first += curves;
    return { columns, values, curves, first: first - curves };
  });
  const { ends, which } = listCurves(kinds, moving);
  const own = new Float32Array(4 * which.length);
  for (let i = 0, k = 0, next = 0; i < moving; i++) {
    for (const { columns, values, curves, first: before } of kinds) {
      for (const end = ends[k++]; next < end; next++) {
        const from = columns * i + which[next] - before;
        for (let c = 0; c * curves < columns; c++) own[4 * next + c] = values[from + c * curves];
      }
    }
  }
  return { own, own_ends: ends, own_which: which };
}

/** A texel for each coefficient of each curve of colours that a splat has. */
function colourShares(parts, { moving, sh_degree: degree }, before) {
  const { columns, values } = parts.get("shares/splat/sh");
  const { columns: curves } = parts.get("curves/splat/sh");
  const kind = { columns, values, curves, first: before };
  const { ends, which } = listCurves([kind], moving);
  const triples = new Float32Array(3 * (degree + 1) ** 2 * which.length);
  for (let i = 0, next = 0, to = 0; i < moving; i++) {
    for (; next < ends[i]; next++) {
      const from = columns * i + which[next] - before;
      for (let c = 0; c < columns; c += curves) triples[to++] = values[from + c];
    }
  }
  return { colours: asTexels(toRgb(triples)), colour_ends: ends, colour_which: which };
}

/** Return the values at t of all curves that a splat may have of its own, in the tables' order. */
export function ownCurvesAt(parts, t) {
  return [...OWN, "splat/sh"].map((name) => parts.get(`curves/${name}`))
    .flatMap((curves) => (curves ? [...curvesAt(curves, t)] : []));
}
