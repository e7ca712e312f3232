// The order in which splats are drawn: the depths of the moved centres, and a sort by counting.

import { BODY, bodiesAt, curvesAt } from "./moving.js";

/**
 * Write how deep the moved centres lie along a direction, but for a number that all share.
 *
 * scene has the parts of the file, and as followed what followedBodies returns.
 */
export function depthsAt({ header, parts, followed }, time, [a, b, c], depths) {
  const { values: means } = parts.get("means");
  for (let i = 0, j = 0; i < depths.length; i++, j += 3) {
    depths[i] = a * means[j] + b * means[j + 1] + c * means[j + 2];
  }
  if (followed) addBodies(header, bodiesAt(parts, time), followed, means, [a, b, c], depths);
  const curves = parts.get("curves/splat/offset");
  if (curves && header.moving) {
    addOffsets(header.moving, curvesAt(curves, time), parts.get("shares/splat/offset"), [a, b, c], depths);
  }
}

function addBodies({ moving, bodies }, moves, followed, means, [a, b, c], depths) {
  // How far a place (x, y, z, 1) moves along the direction is one row of four numbers a body.
  const along = new Float32Array(4 * bodies.count);
  for (let i = 0; i < along.length; i++) {
    const at = BODY * (i >> 2) + 4 + (i & 3);
    along[i] = a * moves[at] + b * moves[at + 4] + c * moves[at + 8];
  }
  const pairs = followed.length / 2 / moving;
  for (let i = 0, next = 0; i < moving; i++) {
    const [x, y, z] = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
    let sum = 0;
    for (let k = 0; k < pairs; k++, next += 2) {
      const row = 4 * followed[next];
      sum += followed[next + 1]
        * (along[row] * x + along[row + 1] * y + along[row + 2] * z + along[row + 3]);
    }
    depths[i] += sum;
  }
}

function addOffsets(moving, curves, { starts, places, values }, direction, depths) {
  const along = direction.flatMap((part) => Array.from(curves, (value) => part * value));
  for (let i = 0; i < moving; i++) {
    let sum = 0;
    for (let n = starts[i]; n < starts[i + 1]; n++) sum += along[places[n]] * values[n];
    depths[i] += sum;
  }
}

/** Sorts numbers of splats by depth; keeps its memory from one time to the next. */
export class Sorter {
  constructor(count) {
    this.depths = new Float32Array(count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.half = new Uint32Array(count);
    this.counts = new Uint32Array(1 << 16);
  }

  /** Write the numbers of the splats to `order`, the deepest first; depths are used up. */
  sort(order) {
    const { bits } = this;
    for (let i = 0; i < bits.length; i++) {
      // As unsigned integers these have the order of the depths, from the deepest on.
      bits[i] = bits[i] & 0x80000000 ? bits[i] : ~bits[i] & 0x7fffffff;
    }
    this.place(0, null, this.half);
    this.place(16, this.half, order);
  }

  /** Bring numbers into the order of 16 bits of their keys; equal ones stay as they are. */
  place(shift, from, to) {
    const { bits, counts } = this;
    counts.fill(0);
    for (let i = 0; i < bits.length; i++) counts[(bits[i] >>> shift) & 0xffff]++;
    for (let k = 0, sum = 0; k < counts.length; k++) {
      const here = counts[k];
      counts[k] = sum;
      sum += here;
    }
    for (let i = 0; i < bits.length; i++) {
      const splat = from ? from[i] : bits.length - 1 - i; // of equal ones the last comes first
      to[counts[(bits[splat] >>> shift) & 0xffff]++] = splat;
    }
  }
}
