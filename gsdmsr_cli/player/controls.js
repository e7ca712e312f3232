// Moves the camera by mouse, touch and keys.

import { reducedMotion } from "./player.js";

const TURN = 0.006; // of a pointer that has moved a pixel [rad]
const WHEEL = 0.0012; // of a wheel's step [1 / px]
const TAPS = { milliseconds: 350, pixels: 24 }; // between the two of a double click or tap
const SPEED = 0.8; // of flying [distances to the target / s]

/** Keys by their place on the keyboard, and where they fly in the camera's axes. */
const FLY = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
};

/** Let pointers on the canvas and keys move the player's camera. */
export function control(player) {
  followPointers(player);
  followKeys(player);
}

function followPointers(player) {
  const { canvas, camera } = player;
  const pointers = new Map();
  let tap = null; // where and when a pointer was last lifted without having moved

  const moved = () => {
    player.fixed = null;
    player.invalidate();
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    const { clientX: x, clientY: y } = event;
    pointers.set(event.pointerId, { x, y, began: [x, y] });
  });

  canvas.addEventListener("pointermove", (event) => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const before = spread(pointers);
    const [dx, dy] = [event.clientX - pointer.x, event.clientY - pointer.y];
    Object.assign(pointer, { x: event.clientX, y: event.clientY });
    const focal = camera.focal(canvas.clientWidth, canvas.clientHeight);
    if (pointers.size === 1 && (event.buttons & 6 || event.shiftKey || event.ctrlKey || event.metaKey)) {
      camera.pan(dx, dy, focal);
    } else if (pointers.size === 1) {
      camera.orbit(-TURN * dx, -TURN * dy);
    } else {
      const after = spread(pointers);
      camera.pan(after.x - before.x, after.y - before.y, focal);
      if (after.size > 1 && before.size > 1) camera.zoom(before.size / after.size);
    }
    moved();
  });

  const lift = (event) => {
    const pointer = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    const at = [event.clientX, event.clientY];
    const still = pointer && near(pointer.began, at) && event.type === "pointerup" && !pointers.size;
    if (!still || event.button > 0) {
      tap = null;
    } else if (tap && near(tap.at, at) && event.timeStamp - tap.when < TAPS.milliseconds) {
      const box = canvas.getBoundingClientRect();
      player.aim(at[0] - box.left, at[1] - box.top);
      tap = null;
    } else {
      tap = { at, when: event.timeStamp };
    }
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());

  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * [1, 16, canvas.clientHeight][event.deltaMode];
    camera.zoom(Math.exp(WHEEL * Math.max(-400, Math.min(400, pixels))));
    moved();
  }, { passive: false });
}

const near = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) < TAPS.pixels;

/** The middle of some pointers, and the mean distance from it. */
function spread(pointers) {
  const all = [...pointers.values()];
  const mean = (of) => all.reduce((sum, one) => sum + of(one), 0) / all.length;
  const [x, y] = [mean((one) => one.x), mean((one) => one.y)];
  return { x, y, size: mean((one) => Math.hypot(one.x - x, one.y - y)) };
}

function followKeys(player) {
  const held = new Set();
  let fast = false;
  const fly = () => {
    const ways = [...held].map((code) => FLY[code]);
    const factor = SPEED * (fast ? 3 : 1);
    player.flying = [0, 1, 2].map((axis) => factor * ways.reduce((sum, way) => sum + way[axis], 0));
    player.invalidate();
  };
  const change = (event, down) => {
    if (!(event.code in FLY) || (down && (isTyping(event) || hasModifier(event)))) return;
    if (down) held.add(event.code);
    else held.delete(event.code);
    fast = event.shiftKey;
    fly();
  };
  window.addEventListener("keydown", (event) => change(event, true));
  window.addEventListener("keyup", (event) => change(event, false));
  window.addEventListener("blur", () => {
    held.clear();
    fly();
  });
}

/** Whether a key is meant for the page's own elements, or for a dialog. */
export function isTyping(event) {
  const elsewhere = document.querySelector("dialog[open]") !== null;
  return elsewhere || event.target.matches?.("select, input[type=text]");
}

export const hasModifier = (event) => event.ctrlKey || event.metaKey || event.altKey;

/** Let the camera go back to where it began, or to its path: there at once, since time may go on. */
export function resetView(player) {
  const { camera } = player;
  const { target, distance, turn } = camera;
  camera.start(player.header?.scene);
  camera.follow(player.time);
  if (!camera.path) {
    const there = { target: camera.target, distance: camera.distance, turn: camera.turn };
    Object.assign(camera, { target, distance, turn });
    camera.go(there, reducedMotion());
  }
  player.fixed = null;
  player.invalidate();
}
