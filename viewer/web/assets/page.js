// Page: shows the rig's people on the canvas. page.wasm decodes and poses; draw_webgpu.js draws with the rig's kernels, or draw_webgl2.js
// where there is no WebGPU, or only a software adapter.
import { WebGl2Drawing } from "./draw_webgl2.js";
import { WebGpuDrawing, openWebGpu } from "./draw_webgpu.js";

const KIND = { rig: 0, state: 4, forget: 5 };
const BACKGROUND = [27 / 255, 29 / 255, 32 / 255];
const RETRY_MS = 1000;
const SHOWN_OVER_MS = 2000; // time over which rates are averaged
const WORDS_EVERY_MS = 200; // words that change with every image cannot be read
const MOST_WHEEL = 0.5; // logarithm of the largest zoom of one event: some mice report thousands of pixels
const NARROW = 0.7; // as LEAST_ASPECT of viewer/viewing/src/navigation.rs
const GLIDE_SECS = 0.18; // time over which a turn goes on after the finger has left

const parameters = new URLSearchParams(location.search);
const canvas = document.getElementById("view");
const [stateText, troubleText, help, details, people, cameras, tools] =
  ["state", "trouble", "help", "details", "people", "cameras", "tools"].map(id => document.getElementById(id));
const text = new TextDecoder();

// Missing feature of the browser, or fault of the page, which cannot continue.
let fault = "";
function fail(problem) { fault = troubleText.textContent = problem; }
function explain(error, message) {
  const isFault = error instanceof WebAssembly.RuntimeError;
  fail(isFault ? `The page failed (${error.message}); load it again.` : error?.message ?? message);
}
addEventListener("error", ({ error, message }) => explain(error, message));
addEventListener("unhandledrejection", ({ reason }) => explain(reason, String(reason)));

const { instance } = await WebAssembly.instantiate(await (await fetch("page.wasm")).arrayBuffer(), {});
const wasm = instance.exports;
const floats = (address, count) => new Float32Array(wasm.memory.buffer, address, count);
const now = () => performance.now() / 1000;

// "draw=webgl2" and "draw=webgpu" in the address choose the drawing. By default, the page does not use a software WebGPU adapter.
const wantedDrawing = parameters.get("draw");
let drawing = null; // none while the graphics processor is lost
let uploaded = false; // whether the drawing has the Gaussians

async function openDrawing(hadWebGpu) {
  const opened = wantedDrawing === "webgl2" ? null
    : await openWebGpu(wantedDrawing === "webgpu").catch(error => console.warn(`WebGPU: ${error.message}`));
  if (!opened) {
    // A canvas keeps the type of its first context.
    if (hadWebGpu) throw new Error("The graphics processor was lost; load the page again.");
    if (wantedDrawing === "webgpu") throw new Error("This browser offers no WebGPU here; take draw=webgpu out of the address.");
    return new WebGl2Drawing(canvas);
  }
  const { device } = opened;
  device.onuncapturederror = ({ error }) => fail(`WebGPU failed (${error.message}); load the page with ?draw=webgl2.`);
  device.lost.then(async () => {
    drawing = null;
    drawing = await openDrawing(true);
    uploaded = false;
  });
  return new WebGpuDrawing(canvas, opened);
}

drawing = await openDrawing(false);
const UNKNOWN = { trouble: "", is_running: false, sets_per_second: 0, people: [], measuring_secs: null, color_layers: [0, 0], is_line_slow: false, clock_secs: null };
let state = UNKNOWN;
let stateAt = 0; // arrival of the state, seconds
let clockAhead = null; // the rig's clock minus this page's, seconds
let linkTrouble = "Connecting.";
let interpolates = !parameters.has("lowest-latency");
let scale = 1; // canvas pixels per pixel of the screen
let dirty = true;
const recent = []; // [time ms, bytes] of messages
const drawn = []; // times ms of images
const spent = { decode: 0, pose: 0, draw: 0 }; // smoothed run times, ms: decoding a message, posing and sorting an image, drawing it

function timed(what, work) {
  const start = performance.now();
  const result = work();
  spent[what] += 0.05 * (performance.now() - start - spent[what]);
  return result;
}

// --- Messages ---

