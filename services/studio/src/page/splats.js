// Splats in WebGL2, by the same projection, low-pass, cut-offs and order as the server's engine.

import { centreOf } from "./geometry.js";

/** @typedef {import("./api.js").View} View */

/** Splats per row of the textures. */
const ROW = 1024;
/** Share of a highlighted splat's colour that is the highlight's, as on the server. */
const HIGHLIGHT = 115;
/** Alpha of a mark that hides its splat. */
const HIDDEN = 255;
/** Nearest depth that is drawn. */
const NEAR = 0.01;
/** Bytes of the head of the server's packed splats. */
const HEAD = 16;
/** Numbers of a packed splat before its colour: index, centre, opacity, covariance. */
const BEFORE_COLOURS = 11;

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D geometry, colours, marks;
uniform mat3 rotation; uniform vec3 translation; uniform vec4 focal; uniform vec2 size; uniform vec4 limits; uniform float near;
uniform int compensated;
in uint splat;
out vec3 rgb; out vec2 offset; out vec3 conic; out float logOpacity;
void main() {
  gl_Position = vec4(0., 0., 2., 1.);
  int i = int(splat), x = i & ${ROW - 1}, y = i / ${ROW};
  vec4 mark = texelFetch(marks, ivec2(x, y), 0);
  if (mark.a > .99) return;
  vec4 g0 = texelFetch(geometry, ivec2(3 * x, y), 0), g1 = texelFetch(geometry, ivec2(3 * x + 1, y), 0), g2 = texelFetch(geometry, ivec2(3 * x + 2, y), 0);
  vec3 c = rotation * g0.xyz + translation;
  if (c.z < near) return;
  vec2 q = clamp(c.xy / c.z, limits.xz, limits.yw);
  mat3 sigma = mat3(g1.x, g1.y, g1.z, g1.y, g1.w, g2.x, g1.z, g2.x, g2.y);
  // Rows of the Jacobian times the rotation.
  vec3 jx = vec3(focal.x / c.z, 0., -focal.x * q.x / c.z) * rotation, jy = vec3(0., focal.y / c.z, -focal.y * q.y / c.z) * rotation;
  vec3 sx = sigma * jx, sy = sigma * jy;
  float a = dot(jx, sx), b = dot(jx, sy), d = dot(jy, sy), before = max(a * d - b * b, 0.);
  a += .3; d += .3;
  float det = a * d - b * b;
  if (det <= 0.) return;
  conic = vec3(d, -b, a) / det;
  float opacity = g0.w * (compensated == 1 ? sqrt(before / det) : 1.);
  if (opacity < 1. / 255.) return;
  logOpacity = log(opacity);
  // The box of the ellipse on which alpha is 1/255.
  vec2 r = sqrt(2. * (logOpacity + 5.541264)) * sqrt(vec2(a, d)) + .5;
  vec2 at = focal.xy * c.xy / c.z + focal.zw, corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2. - 1.;
  if (any(lessThan(at + r, vec2(0.))) || any(greaterThan(at - r, size))) return;
  offset = corner * r;
  vec2 s = (at + offset) / size * 2. - 1.;
  gl_Position = vec4(s.x, -s.y, 0., 1.);
  rgb = mix(texelFetch(colours, ivec2(x, y), 0).rgb, mark.rgb, mark.a);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 rgb; in vec2 offset; in vec3 conic; in float logOpacity;
out vec4 colour;
void main() {
  float power = logOpacity - .5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) - conic.y * offset.x * offset.y;
  float alpha = min(exp(power), .999);
  if (alpha < 1. / 255.) discard;
  colour = vec4(rgb * alpha, alpha);
}`;

const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0., 1.); }`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D from;
out vec4 colour;
void main() { colour = clamp(texelFetch(from, ivec2(gl_FragCoord.xy), 0), 0., 1.); }`;

/** Draws a scene's splats. */
export class SplatView {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    const options = { antialias: false, alpha: true, premultipliedAlpha: true, preserveDrawingBuffer: true };
    const gl = /** @type {WebGL2RenderingContext | null} */ (canvas.getContext("webgl2", options));
    if (!gl) throw new Error("no WebGL2");
    this.gl = gl;
    this.canvas = canvas;
    this.program = this.link(VERTEX, FRAGMENT);
    this.copy = this.link(COPY_VERTEX, COPY_FRAGMENT);
    this.textures = /** @type {WebGLTexture[]} */ ([]);
    this.frame = /** @type {WebGLFramebuffer | null} */ (null);
    /** Splats of the scene, of which so many have arrived. They are kept in the order in which they come: by contribution. */
    this.n = 0;
    this.arrived = 0;
    /** Splats of the last frame. */
    this.rendered = 0;
    /** The splats' labels, and how each label is marked. @type {{labels: Uint8Array, colours: (number[] | null)[]}} */
    this.marking = { labels: new Uint8Array(0), colours: [] };
    /** What changed splats were before, in order. @type {{to: Float32Array, size: number, splats: Uint32Array, before: Float32Array}[]} */
    this.undoings = [];
    this.shaded = { eye: "", count: 0 };
    gl.useProgram(this.program);
    for (const [unit, name] of ["geometry", "colours", "marks"].entries()) gl.uniform1i(this.at(name), unit);
    gl.useProgram(this.copy);
    gl.uniform1i(gl.getUniformLocation(this.copy, "from"), 3);
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const splat = gl.getAttribLocation(this.program, "splat");
    gl.enableVertexAttribArray(splat);
    gl.vertexAttribIPointer(splat, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(splat, 1);
    gl.disable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.floats = Boolean(gl.getExtension("EXT_color_buffer_half_float") || gl.getExtension("EXT_color_buffer_float"));
    gl.getExtension("EXT_float_blend");
  }

  /** Whether a processor draws instead of a GPU. */
  get software() {
    const info = this.gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(info ? this.gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : this.gl.getParameter(this.gl.RENDERER));
    return /swiftshader|llvmpipe|software|basic render/i.test(name);
  }

  /** @param {string} vertex @param {string} fragment */
  link(vertex, fragment) {
    const { gl } = this, program = /** @type {WebGLProgram} */ (gl.createProgram());
    for (const [type, source] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
      const shader = /** @type {WebGLShader} */ (gl.createShader(type));
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "");
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }

  /** @param {string} name */
  at(name) {
    return this.gl.getUniformLocation(this.program, name);
  }

  /** @param {number} unit @param {number} width @param {number} height @param {number} internal @param {number} type @param {ArrayBufferView | null} data */
  texture(unit, width, height, internal, type, data) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    this.textures[unit] ??= /** @type {WebGLTexture} */ (gl.createTexture());
    gl.bindTexture(gl.TEXTURE_2D, this.textures[unit]);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, gl.RGBA, type, data);
  }

  /** Takes all of the server's packed splats. @param {ArrayBuffer} packed */
  load(packed) {
    for (let at = 0, size = HEAD; size; size = this.missing()) {
      this.take(packed.slice(at, at + size), at === 0);
      at += size;
    }
  }

  /**
   * Takes the server's packed splats as they come, the largest contributions first.
   * @param {ReadableStream<Uint8Array>} stream @param {() => void} arrived called after each part of the stream
   */
  async receive(stream, arrived) {
    const reader = stream.getReader();
    let part = new Uint8Array(HEAD), filled = 0, head = true;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      for (let at = 0; at < value.length && part.length;) {
        const count = Math.min(part.length - filled, value.length - at);
        part.set(value.subarray(at, at + count), filled);
        at += count;
        filled += count;
        if (filled < part.length) break;
        this.take(part.buffer, head);
        [part, filled, head] = [new Uint8Array(this.missing()), 0, false];
      }
      arrived();
    }
    if (part.length) throw new TypeError("the splats are incomplete");
  }

  /** Bytes of the chunk of splats that comes next. */
  missing() {
    return 4 * Math.min(this.chunk ?? 0, this.n - this.arrived) * (BEFORE_COLOURS + 3 * (this.functions ?? 0));
  }

  /** Takes the head of the packed splats, or their next chunk. @param {ArrayBuffer} part @param {boolean} head */
  take(part, head) {
    if (head) return this.prepare(new Uint32Array(part));
    const { gl, arrived, means, opacities, covariances, harmonics, indices, slots, functions: K } = this;
    if (!means || !opacities || !covariances || !harmonics || !indices || !slots || !K) return;
    const count = part.byteLength / 4 / (BEFORE_COLOURS + 3 * K), values = new Float32Array(part);
    indices.set(new Uint32Array(part, 0, count), arrived);
    for (let i = arrived; i < arrived + count; i++) slots[indices[i]] = i;
    let at = count;
    for (const [to, size] of /** @type {[Float32Array, number][]} */ ([[means, 3], [opacities, 1], [covariances, 6], [harmonics, 3 * K]])) {
      to.set(values.subarray(at, at + size * count), size * arrived);
      at += size * count;
    }
    this.arrived += count;
    const row = Math.floor(arrived / ROW), rows = Math.ceil(this.arrived / ROW) - row;
    gl.activeTexture(gl.TEXTURE0);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, ROW * 3, rows, gl.RGBA, gl.FLOAT, this.geometry(row, rows));
    this.markRows(row, rows);
  }

  /** Makes space for a scene: splats, degree of the harmonics, whether opacities are compensated, splats of a chunk. @param {Uint32Array} head */
  prepare([n, degree, compensated, chunk]) {
    const { gl } = this, h = Math.max(1, Math.ceil(n / ROW));
    this.n = n;
    this.arrived = 0;
    this.chunk = chunk;
    this.rows = h;
    this.compensated = compensated;
    this.functions = (degree + 1) ** 2;
    this.means = new Float32Array(3 * n);
    this.opacities = new Float32Array(n);
    this.covariances = new Float32Array(6 * n);
    this.harmonics = new Float32Array(3 * this.functions * n);
    /** The number in the scene of each splat, and the reverse. */
    this.indices = new Uint32Array(n);
    this.slots = new Uint32Array(n);
    this.rgb = new Float32Array(ROW * h * 4);
    this.order = new Uint32Array(n);
    this.depths = new Float32Array(n);
    this.undoings = [];
    this.shaded = { eye: "", count: 0 };
    this.marking = { labels: new Uint8Array(0), colours: [] };
    this.texture(0, ROW * 3, h, gl.RGBA32F, gl.FLOAT, null);
    this.texture(1, ROW, h, gl.RGBA32F, gl.FLOAT, null);
    this.texture(2, ROW, h, gl.RGBA8, gl.UNSIGNED_BYTE, null);
  }

  /** Rows of the texture of shapes: centre, opacity, covariance. @param {number} from @param {number} rows */
  geometry(from, rows) {
    const { arrived, means, opacities, covariances } = this, texels = new Float32Array(ROW * 3 * rows * 4);
    if (!means || !opacities || !covariances) return texels;
    for (let i = from * ROW, o = 0; i < Math.min(arrived, (from + rows) * ROW); i++, o += 12) {
      for (let k = 0; k < 3; k++) texels[o + k] = means[3 * i + k];
      texels[o + 3] = opacities[i];
      for (let k = 0; k < 6; k++) texels[o + 4 + k] = covariances[6 * i + k];
    }
    return texels;
  }

  /**
   * Changes shapes and colours of splats, which have all arrived, by the server's packed arrays; what an earlier call changed becomes as
   * it was loaded.
   * @param {ArrayBuffer | null} packed
   */
  change(packed) {
    const { gl, means, covariances, harmonics, slots, functions: K } = this;
    if (!means || !covariances || !harmonics || !slots || !K) return;
    const touched = /** @type {Set<number>} */ (new Set());
    /** Takes numbers for splats, and keeps what they were. @param {Float32Array} to @param {number} size @param {Uint32Array} splats @param {Float32Array} values */
    const take = (to, size, splats, values) => {
      const before = new Float32Array(values.length);
      splats.forEach((i, k) => {
        before.set(to.subarray(size * i, size * (i + 1)), size * k);
        to.set(values.subarray(size * k, size * (k + 1)), size * i);
        if (to !== harmonics) touched.add(Math.floor(i / ROW));
      });
      return { to, size, splats, before };
    };
    for (const { to, size, splats, before } of this.undoings) take(to, size, splats, before);
    this.undoings = [];
    if (packed) {
      const [shapes, colours, degree] = new Uint32Array(packed, 0, 3);
      if ((degree + 1) ** 2 !== K) return;
      const own = (/** @type {Uint32Array} */ splats) => splats.map(i => slots[i]), floats = new Float32Array(packed, 12);
      const cut = own(new Uint32Array(packed, 12, shapes)), lit = own(new Uint32Array(packed, 12 + 40 * shapes, colours));
      this.undoings = [
        take(means, 3, cut, floats.subarray(shapes, 4 * shapes)),
        take(covariances, 6, cut, floats.subarray(4 * shapes, 10 * shapes)),
        take(harmonics, 3 * K, lit, floats.subarray(10 * shapes + colours)),
      ];
    }
    gl.activeTexture(gl.TEXTURE0);
    for (const row of touched) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, ROW * 3, 1, gl.RGBA, gl.FLOAT, this.geometry(row, 1));
    this.shaded.eye = "";
  }

  /** Colours splats by their labels; `null` is no mark, and an alpha of 255 hides. @param {Uint8Array} labels @param {(label: number) => number[] | null} colour */
  mark(labels, colour) {
    // A byte has so many values.
    this.marking = { labels, colours: Array.from({ length: 256 }, (_, label) => (label ? colour(label) : null)) };
    this.markRows(0, Math.ceil(this.arrived / ROW));
  }

  /** Marks rows of splats. @param {number} from @param {number} rows */
  markRows(from, rows) {
    const { gl, arrived, indices, marking: { labels, colours } } = this, marks = new Uint8Array(ROW * rows * 4);
    if (!indices || !rows) return;
    for (let i = from * ROW, o = 0; i < Math.min(arrived, (from + rows) * ROW); i++, o += 4) {
      const rgb = colours[labels[indices[i]]];
      if (rgb) marks.set([rgb[0], rgb[1], rgb[2], rgb[3] ?? HIGHLIGHT], o);
    }
    gl.activeTexture(gl.TEXTURE2);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, from, ROW, rows, gl.RGBA, gl.UNSIGNED_BYTE, marks);
  }

  /** Colours of the first splats as seen from a position. @param {number[]} eye @param {number} n */
  shade(eye, n) {
    const { means, rgb, harmonics, functions: K, gl, shaded } = this, from = shaded.eye === eye.join() ? shaded.count : 0;
    if (from >= n || !means || !rgb || !harmonics || !K) return;
    this.shaded = { eye: eye.join(), count: n };
    const B = new Float64Array(16);
    B[0] = 0.28209479;
    for (let i = from; i < n; i++) {
      if (K > 1) {
        let x = means[3 * i] - eye[0], y = means[3 * i + 1] - eye[1], z = means[3 * i + 2] - eye[2];
        const l = 1 / (Math.sqrt(x * x + y * y + z * z) || 1);
        x *= l; y *= l; z *= l;
        B[1] = -0.48860251 * y; B[2] = 0.48860251 * z; B[3] = -0.48860251 * x;
        if (K > 4) {
          const xx = x * x, yy = y * y, zz = z * z;
          B[4] = 1.0925484 * x * y; B[5] = -1.0925484 * y * z; B[6] = 0.31539157 * (2 * zz - xx - yy);
          B[7] = -1.0925484 * x * z; B[8] = 0.5462742 * (xx - yy);
          if (K > 9) {
            B[9] = -0.5900436 * y * (3 * xx - yy); B[10] = 2.8906114 * x * y * z; B[11] = -0.4570458 * y * (4 * zz - xx - yy);
            B[12] = 0.37317633 * z * (2 * zz - 3 * xx - 3 * yy); B[13] = -0.4570458 * x * (4 * zz - xx - yy);
            B[14] = 1.4453057 * z * (xx - yy); B[15] = -0.5900436 * x * (xx - 3 * yy);
          }
        }
      }
      for (let c = 0; c < 3; c++) {
        let v = 0.5;
        for (let k = 0; k < K; k++) v += B[k] * harmonics[3 * (K * i + k) + c];
        rgb[4 * i + c] = Math.max(v, 0);
      }
    }
    const row = Math.floor(from / ROW), rows = Math.ceil(n / ROW) - row;
    gl.activeTexture(gl.TEXTURE1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, ROW, rows, gl.RGBA, gl.FLOAT, rgb.subarray(4 * ROW * row, 4 * ROW * (row + rows)));
  }

  /** Orders the first splats from far to near, by counting 16-bit depths. @param {number[]} R @param {number[]} t @param {number} n */
  sort(R, t, n) {
    const { means, order, depths, gl } = this, last = 65535;
    if (!means || !order || !depths) return;
    let [low, high] = [Infinity, -Infinity];
    for (let i = 0; i < n; i++) {
      const z = R[6] * means[3 * i] + R[7] * means[3 * i + 1] + R[8] * means[3 * i + 2] + t[2];
      const depth = z > 0 ? Math.log(z) : -Infinity;
      depths[i] = depth;
      if (depth > -Infinity) {
        low = Math.min(low, depth);
        high = Math.max(high, depth);
      }
    }
    const count = new Uint32Array(last + 2), keys = new Uint16Array(n), s = last / (high - low || 1);
    for (let i = 0; i < n; i++) {
      keys[i] = depths[i] === -Infinity ? last : last - (depths[i] - low) * s;
      count[keys[i] + 1]++;
    }
    for (let k = 0; k <= last; k++) count[k + 1] += count[k];
    for (let i = 0; i < n; i++) order[count[keys[i]]++] = i;
    gl.bufferData(gl.ARRAY_BUFFER, order.subarray(0, n), gl.DYNAMIC_DRAW);
  }

  /** Draws a view with some splats at most, those that contribute most; the canvas gets the size of its camera. @param {View} view @param {number} [most] */
  draw(view, most = Infinity) {
    const { gl, canvas } = this, { camera, rotation, translation } = view, { width: w, height: h, fx, fy, cx, cy } = camera;
    if (canvas.width !== w || canvas.height !== h) {
      canvas.width = w;
      canvas.height = h;
    }
    const n = Math.min(this.arrived, most);
    this.rendered = n;
    this.shade(centreOf(view), n);
    this.sort(rotation, translation, n);
    gl.useProgram(this.program);
    if (this.floats) this.target(w, h);
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.uniformMatrix3fv(this.at("rotation"), true, rotation);
    gl.uniform3fv(this.at("translation"), translation);
    gl.uniform4f(this.at("focal"), fx, fy, cx, cy);
    gl.uniform2f(this.at("size"), w, h);
    gl.uniform1f(this.at("near"), NEAR);
    gl.uniform1i(this.at("compensated"), this.compensated ?? 0);
    gl.uniform4f(this.at("limits"), (-0.15 * w - cx) / fx, (1.15 * w - cx) / fx, (-0.15 * h - cy) / fy, (1.15 * h - cy) / fy);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, n);
    if (!this.floats) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy);
    gl.disable(gl.BLEND);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** A target of half floats: 8 bits would round at every layer. @param {number} w @param {number} h */
  target(w, h) {
    const { gl } = this;
    this.frame ??= gl.createFramebuffer();
    if (this.frameSize !== `${w}x${h}`) {
      this.texture(3, w, h, gl.RGBA16F, gl.HALF_FLOAT, null);
      this.frameSize = `${w}x${h}`;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.textures[3], 0);
  }

  /** Waits until everything is drawn. */
  finish() {
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}

export { HIDDEN };
