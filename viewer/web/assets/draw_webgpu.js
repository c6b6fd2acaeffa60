// Draws Gaussians with WebGPU by the rig's own kernels (kernels.json is made of the WGSL in renderer/renderer/src): projection, stable sort by depth,
// lists by tile, blending. Numbers of bindings and the order of dispatches are those of renderer/renderer/src/raster/device.rs.

const SLOT_BYTES = 256; // constants lie this far apart: offsets of bindings may be any multiple of it
const MOST_GROUPS = 65535; // workgroups of a dispatch in one dimension

// Straight alpha over the background and the floor (viewer/viewing/src/floor.rs), on sRGB values, as in the images of the rig. After the
// module `srgb`.
const COMPOSE = `
struct View { camera_from_world: mat4x4<f32>, ground: array<vec4<f32>, 3>, background: vec4<f32>, lens: vec3<f32>, width: u32 }
@group(0) @binding(0) var<storage, read> light: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> view: View;
@group(0) @binding(2) var shadow: texture_2d<f32>;
@group(0) @binding(3) var linear: sampler;
fn behind(pixel: vec2<f32>) -> vec3<f32> {
  let moved = view.camera_from_world;
  let rotation = mat3x3(moved[0].xyz, moved[1].xyz, moved[2].xyz);
  let eye = -(moved[3].xyz * rotation);
  let sight = vec3((pixel - view.lens.yz) / view.lens.x, 1.0) * rotation;
  let center = view.ground[0].xyz;
  let radius = view.ground[0].w;
  let up = cross(view.ground[1].xyz, view.ground[2].xyz);
  let above = dot(eye - center, up);
  let down = -dot(sight, up);
  if !(radius > 0.0 && above > 0.0 && down > 1e-4) { return view.background.rgb; }
  let hit = eye + sight * (above / down) - center;
  let at = vec2(dot(hit, view.ground[1].xyz), dot(hit, view.ground[2].xyz));
  let fade = max(1.0 - dot(at, at) / (radius * radius), 0.0);
  let dark = textureSampleLevel(shadow, linear, at / (2.0 * view.ground[1].w) + 0.5, 0.0).r * sqrt(fade);
  return (view.background.rgb + ${46 / 255} * fade * fade) * (1.0 - 0.7 * dark);
}
@vertex fn whole(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
  return vec4(vec2<f32>(vec2(index & 1u, index >> 1u)) * 4.0 - 1.0, 0.0, 1.0);
}
fn srgb(linear: vec3<f32>) -> vec3<f32> {
  let c = clamp(linear, vec3(0.0), vec3(1.0));
  return vec3(srgb_from_linear(c.r), srgb_from_linear(c.g), srgb_from_linear(c.b));
}
@fragment fn compose(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
  let seen = light[u32(at.y) * view.width + u32(at.x)];
  let person = select(vec3(0.0), srgb(seen.rgb / seen.a), seen.a > 0.0);
  return vec4(mix(behind(at.xy - 0.5), person, min(seen.a, 1.0)), 1.0);
}`;

// Modules and their entry points. A kernel is named after its entry point, or after a module that has only one.
const ENTRIES = {
  project: ["project"], projectAxes: ["project"], bins: ["count_pairs", "keep_pairs", "write_pairs", "end_lists"], scan: ["reduce", "apply"],
  sort: ["find_range", "count_digits", "scatter"], blend: ["blend"],
};

/** Opens a graphics processor and compiles the kernels; null where there is none. `takesSoftware` accepts a software adapter, too. */
export async function openWebGpu(takesSoftware) {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) return null;
  const isSoftware = adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter ?? false;
  if (isSoftware && !takesSoftware) return null;
  const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits;
  const device = await adapter.requestDevice({ requiredLimits: { maxBufferSize, maxStorageBufferBindingSize } });
  const { modules, numbers, frame } = await (await fetch("kernels.json")).json();
  const kernels = {};
  await Promise.all(Object.entries(ENTRIES).flatMap(([name, entries]) => {
    const module = device.createShaderModule({ code: modules[name] });
    return entries.map(async entryPoint => {
      kernels[entries.length === 1 ? name : entryPoint] = await device.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } });
    });
  }));
  return { device, kernels, numbers, frame, srgb: modules.srgb };
}