function take(buffer) {
  const head = new DataView(buffer);
  const kind = head.getUint8(0), person = head.getUint32(4, true);
  const payload = new Uint8Array(buffer, 8);
  recent.push([performance.now(), buffer.byteLength]);
  if (kind === KIND.state) {
    state = { ...UNKNOWN, ...JSON.parse(text.decode(payload)) };
    stateAt = now();
    const ahead = state.clock_secs === null ? null : state.clock_secs - stateAt;
    // The least delayed message counts; clocks drift, and a restarted rig has another.
    const known = ahead !== null && clockAhead !== null && Math.abs(ahead - clockAhead) < 5;
    clockAhead = known ? Math.max(ahead, clockAhead - 0.005) : ahead;
  } else if (kind === KIND.forget) {
    wasm.forget_people();
    dirty = true;
  } else {
    const address = wasm.input(payload.length);
    if (address === 0) return;
    new Uint8Array(wasm.memory.buffer, address, payload.length).set(payload);
    if (timed("decode", () => wasm.take(kind, person, now())) !== 0) {
      const problem = text.decode(new Uint8Array(wasm.memory.buffer, wasm.error(), wasm.error_length()).slice());
      console.warn(problem);
      if (kind <= 1) linkTrouble = problem;
    } else if (kind === KIND.rig) {
      showCameras(JSON.parse(text.decode(payload)).cameras.map(camera => camera.id));
      dirty = true;
    }
  }
}

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { linkTrouble = ""; socket.send(location.hash.slice(1)); };
  socket.onmessage = event => take(event.data);
  socket.onclose = event => {
    linkTrouble = event.reason ? `The rig's server ended the connection: ${event.reason}.` : "No connection to the rig's server; trying again.";
    setTimeout(connect, event.code === 1008 ? 10 * RETRY_MS : RETRY_MS);
  };
}

// --- Buttons ---

const ICONS = {
  reset: "M4 4v5h5M4.6 9A8 8 0 1 1 4 13",
  follow: "M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8M12 2v4M12 18v4M2 12h4M18 12h4",
  smooth: "M2 15c4 0 4-7 8-7s4 8 8 8 3-3 4-4",
  full: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5",
  help: "M9 9a3 3 0 1 1 4.2 2.7c-.9.4-1.2 1-1.2 2M12 17.2v.1M12 2.5a9.5 9.5 0 1 0 0 19 9.5 9.5 0 0 0 0-19",
};

function button(label, act, icon) {
  const made = document.createElement("button");
  if (icon) made.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${ICONS[icon]}"/></svg>`;
  else made.textContent = label;
  made.title = label;
  made.setAttribute("aria-label", label);
  made.onclick = () => { act(); made.blur(); showButtons(); dirty = true; };
  return made;
}

function label(words) {
  const made = document.createElement("span");
  made.textContent = words;
  return made;
}

let follows = parameters.has("follow");
let cameraNames = [];
let peopleShown = [];

/** Returns to the viewpoint of the start. */
function reset() {
  glide = [0, 0];
  wasm.reset();
  wasm.follow(follows ? 1 : 0);
  const wanted = cameraNames.indexOf(parameters.get("camera") ?? "");
  if (wanted >= 0) wasm.jump(wanted);
  dirty = true;
}

function follow(value) {
  follows = value;
  wasm.follow(value ? 1 : 0);
}

function toggleFullscreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.();
}

const toggles = [
  [button("Start again (R)", reset, "reset")],
  [button("Follow the person (F)", () => follow(!follows), "follow"), () => follows],
  [button("Smooth motion, shown later", () => { interpolates = !interpolates; }, "smooth"), () => interpolates],
  ...(document.fullscreenEnabled ? [[button("Whole screen", toggleFullscreen, "full"), () => !!document.fullscreenElement]] : []),
  [button("Details and help (H)", () => { help.hidden = !help.hidden; }, "help"), () => !help.hidden],
];
tools.replaceChildren(...toggles.map(([made]) => made));
document.onfullscreenchange = () => showButtons();

function showButtons() {
  for (const [made, isOn] of toggles) if (isOn) made.setAttribute("aria-pressed", isOn());
}

function showCameras(names) {
  if (names.join("\n") === cameraNames.join("\n")) return;
  cameraNames = names;
  const camera = (name, at) => {
    const made = button(name, () => { glide = [0, 0]; wasm.jump(at); });
    made.title = `Stand at camera ${name}${at < 9 ? ` (${at + 1})` : ""}`;
    return made;
  };
  cameras.replaceChildren(label("camera"), ...names.map(camera));
  reset();
}

/** Lists the people, where there are several. */
function showPeople(count) {
  const shown = Array.from({ length: count }, (_, index) => wasm.person(index)).filter(person => person >= 0);
  if (shown.join() === peopleShown.join()) return;
  peopleShown = shown;
  const choose = person => {
    const made = button(`${person}`, () => { glide = [0, 0]; wasm.choose(person); });
    made.title = `Look at person ${person}`;
    return made;
  };
  people.replaceChildren(...(shown.length > 1 ? [label("person"), ...shown.map(choose)] : []));
}

// --- Pointers and keys ---

