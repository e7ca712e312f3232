// What runs beside the page: it decodes files, and keeps the order of their splats.

import { decode, FileError } from "./decode.js";
import { depthsAt, Sorter } from "./sort.js";
import { makeTables } from "./tables.js";

const FOR_THE_PAGE = /^(points|curves\/.*|shares\/body\/.*)$/; // the page moves bodies itself
const FOR_DEPTHS = /^(means|points|(curves|shares)\/(body\/.*|splat\/offset))$/;

/** Answer the page's messages until it ends this worker. */
export function work() {
  let scene = null;
  let sorter = null;

  const load = async (number, bytes) => {
    const begun = performance.now();
    const file = await decode(bytes);
    const tables = makeTables(file);
    const partsFor = (names) => new Map([...file.parts].filter(([name]) => names.test(name)));
    scene = { header: file.header, parts: partsFor(FOR_DEPTHS), followed: tables.followed };
    sorter = new Sorter(file.header.splats);
    const parts = partsFor(FOR_THE_PAGE);
    const answer = { number, header: file.header, parts, tables, milliseconds: performance.now() - begun };
    const given = Object.entries(tables).filter(([name, table]) => table && name !== "followed");
    postMessage(answer, given.map(([, table]) => table.buffer));
  };

  const sort = (number, { time, direction }) => {
    const begun = performance.now();
    depthsAt(scene, time, direction, sorter.depths);
    const order = new Uint32Array(scene.header.splats);
    sorter.sort(order);
    postMessage({ number, order, milliseconds: performance.now() - begun }, [order.buffer]);
  };

  onmessage = async ({ data: { number, bytes, wanted } }) => {
    try {
      if (bytes) await load(number, bytes);
      else sort(number, wanted);
    } catch (error) {
      const known = error instanceof FileError;
      const fault = known ? error.message : `The file cannot be shown: ${error.message}.`;
      postMessage({ number, fault });
    }
  };
}
