/* What the page draws in the browser: the 3D view, the slider between photograph and depth, and clicks on them.
 *
 * It draws one depth map as a grid, which the graphics card does by itself, so there is no library: a click
 * on a slider's value makes a new list of triangles, and a still view costs nothing.
 * Frame of the view: x right, y up, z towards the viewer, metres; the left camera is at the origin.
 */
(() => {
  "use strict";

  const FIELD_OF_VIEW = 0.8; // radians, vertical
  const SWING = { radians: 0.2, seconds: 7, times: 2 }; // the slow turn at first
  const FRAME_MS = 33; // of the slow turn, so that a weak machine is not busy with it
  const STEEPEST = 9; // tangent of 84 degrees: a steeper surface is an edge, which would look like rubber
  const STEP = [0.01, 0.04]; // bounds of a step from pixel to pixel that this may allow, as a share of depth
  const PICK_PX = 14;
  const MOST_FOR_FIT = 3000;

  const VERTEX = `#version 300 es
    uniform mat4 view; uniform float size;
    in vec3 place; in vec3 look;
    out vec3 seen;
    void main() { gl_Position = view * vec4(place, 1.0); gl_PointSize = size; seen = look; }`;
  const FRAGMENT = `#version 300 es
    precision mediump float;
    uniform sampler2D photograph; uniform bool plain;
    in vec3 seen; out vec4 colour;
    void main() { colour = plain ? vec4(seen, 1.0) : vec4(texture(photograph, seen.xy).rgb, 1.0); }`;

  let scene = null; // of the result that is shown
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
      sure: new Uint8Array(maps, 2 * count, count),
    };
  }

  /* ---- matrices, by columns as WebGL has them ---- */

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
    const place = [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
      -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
    const near = distance / 50, far = distance * 50, f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const lens = [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, (2 * far * near) / (near - far), 0];
    return product(lens, place);
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
          "This browser shows no 3D (WebGL 2 is off). The other tabs have everything else.";
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
        ["view", "size", "plain"].map((name) => [name, gl.getUniformLocation(program, name)]));
      this.buffers = ["place", "look", "mesh", "points", "lines", "colours"].reduce(
        (all, name) => ({ ...all, [name]: gl.createBuffer() }), {});
      this.pointers = new Map();
      this.control = (name) => root.querySelector(`[name=${name}]`);
      this.listen();
      new ResizeObserver(() => this.request()).observe(this.canvas);
    }

    listen() {
      for (const name of ["confidence", "size", "points", "cameras"])
        this.control(name).addEventListener("input", () => {
          if (name === "confidence") this.choose();
          this.request();
        });
      this.control("reset").addEventListener("click", () => this.begin());
      const canvas = this.canvas;
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        this.moved = 0;
        this.swingFrom = null;
      });
      canvas.addEventListener("pointermove", (event) => this.drag(event));
      canvas.addEventListener("pointerup", (event) => {
        if (this.moved < 6 && this.pointers.size === 1) this.pick(event);
        this.pointers.delete(event.pointerId);
      });
      canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
      canvas.addEventListener("wheel", (event) => {
        if (document.activeElement !== canvas) return; // else a page could not be scrolled past
        event.preventDefault();
        this.zoom(Math.exp(event.deltaY / 800));
      }, { passive: false });
      canvas.addEventListener("keydown", (event) => {
        const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
        if (turns[event.key]) this.turn(...turns[event.key]);
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
      this.moved += Math.abs(x) + Math.abs(y);
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (others.length) {
        const [ox, oy] = others[0][1];
        const was = Math.hypot(before[0] - ox, before[1] - oy);
        this.zoom(was / Math.max(1, Math.hypot(event.clientX - ox, event.clientY - oy)));
      } else this.turn(-x / 200, y / 200);
    }

    turn(yaw, pitch) {
      this.yaw += yaw;
      this.pitch = Math.min(1.4, Math.max(-1.4, this.pitch + pitch));
      this.request();
    }

    zoom(factor) {
      this.distance = Math.min(this.farthest, Math.max(this.farthest / 200, this.distance * factor));
      this.request();
    }

    load() {
      if (!this.gl || !scene) return;
      const { w, h, stride, fx, fy, cx, cy, z, width, height } = scene, gl = this.gl;
      this.places = new Float32Array(3 * w * h);
      const looks = new Float32Array(3 * w * h);
      for (let j = 0, k = 0; j < h; j++)
        for (let i = 0; i < w; i++, k++) {
          this.places.set([((i * stride - cx) / fx) * z[k], (-(j * stride - cy) / fy) * z[k], -z[k]], 3 * k);
          looks.set([(i * stride + 0.5) / width, (j * stride + 0.5) / height, 0], 3 * k);
        }
      const lines = scene.cameras.flatMap(({ edges }) => edges.flat());
      const colours = scene.cameras.flatMap(({ edges, colour }) => edges.flatMap(() => colour));
      this.lineCount = lines.length / 3;
      for (const [name, values] of [["place", this.places], ["look", looks],
        ["lines", new Float32Array(lines)], ["colours", new Float32Array(colours)]]) {
        gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
        gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      }
      const picture = new Image();
      picture.onload = () => {
        gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        gl.generateMipmap(gl.TEXTURE_2D);
        this.ready = true;
        this.request();
      };
      picture.src = scene.photograph;
      this.choose();
      this.begin();
    }

    choose() { // the triangles and points of pixels that are sure enough
      const { w, h, z, sure, stride, fx } = scene, gl = this.gl;
      const least = 2.55 * this.control("confidence").value;
      const limit = stride * Math.min(STEP[1], Math.max(STEP[0], STEEPEST / fx));
      const keeps = (k) => z[k] > 0 && sure[k] >= least;
      const points = [], mesh = [];
      for (let j = 0, k = 0; j < h; j++)
        for (let i = 0; i < w; i++, k++) {
          if (!keeps(k)) continue;
          points.push(k);
          if (i + 1 === w || j + 1 === h || !keeps(k + 1) || !keeps(k + w) || !keeps(k + w + 1)) continue;
          const four = [z[k], z[k + 1], z[k + w], z[k + w + 1]];
          const near = Math.min(...four);
          if (Math.max(...four) - near > 2 * limit * near) continue;
          mesh.push(k, k + w, k + 1, k + 1, k + w, k + w + 1);
        }
      this.kept = points;
      this.counts = { mesh: mesh.length, points: points.length };
      for (const [name, list] of [["mesh", mesh], ["points", points]]) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[name]);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(list), gl.STATIC_DRAW);
      }
      const share = Math.round((100 * points.length) / (w * h));
      this.root.querySelector(".viewer-count").textContent = `${share} % of the pixels`;
    }

    begin() { // from the left camera's side, the central 90 % of the points in the frame
      const every = Math.max(1, Math.floor(this.kept.length / MOST_FOR_FIT));
      let sample = this.kept.filter((_, n) => n % every === 0).map((k) => this.point(k));
      if (!sample.length) sample = [[0, 0, -1]];
      const sorted = [0, 1, 2].map((axis) => sample.map((p) => p[axis]).sort((a, b) => a - b));
      const at = (axis, share) => sorted[axis][Math.round(share * (sample.length - 1))];
      const central = sample.filter((p) => p.every((x, axis) => x >= at(axis, 0.05) && x <= at(axis, 0.95)));
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
      const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.swingFrom = still ? null : performance.now();
      this.request();
    }

    point(k) { return [this.places[3 * k], this.places[3 * k + 1], this.places[3 * k + 2]]; }

    view() {
      const { yaw, pitch, distance, target } = this;
      const away = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
      const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
      return viewOf(target.map((x, i) => x + distance * away[i]), target, aspect, distance);
    }

    request() {
      if (this.waits) return;
      this.waits = true;
      requestAnimationFrame((now) => { this.waits = false; this.draw(now); });
    }

    draw(now) {
      if (!this.ready || !this.canvas.isConnected || !this.canvas.clientWidth) return;
      let again = false;
      if (this.swingFrom !== null) {
        const turns = (now - this.swingFrom) / 1000 / SWING.seconds;
        again = turns < SWING.times;
        this.yaw = again ? SWING.radians * Math.sin(2 * Math.PI * turns) : 0;
        if (!again) this.swingFrom = null;
      }
      const gl = this.gl, canvas = this.canvas, sharp = Math.min(2, devicePixelRatio);
      canvas.width = Math.round(canvas.clientWidth * sharp);
      canvas.height = Math.round(canvas.clientHeight * sharp);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0.09, 0.1, 0.12, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(this.program);
      const view = this.view(), asPoints = this.control("points").checked;
      gl.uniformMatrix4fv(this.names.view, false, view);
      gl.uniform1f(this.names.size, sharp * this.control("size").value);
      this.attributes("place", "look", 0);
      const what = asPoints ? "points" : "mesh";
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[what]);
      gl.drawElements(asPoints ? gl.POINTS : gl.TRIANGLES, this.counts[what], gl.UNSIGNED_INT, 0);
      if (this.control("cameras").checked) {
        this.attributes("lines", "colours", 1);
        gl.drawArrays(gl.LINES, 0, this.lineCount);
      }
      this.drawMarks(view);
      if (again) setTimeout(() => this.request(), FRAME_MS);
    }

    attributes(place, look, plain) {
      const gl = this.gl;
      for (const [attribute, buffer] of [["place", place], ["look", look]]) {
        const index = gl.getAttribLocation(this.program, attribute);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[buffer]);
        gl.enableVertexAttribArray(index);
        gl.vertexAttribPointer(index, 3, gl.FLOAT, false, 0, 0);
      }
      gl.uniform1i(this.names.plain, plain);
    }

    drawMarks(view) {
      const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
      const places = marks.points.map(({ at }) => {
        const [x, y, depth] = projected(view, [at[0], -at[1], -at[2]]);
        return depth > 0 ? [((x + 1) / 2) * w, ((1 - y) / 2) * h] : null;
      });
      const parts = marks.segments.map(({ ends: [a, b], text }) => {
        if (!places[a] || !places[b]) return "";
        const [[x1, y1], [x2, y2]] = [places[a], places[b]];
        const line = `<line x1="${x1}" y1="${y1}" x2="${x2}" y2="${y2}"/>`;
        return `${line}<text x="${(x1 + x2) / 2}" y="${(y1 + y2) / 2 - 10}">${text}</text>`;
      });
      places.forEach((p, n) => {
        if (p) parts.push(`<circle cx="${p[0]}" cy="${p[1]}" r="5"/>
          <text x="${p[0]}" y="${p[1] + 20}">${marks.points[n].name}</text>`);
      });
      this.over.innerHTML = parts.join("");
    }

    pick(event) {
      const box = this.canvas.getBoundingClientRect(), view = this.view();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let [best, nearest] = [-1, Infinity];
      for (const k of this.kept) {
        const [px, py, depth] = projected(view, this.point(k));
        const away = Math.hypot(((px + 1) / 2) * box.width - x, ((1 - py) / 2) * box.height - y);
        if (depth <= 0 || away > PICK_PX) continue;
        const cost = depth * (1 + 0.01 * away); // what is in front, and then what is under the pointer
        if (cost < nearest) [best, nearest] = [k, cost];
      }
      if (best >= 0) send((best % scene.w) * scene.stride, Math.floor(best / scene.w) * scene.stride);
    }
  }

  /* ---- the flat pictures ---- */

  function pixelAt(picture, event) {
    const box = picture.getBoundingClientRect();
    const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    if (u < 0 || v < 0 || u >= 1 || v >= 1) return null;
    return [Math.floor(u * scene.width), Math.floor(v * scene.height), u, v];
  }

  function send(x, y) { // the server measures: gradio takes the pixel from here when the hidden button is pressed
    window.geodiffPicked = `${x}, ${y}`;
    document.getElementById("pick").click();
  }

  function compare(root) {
    const range = root.querySelector("input"), over = root.querySelector(".over");
    const line = root.querySelector(".line"), here = root.querySelector(".here");
    const show = () => {
      over.style.clipPath = `inset(0 ${100 - range.value}% 0 0)`;
      line.style.left = `${range.value}%`;
    };
    range.addEventListener("input", show);
    const picture = root.querySelector(".pictures");
    picture.addEventListener("pointerleave", () => { here.hidden = true; });
    const follow = (event) => {
      const at = scene && pixelAt(picture, event);
      if (!at) return;
      if (event.buttons) { range.value = 100 * at[2]; show(); }
      const clamp = (n, most) => Math.min(most, Math.round(n / scene.stride));
      const z = scene.z[clamp(at[1], scene.h - 1) * scene.w + clamp(at[0], scene.w - 1)];
      here.textContent = z > 0 ? `${z.toFixed(2)} m` : "edge, or beyond";
      here.hidden = false;
      here.style.left = `${Math.min(88, 100 * at[2])}%`;
      here.style.top = `${100 * at[3]}%`;
    };
    picture.addEventListener("pointermove", follow);
    picture.addEventListener("pointerdown", follow);
    show();
  }

  /* ---- what comes and goes with gradio's panels ---- */

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
      scene = data ? await unpack(data) : null;
      document.querySelectorAll(".viewer").forEach((root) => viewerOf(root).load());
    }
    const told = document.querySelector("#marks-data .page-data")?.textContent || "";
    if (told !== marksText) {
      marksText = told;
      marks = told ? JSON.parse(told) : { points: [], segments: [] };
      document.querySelectorAll(".viewer").forEach((root) => viewerOf(root).request());
    }
    document.querySelectorAll(".viewer").forEach(viewerOf);
    document.querySelectorAll(".compare:not([data-on])").forEach((root) => {
      root.dataset.on = "yes";
      compare(root);
    });
  }

  document.addEventListener("click", (event) => {
    const picture = event.target.closest?.("#measure-picture img");
    const at = picture && scene && pixelAt(picture, event);
    if (at) send(at[0], at[1]);
  });

  /* ---- names for screen readers, where gradio's own do not say of what they are ---- */

  function nameAfter(root, field) {
    root.querySelectorAll("button[aria-label]").forEach((button) => {
      const own = button.getAttribute("aria-label");
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
  const foreign = ({ target }) => !target.closest?.(".viewer, .compare"); // what is drawn here is no news
  new MutationObserver((changes) => { if (changes.some(foreign)) soon(); })
    .observe(document.documentElement, { childList: true, subtree: true });
  soon();
})();
