// One participant's way through the test. The server knows what is on which side; here there is only left and right.

const SIDES = ["left", "right"];
const NAME = "participant"; // kept for this tab alone, so that the next participant at this computer is asked anew
const CLOSEST = 8; // times
const find = (id) => document.getElementById(id);
const pictures = [...document.querySelectorAll(".picture")];

let participant = "";
let choices = []; // "left", "right" or null, in this participant's order
let place = 0; // the slice that is shown; choices.length = the end
let busy = true; // nothing may be chosen: the pictures are not there yet, or a choice is on its way
let whole = { x: 0, y: 0, width: 1, height: 1 }; // the slice
let view = whole; // what of it is seen
const loaded = new Map(); // place -> promise of what is to be drawn there

class Refused extends Error {}

async function ask(path, said) {
  const options = said && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(said) };
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Refused("The server does not answer. Ask whoever runs the test, then try again.");
  }
  if (!answer.ok) throw new Refused((await answer.text()).trim());
  return answer.json();
}

function complain(reason) {
  if (!(reason instanceof Refused)) throw reason;
  find("trouble").textContent = reason.message;
  find("trouble").hidden = false;
}

function show(id) {
  for (const main of document.querySelectorAll("main")) main.hidden = main.id !== id;
}

// Pictures -------------------------------------------------------------------------------------------

function load(at) {
  if (!loaded.has(at)) {
    const query = `participant=${encodeURIComponent(participant)}&place=${at}`;
    const picture = new Image();
    picture.src = `picture?${query}`;
    const both = Promise.all([ask(`item?${query}`), picture.decode()]).then(
      ([item]) => ({ ...item, picture: picture.src }),
      (reason) => {
        loaded.delete(at);
        throw reason instanceof Refused ? reason : new Refused("A picture could not be loaded. Reload the page.");
      },
    );
    both.catch(() => {}); // whoever waits for it is told
    loaded.set(at, both);
  }
  return loaded.get(at);
}

const path = (lines) => lines.map((line) => "M" + line.map((point) => point.join(",")).join("L")).join("");

function draw(item) {
  for (const picture of pictures) {
    const image = picture.querySelector("image");
    for (const [name, value] of [["width", item.width_mm], ["height", item.height_mm], ["href", item.picture]])
      image.setAttribute(name, value);
    image.setAttribute("preserveAspectRatio", "none");
  }
  for (const side of SIDES) find(side).querySelector("path").setAttribute("d", path(item[side]));
  whole = { x: 0, y: 0, width: item.width_mm, height: item.height_mm };
  look(whole);
}

// The same part of the slice in all three, mm.
function look(part) {
  view = part;
  for (const picture of pictures)
    picture.querySelector("svg").setAttribute("viewBox", `${part.x} ${part.y} ${part.width} ${part.height}`);
}

// Closer by a factor; what is at the point (mm) stays where it is.
function zoom(factor, point) {
  const width = Math.min(Math.max(view.width / factor, whole.width / CLOSEST), whole.width);
  const share = width / view.width;
  const height = view.height * share;
  look({
    x: Math.min(Math.max(point.x - (point.x - view.x) * share, 0), whole.width - width),
    y: Math.min(Math.max(point.y - (point.y - view.y) * share, 0), whole.height - height),
    width,
    height,
  });
}

for (const svg of document.querySelectorAll("svg")) {
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    zoom(Math.exp(-Math.sign(event.deltaY) * 0.15), point);
  }, { passive: false });
}

async function go(to) {
  place = Math.max(0, Math.min(to, choices.length));
  find("trouble").hidden = true;
  if (place === choices.length) {
    find("total").textContent = choices.length;
    busy = false;
    show("done");
    return;
  }
  const here = place;
  busy = true;
  find("pictures").classList.add("waiting");
  label();
  show("judging");
  try {
    const item = await load(here);
    if (place !== here) return;
    draw(item);
    find("pictures").classList.remove("waiting");
    busy = false;
    label();
    if (here + 1 < choices.length) load(here + 1);
  } catch (reason) {
    complain(reason);
  }
}

function label() {
  const judged = choices.filter((choice) => choice !== null).length;
  find("count").textContent = `${participant}: slice ${place + 1} of ${choices.length}`;
  find("progress").max = choices.length;
  find("progress").value = judged;
  for (const side of SIDES) {
    find(side).setAttribute("aria-pressed", String(choices[place] === side));
    find(side).disabled = busy;
  }
  find("back").disabled = place === 0;
  find("next").disabled = choices[place] === null;
}

// What a participant does ----------------------------------------------------------------------------

async function begin(name) {
  try {
    const told = await ask("begin", { participant: name });
    participant = told.participant;
    choices = told.choices;
    sessionStorage.setItem(NAME, participant);
    loaded.clear();
    const open = choices.indexOf(null);
    await go(open === -1 ? choices.length : open);
  } catch (reason) {
    show("welcome");
    complain(reason);
  }
}

async function choose(side) {
  if (busy) return;
  busy = true;
  const here = place;
  try {
    await ask("choose", { participant, place: here, side });
    choices[here] = side;
    label(); // seen for a moment before the next one comes
    await new Promise((done) => setTimeout(done, 180));
    if (place === here) await go(here + 1);
  } catch (reason) {
    busy = false;
    label();
    complain(reason);
  }
}

const back = () => place > 0 && go(place - 1);
const next = () => place < choices.length && choices[place] !== null && go(place + 1);
const plain = (on) => find("pictures").classList.toggle("plain", on);

const buttons = { left: () => choose("left"), right: () => choose("right"), back, again: back, next };
for (const [id, press] of Object.entries(buttons)) {
  find(id).addEventListener("click", (event) => {
    if (event.detail > 0) find(id).blur(); // a mouse leaves no focus behind, on which Enter would press again
    press();
  });
}
find("begin").addEventListener("submit", (event) => {
  event.preventDefault();
  find("trouble").hidden = true;
  begin(find("name").value);
});

for (const [event, on] of [["pointerdown", true], ["pointerup", false], ["pointercancel", false], ["pointerleave", false]])
  find("plain").addEventListener(event, () => plain(on));

const KEYS = { ArrowLeft: () => choose("left"), ArrowRight: () => choose("right"), Backspace: back, Enter: next };

addEventListener("keydown", (event) => {
  if (!find("welcome").hidden || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === " ") plain(true);
  else if (event.key === "Enter" && event.target.matches("button")) return;
  else if (KEYS[event.key]) {
    if (!event.repeat) KEYS[event.key]();
  } else return;
  event.preventDefault();
});
addEventListener("keyup", (event) => {
  if (event.key !== " " || !find("welcome").hidden) return;
  plain(false);
  event.preventDefault(); // a button that has the focus is not pressed by it
});
addEventListener("blur", () => plain(false));

try {
  const about = await ask("about");
  for (const note of document.querySelectorAll(".synthetic")) note.hidden = !about.synthetic;
  const name = about.participant ?? sessionStorage.getItem(NAME);
  if (name) await begin(name);
  else {
    show("welcome");
    find("name").focus();
  }
} catch (reason) {
  complain(reason);
}