const pointers = new Map();
let glide = [0, 0]; // speed of a turn, radians per second
let turnedAt = 0;

canvas.onpointerdown = event => {
  event.preventDefault();
  glide = [0, 0];
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = event => {
  pointers.delete(event.pointerId);
  // A finger that rested before it left ends the turn.
  if (performance.now() - turnedAt > 60 || pointers.size > 0) glide = [0, 0];
};
canvas.oncontextmenu = event => event.preventDefault();
canvas.onpointermove = event => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
  const height = Math.min(canvas.clientHeight, canvas.clientWidth / NARROW);
  if (pointers.size >= 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const distance = at => Math.hypot(at[0] - other[0], at[1] - other[1]);
    wasm.zoom(Math.max(distance([event.clientX, event.clientY]), 20) / Math.max(distance(last), 20));
    wasm.shift(dx / 2 / height, dy / 2 / height);
  } else if (event.buttons & 6 || event.shiftKey) {
    wasm.shift(dx / height, dy / height);
  } else {
    const turn = [dx, dy].map(by => by / height * Math.PI);
    wasm.orbit(...turn);
    const secs = Math.max((performance.now() - turnedAt) / 1000, 0.008);
    glide = turn.map((by, axis) => 0.5 * glide[axis] + 0.5 * by / secs);
    turnedAt = performance.now();
  }
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  dirty = true;
};
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const by = -event.deltaY * (event.deltaMode === 1 ? 0.05 : event.ctrlKey ? 0.008 : 0.0015);
  wasm.zoom(Math.exp(Math.min(Math.max(by, -MOST_WHEEL), MOST_WHEEL)));
  dirty = true;
}, { passive: false });

const held = new Set();
const FLY = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  held.add(event.code);
  if (event.repeat) return;
  if (event.code === "KeyF") follow(!follows);
  if (event.code === "KeyR") reset();
  if (event.code === "KeyH" || event.key === "?") help.hidden = !help.hidden;
  if (event.code === "Escape") help.hidden = true;
  showButtons();
  const digit = /^Digit([1-9])$/.exec(event.code);
  if (digit) { wasm.jump(Number(digit[1]) - 1); dirty = true; }
});
addEventListener("keyup", event => held.delete(event.code));
addEventListener("blur", () => held.clear());

// --- Images ---

canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); drawing = null; });
canvas.addEventListener("webglcontextrestored", () => { drawing = new WebGl2Drawing(canvas); uploaded = false; });

let lastTick = performance.now();
let wordsAt = -Infinity;

/** Reduces the resolution where drawing is slow, and raises it where there is time. */
function adapt() {
  const late = drawn.length > 8 ? (drawn.at(-1) - drawn.at(-9)) / 8 : 0;
  if (late > 45 && scale > 0.35) scale *= 0.8;
  else if (late > 0 && late < 20 && scale < 1) scale = Math.min(1, scale * 1.05);
}

function tick(time) {
  requestAnimationFrame(tick);
  const step = Math.min((time - lastTick) / 1000, 0.1);
  lastTick = time;
  for (const key of held) {
    if (FLY[key]) { wasm.fly(...FLY[key].map(axis => axis * step * 1.5)); dirty = true; }
  }
  if (pointers.size === 0 && Math.hypot(...glide) > 0.02) {
    wasm.orbit(...glide.map(speed => speed * step));
    glide = glide.map(speed => speed * Math.exp(-step / GLIDE_SECS));
    dirty = true;
  }
  if (time - wordsAt >= WORDS_EVERY_MS) {
    wordsAt = time;
    showWords(time);
  }
  if (!drawing || drawing.isBusy) return;
  const ratio = (parameters.has("fixed") ? 1 : devicePixelRatio * scale);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(side => Math.max(1, Math.round(side * ratio)));
  if (canvas.width !== width || canvas.height !== height) {
    [canvas.width, canvas.height] = [width, height];
    dirty = true;
  }
  const start = performance.now();
  const count = wasm.pose(now(), interpolates ? 1 : 0);
  const changes = uploaded ? wasm.changes() : 3;
  if (changes === 0 && !dirty) return;
  let order = 0;
  if (drawing.sorts) wasm.look(width, height);
  else order = wasm.order(width, height);
  spent.pose += 0.05 * (performance.now() - start - spent.pose);
  timed("draw", () => {
    // The memory may have moved before this point.
    const list = address => floats(address, 4 * count);
    const rotations = wasm.rotations(); // 0 while all Gaussians are isotropic
    if (changes & 1) {
      drawing.setCenters(list(wasm.centers()), list(wasm.normals()), count);
      drawing.setRotations(rotations ? list(rotations) : null, count);
    }
    if (changes & 2) drawing.setColors(list(wasm.colors()), count);
    // Opacities depend on the camera; a drawing that takes the order does not need them.
    if (rotations && (changes & 1 || drawing.sorts)) drawing.setScales(list(wasm.scales()), count);
    if (!parameters.has("bare")) {
      const shadow = wasm.shadow(), side = wasm.shadow_side();
      if (shadow) drawing.setFloor(floats(wasm.floor(), 12), changes & 1 ? new Uint8Array(wasm.memory.buffer, shadow, side * side) : null, side);
    }
    const ordered = drawing.sorts ? null : new Uint32Array(wasm.memory.buffer, order, wasm.order_length());
    drawing.draw(floats(wasm.camera(), 19), BACKGROUND, ordered);
  });
  [uploaded, dirty] = [true, false];
  const matrix = floats(wasm.camera(), 16);
  const eye = [0, 4, 8].map(column => -(matrix[column] * matrix[12] + matrix[column + 1] * matrix[13] + matrix[column + 2] * matrix[14]));
  document.documentElement.dataset.eye = eye.map(metres => metres.toFixed(3)).join(" ");
  document.documentElement.dataset.frame = wasm.frame();
  document.documentElement.dataset.drawing = drawing.kind;
  drawn.push(time);
  if (drawn.length > 200) drawn.splice(0, 100);
  if (!parameters.has("fixed")) adapt();
}

