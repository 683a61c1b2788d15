// The page: what it is told is shown, what a user wants is sent.

import { Section } from "./section.js";
import { Solid } from "./solid.js";
import { COIL_STATES, STATUSES, Stream, Timeline } from "./stream.js";
import { Tongue } from "./tongue.js";

const LONGEST_DELAY_MS = 2000;
const TEXT_PERIOD_MS = 100; // numbers that change faster cannot be read
const BAR_SIGMAS = 5;
// Told apart by colour-blind eyes as well, on dark and on light (Okabe and Ito 2008, without black and yellow).
const COLOURS = ["#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#0072b2"];

const $ = (id) => document.getElementById(id);
const timeline = new Timeline(LONGEST_DELAY_MS + 1000);
const section = new Section($("section"));
const dark = matchMedia("(prefers-color-scheme: dark)");
let solid = null, hello = null, tongue = null, wanted = 0, ghost = null, shown = null, delayMs = 0;
let taking = false, drawn = 0, textsMs = 0, state = null;

try {
  solid = new Solid($("solid"));
} catch {
  $("solid").textContent = "This browser has no WebGL; the view from the side works without.";
}

const stream = new Stream({
  pose: (pose, nowMs) => timeline.add(pose, nowMs),
  text: (message) => TEXTS[message.type]?.(message),
  connection: (word, kind) => {
    badge("connection", word, kind);
    if (kind !== "good") badge("status", "no pose", "");
  },
});

const TEXTS = {
  hello: begin,
  state: showState,
  model: (message) => fetchModel(message.number),
  told: (message) => answer({ take: "take: passed on", mark: "marker: passed on", speaker: "speaker: passed on" }[message.what]),
  refused: (message) => answer(`not passed on: ${message.why}`),
  over: () => badge("connection", "run has ended", "warn"),
};

// What is told ----------------------------------------------------------------------------------------

function begin(message) {
  const before = hello;
  hello = message;
  timeline.clear();
  if (before && before.version !== hello.version) location.reload();
  const other = !before || before.run !== hello.run;
  if (other) {
    tongue = shown = null;
    const colours = hello.coils.map((_, i) => COLOURS[i % COLOURS.length]);
    const names = shortNames(hello.coils.map((coil) => coil.role));
    section.prepare(hello, names, colours);
    solid?.prepare(hello, names, colours);
    makeBars();
    makeCoils(colours);
    setGhost(null);
    document.title = hello.title ? `${hello.title} – tonguetrack` : "tonguetrack";
    $("title").textContent = hello.title;
    $("model").textContent = `model: ${hello.model.name}`;
    for (const control of $("controls").querySelectorAll("input, button")) control.disabled = !hello.control;
    answer(hello.control ? "" : "This run is not controlled from here; a live one is.");
  }
  if (other || hello.model.number !== wanted) fetchModel(hello.model.number);
}

async function fetchModel(number) {
  const run = hello.run;
  wanted = number;
  try {
    const loaded = await Tongue.load(hello, number);
    if (run !== hello.run || number !== wanted) return;
    const first = tongue === null;
    tongue = loaded;
    solid?.take(tongue, first);
    if (first) section.frame(tongue, hello.contour, hello.coefficients.mean, hello.coefficients.sigma);
    if (ghost) setGhost(ghost);
    shown = null;
  } catch {
    if (run === hello.run && number === wanted) setTimeout(() => fetchModel(number), 1000);
  }
}

function showState(message) {
  state = message;
  const { take, troubles } = message;
  taking = take.name !== "";
  $("recording").hidden = !taking;
  $("recording").textContent = `● ${take.name}`;
  $("take").textContent = taking ? `${take.name}, ${take.frames} frames` : "none is being recorded";
  $("take-button").textContent = taking ? "Stop" : "Start";
  $("take-button").classList.toggle("running", taking);
  const wrong = take.failure ? [`NOT RECORDING: ${take.failure}`, ...troubles] : troubles;
  $("trouble").hidden = wrong.length === 0;
  $("trouble").textContent = wrong.join(" · ");
  $("way").textContent = message.round_trip_ms === null ? "–" : (message.round_trip_ms / 2).toFixed(1);
  $("pictures").textContent = drawn;
  drawn = 0;
}

function badge(id, word, kind) {
  $(id).textContent = word;
  $(id).className = `pill ${kind}`;
}

function answer(text) {
  $("answer").textContent = text;
}

/** tongue_tip, tongue_dorsum: tip, dorsum. */
function shortNames(roles) {
  const plain = roles.map((role) => role.replaceAll("_", " "));
  return plain.every((name) => name.startsWith("tongue ")) ? plain.map((name) => name.slice(7)) : plain;
}

function makeBars() {
  $("bars").replaceChildren(
    ...hello.coefficients.mean.flatMap((_, k) => {
      const name = element("span", "", `${k + 1}`), bar = element("span", "bar"), value = element("span", "value", "–");
      bar.append(element("i"), element("b"));
      return [name, bar, value];
    }),
  );
}

