// The page's side of the worker: files to decode, and orders of splats, one at a time.

import { FileError } from "./decode.js";
import { note } from "./figures.js";

/** A worker that runs the page's own script. */
export class Helper {
  /** onOrder(order) is called with every order that comes, onFault(error) where none can be had. */
  constructor(script, onOrder, onFault) {
    const url = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.worker.onmessage = ({ data }) => this.answers.get(data.number)?.(data);
    this.answers = new Map();
    this.number = 0;
    this.onOrder = onOrder;
    this.onFault = onFault;
    this.sortMilliseconds = [];
    this.orders = 0;
    this.loaded = false;
    this.fault = null; // why there are no orders any more
    this.current = null; // what the last order that came was for
    this.running = null;
    this.wanted = null; // asked for while another is on its way
  }

  call(message, transferred = []) {
    const number = ++this.number;
    return new Promise((resolve, reject) => {
      this.answers.set(number, (answer) => {
        this.answers.delete(number);
        if (answer.fault) reject(new FileError(answer.fault));
        else resolve(answer);
      });
      this.worker.onerror = () => reject(new FileError("The page cannot run its worker here."));
      this.worker.postMessage({ number, ...message }, transferred);
    });
  }

  /** Return what the worker has made of a file; its bytes are copied. */
  async load(bytes) {
    const before = this.loaded;
    this.loaded = false;
    this.fault = null;
    await this.running;
    try {
      const answer = await this.call({ bytes });
      this.current = null;
      this.loaded = true;
      return answer;
    } catch (error) {
      this.loaded = before; // the worker keeps what it had
      throw error;
    }
  }

  /** Ask for the order at a time along a direction, unless it is there or on its way. */
  ask(wanted) {
    if (!this.loaded || (!this.running && same(wanted, this.current))) return;
    this.wanted = wanted;
    this.running ??= this.run();
  }

  async run() {
    try {
      while (this.wanted && this.loaded) {
        const wanted = this.wanted;
        this.wanted = null;
        const { order, milliseconds } = await this.call({ wanted });
        this.orders += 1;
        note(this.sortMilliseconds, milliseconds);
        this.current = wanted;
        this.onOrder(order);
        if (this.wanted && same(this.wanted, wanted)) this.wanted = null;
      }
    } catch (error) {
      this.loaded = false;
      this.fault = error;
      this.onFault(error);
    } finally {
      this.running = null;
    }
  }

  /** Return when the last order is the one at a time along a direction; fail where none can be had. */
  async exact(wanted) {
    while (this.loaded && !same(wanted, this.current)) {
      this.ask(wanted);
      await this.running;
    }
    if (this.fault) throw this.fault;
  }
}

function same(a, b) {
  return a && b && a.time === b.time && a.direction.every((value, i) => value === b.direction[i]);
}