/** Returns why nobody is shown. */
function absence() {
  if (!state.is_running) return "Asking the rig.";
  if (state.measuring_secs !== null) {
    return `Somebody is being measured (${Math.floor(state.measuring_secs + now() - stateAt)} s).`;
  }
  const isSeen = state.people.some(([, tracking]) => tracking !== "lost" && tracking !== "searching");
  return isSeen ? "Somebody is seen, and is on the way here." : "Nobody is seen.";
}

/** Returns the plain line on what is shown. */
function summary(isComplete) {
  const behind = clockAhead === null ? null : now() + clockAhead - wasm.capture_secs();
  const words = [behind === null || behind < 0 ? "live" : `live, ${behind.toFixed(1)} s behind`];
  if (!isComplete) words.push("colours are loading");
  // An avatar's colours are part of it.
  else if (state.is_line_slow && wasm.scales() === 0) words.push("coarse colours: the network to the rig is slow");
  if (state.measuring_secs !== null) words.push("somebody else is being measured");
  return words.join(" \u00b7 ");
}

function showWords(time) {
  while (recent.length > 0 && time - recent[0][0] > SHOWN_OVER_MS) recent.shift();
  const shown = wasm.people() & 255, isComplete = (wasm.people() & 256) !== 0;
  showPeople(shown);
  const trouble = fault || linkTrouble || state.trouble;
  const message = trouble || (shown === 0 ? absence() : "");
  if (troubleText.textContent !== message) troubleText.textContent = message;
  const words = shown === 0 ? "" : trouble ? "the last frame" : summary(isComplete);
  if (stateText.textContent !== words) stateText.textContent = words;
  stateText.dataset.kind = trouble ? "wait" : "live";
  if (!help.hidden) showDetails(time);
  document.documentElement.dataset.ready = shown > 0 && isComplete && !message ? "yes" : "no";
}

function showDetails(time) {
  const rate = list => list.filter(at => time - at < SHOWN_OVER_MS).length / SHOWN_OVER_MS * 1000;
  const bits = recent.reduce((sum, [, bytes]) => sum + bytes, 0) * 8 / SHOWN_OVER_MS / 1000;
  const quality = state.people.filter(([, , quality]) => quality !== null).map(([, , quality]) => `${Math.round(100 * quality)} %`);
  const [layers, all] = state.color_layers;
  details.textContent = [
    state.rig ? `rig ${state.rig}` + (state.sets_per_second > 0 ? `, ${state.sets_per_second.toFixed(1)} frame sets/s` : "") : "",
    `${rate(drawn).toFixed(0)} images/s, ${bits.toFixed(1)} Mbit/s`,
    `decode ${spent.decode.toFixed(1)} ms, pose and sort ${spent.pose.toFixed(1)} ms, ${drawing?.kind ?? "graphics lost"} ${spent.draw.toFixed(1)} ms`,
    quality.length > 0 ? `tracking ${quality.join(", ")}` : "",
    layers < all ? `colours: ${layers} of ${all} layers` + (state.is_line_slow ? ", as many as the network to the rig carries" : "") : "",
  ].filter(line => line).join("\n");
}

document.body.classList.toggle("bare", parameters.has("bare"));
showButtons();
connect();
requestAnimationFrame(tick);
