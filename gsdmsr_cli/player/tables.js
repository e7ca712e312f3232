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

/** Return the tables of a decoded file by name; those that it does not need are null, or not there. */
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
 * kinds are parts of shares, each with how many curves it is of and how many curves lie before them. Returns for each
 * splat where its entries of each kind end, for each entry which curve it is, and its `size` channels of shares.
 */
function listShares(kinds, moving, size) {
  const ends = new Float32Array(kinds.length * moving);
  const entries = new Int32Array(Math.max(...kinds.map(({ curves }) => curves)));
  const walk = (take) => {
    let end = 0;
    entries.fill(-1);
    for (let i = 0, k = 0; i < moving; i++) {
      for (const { starts, places, values, curves, before } of kinds) {
        const begin = end;
        for (let n = starts[i]; n < starts[i + 1]; n++) {
          const r = places[n] % curves;
          if (entries[r] < begin) entries[r] = end++;
          take(entries[r], before + r, (places[n] - r) / curves, values[n]);
        }
        ends[k++] = end;
      }
    }
    return end;
  };
  const count = walk(() => {});
  if (count > MOST_ROWS) throw new FileError("The scene moves in more ways than a page can show.");
  const which = new Float32Array(count);
  const shares = new Float32Array(size * count);
  walk((entry, curve, channel, share) => {
    which[entry] = curve;
    shares[size * entry + channel] = share;
  });
  return { ends, which, shares };
}

/** A texel for each curve that a splat has, kind after kind: its share of up to four channels. */
function ownShares(parts, moving) {
  const none = { starts: new Uint32Array(moving + 1) };
  let before = 0;
  const kinds = OWN.map((name) => {
    const curves = parts.get(`curves/${name}`)?.columns ?? 0;
    const kind = { ...(parts.get(`shares/${name}`) ?? none), curves, before };
    before += curves;
    return kind;
  });
  const { ends, which, shares } = listShares(kinds, moving, 4);
  return { own: shares, own_ends: ends, own_which: which };
}

/** A texel for each coefficient of each curve of colours that a splat has. */
function colourShares(parts, { moving, sh_degree: degree }, before) {
  const { columns: curves } = parts.get("curves/splat/sh");
  const kind = { ...parts.get("shares/splat/sh"), curves, before };
  const { ends, which, shares } = listShares([kind], moving, 3 * (degree + 1) ** 2);
  return { colours: asTexels(toRgb(shares)), colour_ends: ends, colour_which: which };
}

/** Return the values at t of all curves that a splat may have of its own, in the tables' order. */
export function ownCurvesAt(parts, t) {
  return [...OWN, "splat/sh"].map((name) => parts.get(`curves/${name}`))
    .flatMap((curves) => (curves ? [...curvesAt(curves, t)] : []));
}
