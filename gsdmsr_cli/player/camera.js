// A camera that looks at a target: orbit, pan, zoom, fly, ways from one place to another, and a path in time.

import { add, between, cross, dot, fromColumns, mix, product, subtract, times, turnAbout, turned,
  unit } from "./vectors.js";

const STEEPEST = 0.02; // least angle between the line of sight and the orbit's axis [rad]
const SECONDS = 0.35; // of a way

/** Where one looks from; `turn` takes the axes of the camera (x right, y down, z ahead) to the world. */
export class Camera {
  constructor() {
    this.target = [0, 0, 0];
    this.distance = 4;
    this.turn = [1, 0, 0, 0];
    this.fovY = 0.7; // of a canvas that is wider than high
    this.fovX = 0.7; // of the others
    this.up = [0, 0, 1];
    this.way = null;
    this.path = null; // places in time that it goes along until somebody moves it
  }

  get right() { return turned(this.turn, [1, 0, 0]); }

  get down() { return turned(this.turn, [0, 1, 0]); }

  get ahead() { return turned(this.turn, [0, 0, 1]); }

  get position() { return subtract(this.target, times(this.distance, this.ahead)); }

  /** Take the place that a file's header proposes; whatever it lacks is made up. */
  start(scene) {
    const bound = scene?.bound > 0 ? scene.bound : 1.3;
    const view = scene?.view ?? {};
    this.up = unit(vector(scene?.up) ?? [0, 0, 1]) ?? [0, 0, 1];
    this.fovY = angle(view.fov_y) ?? 0.7;
    this.fovX = Math.min(angle(view.fov_x) ?? this.fovY, this.fovY);
    this.target = vector(view.target) ?? [0, 0, 0];
    const aside = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    const front = add(times(2.5 * bound, unit(cross(this.up, aside))), times(bound, this.up));
    const position = vector(view.position) ?? add(this.target, front);
    Object.assign(this, facing(position, this.target, vector(view.up) ?? this.up));
    this.way = null;
    this.path = pathOf(scene?.path, this.up);
  }

  /** Go where the path is at a time, if it has one that nobody has left. */
  follow(time) {
    if (!this.path) return;
    const last = this.path.length - 2;
    const found = this.path.findIndex((place) => place.time > time) - 1;
    const i = found < -1 ? last : Math.min(Math.max(found, 0), last);
    const [a, b] = [this.path[i], this.path[i + 1]];
    const f = Math.min(1, Math.max(0, (time - a.time) / (b.time - a.time)));
    this.turn = between(a.turn, b.turn, f);
    this.distance = a.distance + f * (b.distance - a.distance);
    this.target = add(mix(a.position, b.position, f), times(this.distance, this.ahead));
  }

  /** Leave ways and paths: somebody moves the camera. */
  free() {
    this.way = null;
    this.path = null;
  }

  /** Turn about the target, by angles [rad]. */
  orbit(sideways, upwards) {
    const steepness = Math.acos(Math.min(1, Math.max(-1, dot(this.ahead, this.up))));
    const highest = Math.max(0, steepness - STEEPEST);
    const lowest = Math.min(0, steepness + STEEPEST - Math.PI);
    const tilt = turnAbout(this.right, Math.min(highest, Math.max(lowest, upwards)));
    this.turn = unit(product(turnAbout(this.up, sideways), product(tilt, this.turn)));
    this.free();
  }

  /** Move sideways, so that what is as far away as the target follows a pointer [px]. */
  pan(x, y, focal) {
    const step = this.distance / focal;
    this.target = subtract(this.target, add(times(step * x, this.right), times(step * y, this.down)));
    this.free();
  }

  /** Come nearer to the target, or go away from it. */
  zoom(factor) {
    this.distance = Math.min(1e4, Math.max(1e-3, this.distance * factor));
    this.free();
  }

  /** Fly with the target ahead, by a way in the camera's axes. */
  fly(way) {
    this.target = add(this.target, turned(this.turn, way));
    this.free();
  }

  /** Begin to go to where something else is looked at; at once if `jump`. */
  go(to, jump = false) {
    const { target, distance, turn } = this;
    this.path = null;
    this.way = { from: { target, distance, turn }, to: { target, distance, turn, ...to }, done: 0 };
    if (jump) this.advance(SECONDS);
  }

  /** Go sideways until a place, in the camera's axes, is in the middle, and make it the target. */
  goToSeen(seen, jump = false) {
    const target = add(this.position, turned(this.turn, seen));
    [this.target, this.distance] = [add(this.position, times(seen[2], this.ahead)), seen[2]];
    this.go({ target }, jump);
  }

  /** Go on with a way for some seconds. */
  advance(seconds) {
    if (!this.way) return;
    const { from, to } = this.way;
    this.way.done = Math.min(1, this.way.done + seconds / SECONDS);
    const f = this.way.done ** 2 * (3 - 2 * this.way.done);
    this.target = mix(from.target, to.target, f);
    this.distance = from.distance * (to.distance / from.distance) ** f;
    this.turn = between(from.turn, to.turn, f);
    if (this.way.done === 1) this.way = null;
  }

  /** Return the focal length [px] for a canvas: the angle of view is that of its shorter side. */
  focal(width, height) {
    return Math.min(width, height) / 2 / Math.tan((width < height ? this.fovX : this.fovY) / 2);
  }

  /** Return what the drawing needs to know: a rigid transform, row by row, and intrinsics [px]. */
  view(width, height) {
    const { position } = this;
    const rows = [this.right, this.down, this.ahead].flatMap((axis) => [...axis, -dot(axis, position)]);
    const focal = this.focal(width, height);
    return {
      world_to_camera: [...rows, 0, 0, 0, 1],
      fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height,
    };
  }
}

/** Return how far from a place a target is, and how a camera is turned that looks at it. */
function facing(position, target, up) {
  const way = subtract(target, position);
  const ahead = unit(way) ?? [0, 1, 0];
  const right = unit(cross(ahead, up)) ?? unit(cross(ahead, [0.6, 0.64, 0.48]));
  const distance = Math.max(Math.hypot(...way), 1e-3);
  return { distance, turn: fromColumns(right, cross(ahead, right), ahead) };
}

/** Return the places of a path as a file's header gives them, null where there is none that can be used. */
function pathOf(given, up) {
  const known = (one, i) => Number.isFinite(one?.time) && vector(one.position) && vector(one.target)
    && (i === 0 || one.time > given[i - 1].time);
  if (!Array.isArray(given) || given.length < 2 || !given.every(known)) return null;
  return given.map(({ time, position, target, up: own }) => (
    { time, position, ...facing(position, target, vector(own) ?? up) }));
}

const angle = (given) => (given > 0 && given < 3 ? given : null);

function vector(given) {
  return Array.isArray(given) && given.length === 3 && given.every(Number.isFinite) ? given : null;
}
