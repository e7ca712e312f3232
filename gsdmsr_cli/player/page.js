// The page around the canvas: timeline, buttons, keys, and what other scripts may call.

import { control, hasModifier, isTyping, resetView } from "./controls.js";
import { FileError } from "./decode.js";
import { address, follow } from "./live.js";
import { Player, reducedMotion } from "./player.js";

const BACKGROUNDS = [["scene's own", null], ["white", [1, 1, 1]], ["black", [0, 0, 0]]];
const FRAME = 1 / 30; // step of the arrow keys [s]

const element = (id) => document.getElementById(id);

/** Show the scene that the page holds or names. script is the page's own. */
export function show(script) {
  try {
    const player = new Player(element("scene"), script, tell);
    const ready = begin(player);
    ready.catch(tell);
    offer(player, ready);
  } catch (error) {
    tell(error);
    offer(null, Promise.reject(error));
  }
}

/** Put a sentence in the middle of the page. */
function tell(error) {
  const known = error instanceof FileError;
  element("message").textContent = known ? error.message : `The scene cannot be shown: ${error.message}`;
  element("message").classList.add("fault");
  document.body.classList.add("empty");
}

async function begin(player) {
  control(player);
  const options = new URLSearchParams(location.hash.slice(1));
  connect(player);
  const bytes = await fileOfThePage();
  if (options.has("time")) player.setTime(options.get("time"));
  if (options.has("speed")) setSpeed(player, Number(options.get("speed")));
  const [, colour] = BACKGROUNDS.find(([name]) => name === options.get("background")) ?? [];
  player.background = colour ?? null;
  document.body.classList.toggle("bare", options.has("bare"));
  await player.load(bytes);
  document.body.classList.remove("empty");
  element("message").textContent = "";
  if (!options.has("paused") && !options.has("time") && !reducedMotion()) player.setPlaying(true);
  player.changed();
  if ("live" in element("file").dataset) follow(player, tell);
}

/** Return the file that stands in the page, or lies where it says. */
async function fileOfThePage() {
  const { textContent, dataset } = element("file");
  if (!dataset.url) return Uint8Array.from(atob(textContent.trim()), (letter) => letter.charCodeAt(0));
  let answer = null;
  try {
    answer = await fetch("live" in dataset ? address(dataset.url) : dataset.url);
  } catch {
    const why = location.protocol === "file:"
      ? "a page that is opened from a disk may not read other files: put both on a web server, or export the page without --embed"
      : "it cannot be reached";
    throw new FileError(`The file ${dataset.url} cannot be loaded: ${why}.`);
  }
  if (!answer.ok) {
    throw new FileError(`The file ${dataset.url} cannot be loaded: the server says ${answer.status}.`);
  }
  return new Uint8Array(await answer.arrayBuffer());
}

/** Tie the elements of the page to the player. */
function connect(player) {
  const toggleBackground = () => {
    const at = BACKGROUNDS.findIndex(([, colour]) => colour === player.background);
    [, player.background] = BACKGROUNDS[(at + 1) % BACKGROUNDS.length];
    player.changed();
  };
  const toggleHelp = () => (element("help").open ? element("help").close() : element("help").showModal());
  const actions = {
    play: () => player.setPlaying(!player.playing),
    loop: () => {
      player.loop = !player.loop;
      player.changed();
    },
    reset: () => resetView(player),
    screenshot: () => save(player),
    background: toggleBackground,
    fullscreen: toggleFullScreen,
    "help-button": toggleHelp,
  };
  for (const [id, act] of Object.entries(actions)) element(id).addEventListener("click", act);
  element("close").addEventListener("click", toggleHelp);
  element("time").addEventListener("input", (event) => player.setTime(event.target.value));
  element("speed").addEventListener("change", (event) => setSpeed(player, Number(event.target.value)));
  element("fullscreen").hidden = !document.fullscreenEnabled;
  listen(player, actions);
  player.onChange = () => refresh(player);
}

/** Let keys do what buttons do, and more. */
function listen(player, actions) {
  const step = (seconds) => player.setTime(player.time + seconds / player.seconds);
  const keys = {
    " ": actions.play, l: actions.loop, r: actions.reset, p: actions.screenshot, b: actions.background,
    f: actions.fullscreen, h: actions["help-button"], "?": actions["help-button"],
    ArrowLeft: () => step(-FRAME), ArrowRight: () => step(FRAME),
    Home: () => player.setTime(0), End: () => player.setTime(1),
    ",": () => changeSpeed(player, -1), ".": () => changeSpeed(player, 1),
  };
  window.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const onButton = event.key === " " && event.target.matches?.("button");
    if (!act || isTyping(event) || hasModifier(event) || onButton) return;
    event.preventDefault();
    act();
  });
}

function changeSpeed(player, by) {
  const { options, selectedIndex } = element("speed");
  const next = options[selectedIndex + by];
  if (next) setSpeed(player, Number(next.value));
}

function setSpeed(player, speed) {
  const known = [...element("speed").options].some(({ value }) => Number(value) === speed);
  if (known) player.speed = speed;
  player.changed();
}

/** Let the elements say what the player does. */
function refresh(player) {
  document.body.classList.toggle("still", !player.moves);
  const { time, seconds, playing, loop } = player;
  const said = `${(time * seconds).toFixed(2)} of ${seconds.toFixed(2)} s`;
  element("time").value = time;
  element("time").style.setProperty("--at", `${100 * time}%`);
  element("time").setAttribute("aria-valuetext", said);
  element("clock").textContent = `${(time * seconds).toFixed(2)} / ${seconds.toFixed(2)} s`;
  element("speed").value = String(player.speed);
  element("loop").setAttribute("aria-pressed", loop);
  element("play").classList.toggle("playing", playing);
  label("play", playing ? "Pause (space)" : "Play (space)");
  const [name] = BACKGROUNDS.find(([, colour]) => colour === player.background) ?? ["given"];
  label("background", `Background: ${name} (B)`);
}

function label(id, text) {
  element(id).title = text;
  element(id).setAttribute("aria-label", text);
}

async function save(player) {
  const blob = await player.picture();
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${document.title} at ${player.time.toFixed(3)}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function toggleFullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

/** What other scripts may call; see docs/player.md. */
function offer(player, ready) {
  ready.catch(() => {}); // whoever waits for it is told; nobody has to
  window.dsplat = {
    ready,
    load: (bytes) => player.load(new Uint8Array(bytes)),
    setTime: (time) => player.setTime(time),
    setCamera: (view) => {
      player.fixed = view;
      player.invalidate();
    },
    view: () => player.view(),
    background: (colour) => {
      player.background = colour;
      player.changed();
    },
    play: () => player.setPlaying(true),
    pause: () => player.setPlaying(false),
    draw: () => player.draw(),
    pixels: () => player.pixels(),
    statistics: () => player.statistics(),
  };
}
