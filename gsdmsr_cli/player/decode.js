// Reads a file of moving splats: container, header and parts. docs/file-format.md has the layout.

const MAGIC = [0x64, 0x73, 0x70, 0x6c, 0x61, 0x74, 0x0d, 0x0a];
const VERSION = 1;
export const MOST_ROWS = 1 << 24; // so that every row has a number that float32 holds

/** What is wrong with a file, as a sentence for whoever has opened it. */
export class FileError extends Error {}

/**
 * Return what a file holds: its header, and its parts by name.
 *
 * A part is {rows, columns, values}; values is a Float32Array of rows * columns, row by row. Shares of splats,
 * most of which are 0, are {rows, columns, starts, places, values} of the others: those of row i are
 * values[n], in column places[n], for n from starts[i] to starts[i + 1].
 */
export async function decode(bytes) {
  const { header, start } = readHeader(bytes);
  const parts = new Map();
  let at = start;
  for (const entry of header.parts) {
    const end = at + entry.bytes;
    if (end > bytes.length) {
      throw new FileError(
        `The file is cut off: it should have ${end} bytes or more and has ${bytes.length}.`,
      );
    }
    if (isKnown(entry.name)) {
      const planes = await inflate(bytes.subarray(at, end), entry);
      const read = entry.name === "means" ? { values: readMeans(planes, entry, header.moving) }
        : SPARSE.test(entry.name) ? readSparse(planes, entry) : { values: readTable(planes, entry) };
      parts.set(entry.name, { rows: entry.rows, columns: entry.columns, ...read });
    }
    at = end;
  }
  checkParts(header, parts);
  return { header, parts };
}

function readHeader(bytes) {
  if (bytes.length < 16 || MAGIC.some((value, i) => bytes[i] !== value)) {
    throw new FileError("This is not a file of moving splats: it does not begin as a .dsplat does.");
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const version = view.getUint32(8, true);
  if (version !== VERSION) {
    throw new FileError(
      `The file has version ${version} and this page plays version ${VERSION}: ` +
        "make the page with the gsdmsr that has made the file.",
    );
  }
  const start = 16 + view.getUint32(12, true);
  if (start > bytes.length) throw new FileError("The file is cut off inside its header.");
  const header = parseHeader(bytes.subarray(16, start));
  checkHeader(header);
  return { header, start };
}

function parseHeader(bytes) {
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes));
  } catch {
    throw new FileError("The file is damaged: its header cannot be read.");
  }
}

const isCount = (value, most = MOST_ROWS) => Number.isInteger(value) && value >= 0 && value <= most;

function demand(holds, what) {
  if (!holds) throw new FileError(`The file is damaged: ${what}.`);
}

function checkHeader(header) {
  demand(header !== null && typeof header === "object", "its header is no object");
  const { splats, moving, sh_degree: degree, times, bodies, parts } = header;
  demand(isCount(splats) && isCount(moving, splats), "its numbers of splats are not possible");
  demand(isCount(degree, 3), "sh_degree is not 0 to 3");
  demand(isCount(times) && times >= 1, "times is not 1 or more");
  if (bodies) {
    const { count, neighbours } = bodies;
    demand(isCount(count) && count >= 1 && isCount(neighbours, count), "bodies is not possible");
  }
  demand(Array.isArray(parts), "it has no list of parts");
  for (const entry of parts) checkEntry(entry);
}

function checkEntry(entry) {
  demand(entry !== null && typeof entry?.name === "string", "a part has no name");
  const { name, rows, columns, width, bytes } = entry;
  demand(isCount(rows) && isCount(columns, 1 << 20), `${name} has no size`);
  demand(isCount(width, 6) && width >= 1 && isCount(bytes, 2 ** 40), `${name} has no width`);
  if (!isKnown(name)) return;
  for (const key of ["least", "step"]) {
    const given = entry[key] = [entry[key]].flat(); // one number may stand for all columns
    const enough = given.length === 1 || given.length === (name === "means" ? 3 : columns);
    demand(enough && given.every(Number.isFinite), `${name} has no values for ${key}`);
  }
}

/** Return the planes of bytes of a part. */
async function inflate(bytes, { name, rows, columns, width }) {
  const planes = new Uint8Array(rows * columns * width);
  let filled = 0;
  try {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    for (let reader = stream.getReader(); ;) {
      const { done, value } = await reader.read();
      if (done) break;
      planes.set(value, filled); // throws where there is more than there should be
      filled += value.length;
    }
  } catch {
    throw new FileError(`The file is damaged: ${name} cannot be unpacked.`);
  }
  demand(filled === planes.length, `${name} is shorter than it should be`);
  return planes;
}

/** Write the unsigned integers of one column to `column`; exact up to 2^53. */
function readColumn(planes, { rows, width }, c, column) {
  column.fill(0);
  for (let k = 0, factor = 1; k < width; k++, factor *= 256) {
    const first = (c * width + k) * rows;
    for (let i = 0; i < rows; i++) column[i] += factor * planes[first + i];
  }
}