/** Returns the workgroups in x and y for a number of invocations, as flyrig_gpu::dispatch_1d. */
function groupsFor(items, lanes) {
  const groups = Math.max(1, Math.ceil(items / lanes));
  const rows = Math.ceil(groups / MOST_GROUPS);
  return [Math.ceil(groups / rows), rows];
}

/** Drawing of one canvas with the result of `openWebGpu`. Create a new one after `device.lost`. */
export class WebGpuDrawing {
  constructor(canvas, { device, kernels, numbers, frame, srgb }) {
    Object.assign(this, { canvas, device, kernels, numbers, offsets: frame, sorts: true, kind: "WebGPU" });
    this.context = canvas.getContext("webgpu");
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device, format, alphaMode: "opaque" });
    const module = device.createShaderModule({ code: srgb + COMPOSE });
    this.compose = device.createRenderPipeline({
      layout: "auto", vertex: { module, entryPoint: "whole" }, fragment: { module, entryPoint: "compose", targets: [{ format }] },
    });
    this.buffers = new Map(); // by name
    this.ground = new Float32Array(12); // no floor
    this.linear = device.createSampler({ magFilter: "linear", minFilter: "linear" });
    this.setFloor(this.ground, new Uint8Array(1), 1);
    this.count = 0;
    this.hasAxes = false;
    this.planned = ""; // count, size and kind of the present steps
    this.waiting = 0; // images that the device has not finished
  }

  /** Returns whether earlier images are still being drawn: more of them would only wait in the device's queue. */
  get isBusy() { return this.waiting > 1; }

  /** Returns the buffer of a name with room for a number of bytes; the content is lost when it grows. */
  buffer(name, bytes, usage = 0) {
    const known = this.buffers.get(name);
    if (known && known.size >= bytes) return known;
    known?.destroy();
    const size = 4 * Math.ceil(Math.max(16, bytes) / 4);
    const made = this.device.createBuffer({ label: name, size, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST | usage });
    this.buffers.set(name, made);
    this.planned = "";
    return made;
  }

  write(name, values) { this.device.queue.writeBuffer(this.buffer(name, values.byteLength), 0, values); }

  setCenters(centers, normals, count) {
    this.count = count;
    this.write("centers", centers);
    this.write("normals", normals);
  }

  setColors(colors) { this.write("colors", colors); }

  /** Sets the rotations of the Gaussians' axes; null where all are isotropic. */
  setRotations(rotations) {
    this.hasAxes = rotations !== null;
    if (this.hasAxes) this.write("rotations", rotations);
  }

  /** Sets the standard deviations along the axes, and the opacities for the camera. */
  setScales(scales) { this.write("scales", scales); }

  /** Sets the floor: Floor::numbers, and the shadow where it has changed, `side` squared bytes. */
  setFloor(numbers, shadow, side) {
    this.ground.set(numbers);
    if (!shadow) return;
    if (this.shadow?.width !== side) {
      this.shadow?.destroy();
      const usage = GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST;
      this.shadow = this.device.createTexture({ size: [side, side], format: "r8unorm", usage });
      this.planned = "";
    }
    this.device.queue.writeTexture({ texture: this.shadow }, shadow, { bytesPerRow: side }, [side, side]);
  }

  /** Builds the steps of an image: kernel, bind group, and workgroups or the place in "work" that holds their number. */
  plan(width, height) {
    const { count, kernels, device } = this;
    const { tile, binsLanes, block, digitBits, keyBits, segments, pairsPerGaussian, pairsPerTile, minPairs } = this.numbers;
    const columns = Math.ceil(width / tile), rows = Math.ceil(height / tile);
    const most = Math.min(Math.floor(device.limits.maxStorageBufferBindingSize / 8), MOST_GROUPS * binsLanes);
    const pairs = Math.min(Math.max(minPairs, pairsPerGaussian * count + pairsPerTile * columns * rows), most);
    const blocks = elements => Math.max(1, Math.ceil(elements / block));
    const tableLength = elements => blocks(elements) << digitBits;

    const own = {};
    const make = (name, bytes, usage) => { own[name] = this.buffer(name, bytes, usage); };
    const attributes = ["centers", "normals", "colors", ...(this.hasAxes ? ["scales", "rotations"] : [])];
    for (const name of attributes) make(name, 16 * count);
    make("splats", 32 * count);
    make("rects", 8 * count);
    make("pairsBefore", 4 * count);
    make("pairTotal", 4);
    make("work", 48, GPUBufferUsage.INDIRECT);
    make("stats", 12);
    make("sums", 4 * segments);
    make("ends", 4 * columns * rows);
    make("light", 16 * width * height);
    make("view", 144);
    make("constants", 16 * SLOT_BYTES);
    for (const [sort, elements] of [["depth", count], ["list", pairs]]) {
      make(`${sort}Elements`, 8 * elements);
      make(`${sort}Other`, 8 * elements);
      make(`${sort}Table`, 4 * tableLength(elements));
      make(`${sort}Extremes`, 8);
      make(`${sort}Valid`, 4);
    }

    let slots = 0;
    const constant = values => {
      const offset = SLOT_BYTES * slots++;
      device.queue.writeBuffer(own.constants, offset, values);
      return { buffer: own.constants, offset, size: values.byteLength };
    };
    const steps = [];
    const step = (name, bindings, groups) => {
      const entries = Object.entries(bindings).map(([binding, value]) => (
        { binding: Number(binding), resource: value instanceof GPUBuffer ? { buffer: value } : value }));
      const kernel = kernels[name];
      steps.push({ kernel, groups, group: device.createBindGroup({ layout: kernel.getBindGroupLayout(0), entries }) });
    };
    const scan = (length, values, total) => {
      step("reduce", { 0: length, 1: values, 2: own.sums }, [segments, 1]);
      step("apply", { 0: length, 1: values, 2: own.sums, 3: total }, [segments, 1]);
    };
    // Returns the buffer of the sorted elements.
    const sort = (name, elements, passes, isScaled, length, groups) => {
      const [table, extremes, valid] = ["Table", "Extremes", "Valid"].map(part => own[name + part]);
      let [from, to] = [own[`${name}Elements`], own[`${name}Other`]];
      for (let index = 0; index < passes; index++) {
        const settings = constant(new Uint32Array([elements, index, isScaled ? 1 : 0, 0])); // struct SortPass of radix.wgsl
        if (index === 0 && isScaled) step("find_range", { 0: settings, 1: from, 2: extremes }, groups);
        const known = { 0: settings, 1: from, 2: extremes, 3: table, 4: valid };
        step("count_digits", known, groups);
        scan(length, table, valid);
        step("scatter", { ...known, 5: to }, groups);
        [from, to] = [to, from];
      }
      return from;
    };

    const frame = this.frame = constant(new Uint8Array(this.offsets.bytes));
    const { centers, normals, colors, splats, rects, pairsBefore, pairTotal, work } = own;
    const projected = { 0: frame, 1: centers, 5: splats, 6: rects, 7: own.depthElements };
    // The page hides what faces away by its opacity; normals are bound and not read.
    if (this.hasAxes) step("projectAxes", { ...projected, 2: own.scales, 3: own.rotations, 4: centers }, groupsFor(count, 64));
    // No canonical positions are drawn; something must be bound.
    else step("project", { ...projected, 2: normals, 3: colors, 4: normals }, groupsFor(count, 64));
    const depthLength = constant(new Uint32Array([tableLength(count), 0, 0, 0]));
    const ordered = sort("depth", count, Math.ceil(keyBits / digitBits), true, depthLength, [blocks(count), 1]);
    const visible = own.depthValid, kept = own.listValid;
    step("count_pairs", { 0: frame, 1: ordered, 2: visible, 3: rects, 4: pairsBefore }, groupsFor(count, binsLanes));
    scan(constant(new Uint32Array([count, 0, 0, 0])), pairsBefore, pairTotal);
    step("keep_pairs", { 0: frame, 2: visible, 4: pairsBefore, 5: pairTotal, 6: kept, 9: own.stats, 10: work }, [1, 1]);
    step("write_pairs", { 0: frame, 1: ordered, 2: visible, 3: rects, 4: pairsBefore, 6: kept, 7: own.listElements }, 16);
    const tileBits = 32 - Math.clz32(columns * rows - 1);
    const lists = sort("list", pairs, Math.max(1, Math.ceil(tileBits / digitBits)), false, { buffer: work, offset: 0, size: 16 }, 32);
    step("end_lists", { 0: frame, 6: kept, 7: lists, 8: own.ends }, groupsFor(columns * rows, binsLanes));
    step("blend", { 0: frame, 1: splats, 2: colors, 4: own.ends, 5: lists, 6: own.light }, [columns, rows]);

    this.steps = steps;
    this.own = own;
    this.pairs = pairs;
    this.tiles = [columns, rows];
    const resources = [{ buffer: own.light }, { buffer: own.view }, this.shadow.createView(), this.linear];
    const entries = resources.map((resource, binding) => ({ binding, resource }));
    this.composed = device.createBindGroup({ layout: this.compose.getBindGroupLayout(0), entries });
  }

  /** Returns the constants of an image with a camera of 19 numbers (viewer/page/src/page.rs), for kernels that take any lens. */
  frameConstants(camera, width, height) {
    const { offsets, numbers } = this;
    const bytes = new ArrayBuffer(offsets.bytes);
    const floats = (offset, values) => new Float32Array(bytes, offset, values.length).set(values);
    const words = (offset, values) => new Uint32Array(bytes, offset, values.length).set(values);
    const matrix = camera.subarray(0, 16), [focal, ...center] = camera.subarray(16);
    const position = [0, 4, 8].map(column => -(matrix[column] * matrix[12] + matrix[column + 1] * matrix[13] + matrix[column + 2] * matrix[14]));
    floats(0, matrix);
    floats(offsets.position, [...position, 1]);
    floats(offsets.focal, [focal, focal]);
    floats(offsets.center, center);
    words(offsets.cameraSize, [width, height]);
    floats(offsets.validRadius, [1e9]);
    words(offsets.size, [width, height]);
    words(offsets.tiles, this.tiles);
    words(offsets.gaussians, [this.count]);
    words(offsets.cullBackfacing, [this.hasAxes ? 0 : 1]);
    words(offsets.pairCapacity, [this.pairs]);
    floats(offsets.near, [numbers.nearM]);
    floats(offsets.filterVariance, [numbers.filterVariancePx2]);
    return bytes;
  }

  /** Draws all Gaussians with a camera of 19 numbers (viewer/page/src/page.rs). */
  draw(camera, background) {
    const { device, count } = this;
    const { width, height } = this.canvas;
    const encoder = device.createCommandEncoder();
    if (count > 0 && camera[16] > 0) {
      const wanted = `${count} ${width} ${height} ${this.hasAxes}`;
      if (this.planned !== wanted) {
        this.plan(width, height);
        this.planned = wanted;
      }
      device.queue.writeBuffer(this.own.constants, this.frame.offset, this.frameConstants(camera, width, height));
      const view = new ArrayBuffer(144); // struct View above
      new Float32Array(view).set([...camera.subarray(0, 16), ...this.ground, ...background, 1, ...camera.subarray(16, 19)]);
      new Uint32Array(view)[35] = width;
      device.queue.writeBuffer(this.own.view, 0, view);
      for (const extremes of [this.own.depthExtremes, this.own.listExtremes]) encoder.clearBuffer(extremes);
      const pass = encoder.beginComputePass();
      for (const { kernel, group, groups } of this.steps) {
        pass.setPipeline(kernel);
        pass.setBindGroup(0, group);
        if (Array.isArray(groups)) pass.dispatchWorkgroups(...groups);
        else pass.dispatchWorkgroupsIndirect(this.own.work, groups);
      }
      pass.end();
    }
    const [r, g, b] = background;
    const view = this.context.getCurrentTexture().createView();
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store", clearValue: { r, g, b, a: 1 } }] });
    if (count > 0 && this.planned) {
      pass.setPipeline(this.compose);
      pass.setBindGroup(0, this.composed);
      pass.draw(3);
    }
    pass.end();
    device.queue.submit([encoder.finish()]);
    this.waiting += 1;
    const done = () => { this.waiting -= 1; };
    device.queue.onSubmittedWorkDone().then(done, done);
  }
}
