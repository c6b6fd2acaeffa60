// Plays a take whose messages are inside the page (viewer/web/src/take_page.rs). page.wasm decodes and poses; draw_webgl2.js, above, draws.
const RIG = 0, TEMPLATE = 1, MOTION = 2, COLORS = 3;
const BACKGROUND = [27 / 255, 29 / 255, 32 / 255];
const REFRESH_SECS = 1.05; // every part of the colours comes again within this time
const BEFORE_SECS = 1; // motions that are read before the instant shown, to interpolate
const FILLS = 0.74; // share of the view's height that the person takes at the start
const ABOVE = 0.015; // of the middle, because of the bar below

const [canvas, play, time, clock, trouble] = ["view", "play", "time", "clock", "trouble"].map(id => document.getElementById(id));
const text = new TextDecoder();
const fail = problem => { trouble.textContent = problem; };
addEventListener("error", ({ error, message }) => fail(error?.message ?? message));
addEventListener("unhandledrejection", ({ reason }) => fail(reason?.message ?? String(reason)));

function embedded(id) {
  const element = document.getElementById(id);
  const letters = atob(element.textContent.trim());
  element.remove();
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

// --- Messages ---

/** Returns the messages: kind, person, seconds from the first motion, and bytes. */
function split(bytes) {
  const view = new DataView(bytes.buffer);
  const found = [];
  for (let at = 0; at + 20 <= bytes.length;) {
    const length = view.getUint32(at + 16, true);
    const payload = bytes.subarray(at + 20, at + 20 + length);
    found.push({ kind: view.getUint8(at), person: view.getUint32(at + 4, true), secs: view.getFloat64(at + 8, true), payload });
    at += 20 + length;
  }
  return found;
}

const { instance } = await WebAssembly.instantiate(embedded("wasm"), {});
const wasm = instance.exports;
const messages = split(embedded("take"));
const motions = messages.filter(message => message.kind === MOTION);
const people = new Set(motions.map(message => message.person)).size;
const last = motions.at(-1)?.secs ?? 0;
// Interpolation shows the person one interval and a half late; at the end the last motion is shown for a moment.
const end = last + 0.3;

function send({ kind, person, secs, payload }) {
  const address = wasm.input(payload.length);
  if (address === 0) return;
  new Uint8Array(wasm.memory.buffer, address, payload.length).set(payload);
  if (wasm.take(kind, person, secs) !== 0) {
    console.warn(text.decode(new Uint8Array(wasm.memory.buffer, wasm.error(), wasm.error_length()).slice()));
  }
}

let at = 0; // seconds of the take that are shown
let next = 0; // first message that was not sent yet

/** Sends the messages up to the instant shown. */
function advance() {
  while (next < messages.length && messages[next].secs <= at) send(messages[next++]);
}

/** Shows another instant: the person is built again from the template before it and the messages shortly before it. */
function seek(secs) {
  const to = Math.min(Math.max(secs, 0), end);
  if (to >= at && to < at + 0.5) {
    at = to;
  } else {
    at = to;
    wasm.forget_people();
    next = messages.findIndex(message => message.secs > at);
    if (next < 0) next = messages.length;
    const templates = new Map();
    for (const message of messages.slice(0, next)) if (message.kind === TEMPLATE) templates.set(message.person, message);
    for (const message of templates.values()) send(message);
    for (const message of messages.slice(0, next)) {
      const from = at - (message.kind === COLORS ? REFRESH_SECS : BEFORE_SECS);
      if (message.kind >= MOTION && message.secs >= from) send(message);
    }
  }
  advance();
  dirty = true;
}

// --- View ---

let drawing = new WebGl2Drawing(canvas);
let [dirty, uploaded, isPlaying] = [true, false, true];
canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); drawing = null; });
canvas.addEventListener("webglcontextrestored", () => { drawing = new WebGl2Drawing(canvas); uploaded = false; dirty = true; });

/** Moves the viewpoint so that the person fills the view. */
function frame() {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  wasm.jump(0);
  for (let round = 0; round < 4; round++) {
    const count = wasm.pose(at, 1);
    if (count === 0 || wasm.look(width, height) === 0) return;
    const centers = new Float32Array(wasm.memory.buffer, wasm.centers(), 4 * count);
    const m = new Float32Array(wasm.memory.buffer, wasm.camera(), 19);
    let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let i = 0; i < 4 * count; i += 4) {
      const [x, y, z] = [0, 1, 2].map(row => m[row] * centers[i] + m[4 + row] * centers[i + 1] + m[8 + row] * centers[i + 2] + m[12 + row]);
      if (z < 0.05) continue;
      const [u, v] = [m[16] * x / z + m[17], m[16] * y / z + m[18]];
      left = Math.min(left, u); right = Math.max(right, u); top = Math.min(top, v); bottom = Math.max(bottom, v);
    }
    if (!(right > left && bottom > top)) return;
    wasm.shift((width / 2 - (left + right) / 2) / height, (height / 2 - (top + bottom) / 2) / height - ABOVE);
    wasm.zoom(FILLS / Math.max((bottom - top) / height, (right - left) / width));
  }
  dirty = true;
}