/** Call take(c, values) for every column; the values are good until the next one. */
function readColumns(planes, entry, take) {
  const { name, rows, columns, least, step, signed, difference } = entry;
  const codes = new Float64Array(rows);
  const values = new Float32Array(rows);
  for (let c = 0; c < columns; c++) {
    readColumn(planes, entry, c, codes);
    if (signed || difference) {
      for (let i = 0; i < rows; i++) {
        const half = Math.floor(codes[i] / 2);
        codes[i] = codes[i] === 2 * half ? half : -half - 1;
      }
    }
    if (difference) for (let i = 1; i < rows; i++) codes[i] += codes[i - 1];
    const base = least[c % least.length];
    const factor = step[c % step.length];
    for (let i = 0; i < rows; i++) values[i] = base + factor * codes[i];
    let none = 0; // becomes NaN where a value is not finite
    for (let i = 0; i < rows; i++) none += 0 * values[i];
    demand(none === 0, `${name} has values that are not finite`);
    take(c, values);
  }
}

function readTable(planes, entry) {
  const { rows, columns } = entry;
  const values = new Float32Array(rows * columns);
  readColumns(planes, entry, (c, column) => {
    for (let i = 0; i < rows; i++) values[i * columns + c] = column[i];
  });
  return values;
}

/** Return the values that are not 0, and where they are, see decode(). */
function readSparse(planes, entry) {
  const { rows } = entry;
  const starts = new Uint32Array(rows + 1);
  readColumns(planes, entry, (c, column) => {
    for (let i = 0; i < rows; i++) if (column[i]) starts[i + 1]++;
  });
  for (let i = 0; i < rows; i++) starts[i + 1] += starts[i];
  const next = starts.slice();
  const places = new Uint32Array(starts[rows]);
  const values = new Float32Array(starts[rows]);
  readColumns(planes, entry, (c, column) => {
    for (let i = 0; i < rows; i++) {
      if (!column[i]) continue;
      places[next[i]] = c;
      values[next[i]++] = column[i];
    }
  });
  return { starts, places, values };
}

/** Return the canonical centres, which are Morton codes in the file. */
function readMeans(planes, entry, moving) {
  const { rows, columns, least, step, warp } = entry;
  demand(columns === 1, "means has more than one column");
  const column = new Float64Array(rows);
  readColumn(planes, entry, 0, column);
  const values = new Float32Array(rows * 3);
  let code = 0;
  for (let i = 0; i < rows; i++) {
    code = (i === moving ? 0 : code) + column[i];
    const high = Math.floor(code / 2 ** 24);
    const low = code - high * 2 ** 24;
    for (let axis = 0; axis < 3; axis++) {
      const q = everyThirdBit(low >>> axis) + 256 * everyThirdBit(high >>> axis);
      const p = least[axis % least.length] + step[axis % step.length] * q;
      values[3 * i + axis] = warp === undefined ? p : warp * Math.sinh(p);
    }
  }
  demand(code < 2 ** 53 && values.every(Number.isFinite), "means has impossible places");
  return values;
}

/** Return bits 0, 3, 6 ... of a number of up to 30 bits, side by side. */
function everyThirdBit(bits) {
  let x = bits & 0x09249249;
  x = (x ^ (x >>> 2)) & 0x030c30c3;
  x = (x ^ (x >>> 4)) & 0x0300f00f;
  x = (x ^ (x >>> 8)) & 0x030000ff;
  return (x ^ (x >>> 16)) & 0x3ff;
}

const CHANNELS = {
  "body/offset": 3, "body/turn": 4, "body/growth": 3,
  "splat/offset": 3, "splat/turn": 4, "splat/growth": 3, "splat/opacity": 1,
};

/** Return how many channels curves have, by what they change. */
export function channelsOf(header) {
  return { ...CHANNELS, "splat/sh": 3 * (header.sh_degree + 1) ** 2 };
}

const SINGLE = ["means", "quats", "log_scales", "opacities", "sh_0", "sh_rest", "lives", "points",
  "log_radii", "body"];

const SPARSE = /^shares\/splat\//;

function isKnown(name) {
  const [kind, ...rest] = name.split("/");
  const curve = rest.join("/");
  return SINGLE.includes(name)
    || (["curves", "shares"].includes(kind) && (curve in CHANNELS || curve === "splat/sh"));
}

/** Throw unless the parts are there that the header calls for, with as many rows and columns. */
function checkParts(header, parts) {
  const { splats: n, moving: m, sh_degree: degree, bodies } = header;
  const expected = { means: [n, 1], quats: [n, 3], log_scales: [n, 3], opacities: [n, 1], sh_0: [n, 3] };
  if (degree > 0) expected.sh_rest = [n, 3 * ((degree + 1) ** 2 - 1)];
  if (parts.has("lives")) expected.lives = [m, 4];
  if (bodies) {
    expected.points = [bodies.count, 3];
    expected[bodies.neighbours ? "log_radii" : "body"] = [bodies.neighbours ? bodies.count : m, 1];
  }
  for (const [name, channels] of Object.entries(channelsOf(header))) {
    const curves = parts.get(`curves/${name}`);
    demand(Boolean(curves) === parts.has(`shares/${name}`), `${name} has curves or shares alone`);
    if (!curves) continue;
    demand(bodies || !name.startsWith("body/"), `${name} is there without bodies`);
    expected[`curves/${name}`] = [header.times, curves.columns];
    const rows = name.startsWith("body/") ? bodies.count : m;
    expected[`shares/${name}`] = [rows, curves.columns * channels];
  }
  for (const [name, [rows, columns]] of Object.entries(expected)) {
    const part = parts.get(name);
    demand(part, `${name} is missing`);
    demand(part.rows === rows && part.columns === columns, `${name} has another size than it should`);
  }
  const inside = (body) => body >= 0 && body < bodies.count && Number.isInteger(body);
  demand(!("body" in expected) || parts.get("body").values.every(inside), "body names no body");
}