function makeCoils(colours) {
  $("coils").tBodies[0].replaceChildren(
    ...hello.coils.map((coil, i) => {
      const row = element("tr"), dot = element("span", "dot"), first = element("td");
      dot.style.background = colours[i];
      first.append(dot);
      row.append(first, element("td", "", coil.role.replaceAll("_", " ")), element("td"), element("td", "", "–"));
      return row;
    }),
  );
}

function element(tag, name = "", text = "") {
  const made = document.createElement(tag);
  made.className = name;
  made.textContent = text;
  return made;
}

// What is drawn ---------------------------------------------------------------------------------------

function sigmas(weights) {
  const { mean, sigma } = hello.coefficients;
  return Array.from(weights, (weight, k) => (weight - mean[k]) / sigma[k]);
}

function showPose(pose) {
  const vertices = tongue.points(hello.coils.map((coil) => coil.vertex), pose);
  section.show(pose, tongue.points(hello.contour, pose), vertices, timeline.before(pose, Section.trailMs));
  solid?.show(pose, vertices);
  const bars = $("bars").children;
  sigmas(pose.weights).forEach((value, k) => {
    bars[3 * k + 1].firstChild.style.transform = `scaleX(${Math.max(-1, Math.min(1, value / BAR_SIGMAS))})`;
  });
  drawn += 1;
}

function showTexts(pose) {
  const bars = $("bars").children;
  sigmas(pose.weights).forEach((value, k) => (bars[3 * k + 2].textContent = signed(value)));
  badge("status", ...(STATUSES[pose.status] ?? ["unknown", "warn"]));
  Array.from($("coils").tBodies[0].rows).forEach((row, i) => {
    const [word, kind] = COIL_STATES[pose.states[i]] ?? ["unknown", "warn"];
    row.cells[2].textContent = word;
    row.cells[2].className = kind;
    row.cells[3].textContent = millimetres(pose.residuals[i]);
  });
  $("residual").textContent = `${millimetres(pose.residualMm)} mm`;
  const [median, worst] = state?.latency.host_to_solved ?? [null, null];
  $("solve").textContent = median === null ? pose.solveMs.toFixed(2) : `${median.toFixed(2)} / ${worst.toFixed(2)}`;
  $("age").textContent = pose.ageMs.toFixed(1);
  $("speaker").textContent = pose.fixed ? "fixed" : "being estimated";
  $("speaker-button").textContent = pose.fixed ? "Free speaker" : "Fix speaker";
  $("speaker-button").dataset.fix = pose.fixed ? "" : "yes";
}

const signed = (value) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(2)}`;
const millimetres = (value) => (Number.isFinite(value) ? value.toFixed(2) : "–");

function setGhost(pose) {
  ghost = pose;
  $("ghost").setAttribute("aria-pressed", String(pose !== null));
  $("ghost").textContent = pose ? "Clear ghost" : "Keep as ghost";
  if (tongue) solid?.ghost(pose);
  section.ghost(pose && tongue ? tongue.points(hello.contour, pose) : null);
  const bars = $("bars").children;
  const values = pose ? sigmas(pose.weights) : [];
  for (let k = 0; 3 * k + 1 < bars.length; k += 1) {
    const mark = bars[3 * k + 1].lastChild;
    mark.hidden = !pose;
    if (pose) mark.style.left = `${50 + 50 * Math.max(-1, Math.min(1, values[k] / BAR_SIGMAS))}%`;
  }
}

function draw(nowMs) {
  requestAnimationFrame(draw);
  const pose = hello && tongue ? timeline.at(performance.now(), delayMs) : null;
  if (pose && pose !== shown) {
    shown = pose;
    showPose(pose);
    if (nowMs - textsMs > TEXT_PERIOD_MS) {
      textsMs = nowMs;
      showTexts(pose);
    }
  }
  section.draw();
  solid?.draw();
}

function theme() {
  const style = getComputedStyle(document.documentElement);
  section.theme(style);
  solid?.theme(style);
}

// What a user wants -----------------------------------------------------------------------------------

function wish(message) {
  if (!stream.send(message)) answer("not passed on: there is no connection");
}

$("reset").addEventListener("click", () => solid?.reset());
$("ghost").addEventListener("click", () => setGhost(ghost ? null : shown));
$("delay").addEventListener("input", () => {
  delayMs = Number($("delay").value);
  $("delay-shown").textContent = `${delayMs} ms`;
});
$("take-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const name = $("take-name").value.trim();
  wish(taking ? { do: "take", on: false } : name ? { do: "take", on: true, name } : { do: "take", on: true });
});
$("mark-form").addEventListener("submit", (event) => {
  event.preventDefault();
  wish({ do: "mark", text: $("mark-text").value.trim() || "mark" });
});
$("speaker-button").addEventListener("click", () => wish({ do: "speaker", fix: $("speaker-button").dataset.fix === "yes" }));
dark.addEventListener("change", theme);
theme();
requestAnimationFrame(draw);
