// What is shown: a scene, a camera, a time; draws a frame whenever one of them changes.

import { Camera } from "./camera.js";
import { Drawing } from "./draw.js";
import { median, note } from "./figures.js";
import { Helper } from "./helper.js";

const DENSEST = 2; // most pixels of the canvas for one of the page along a side
const LONGEST = 0.5; // that a frame counts for: the page may have been hidden [s]

/** A canvas on which a scene plays. */
export class Player {
  /** script is the page's own, which the worker runs; onFault is told what goes wrong. */
  constructor(canvas, script, onFault) {
    this.canvas = canvas;
    this.onFault = onFault;
    this.onChange = () => {};
    this.camera = new Camera();
    this.helper = new Helper(script, (order) => this.takeOrder(order), onFault);
    this.drawing = new Drawing(canvas);
    this.scene = null;
    this.bytes = null;
    this.loading = null; // a promise: the last file that came is shown, or refused
    this.coming = null; // a scene whose first order is on its way
    this.time = 0;
    this.playing = false;
    this.loop = true;
    this.speed = 1;
    this.background = null; // null is the scene's own
    this.fixed = null; // a view that is given from outside
    this.flying = [0, 0, 0]; // in the camera's axes
    this.scheduled = false;
    this.before = null;
    this.scriptMilliseconds = [];
    this.frames = 0;
    this.firstPicture = null;
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.drawing = null;
    });
    canvas.addEventListener("webglcontextrestored", () => this.restore());
    new ResizeObserver(() => this.invalidate()).observe(canvas);
  }

  /** Show what these bytes of a file hold; camera and time stay where they are if there are any. */
  async load(bytes) {
    const taken = this.take(bytes);
    this.loading = taken.catch(() => {}); // who waits for a picture gets that of what there is
    await taken;
  }

  async take(bytes) {
    const scene = await this.helper.load(bytes);
    if (!this.scene) {
      this.camera.start(scene.header.scene);
      this.camera.follow(this.time);
    }
    this.bytes = bytes;
    this.coming = scene;
    await this.settle();
  }

  takeOrder(order) {
    if (!this.drawing) return;
    if (this.coming) {
      this.drawing.load(this.coming);
      const { header, milliseconds } = this.coming;
      this.scene = { header, milliseconds };
      this.coming = null;
      this.onChange();
    }
    this.drawing.setOrder(order);
    this.invalidate();
  }

  async restore() {
    try {
      this.drawing = new Drawing(this.canvas);
      if (this.bytes) await this.load(this.bytes);
    } catch (error) {
      this.onFault(error);
    }
  }

  get header() { return (this.coming ?? this.scene)?.header; }

  get moves() { return (this.header?.moving ?? 0) > 0; }

  get seconds() {
    const seconds = this.header?.scene?.seconds;
    return seconds > 0 ? seconds : 3;
  }

  get colour() {
    const own = this.header?.scene?.background;
    return this.background ?? (Array.isArray(own) && own.length === 3 ? own : [0, 0, 0]);
  }

  view() {
    if (this.fixed) return this.fixed;
    const density = Math.min(window.devicePixelRatio || 1, DENSEST);
    const side = (length) => Math.max(1, Math.round(length * density));
    return this.camera.view(side(this.canvas.clientWidth), side(this.canvas.clientHeight));
  }

  /** What an order of the splats depends on. */
  wanted(view = this.view()) {
    return { time: this.moves ? this.time : 0, direction: view.world_to_camera.slice(8, 11) };
  }

  /** Have a frame drawn soon. */
  invalidate() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    const begun = performance.now();
    this.scheduled = false;
    const seconds = Math.min(LONGEST, (now - (this.before ?? now)) / 1000);
    const goesOn = this.advance(seconds);
    this.before = goesOn ? now : null;
    if (this.scene && this.drawing) {
      const view = this.view();
      this.paint(view);
      this.helper.ask(this.wanted(view));
      this.frames += 1;
      note(this.scriptMilliseconds, performance.now() - begun);
    }
    if (goesOn) this.invalidate();
  }

  /** Let some seconds go by; return whether anything goes on moving by itself. */
  advance(seconds) {
    if (this.playing) this.play(seconds);
    const flies = this.flying.some(Boolean);
    if (flies) this.camera.fly(this.flying.map((value) => value * seconds * this.camera.distance));
    if (flies || this.camera.way) this.fixed = null;
    this.camera.advance(seconds);
    return this.playing || flies || Boolean(this.camera.way);
  }

  play(seconds) {
    const time = this.time + seconds * this.speed / this.seconds;
    if (time > 1 && !this.loop) this.playing = false;
    this.goTo(time <= 1 ? time : this.loop ? time % 1 : 1);
    this.onChange();
  }

  /** Let it be a time; a camera that has a path goes with it. */
  goTo(time) {
    this.time = time;
    this.camera.follow(time);
  }

  paint(view) {
    this.drawing.draw(view, this.time, this.colour);
    this.firstPicture ??= performance.now();
  }

  /** Draw in the exact order for this time and camera; return when it is on the canvas. */
  async draw() {
    await this.loading;
    await this.settle();
  }

  async settle() {
    await this.helper.exact(this.wanted());
    if (this.scene && this.drawing) this.paint(this.view());
  }

  /** Return the pixels of the canvas, row by row from the top, four bytes each. */
  async pixels() {
    await this.draw();
    return this.drawing.pixels();
  }

  /** Return the canvas as a PNG. */
  async picture() {
    await this.draw(); // what is drawn now is gone after this task, so there is no await between
    return new Promise((resolve) => this.canvas.toBlob(resolve));
  }

  setTime(time) {
    this.goTo(Math.min(1, Math.max(0, Number(time) || 0)));
    this.playing = false;
    this.changed();
  }

  /** Begin or end playing; from the end it begins anew. */
  setPlaying(playing) {
    this.playing = playing && this.moves;
    if (this.playing && this.time >= 1) this.goTo(0);
    this.changed();
  }

  /** Note that something has been set. */
  changed() {
    this.onChange();
    this.invalidate();
  }

  /** Make what lies at a place of the canvas [px of the page] the target. */
  aim(x, y) {
    if (!this.scene || !this.drawing) return;
    const view = this.view();
    const { clientWidth, clientHeight } = this.canvas;
    const [column, row] = [x * view.width / clientWidth, y * view.height / clientHeight];
    const depth = this.drawing.depthAt(column, row, 4 * this.camera.distance);
    this.invalidate();
    if (depth === null) return;
    const across = [(column - view.cx) / view.fx * depth, (row - view.cy) / view.fy * depth, depth];
    this.camera.goToSeen(across, reducedMotion());
  }

  statistics() {
    const { header, milliseconds } = this.scene ?? {};
    return {
      splats: header?.splats, moving: header?.moving, bytes: this.bytes?.length,
      decode_ms: milliseconds, first_picture_ms: this.firstPicture,
      frames: this.frames, script_ms: median(this.scriptMilliseconds),
      sort_ms: median(this.helper.sortMilliseconds), orders: this.helper.orders,
      target: this.drawing && (this.drawing.half ? "RGBA16F" : "RGBA8"),
    };
  }
}

export const reducedMotion = () => matchMedia("(prefers-reduced-motion: reduce)").matches;
