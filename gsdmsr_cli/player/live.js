// What a served page shows beside the scene: how its training stands, and a view that it has not seen.

const EVERY = 2000; // between two questions [ms]
const WIDTH = 260, HEIGHT = 90; // of the curve [units of its own]

/** Keep asking how the run stands; take its splats whenever there are newer ones. */
export function follow(player, tell) {
  const panel = new Panel();
  let shown = null;
  let state = null;
  const look = async () => {
    if (document.hidden) return; // nobody looks: the training then writes nothing for us
    try {
      state = await json("state.json");
      panel.show(state);
      if (shown !== null && state.scene !== shown) await newest();
      shown ??= state.scene;
    } catch {
      panel.lose();
    }
  };
  const newest = async () => {
    const answer = await fetch(address("scene.dsplat"));
    if (!answer.ok) return;
    try {
      await player.load(new Uint8Array(await answer.arrayBuffer()));
    } catch (error) {
      tell(error);
    }
    shown = state.scene;
    panel.showPictures(state);
  };
  const again = async () => {
    await look();
    setTimeout(again, EVERY);
  };
  document.addEventListener("visibilitychange", look);
  again();
}

/** Return where to ask for a name, with the token that the page was asked for with. */
export const address = (name) => name + location.search;

async function json(name) {
  const answer = await fetch(address(name), { cache: "no-store" });
  if (!answer.ok) throw new Error(`the server says ${answer.status}`);
  return answer.json();
}

/** The panel at the side. */
class Panel {
  constructor() {
    this.root = document.createElement("aside");
    this.root.id = "live";
    this.root.setAttribute("aria-label", "Training");
    this.root.innerHTML = `
      <details open><summary></summary>
      <progress max="1"></progress><p class="numbers"></p>
      <figure class="curve"><svg viewBox="0 0 ${WIDTH} ${HEIGHT}" role="img"></svg><figcaption></figcaption></figure>
      <div class="pictures" hidden><figure><img class="drawn" alt="The held-out view as the run draws it"><figcaption>drawn</figcaption></figure>
      <figure><img class="truth" alt="The picture that was taken there"><figcaption>truth</figcaption></figure></div></details>`;
    document.body.append(this.root);
    this.pictures = null;
  }

  part(name) { return this.root.querySelector(name); }

  show(state) {
    this.root.classList.remove("lost");
    const ended = state.progress >= 1 ? "trained" : "not going on";
    const status = state.running ? `${duration(state.remaining)} left` : ended;
    this.part("summary").textContent = `${state.name}: ${status}`;
    this.part("progress").value = state.progress;
    const numbers = [
      state.preset,
      state.splats === null ? null : `${state.splats.toLocaleString("en")} splats`,
      state.step === null ? null : `step ${state.step.toLocaleString("en")}`,
      `${duration(state.elapsed)} trained`,
    ];
    this.part(".numbers").textContent = numbers.filter(Boolean).join(", ");
    this.draw(state.curve);
    if (this.pictures === null) this.showPictures(state);
  }

  /** Draw PSNR over minutes. */
  draw(curve) {
    this.part(".curve").hidden = curve.length < 2;
    if (curve.length < 2) return;
    const [last, best] = [curve.at(-1), Math.max(...curve.map(([, value]) => value))];
    const least = Math.min(...curve.map(([, value]) => value));
    const x = (minutes) => 3 + (WIDTH - 6) * minutes / last[0];
    const y = (value) => HEIGHT - 4 - (HEIGHT - 8) * (value - least) / Math.max(best - least, 1e-3);
    const path = curve.map(([minutes, value]) => `${x(minutes).toFixed(1)},${y(value).toFixed(1)}`).join("L");
    this.part("svg").innerHTML = `<path d="M${path}"/>`;
    const text = `PSNR of a held-out view: ${last[1].toFixed(2)} dB`;
    this.part("svg").setAttribute("aria-label", text);
    this.part(".curve figcaption").textContent = `${text}, ${last[0].toFixed(1)} min`;
  }

  showPictures(state) {
    if (!state.held_out || this.pictures === state.scene) return;
    this.pictures = state.scene;
    this.part(".pictures").hidden = false;
    const mark = `${location.search ? "&" : "?"}of=${encodeURIComponent(state.scene)}`;
    this.part(".drawn").src = address("drawn.png") + mark;
    if (!this.part(".truth").src) this.part(".truth").src = address("truth.png");
  }

  lose() {
    this.root.classList.add("lost");
    this.part("summary").textContent = "The server does not answer any more";
  }
}

/** Return a time in words. */
function duration(seconds) {
  if (seconds === null || !Number.isFinite(seconds)) return "?";
  const minutes = Math.floor(seconds / 60);
  const rest = String(Math.floor(seconds % 60)).padStart(2, "0");
  return minutes < 60 ? `${minutes}:${rest} min` : `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")} h`;
}
