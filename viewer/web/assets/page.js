// Page: shows the rig's people on the canvas. page.wasm decodes and poses; draw_webgpu.js draws with the rig's kernels, or draw_webgl2.js
// where there is no WebGPU, or only a software adapter.
import { WebGl2Drawing } from "./draw_webgl2.js";
import { WebGpuDrawing, openWebGpu } from "./draw_webgpu.js";

const KIND = { rig: 0, state: 4, forget: 5 };
const BACKGROUND = [27 / 255, 29 / 255, 32 / 255];
const RETRY_MS = 1000;
const SHOWN_OVER_MS = 2000; // time over which rates are averaged

const parameters = new URLSearchParams(location.search);
const canvas = document.getElementById("view");
const panel = document.getElementById("panel");
const stateText = document.getElementById("state");
const troubleText = document.getElementById("trouble");
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
let state = { trouble: "Connecting", sets_per_second: 0, people: [], color_layers: [0, 0] };
let linkTrouble = "";
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
    state = JSON.parse(text.decode(payload));
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

function button(label, act, pressed) {
  const made = document.createElement("button");
  made.textContent = label;
  if (pressed !== undefined) made.setAttribute("aria-pressed", pressed);
  made.onclick = () => { act(made); dirty = true; };
  return made;
}

let follows = parameters.has("follow");
let cameraNames = [];

function showCameras(names) {
  if (names.join("\n") === cameraNames.join("\n")) return;
  cameraNames = names;
  const toggle = (label, get, set) => button(label, made => { set(!get()); made.setAttribute("aria-pressed", get()); }, get());
  panel.replaceChildren(
    toggle("Follow", () => follows, value => { follows = value; wasm.follow(value ? 1 : 0); }),
    toggle("Smooth", () => interpolates, value => { interpolates = value; }),
    ...names.map((name, at) => button(`Camera ${name}`, () => wasm.jump(at))),
  );
  wasm.follow(follows ? 1 : 0);
  const wanted = names.indexOf(parameters.get("camera") ?? "");
  if (wanted >= 0) wasm.jump(wanted);
}

// --- Pointers and keys ---

const pointers = new Map();

canvas.onpointerdown = event => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = event => pointers.delete(event.pointerId);
canvas.oncontextmenu = event => event.preventDefault();
canvas.onpointermove = event => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
  const height = canvas.clientHeight;
  if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const distance = at => Math.hypot(at[0] - other[0], at[1] - other[1]);
    wasm.zoom(distance([event.clientX, event.clientY]) / Math.max(distance(last), 1));
    wasm.shift(dx / 2 / height, dy / 2 / height);
  } else if (event.buttons & 6 || event.shiftKey) {
    wasm.shift(dx / height, dy / height);
  } else {
    wasm.orbit(dx / height * Math.PI, dy / height * Math.PI);
  }
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  dirty = true;
};
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  wasm.zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)));
  dirty = true;
}, { passive: false });

const held = new Set();
const FLY = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  held.add(event.code);
  if (event.code === "KeyF") panel.firstChild?.click();
  const digit = /^Digit([1-9])$/.exec(event.code);
  if (digit) { wasm.jump(Number(digit[1]) - 1); dirty = true; }
});
addEventListener("keyup", event => held.delete(event.code));
addEventListener("blur", () => held.clear());

// --- Images ---

canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); drawing = null; });
canvas.addEventListener("webglcontextrestored", () => { drawing = new WebGl2Drawing(canvas); uploaded = false; });

let lastTick = performance.now();

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
  showState(time);
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
    const ordered = drawing.sorts ? null : new Uint32Array(wasm.memory.buffer, order, wasm.order_length());
    drawing.draw(floats(wasm.camera(), 19), BACKGROUND, ordered);
  });
  [uploaded, dirty] = [true, false];
  document.documentElement.dataset.frame = wasm.frame();
  document.documentElement.dataset.drawing = drawing.kind;
  drawn.push(time);
  if (drawn.length > 200) drawn.splice(0, 100);
  if (!parameters.has("fixed")) adapt();
}

function showState(time) {
  while (recent.length > 0 && time - recent[0][0] > SHOWN_OVER_MS) recent.shift();
  const rate = list => list.filter(at => time - at < SHOWN_OVER_MS).length / SHOWN_OVER_MS * 1000;
  const bits = recent.reduce((sum, [, bytes]) => sum + bytes, 0) * 8 / SHOWN_OVER_MS / 1000;
  const people = wasm.people();
  const shown = people & 255, complete = (people & 256) !== 0;
  const missing = state.people.length > 0 ? "Loading a person." : "The rig is running; no person is in view.";
  const absence = shown === 0 && !state.trouble ? missing : "";
  const quality = state.people.filter(([, quality]) => quality !== null).map(([, quality]) => `${Math.round(100 * quality)} %`);
  const [layers, all] = state.color_layers;
  troubleText.textContent = fault || linkTrouble || state.trouble || absence;
  stateText.textContent = parameters.has("bare") ? "" : [
    state.rig ?? "",
    `${rate(drawn).toFixed(0)} images/s` + (state.sets_per_second > 0 ? `, rig ${state.sets_per_second.toFixed(1)} frame sets/s` : "")
      + `, ${bits.toFixed(1)} Mbit/s`,
    `decode ${spent.decode.toFixed(1)} ms, pose and sort ${spent.pose.toFixed(1)} ms, ${drawing?.kind ?? "graphics lost"} ${spent.draw.toFixed(1)} ms`,
    quality.length > 0 ? `tracking ${quality.join(", ")}` : "",
    // An avatar's colours are part of it.
    shown > 0 && layers < all && wasm.scales() === 0 ? `colours: ${layers} of ${all} layers, as many as the network to the rig carries` : "",
    shown > 0 && !complete ? "colours are still loading" : "",
  ].filter(line => line).join("\n");
  document.documentElement.dataset.ready = shown > 0 && complete && !troubleText.textContent ? "yes" : "no";
}

if (parameters.has("bare")) panel.style.display = "none";
connect();
requestAnimationFrame(tick);