const pointers = new Map();
canvas.onpointerdown = event => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = event => pointers.delete(event.pointerId);
canvas.oncontextmenu = event => event.preventDefault();
canvas.onpointermove = event => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
  const height = canvas.clientHeight;
  if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const distance = place => Math.hypot(place[0] - other[0], place[1] - other[1]);
    zoom(distance([event.clientX, event.clientY]) / Math.max(distance(before), 1));
    wasm.shift(dx / 2 / height, dy / 2 / height);
  } else if (event.buttons & 6 || event.shiftKey) {
    wasm.shift(dx / height, dy / height);
  } else {
    wasm.orbit(dx / height * Math.PI, dy / height * Math.PI);
  }
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  dirty = true;
};
/** Zooms by one step, however far the wheel was turned. */
function zoom(factor) { wasm.zoom(Math.min(Math.max(factor, 0.7), 1.4)); dirty = true; }
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)));
}, { passive: false });

// --- Bar ---

function setPlaying(plays) {
  isPlaying = plays;
  play.textContent = plays ? "Pause" : "Play";
}
play.onclick = () => setPlaying(!isPlaying);
time.max = end;
time.oninput = () => { setPlaying(false); seek(Number(time.value)); };
document.getElementById("reset").onclick = frame;
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const step = { ArrowLeft: -0.1, ArrowRight: 0.1 }[event.code];
  if (event.code === "Space") setPlaying(!isPlaying);
  else if (event.code === "KeyR") frame();
  else if (step) { setPlaying(false); seek(at + step); }
  else return;
  event.preventDefault();
});

// --- Images ---

const hasFloor = !new URLSearchParams(location.search).has("bare");
let lastTick = performance.now();
let isFramed = false;

function tick(now) {
  requestAnimationFrame(tick);
  const step = Math.min((now - lastTick) / 1000, 0.2);
  lastTick = now;
  if (isPlaying) seek(at + step > end ? 0 : at + step);
  if (document.activeElement !== time || isPlaying) time.value = at;
  clock.textContent = `${Math.min(at, last).toFixed(1)} / ${last.toFixed(1)} s`;
  if (!drawing) return;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(side => Math.max(1, Math.round(side * devicePixelRatio)));
  if (canvas.width !== width || canvas.height !== height) {
    [canvas.width, canvas.height] = [width, height];
    dirty = true;
  }
  const count = wasm.pose(at, 1);
  if (!isFramed && count > 0) { isFramed = true; frame(); }
  const changes = uploaded ? wasm.changes() : 3;
  if (changes === 0 && !dirty) return;
  const order = wasm.order(width, height);
  const list = address => new Float32Array(wasm.memory.buffer, address, 4 * count);
  const rotations = wasm.rotations(); // 0 while all Gaussians are isotropic
  drawing.setCenters(list(wasm.centers()), list(wasm.normals()), count);
  drawing.setRotations(rotations ? list(rotations) : null, count);
  drawing.setColors(list(wasm.colors()), count);
  if (rotations) drawing.setScales(list(wasm.scales()), count);
  const shadow = wasm.shadow(), side = wasm.shadow_side();
  if (shadow && hasFloor) drawing.setFloor(new Float32Array(wasm.memory.buffer, wasm.floor(), 12), new Uint8Array(wasm.memory.buffer, shadow, side * side), side);
  drawing.draw(new Float32Array(wasm.memory.buffer, wasm.camera(), 19), BACKGROUND, new Uint32Array(wasm.memory.buffer, order, wasm.order_length()));
  [uploaded, dirty] = [true, false];
  document.documentElement.dataset.frame = wasm.frame();
  document.documentElement.dataset.ready = count > 0 && wasm.people() & 256 ? "yes" : "no";
}

messages.filter(message => message.kind === RIG).forEach(send);
trouble.textContent = people === 0 ? "The take shows no person." : "";
advance();
requestAnimationFrame(tick);
