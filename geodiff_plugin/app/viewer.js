/* The browser's part of the page: the 3D view, the slider between image and depth, and clicks on both.
 *
 * Draws one depth map as a grid with plain WebGL 2, without a library (docs/contributing.md states why). Moving a
 * slider rebuilds the list of triangles; a static view uses no CPU.
 * Frame of the view: x right, y up, z towards the viewer, metres; the left camera is at the origin.
 */
(() => {
  "use strict";

  const FIELD_OF_VIEW = 0.8; // radians, vertical
  const SWING = { radians: 0.2, seconds: 7, times: 2 }; // the initial orbit
  const FRAME_MS = 33; // frame interval of the initial orbit, long enough for slow machines
  const MAX_SLOPE = 9; // tangent of 84 degrees: steeper triangles are depth edges and are not drawn
  const STEP_LIMITS = [0.01, 0.04]; // bounds of the depth step that MAX_SLOPE allows between pixels, relative to depth
  const PICK_PX = 14;
  const FADED = 0.35; // opacity of surfaces that connect the two sides of a depth edge
  const GRID_LINES = 10; // approximate number of grid lines across the scene
  const GRID_STEPS = [1, 2, 5];
  const LABEL_PX = 16; // distance of a label from its point
  const MAX_FIT_POINTS = 3000;

  const VERTEX = `#version 300 es
    uniform mat4 view; uniform float size;
    in vec3 position; in vec3 appearance; // texture coordinates, or a colour if plain
    out vec3 shade;
    void main() { gl_Position = view * vec4(position, 1.0); gl_PointSize = size; shade = appearance; }`;
  const FRAGMENT = `#version 300 es
    precision mediump float;
    uniform sampler2D image; uniform bool plain; uniform float opacity;
    in vec3 shade; out vec4 colour;
    void main() { colour = vec4(plain ? shade : texture(image, shade.xy).rgb, opacity); }`;

  let scene = null; // data of the result on display
  let marks = { points: [], segments: [] };

  /* ---- the data ---- */

  async function unpack(text) {
    const data = JSON.parse(text);
    const bytes = Uint8Array.from(atob(data.maps), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const maps = await new Response(stream).arrayBuffer();
    const count = data.w * data.h;
    return {
      ...data,
      z: Float32Array.from(new Uint16Array(maps, 0, count), (value) => value * data.unit),
      confidence: new Uint8Array(maps, 2 * count, count),
    };
  }

  /* ---- matrices, column-major as in WebGL ---- */

  const minus = (a, b) => a.map((value, i) => value - b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unitOf = (a) => a.map((value) => value / Math.hypot(...a));

  function product(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  }

  function viewOf(eye, target, aspect, distance) {
    const z = unitOf(minus(eye, target)), x = unitOf(cross([0, 1, 0], z)), y = cross(z, x);
    const pose = [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
      -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
    const near = distance / 50, far = distance * 50, f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const lens = [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, (2 * far * near) / (near - far), 0];
    return product(lens, pose);
  }

  function projected(view, p) {
    const row = (r) => view[r] * p[0] + view[4 + r] * p[1] + view[8 + r] * p[2] + view[12 + r];
    const w = row(3);
    return [row(0) / w, row(1) / w, w];
  }

  /* ---- the 3D view ---- */

  class Viewer {
    constructor(root) {
      this.root = root;
      this.canvas = root.querySelector("canvas");
      this.over = root.querySelector("svg");
      this.gl = this.canvas.getContext("webgl2", { antialias: true });
      if (!this.gl) {
        root.querySelector(".viewer-hint").textContent =
          "The 3D view needs WebGL 2, which this browser has disabled. All other tabs work.";
        return;
      }
      const gl = this.gl, program = (this.program = gl.createProgram());
      for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, text);
        gl.compileShader(shader);
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      this.names = Object.fromEntries(
        ["view", "size", "plain", "opacity"].map((name) => [name, gl.getUniformLocation(program, name)]));
      this.buffers = ["position", "appearance", "mesh", "faded", "points", "lines", "colours", "grid", "gridColours"].reduce(
        (all, name) => ({ ...all, [name]: gl.createBuffer() }), {});
      this.pointers = new Map();
      this.control = (name) => root.querySelector(`[name=${name}]`);
      this.listen();
      new ResizeObserver(() => this.request()).observe(this.canvas);
    }

    listen() {
      for (const name of ["confidence", "size", "points", "cameras", "grid"])
        this.control(name).addEventListener("input", () => {
          if (name === "confidence" && scene) this.select();
          this.showControls();
          this.request();
        });
      this.control("reset").addEventListener("click", () => this.resetView());
      this.control("full").addEventListener("click", () => toggleFull(this.root));
      this.showControls();
      const canvas = this.canvas;
      canvas.addEventListener("contextmenu", (event) => event.preventDefault()); // the right button moves
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        this.draggedPx = 0;
        this.swingFrom = null;
      });
      canvas.addEventListener("pointermove", (event) => this.drag(event));
      canvas.addEventListener("pointerup", (event) => {
        if (this.draggedPx < 6 && this.pointers.size === 1 && event.button === 0) this.pick(event);
        this.pointers.delete(event.pointerId);
      });
      canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
      canvas.addEventListener("wheel", (event) => {
        if (document.activeElement !== canvas && !isFull(this.root)) return; // the page scrolls instead
        event.preventDefault();
        this.zoom(Math.exp(event.deltaY / 800));
      }, { passive: false });
      canvas.addEventListener("keydown", (event) => {
        const rotations = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
        if (rotations[event.key] && event.shiftKey) this.pan(...rotations[event.key].map((step) => 400 * step));
        else if (rotations[event.key]) this.rotate(...rotations[event.key]);
        else if ("+-".includes(event.key)) this.zoom(event.key === "+" ? 0.9 : 1.1);
        else return;
        this.swingFrom = null;
        event.preventDefault();
      });
    }

    drag(event) {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const [x, y] = [event.clientX - before[0], event.clientY - before[1]];
      this.draggedPx += Math.abs(x) + Math.abs(y);
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (others.length) {
        const [ox, oy] = others[0][1];
        const lastSpan = Math.hypot(before[0] - ox, before[1] - oy);
        this.zoom(lastSpan / Math.max(1, Math.hypot(event.clientX - ox, event.clientY - oy)));
        this.pan(x / 2, y / 2); // each of two fingers moves the view by half
      } else if (event.shiftKey || event.buttons & 6) this.pan(x, y);
      else this.rotate(-x / 200, y / 200);
    }

    rotate(yaw, pitch) {
      this.yaw += yaw;
      this.pitch = Math.min(1.4, Math.max(-1.4, this.pitch + pitch));
      this.request();
    }

    pan(x, y) { // moves the target, so that the point below the pointer stays below it
      const metres = (2 * this.distance * Math.tan(FIELD_OF_VIEW / 2)) / Math.max(1, this.canvas.clientHeight);
      const { right, up } = this.axes();
      this.target = this.target.map((value, i) => value - metres * (x * right[i] - y * up[i]));
      this.request();
    }

    axes() { // unit vectors from the target to the eye, to the right and up on the screen
      const { yaw, pitch } = this;
      const back = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
      const right = unitOf(cross([0, 1, 0], back));
      return { back, right, up: cross(back, right) };
    }

    showControls() {
      this.root.querySelector(".of-points").hidden = !this.control("points").checked;
      this.control("confidence-value").textContent = `${this.control("confidence").value} %`;
      this.control("size-value").textContent = this.control("size").value;
    }

    zoom(factor) {
      this.distance = Math.min(this.farthest, Math.max(this.farthest / 200, this.distance * factor));
      this.request();
    }

    load() {
      if (!this.gl) return;
      if (!scene) {
        this.ready = false;
        this.kept = [];
        this.over.innerHTML = "";
        this.gl.clear(this.gl.COLOR_BUFFER_BIT | this.gl.DEPTH_BUFFER_BIT);
        this.showEmpty();
        return;
      }
      const { w, h, stride, fx, fy, cx, cy, z, width, height } = scene, gl = this.gl;
      this.positions = new Float32Array(3 * w * h);
      const coordinates = new Float32Array(3 * w * h);
      for (let j = 0, k = 0; j < h; j++)
        for (let i = 0; i < w; i++, k++) {
          this.positions.set([((i * stride - cx) / fx) * z[k], (-(j * stride - cy) / fy) * z[k], -z[k]], 3 * k);
          coordinates.set([(i * stride + 0.5) / width, (j * stride + 0.5) / height, 0], 3 * k);
        }
      const lines = scene.cameras.flatMap(({ edges }) => edges.flat());
      const colours = scene.cameras.flatMap(({ edges, colour }) => edges.flatMap(() => colour));
      this.lineCount = lines.length / 3;
      this.fill("position", this.positions);
      this.fill("appearance", coordinates);
      this.fill("lines", lines);
      this.fill("colours", colours);
      const image = new Image();
      image.onload = () => {
        gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
        gl.generateMipmap(gl.TEXTURE_2D);
        this.ready = true;
        this.request();
      };
      image.src = scene.image;
      this.select();
      this.makeGrid();
      this.resetView();
    }

    makeGrid() { // on the floor: below nearly all points
      const points = this.sample(scene.z.keys());
      const lines = [], colours = [];
      if (points.length) {
        const [low, high] = [0.02, 0.98].map((fraction) => [0, 1, 2].map((axis) => quantile(points, axis, fraction)));
        const size = Math.max(high[0] - low[0], high[2] - low[2]);
        const power = 10 ** Math.floor(Math.log10(size / GRID_LINES));
        this.gridStep = power * (GRID_STEPS.find((step) => (step * power * GRID_LINES) >= size) || 10);
        const [x0, x1] = [low[0], high[0]].map((value) => value / this.gridStep);
        const z0 = Math.floor(low[2] / this.gridStep), [from, to] = [Math.floor(x0), Math.ceil(x1)];
        const at = (i, k) => [i * this.gridStep, low[1], k * this.gridStep];
        for (let i = from; i <= to; i++) lines.push(...at(i, z0), ...at(i, 0));
        for (let k = z0; k <= 0; k++) lines.push(...at(from, k), ...at(to, k));
        lines.forEach(() => colours.push(0.5));
      }
      this.gridCount = lines.length / 3;
      const step = this.gridStep >= 1 ? `${+this.gridStep.toPrecision(2)} m` : `${+(100 * this.gridStep).toPrecision(2)} cm`;
      this.control("grid-value").textContent = points.length ? step : "";
      this.fill("grid", lines);
      this.fill("gridColours", colours);
    }

    fill(name, values) {
      this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffers[name]);
      this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(values), this.gl.STATIC_DRAW);
    }

    sample(pixels) { // at most MAX_FIT_POINTS of the pixels that have a depth, as points
      const known = [...pixels].filter((k) => scene.z[k] > 0);
      const every = Math.max(1, Math.floor(known.length / MAX_FIT_POINTS));
      return known.filter((_, n) => n % every === 0).map((k) => this.point(k));
    }

    showEmpty() { // states why nothing is drawn
      const empty = this.root.querySelector(".viewer-empty");
      empty.hidden = this.kept.length > 0;
      if (!empty.hidden)
        empty.textContent = !scene ? "There is no result to show."
          : scene.z.some((z) => z > 0)
            ? `No pixel has a confidence of at least ${this.control("confidence").value} %, so nothing is drawn. Lower the minimum confidence to see the uncertain surface.`
            : "No pixel has a usable depth. The banner above states the reason.";
    }

    select() { // triangles and points of pixels with at least the minimum confidence
      const { w, h, z, confidence, stride, fx } = scene, gl = this.gl;
      const minimum = 2.55 * this.control("confidence").value;
      const limit = stride * Math.min(STEP_LIMITS[1], Math.max(STEP_LIMITS[0], MAX_SLOPE / fx));
      const keeps = (k) => z[k] > 0 && confidence[k] >= minimum;
      const points = [], mesh = [], faded = [];
      for (let j = 0, k = 0; j < h; j++)
        for (let i = 0; i < w; i++, k++) {
          if (!keeps(k)) continue;
          points.push(k);
          if (i + 1 === w || j + 1 === h || !keeps(k + 1) || !keeps(k + w) || !keeps(k + w + 1)) continue;
          const four = [z[k], z[k + 1], z[k + w], z[k + w + 1]];
          const near = Math.min(...four);
          const list = Math.max(...four) - near > 2 * limit * near ? faded : mesh;
          list.push(k, k + w, k + 1, k + 1, k + w, k + w + 1);
        }
      this.kept = points;
      this.counts = { mesh: mesh.length, faded: faded.length, points: points.length };
      for (const [name, list] of [["mesh", mesh], ["faded", faded], ["points", points]]) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[name]);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(list), gl.STATIC_DRAW);
      }
      const percentage = Math.round((100 * points.length) / (w * h));
      this.root.querySelector(".viewer-count").textContent = `${percentage} % of the pixels`;
      this.showEmpty();
    }

    resetView() { // look along the left camera's axis, with cameras and the central 90 % of the points in the frame
      if (!scene) return;
      let sample = this.sample(this.kept.length ? this.kept : scene.z.keys());
      if (!sample.length) sample = [[0, 0, -1]];
      const at = (axis, fraction) => quantile(sample, axis, fraction);
      const low = [0, 1, 2].map((axis) => at(axis, 0.05)), high = [0, 1, 2].map((axis) => at(axis, 0.95));
      const central = sample.filter((p) => p.every((x, axis) => x >= low[axis] && x <= high[axis]));
      if (this.control("cameras").checked) central.push(...scene.cameras.flatMap(({ edges }) => edges));
      this.target = [...[0, 1].map((axis) => (at(axis, 0.05) + at(axis, 0.95)) / 2), at(2, 0.5)];
      [this.yaw, this.pitch] = [0, 0.12];
      this.farthest = 20 * Math.hypot(...this.target);
      let [near, far] = [0.05 * Math.hypot(...this.target), this.farthest];
      for (let n = 0; n < 30; n++) {
        this.distance = (near + far) / 2;
        const view = this.view();
        const fits = central.every((p) => {
          const [x, y, w] = projected(view, p);
          return w > 0 && Math.abs(x) < 0.96 && Math.abs(y) < 0.96;
        });
        if (fits) far = this.distance; else near = this.distance;
      }
      this.distance = far;
      const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.swingFrom = reducedMotion ? null : performance.now();
      this.request();
    }

    point(k) { return [this.positions[3 * k], this.positions[3 * k + 1], this.positions[3 * k + 2]]; }

    view() {
      const { distance, target } = this, direction = this.axes().back;
      const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
      return viewOf(target.map((x, i) => x + distance * direction[i]), target, aspect, distance);
    }

    request() {
      if (this.requested) return;
      this.requested = true;
      requestAnimationFrame((now) => { this.requested = false; this.draw(now); });
    }

    draw(now) {
      if (!this.ready || !this.canvas.isConnected || !this.canvas.clientWidth) return;
      let again = false;
      if (this.swingFrom !== null) {
        const cycles = (now - this.swingFrom) / 1000 / SWING.seconds;
        again = cycles < SWING.times;
        this.yaw = again ? SWING.radians * Math.sin(2 * Math.PI * cycles) : 0;
        if (!again) this.swingFrom = null;
      }
      const gl = this.gl, canvas = this.canvas, pixelRatio = Math.min(2, devicePixelRatio);
      canvas.width = Math.round(canvas.clientWidth * pixelRatio);
      canvas.height = Math.round(canvas.clientHeight * pixelRatio);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0.09, 0.1, 0.12, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(this.program);
      const view = this.view(), asPoints = this.control("points").checked;
      gl.uniformMatrix4fv(this.names.view, false, view);
      gl.uniform1f(this.names.size, pixelRatio * this.control("size").value);
      gl.uniform1f(this.names.opacity, 1);
      this.attributes("position", "appearance", 0);
      this.drawElements(asPoints ? "points" : "mesh", asPoints ? gl.POINTS : gl.TRIANGLES);
      if (this.control("cameras").checked) this.drawLines("lines", "colours", this.lineCount);
      if (this.control("grid").checked) this.drawLines("grid", "gridColours", this.gridCount);
      if (!asPoints) { // last, over what is behind the holes
        gl.enable(gl.BLEND);
        gl.uniform1f(this.names.opacity, FADED);
        this.attributes("position", "appearance", 0);
        this.drawElements("faded", gl.TRIANGLES);
        gl.disable(gl.BLEND);
      }
      this.drawMarks(view);
      if (again) setTimeout(() => this.request(), FRAME_MS);
    }

    drawElements(name, kind) {
      this.gl.bindBuffer(this.gl.ELEMENT_ARRAY_BUFFER, this.buffers[name]);
      this.gl.drawElements(kind, this.counts[name], this.gl.UNSIGNED_INT, 0);
    }

    drawLines(position, colours, count) {
      this.attributes(position, colours, 1);
      this.gl.drawArrays(this.gl.LINES, 0, count);
    }

    attributes(position, appearance, plain) {
      const gl = this.gl;
      for (const [attribute, buffer] of [["position", position], ["appearance", appearance]]) {
        const index = gl.getAttribLocation(this.program, attribute);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[buffer]);
        gl.enableVertexAttribArray(index);
        gl.vertexAttribPointer(index, 3, gl.FLOAT, false, 0, 0);
      }
      gl.uniform1i(this.names.plain, plain);
    }

    drawMarks(view) {
      const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
      const pixels = marks.points.map(({ at }) => {
        const [x, y, depth] = projected(view, [at[0], -at[1], -at[2]]);
        return depth > 0 ? [((x + 1) / 2) * w, ((1 - y) / 2) * h] : null;
      });
      this.over.innerHTML = drawnMarks(pixels);
    }

    pick(event) {
      if (!scene) return;
      const box = this.canvas.getBoundingClientRect(), view = this.view();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let [best, nearest] = [-1, Infinity];
      for (const k of this.kept) {
        const [px, py, depth] = projected(view, this.point(k));
        const offset = Math.hypot(((px + 1) / 2) * box.width - x, ((1 - py) / 2) * box.height - y);
        if (depth <= 0 || offset > PICK_PX) continue;
        const cost = depth * (1 + 0.01 * offset); // nearest to the camera first, then to the pointer
        if (cost < nearest) [best, nearest] = [k, cost];
      }
      if (best >= 0) send((best % scene.w) * scene.stride, Math.floor(best / scene.w) * scene.stride);
    }
  }

  /* ---- marks of points and distances, in the 3D view and on images ---- */

  function drawnMarks(pixels, unit = 1) { // SVG; unit is the length of a screen pixel
    const middle = pixels.filter(Boolean).reduce(([x, y], p, _, all) => [x + p[0] / all.length, y + p[1] / all.length], [0, 0]);
    const away = (p, from) => { // from p, a label's distance away from another point
      const [x, y] = [p[0] - from[0], p[1] - from[1]], length = Math.hypot(x, y);
      return length < unit ? [p[0], p[1] - LABEL_PX * unit]
        : [p[0] + (x / length) * LABEL_PX * unit, p[1] + (y / length) * LABEL_PX * unit];
    };
    const label = ([x, y], text) => `<text x="${x}" y="${y}" dy="0.35em" font-size="${14 * unit}">${text}</text>`;
    const partner = (n) => pixels[n ^ 1] || middle;
    const parts = marks.segments.map(({ ends: [a, b], text }) => {
      if (!pixels[a] || !pixels[b]) return "";
      const [[x1, y1], [x2, y2]] = [pixels[a], pixels[b]], length = Math.hypot(x2 - x1, y2 - y1) || 1;
      // Next to the segment, far enough that the text, which is wider than high, covers neither line nor points.
      const [nx, ny] = [(y2 - y1) / length, -(x2 - x1) / length], side = ny > 0 ? -1 : 1;
      const gap = side * unit * (LABEL_PX + Math.abs(nx) * 4.5 * text.length);
      const line = (kind) => `<line class="${kind}" x1="${x1}" y1="${y1}" x2="${x2}" y2="${y2}"/>`;
      return line("halo") + line("core") + label([(x1 + x2) / 2 + gap * nx, (y1 + y2) / 2 + gap * ny], text);
    });
    pixels.forEach((p, n) => {
      if (p) parts.push(`<circle cx="${p[0]}" cy="${p[1]}" r="${5 * unit}"/>`, label(away(p, partner(n)), marks.points[n].name));
    });
    return parts.join("");
  }

  const quantile = (points, axis, fraction) => {
    const sorted = points.map((p) => p[axis]).sort((a, b) => a - b);
    return sorted[Math.round(fraction * (sorted.length - 1))];
  };

  /* ---- full screen ---- */

  const isFull = (root) => root.classList.contains("filled");

  function toggleFull(root, on = !isFull(root)) {
    root.classList.toggle("filled", on);
    root.querySelector("[name=full]").textContent = on ? "Close" : root.matches(".viewer") ? "Full screen" : "Enlarge";
    if (on) root.requestFullscreen?.().catch(() => {}); // a phone without it fills the window by style
    else if (document.fullscreenElement === root) document.exitFullscreen();
  }

  const closeFull = () => document.querySelectorAll(".filled").forEach((root) => toggleFull(root, false));
  document.addEventListener("fullscreenchange", () => { if (!document.fullscreenElement) closeFull(); });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") closeFull(); });

  /* ---- the 2D images ---- */

  function pixelAt(image, event, width, height) {
    const box = image.getBoundingClientRect();
    const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    if (u < 0 || v < 0 || u >= 1 || v >= 1) return null;
    return [Math.floor(u * width), Math.floor(v * height), u, v];
  }

  function send(x, y) { // to the server: gradio reads this pixel when the hidden button is pressed
    window.geodiffPicked = `${x}, ${y}`;
    document.getElementById("pick").click();
  }

  const endsField = () => document.querySelector("#ends input, #ends textarea");
  const endsOf = (text) => (text.match(/-?\d+(\.\d+)?/g) || []).slice(0, 4).map(Number);

  function tapEnd(x, y) { // a third tap starts over
    const field = endsField(), before = endsOf(field.value);
    field.value = [...(before.length === 2 ? before : []), x, y].join(", ");
    field.dispatchEvent(new Event("input", { bubbles: true }));
    drawImageMarks();
  }

  /** An image that is clicked, enlarged by buttons, wheel or two fingers, and moved by one when enlarged. */
  class Zoom {
    constructor(root) {
      this.root = root;
      this.inner = root.querySelector(".zoom-inner");
      this.image = root.querySelector("img");
      this.stage = root.querySelector(".zoom-stage");
      [this.scale, this.x, this.y] = [1, 0, 0];
      this.pointers = new Map();
      for (const [name, factor] of [["in", 1.5], ["out", 1 / 1.5]])
        root.querySelector(`[name=${name}]`).addEventListener("click", () => this.zoom(factor));
      root.querySelector("[name=full]").addEventListener("click", () => toggleFull(root));
      this.stage.addEventListener("pointerdown", (event) => {
        if (!this.pointers.size) this.movedPx = 0;
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      });
      this.stage.addEventListener("pointermove", (event) => this.drag(event));
      for (const name of ["pointerup", "pointercancel", "pointerleave"])
        this.stage.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
      this.stage.addEventListener("click", (event) => { if (this.movedPx < 8) this.pick(event); });
      this.stage.addEventListener("wheel", (event) => {
        if (!isFull(root) && !event.ctrlKey) return; // the page scrolls instead
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 500), event.clientX, event.clientY);
      }, { passive: false });
    }

    drag(event) {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const [x, y] = [event.clientX - before[0], event.clientY - before[1]];
      this.movedPx += Math.abs(x) + Math.abs(y);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
      if (others.length) {
        const [ox, oy] = others[0][1];
        const span = (p) => Math.max(1, Math.hypot(p[0] - ox, p[1] - oy));
        this.zoom(span([event.clientX, event.clientY]) / span(before), (ox + event.clientX) / 2, (oy + event.clientY) / 2);
      } else if (this.scale > 1) this.move(x, y);
    }

    zoom(factor, clientX, clientY) { // keeps the point at these coordinates, by default the middle
      const box = this.stage.getBoundingClientRect();
      const [px, py] = [(clientX ?? box.left + box.width / 2) - box.left, (clientY ?? box.top + box.height / 2) - box.top];
      const scale = Math.min(12, Math.max(1, this.scale * factor));
      this.x = px - ((px - this.x) * scale) / this.scale;
      this.y = py - ((py - this.y) * scale) / this.scale;
      this.scale = scale;
      this.move(0, 0);
    }

    move(x, y) { // keeps the stage covered
      const limit = (value, side) => Math.min(0, Math.max(side * (1 - this.scale), value));
      this.x = limit(this.x + x, this.stage.clientWidth);
      this.y = limit(this.y + y, this.stage.clientHeight);
      this.inner.style.transform = `translate(${this.x}px, ${this.y}px) scale(${this.scale})`;
      this.stage.style.touchAction = this.scale > 1 ? "none" : "pan-y";
      drawImageMarks();
    }

    pick(event) {
      const ends = this.root.dataset.picked === "ends";
      if (!ends && !scene) return;
      const [width, height] = ends ? [this.root.dataset.width, this.root.dataset.height].map(Number) : [scene.width, scene.height];
      const at = pixelAt(this.image, event, width, height);
      if (at) (ends ? tapEnd : send)(at[0], at[1]);
    }
  }

  function compare(root) {
    const range = root.querySelector("input"), readout = root.querySelector(".readout");
    const images = root.querySelector(".images");
    const show = () => root.style.setProperty("--split", range.value);
    range.addEventListener("input", show);
    images.addEventListener("pointerleave", () => { readout.hidden = true; });
    images.addEventListener("pointermove", (event) => {
      const at = scene && pixelAt(images, event, scene.width, scene.height);
      if (!at) return;
      const clamp = (n, limit) => Math.min(limit, Math.round(n / scene.stride));
      const z = scene.z[clamp(at[1], scene.h - 1) * scene.w + clamp(at[0], scene.w - 1)];
      readout.textContent = z > 0 ? `${z.toFixed(2)} m` : "depth edge or too far";
      readout.hidden = false;
      readout.style.left = `${Math.min(88, 100 * at[2])}%`;
      readout.style.top = `${100 * at[3]}%`;
    });
    images.addEventListener("click", (event) => {
      const at = scene && pixelAt(images, event, scene.width, scene.height);
      if (at) send(at[0], at[1]);
    });
    show();
  }

  function drawImageMarks() {
    document.querySelectorAll("svg.marks").forEach((svg) => {
      const root = svg.closest(".zoom"), ends = root?.dataset.picked === "ends";
      if (!ends && !scene) { svg.innerHTML = ""; return; }
      const size = ends ? [root.dataset.width, root.dataset.height].map(Number) : [scene.width, scene.height];
      svg.setAttribute("viewBox", `-0.5 -0.5 ${size[0]} ${size[1]}`);
      const unit = size[0] / (svg.getBoundingClientRect().width || size[0]);
      if (ends) {
        const [x1, y1, x2, y2] = endsOf(endsField()?.value || "");
        const both = x2 !== undefined && y2 !== undefined;
        const line = both ? ["halo", "core"].map((kind) =>
          `<line class="${kind}" x1="${x1}" y1="${y1}" x2="${x2}" y2="${y2}"/>`).join("") : "";
        const dots = [[x1, y1], ...(both ? [[x2, y2]] : [])].filter(([x, y]) => x !== undefined && y !== undefined);
        svg.innerHTML = line + dots.map(([x, y]) => `<circle cx="${x}" cy="${y}" r="${5 * unit}"/>`).join("");
      } else svg.innerHTML = drawnMarks(marks.points.map(({ px }) => px), unit);
    });
  }

  /* ---- updates of gradio's panels ---- */

  const viewers = new WeakMap();
  const viewerOf = (root) => {
    if (!viewers.has(root)) { viewers.set(root, new Viewer(root)); viewers.get(root).load(); }
    return viewers.get(root);
  };
  let dataText = "", marksText = "";

  async function scan() {
    const data = document.querySelector("#scene-data .page-data")?.textContent || "";
    if (data !== dataText) {
      dataText = data;
      const unpacked = data ? await unpack(data) : null;
      if (data !== dataText) return; // a later result arrived meanwhile
      scene = unpacked;
      document.querySelectorAll(".viewer").forEach((root) => viewerOf(root).load());
      drawImageMarks();
    }
    const text = document.querySelector("#marks-data .page-data")?.textContent || "";
    if (text !== marksText) {
      marksText = text;
      marks = text ? JSON.parse(text) : { points: [], segments: [] };
      document.querySelectorAll(".viewer").forEach((root) => viewerOf(root).request());
      drawImageMarks();
    }
    document.querySelectorAll(".viewer").forEach(viewerOf);
    document.querySelectorAll("img[data-photo]").forEach((image) => {
      const source = scene ? scene.image : "";
      if (image.getAttribute("src") !== source) image.src = source;
    });
    document.querySelectorAll(":is(.compare, .zoom):not([data-on])").forEach((root) => {
      root.dataset.on = "yes";
      if (root.matches(".compare")) compare(root); else new Zoom(root);
      new ResizeObserver(drawImageMarks).observe(root);
    });
  }

  document.addEventListener("input", (event) => { if (event.target.closest?.("#ends")) drawImageMarks(); });

  /* ---- accessible names that gradio leaves without context ---- */

  function nameAfter(root, field) {
    root.querySelectorAll("button[aria-label]").forEach((button) => {
      if (button.title === "common.upload") button.title = "Upload"; // gradio does not translate this one
      const own = button.getAttribute("aria-label").replace("common.upload", "Upload");
      if (field && !own.startsWith(field)) button.setAttribute("aria-label", `${field}: ${own}`);
    });
  }

  function nameFields() {
    document.querySelectorAll("svg:not([aria-hidden])").forEach((icon) => icon.setAttribute("aria-hidden", "true"));
    document.querySelectorAll("#examples button").forEach((button) =>
      button.setAttribute("aria-label", `Run the example ${button.textContent.trim()}`));
    document.querySelectorAll("#left, #right, #calibration").forEach((root) =>
      nameAfter(root, root.querySelector("label")?.textContent.trim()));
    document.querySelectorAll("#form input[type=range]").forEach((slider) => {
      const root = slider.closest(".block");
      nameAfter(root, root.querySelector("[data-testid=block-info]")?.textContent.trim());
    });
  }

  let due = false;
  const soon = () => {
    if (due) return;
    due = true;
    setTimeout(() => { due = false; nameFields(); scan(); }, 100);
  };
  const foreign = ({ target }) => !target.closest?.(".viewer, .compare, .zoom"); // ignore changes made by this script
  new MutationObserver((changes) => { if (changes.some(foreign)) soon(); })
    .observe(document.documentElement, { childList: true, subtree: true });
  soon();
})();
