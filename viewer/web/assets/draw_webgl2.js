// Draws Gaussians with WebGL2, as project.wgsl and blend.wgsl of renderer/renderer/src/raster do: EWA projection, Mip filter, blending in
// linear light. Gaussians come sorted, farthest first.

const TEXELS = 1024; // Gaussians in a row of the data textures
const FILTER_PX2 = 0.1; // RasterSettings::filter_variance_px2

// Vertex shader of isotropic or anisotropic Gaussians.
const project = hasAxes => `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D centers;
uniform sampler2D colors;
uniform highp usampler2D order;
${hasAxes ? `uniform sampler2D scales;
uniform sampler2D rotations;
// Returns the axes of a Gaussian by its unit quaternion, as columns, in the world.
mat3 axes(vec4 q) {
  vec3 d = q.xyz * q.xyz, w = q.w * q.xyz;
  float xy = q.x * q.y, yz = q.y * q.z, zx = q.z * q.x;
  return mat3(
    1.0 - 2.0 * (d.y + d.z), 2.0 * (xy + w.z), 2.0 * (zx - w.y),
    2.0 * (xy - w.z), 1.0 - 2.0 * (d.x + d.z), 2.0 * (yz + w.x),
    2.0 * (zx + w.y), 2.0 * (yz - w.x), 1.0 - 2.0 * (d.x + d.y));
}` : ""}
uniform mat4 cameraFromWorld;
uniform vec3 lens; // focal length and principal point, pixels; pixel centres are at integers
uniform vec2 size;
out vec2 offset;
flat out vec3 conic;
flat out float log2Opacity;
flat out vec3 paint;
const float CUT = 1.0 / 255.0;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  // Four vertices per Gaussian.
  int rank = gl_VertexID / 4;
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  int index = int(texelFetch(order, ivec2(rank % ${TEXELS}, rank / ${TEXELS}), 0).r);
  ivec2 at = ivec2(index % ${TEXELS}, index / ${TEXELS});
  vec4 center = texelFetch(centers, at, 0);
  vec4 color = texelFetch(colors, at, 0);
  vec3 p = (cameraFromWorld * vec4(center.xyz, 1.0)).xyz;
  float focal = lens.x / p.z;
  vec2 pixel = focal * p.xy + lens.yz;
  // Rows of the matrix whose product with its transpose is the covariance.
  vec3 rowX = vec3(focal, 0.0, -focal * p.x / p.z);
  vec3 rowY = vec3(0.0, focal, -focal * p.y / p.z);
  ${hasAxes ? `mat3 alongAxes = mat3(cameraFromWorld) * axes(texelFetch(rotations, at, 0));
  vec3 scale = texelFetch(scales, at, 0).xyz;
  rowX = rowX * alongAxes * scale;
  rowY = rowY * alongAxes * scale;` : `rowX *= center.w;
  rowY *= center.w;`}
  float xx = dot(rowX, rowX), xy = dot(rowX, rowY), yy = dot(rowY, rowY);
  vec3 normal = cross(rowX, rowY);
  float det = dot(normal, normal);
  const float s = ${FILTER_PX2};
  float filteredDet = det + s * (xx + yy) + s * s;
  float opacity = min(color.w, 1.0) * sqrt(det / filteredDet);
  if (!(opacity > CUT)) return;
  float r2 = 2.0 * log(opacity / CUT);
  vec2 extent = sqrt(r2 * vec2(xx + s, yy + s)) + 0.01;
  offset = corner * extent;
  conic = vec3(yy + s, -2.0 * xy, xx + s) * (0.72134752 / filteredDet);
  log2Opacity = log2(opacity);
  paint = color.rgb;
  vec2 ndc = (pixel + offset + 0.5) / size * 2.0 - 1.0;
  gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
}`;

const BLEND = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec3 conic;
flat in float log2Opacity;
flat in vec3 paint;
out vec4 color;
void main() {
  float exponent = log2Opacity - conic.x * offset.x * offset.x - offset.y * (conic.y * offset.x + conic.z * offset.y);
  if (exponent < -7.9943534) discard; // log2(1 / 255)
  float alpha = min(exp2(exponent), 0.99);
  color = vec4(paint * alpha, alpha);
}`;

const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// Straight alpha over the background and the floor (viewer/viewing/src/floor.rs), on sRGB values, as in the images of the rig.
const COMPOSE = `#version 300 es
precision highp float;
uniform sampler2D light;
uniform sampler2D shadow;
uniform vec3 background;
uniform mat4 cameraFromWorld;
uniform vec3 lens;
uniform float height;
uniform vec4 ground[3]; // Floor::numbers
out vec4 color;
vec3 behind() {
  mat3 rotation = mat3(cameraFromWorld);
  vec3 eye = -(cameraFromWorld[3].xyz * rotation);
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y) - 0.5;
  vec3 sight = vec3((pixel - lens.yz) / lens.x, 1.0) * rotation;
  vec3 up = cross(ground[1].xyz, ground[2].xyz);
  float above = dot(eye - ground[0].xyz, up), down = -dot(sight, up), radius = ground[0].w;
  if (!(radius > 0.0 && above > 0.0 && down > 1e-4)) return background;
  vec3 hit = eye + sight * (above / down) - ground[0].xyz;
  vec2 at = vec2(dot(hit, ground[1].xyz), dot(hit, ground[2].xyz));
  float fade = max(1.0 - dot(at, at) / (radius * radius), 0.0);
  float dark = texture(shadow, at / (2.0 * ground[1].w) + 0.5).r * sqrt(fade);
  return (background + ${46 / 255} * fade * fade) * (1.0 - 0.7 * dark);
}
vec3 srgb(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
void main() {
  vec4 seen = texelFetch(light, ivec2(gl_FragCoord.xy), 0);
  vec3 person = seen.a > 0.0 ? srgb(seen.rgb / seen.a) : vec3(0.0);
  color = vec4(mix(behind(), person, min(seen.a, 1.0)), 1.0);
}`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const places = new Map();
  return { made, place: name => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
    return places.get(name);
  } };
}

/** Drawing of one canvas. Create a new one after the context was lost. */
export class WebGl2Drawing {
  constructor(canvas) {
    [this.kind, this.sorts, this.isBusy] = ["WebGL2", false, false];
    const options = { alpha: false, antialias: false, depth: false, stencil: false, preserveDrawingBuffer: true };
    const gl = this.gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("This browser has no WebGL2; update it, or switch hardware acceleration on.");
    // Without half floats, 8 bits of sRGB with linear blending.
    this.format = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float")
      ? gl.RGBA16F : gl.SRGB8_ALPHA8;
    this.splats = program(gl, project(false), BLEND);
    this.ellipsoids = null; // program of anisotropic Gaussians, once there are some
    this.hasAxes = false;
    this.compose = program(gl, WHOLE, COMPOSE);
    // No attributes: vertices are numbered. Instances of four vertices would be slow on some drivers, most of all on software.
    this.vertices = gl.createVertexArray();
    this.indices = gl.createBuffer();
    this.capacity = 0; // number of Gaussians that the indices cover
    this.order = { texture: gl.createTexture(), rows: 0 };
    this.centers = { texture: gl.createTexture(), rows: 0 };
    this.colors = { texture: gl.createTexture(), rows: 0 };
    this.scales = { texture: gl.createTexture(), rows: 0 };
    this.rotations = { texture: gl.createTexture(), rows: 0 };
    this.four = [gl.RGBA32F, gl.RGBA, gl.FLOAT, 4];
    this.one = [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, 1];
    this.light = gl.createTexture();
    this.shadow = gl.createTexture();
    this.ground = new Float32Array(12); // nothing
    this.frame = gl.createFramebuffer();
    this.size = [0, 0];
  }

  /** Uploads the texels of `count` Gaussians, TEXELS in a row. `kind`: internal format, format, type and numbers of a texel. */
  upload(data, numbers, count, [internal, format, type, each]) {
    const gl = this.gl;
    const rows = Math.max(1, Math.ceil(count / TEXELS));
    gl.bindTexture(gl.TEXTURE_2D, data.texture);
    if (data.rows < rows) {
      gl.texImage2D(gl.TEXTURE_2D, 0, internal, TEXELS, rows, 0, format, type, null);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
      data.rows = rows;
    }
    const whole = Math.floor(count / TEXELS), rest = count % TEXELS;
    if (whole > 0) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXELS, whole, format, type, numbers);
    if (rest > 0) {
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest, 1, format, type, numbers.subarray(each * whole * TEXELS));
    }
  }

  /** Writes six indices for each of a number of Gaussians. */
  reserve(count) {
    if (count <= this.capacity) return;
    const gl = this.gl;
    const made = new Uint32Array(6 * count);
    for (let i = 0; i < count; i++) made.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, made, gl.STATIC_DRAW);
    this.capacity = count;
  }

  setCenters(centers, normals, count) { this.upload(this.centers, centers, count, this.four); this.reserve(count); }
  setColors(floats, count) { this.upload(this.colors, floats, count, this.four); }

  /** Sets the rotations of the Gaussians' axes; null where all are isotropic. */
  setRotations(rotations, count) {
    this.hasAxes = rotations !== null;
    if (!this.hasAxes) return;
    this.ellipsoids ??= program(this.gl, project(true), BLEND);
    this.upload(this.rotations, rotations, count, this.four);
  }

  /** Sets the standard deviations along the axes; opacities are those of the colours, and `order` omits Gaussians that face away. */
  setScales(scales, count) { this.upload(this.scales, scales, count, this.four); }

  /** Sets the floor: Floor::numbers, and the shadow where it has changed, `side` squared bytes. */
  setFloor(numbers, shadow, side) {
    this.ground.set(numbers);
    if (!shadow) return;
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE5);
    gl.bindTexture(gl.TEXTURE_2D, this.shadow);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, side, side, 0, gl.RED, gl.UNSIGNED_BYTE, shadow);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    gl.activeTexture(gl.TEXTURE0);
  }

  /** Draws the Gaussians of `order`, farthest first, with a camera of 19 numbers (viewer/page/src/page.rs). */
  draw(camera, background, order) {
    const gl = this.gl;
    const width = gl.drawingBufferWidth, height = gl.drawingBufferHeight;
    if (this.size[0] !== width || this.size[1] !== height) {
      gl.bindTexture(gl.TEXTURE_2D, this.light);
      const [kind, bytes] = this.format === gl.RGBA16F ? [gl.RGBA, gl.HALF_FLOAT] : [gl.RGBA, gl.UNSIGNED_BYTE];
      gl.texImage2D(gl.TEXTURE_2D, 0, this.format, width, height, 0, kind, bytes, null);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.light, 0);
      this.size = [width, height];
    }
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bindVertexArray(this.vertices);
    if (order.length > 0 && this.centers.rows > 0 && this.colors.rows > 0) {
      gl.activeTexture(gl.TEXTURE2);
      this.upload(this.order, order, order.length, this.one);
      const splats = this.hasAxes ? this.ellipsoids : this.splats;
      gl.useProgram(splats.made);
      gl.uniform1i(splats.place("order"), 2);
      const lists = this.hasAxes ? [[3, "scales"], [4, "rotations"], [1, "colors"], [0, "centers"]] : [[1, "colors"], [0, "centers"]];
      for (const [unit, name] of lists) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, this[name].texture);
        gl.uniform1i(splats.place(name), unit);
      }
      gl.uniformMatrix4fv(splats.place("cameraFromWorld"), false, camera.subarray(0, 16));
      gl.uniform3fv(splats.place("lens"), camera.subarray(16, 19));
      gl.uniform2f(splats.place("size"), width, height);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.drawElements(gl.TRIANGLES, 6 * Math.min(order.length, this.capacity), gl.UNSIGNED_INT, 0);
      gl.disable(gl.BLEND);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.compose.made);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.light);
    gl.uniform1i(this.compose.place("light"), 0);
    gl.activeTexture(gl.TEXTURE5);
    gl.bindTexture(gl.TEXTURE_2D, this.shadow);
    gl.uniform1i(this.compose.place("shadow"), 5);
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform3fv(this.compose.place("background"), background);
    gl.uniformMatrix4fv(this.compose.place("cameraFromWorld"), false, camera.subarray(0, 16));
    gl.uniform3fv(this.compose.place("lens"), camera.subarray(16, 19));
    gl.uniform1f(this.compose.place("height"), height);
    gl.uniform4fv(this.compose.place("ground"), this.ground);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }
}
