// A viewer of baked voxels by WebGL2: rays are marched through bricks of 8 x 8 x 8 cells, kept as tiles of 3D textures.
//
// showVoxels(element) turns an element that `page.page_of` wrote into a canvas. What cannot be shown (no WebGL2, no
// DecompressionStream, a texture too large) leaves the picture that stands in the element.
"use strict";
window.showVoxels ||= (() => {
  const BRICK = 8, TILE = BRICK + 1; // cells of a brick, and the voxel centres around them
  const COEFFICIENTS = 27, TEXTURES = 7;

  const VERTEX = `#version 300 es
  void main() { gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 2.0 * float(gl_VertexID & 2) - 1.0, 0.0, 1.0); }`;

  const FRAGMENT = `#version 300 es
  precision highp float;
  precision highp int;
  precision highp sampler3D;
  precision highp usampler3D;
  uniform usampler3D bricks;      // distance to the next brick that is not empty, or 256 + the number of the brick
  uniform sampler3D densities;    // optical depth over the length of a voxel
  uniform sampler3D colours[7];   // 27 coefficients, red first, and one unused
  uniform vec3 origin;            // of the rays, in cells
  uniform mat3 rotation;          // world_from_camera
  uniform vec4 lens;              // fx, fy, cx, cy in pixels
  uniform float height;           // of the canvas
  uniform vec3 middle;            // of the sphere, in cells
  uniform float radius;           // of the sphere, in cells
  uniform float stride;           // between samples, in cells
  uniform ivec3 tiles;            // of the atlas, along each axis
  uniform vec4 low[7];            // range of each coefficient
  uniform vec4 range[7];
  out vec4 pixel;

  void main() {
    vec2 at = vec2(gl_FragCoord.x - 0.5, height - 0.5 - gl_FragCoord.y);
    vec3 along = normalize(rotation * vec3((at - lens.zw) / lens.xy, 1.0));
    vec3 inward = middle - origin;
    float closest = dot(inward, along);
    vec3 aside = inward - closest * along;
    float square = radius * radius - dot(aside, aside);
    vec3 colour = vec3(0.0);
    float depth = 0.0, opacity = 0.0;
    if (square > 0.0) {
      float x = along.x, y = along.y, z = along.z;
      float basis[9] = float[9](
        0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x, 1.09254843 * x * y, -1.09254843 * y * z,
        0.31539157 * (3.0 * z * z - 1.0), -1.09254843 * x * z, 0.54627422 * (x * x - y * y));
      vec4 b0 = vec4(basis[0], basis[1], basis[2], basis[3]), b1 = vec4(basis[4], basis[5], basis[6], basis[7]);
      vec4 b2 = vec4(basis[8], basis[0], basis[1], basis[2]), b3 = vec4(basis[3], basis[4], basis[5], basis[6]);
      vec4 b4 = vec4(basis[7], basis[8], basis[0], basis[1]), b5 = vec4(basis[2], basis[3], basis[4], basis[5]);
      vec4 b6 = vec4(basis[6], basis[7], basis[8], 0.0);
      vec3 constant = vec3(
        dot(b0, low[0]) + dot(b1, low[1]) + b2.x * low[2].x,
        dot(b2.yzw, low[2].yzw) + dot(b3, low[3]) + dot(b4.xy, low[4].xy),
        dot(b4.zw, low[4].zw) + dot(b5, low[5]) + dot(b6, low[6]));
      b0 *= range[0]; b1 *= range[1]; b2 *= range[2]; b3 *= range[3]; b4 *= range[4]; b5 *= range[5]; b6 *= range[6];
      float half_chord = sqrt(square);
      float near = max(closest - half_chord, 0.0), far = max(closest + half_chord, 0.0);
      float first = near + 0.5 * stride;
      ivec3 size = textureSize(bricks, 0);
      vec3 scale = 1.0 / vec3(textureSize(densities, 0));
      vec3 per_cell = 1.0 / (abs(along) + 1e-9);
      float number = 0.0;
      for (int guard = 0; guard < 4096; guard++) {
        float t = first + number * stride;
        if (t >= far || depth > 6.9077553) break;
        vec3 place = origin + t * along;
        ivec3 brick = ivec3(floor(place / 8.0));
        if (any(lessThan(brick, ivec3(0))) || any(greaterThanEqual(brick, size))) { number += 1.0; continue; }
        uint found = texelFetch(bricks, brick, 0).r;
        if (found < 256u) {
          // The distance along the ray to the border of the empty bricks around this one.
          vec3 border = 8.0 * (vec3(brick) + 0.5 + (float(found) - 0.5) * sign(along));
          vec3 ahead = abs(border - place) * per_cell;
          float leap = min(ahead.x, min(ahead.y, ahead.z));
          number = max(number + 1.0, ceil((t + leap - first) / stride - 1e-3));
          continue;
        }
        number += 1.0;
        int tile = int(found) - 256;
        ivec3 corner = 9 * ivec3(tile % tiles.x, (tile / tiles.x) % tiles.y, tile / (tiles.x * tiles.y));
        vec3 where_ = (vec3(corner) + place - 8.0 * vec3(brick) + 0.5) * scale;
        float added = textureLod(densities, where_, 0.0).r * stride;
        if (added <= 0.0) continue;
        vec4 c0 = textureLod(colours[0], where_, 0.0), c1 = textureLod(colours[1], where_, 0.0);
        vec4 c2 = textureLod(colours[2], where_, 0.0), c3 = textureLod(colours[3], where_, 0.0);
        vec4 c4 = textureLod(colours[4], where_, 0.0), c5 = textureLod(colours[5], where_, 0.0);
        vec4 c6 = textureLod(colours[6], where_, 0.0);
        vec3 seen = constant + vec3(
          dot(b0, c0) + dot(b1, c1) + b2.x * c2.x,
          dot(b2.yzw, c2.yzw) + dot(b3, c3) + dot(b4.xy, c4.xy),
          dot(b4.zw, c4.zw) + dot(b5, c5) + dot(b6, c6));
        float weight = exp(-depth) * (1.0 - exp(-added));
        depth += added;
        opacity += weight;
        colour += weight * clamp(seen, 0.0, 1.0);
      }
    }
    pixel = vec4(colour + 1.0 - opacity, 1.0);
  }`;

  async function inflate(text) {
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  function readHalf(bits) {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023;
    return exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : (2 ** -14 * fraction) / 1024;
  }

  // The tiles of the bricks that hold a voxel, and the grid that says which brick has which tile.
  function layOut(scene, data) {
    const side = scene.side, rows = scene.rows, bits = side ** 3 / 8;
    const grid = Math.ceil((side + 1) / BRICK), cells = new Uint16Array(grid ** 3);
    const places = new Uint32Array(rows); // padded by one voxel: x, y, z below 1024
    for (let voxel = 0, row = 0; voxel < side ** 3; voxel++) {
      if (!(data[voxel >> 3] && (data[voxel >> 3] >> (voxel & 7)) & 1)) continue;
      const z = voxel % side, y = Math.floor(voxel / side) % side, x = Math.floor(voxel / (side * side));
      places[row++] = ((x + 1) << 20) | ((y + 1) << 10) | (z + 1);
    }
    const around = (at) => (at & 7 || !at ? [at >> 3] : [(at >> 3) - 1, at >> 3]); // bricks that hold a voxel centre
    const visit = (row, action) => {
      const x = places[row] >> 20, y = (places[row] >> 10) & 1023, z = places[row] & 1023;
      for (const i of around(x)) for (const j of around(y)) for (const k of around(z))
        action(i + grid * (j + grid * k), x - BRICK * i + TILE * (y - BRICK * j + TILE * (z - BRICK * k)));
    };
    let count = 0;
    for (let row = 0; row < rows; row++) visit(row, (cell) => { if (!cells[cell]) cells[cell] = 256 + count++; });
    const across = Math.ceil(Math.cbrt(count)), layers = Math.ceil(count / (across * across));
    const wide = across * TILE, volume = wide * wide * layers * TILE;
    const density = new Uint16Array(volume), colours = Array.from({ length: TEXTURES }, () => new Uint8Array(4 * volume));
    const base = (tile) => {
      const i = tile % across, j = Math.floor(tile / across) % across, k = Math.floor(tile / (across * across));
      return TILE * (i + wide * (j + wide * k));
    };
    const offsets = new Uint32Array(TILE ** 3);
    for (let at = 0; at < offsets.length; at++)
      offsets[at] = (at % TILE) + wide * ((Math.floor(at / TILE) % TILE) + wide * Math.floor(at / (TILE * TILE)));
    const filled = new Uint8Array(volume), high = bits, lower = bits + rows, first = bits + 2 * rows;
    for (let row = 0; row < rows; row++) visit(row, (cell, at) => {
      const texel = base(cells[cell] - 256) + offsets[at];
      density[texel] = (data[high + row] << 8) | data[lower + row];
      filled[texel] = 1;
      for (let number = 0; number < COEFFICIENTS; number++)
        colours[number >> 2][4 * texel + (number & 3)] = data[first + number * rows + row];
    });
    spread(count, base, offsets, wide, filled, colours);
    distances(cells, grid);
    return { cells, grid, density, colours, wide, deep: layers * TILE, tiles: [across, across, layers] };
  }

  // Colours of empty voxels beside filled ones, axis by axis: textures interpolate colours without regard to density.
  function spread(count, base, offsets, wide, filled, colours) {
    const steps = [[1, 1], [TILE, wide], [TILE * TILE, wide * wide]];
    for (let tile = 0; tile < count; tile++) {
      const start = base(tile);
      for (const [stride, step] of steps) {
        const found = [];
        for (let at = 0; at < offsets.length; at++) {
          const texel = start + offsets[at];
          if (filled[texel]) continue;
          const place = Math.floor(at / stride) % TILE;
          const before = place > 0 && filled[texel - step] ? texel - step : -1;
          const after = place < TILE - 1 && filled[texel + step] ? texel + step : -1;
          if (before < 0 && after < 0) continue;
          const one = before < 0 ? after : before, two = after < 0 ? before : after;
          for (const colour of colours) for (let part = 0; part < 4; part++)
            colour[4 * texel + part] = (colour[4 * one + part] + colour[4 * two + part] + 1) >> 1;
          found.push(texel);
        }
        for (const texel of found) filled[texel] = 1;
      }
    }
  }

  // For every empty brick the distance to the nearest that is not, at most 255: two passes of a chessboard transform.
  function distances(cells, grid) {
    const at = (x, y, z) => x + grid * (y + grid * z);
    const away = new Uint8Array(grid ** 3).map((_, cell) => (cells[cell] ? 0 : 255));
    for (const forward of [true, false]) for (let n = 0; n < grid ** 3; n++) {
      const cell = forward ? n : grid ** 3 - 1 - n;
      const x = cell % grid, y = Math.floor(cell / grid) % grid, z = Math.floor(cell / (grid * grid));
      let least = away[cell];
      for (let k = -1; k <= 1; k++) for (let j = -1; j <= 1; j++) for (let i = -1; i <= 1; i++) {
        const a = x + i, b = y + j, c = z + k;
        if (Math.min(a, b, c) < 0 || Math.max(a, b, c) >= grid) continue;
        least = Math.min(least, away[at(a, b, c)] + 1);
      }
      away[cell] = least;
    }
    for (let cell = 0; cell < cells.length; cell++) if (!cells[cell]) cells[cell] = away[cell];
  }

  function compile(gl) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  function upload(gl, program, laid, scene) {
    const largest = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    if (Math.max(laid.wide, laid.deep) > largest) throw new Error(`textures of ${laid.wide}, at most ${largest} here`);
    gl.useProgram(program);
    const place = (name) => gl.getUniformLocation(program, name);
    const texture = (unit, internal, size, format, type, values, filter) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
        gl.texParameteri(gl.TEXTURE_3D, axis, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, filter);
      gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, filter);
      gl.texImage3D(gl.TEXTURE_3D, 0, internal, ...size, 0, format, type, values);
    };
    const size = [laid.wide, laid.wide, laid.deep], grid = [laid.grid, laid.grid, laid.grid];
    texture(0, gl.R16UI, grid, gl.RED_INTEGER, gl.UNSIGNED_SHORT, laid.cells, gl.NEAREST);
    texture(1, gl.R16F, size, gl.RED, gl.HALF_FLOAT, laid.density, gl.LINEAR);
    laid.colours.forEach((part, n) => texture(2 + n, gl.RGBA8, size, gl.RGBA, gl.UNSIGNED_BYTE, part, gl.LINEAR));
    gl.uniform1i(place("bricks"), 0);
    gl.uniform1i(place("densities"), 1);
    gl.uniform1iv(place("colours"), laid.colours.map((_, n) => 2 + n));
    gl.uniform3iv(place("tiles"), laid.tiles);
    gl.uniform4fv(place("low"), [...scene.low, 0]);
    gl.uniform4fv(place("range"), [...scene.range, 0]);
    const cell = (2 * scene.radius) / scene.side; // world units
    gl.uniform3f(place("middle"), ...[0, 0, 0].fill(scene.side / 2 + 0.5));
    gl.uniform1f(place("radius"), scene.radius / cell);
    gl.uniform1f(place("stride"), scene.side / scene.steps);
    const error = gl.getError();
    if (error) throw new Error(`WebGL error ${error}`);
    return { place, cell };
  }

  const minus = (a, b) => a.map((value, n) => value - b[n]);
  const dot = (a, b) => a.reduce((sum, value, n) => sum + value * b[n], 0);
  const scaled = (a, factor) => a.map((value) => value * factor);
  const unit = (a) => scaled(a, 1 / Math.hypot(...a));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

  // camera_from_world of a camera that looks at the middle of the scene: OpenCV's axes, x right, y down, z forward.
  class Orbit {
    constructor(scene) {
      this.scene = scene;
      this.up = unit(scene.up);
      const standing = minus(scene.eye, scene.centre);
      this.start = { azimuth: 0, elevation: Math.asin(dot(unit(standing), this.up)), distance: Math.hypot(...standing) };
      const level = minus(standing, scaled(this.up, dot(standing, this.up)));
      const aside = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
      this.front = unit(Math.hypot(...level) > 1e-6 * this.start.distance ? level : cross(this.up, aside));
      this.side = cross(this.up, this.front);
      this.reset();
    }
    reset() { Object.assign(this, this.start); }
    turn(azimuth, elevation) {
      this.azimuth += azimuth;
      this.elevation = Math.min(1.55, Math.max(-1.55, this.elevation + elevation));
    }
    zoom(factor) {
      this.distance = Math.min(6 * this.start.distance, Math.max(0.15 * this.start.distance, this.distance * factor));
    }
    pose() {
      const { azimuth: a, elevation: e, distance: d, scene } = this;
      const eye = scene.centre.map((value, n) => value + d * (
        Math.cos(e) * (Math.cos(a) * this.front[n] + Math.sin(a) * this.side[n]) + Math.sin(e) * this.up[n]));
      const forward = unit(minus(scene.centre, eye)), right = unit(cross(forward, this.up));
      return { rows: [right, cross(forward, right), forward], eye };
    }
  }

  // A camera of the address: #camera=12 numbers of camera_from_world,fx,fy,cx,cy,width,height
  const CAMERA = /[#&]camera=([^&]*)/, LARGEST = 4096; // pixels of a side
  function addressed() {
    const match = CAMERA.exec(location.hash), numbers = match && match[1].split(",").map(Number);
    if (!numbers || numbers.length !== 18 || !numbers.every(Number.isFinite)) return null;
    if (!numbers[12] || !numbers[13]) return null;
    if (!numbers.slice(16).every((side) => Number.isInteger(side) && side >= 1 && side <= LARGEST)) return null;
    const rows = [0, 4, 8].map((at) => numbers.slice(at, at + 3)), shift = [3, 7, 11].map((at) => numbers[at]);
    const eye = [0, 1, 2].map((axis) => -rows.reduce((sum, row, n) => sum + row[axis] * shift[n], 0));
    return { rows, eye, lens: numbers.slice(12, 16), width: numbers[16], height: numbers[17] };
  }

  addEventListener("hashchange", ({ oldURL, newURL }) => {
    if (CAMERA.test(oldURL) || CAMERA.test(newURL)) location.reload();
  });

  function control(canvas, orbit, changed) {
    const fingers = new Map();
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const release = (event) => fingers.delete(event.pointerId);
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      changed();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!(event.buttons & 1)) release(event); // somewhere else, which nobody told the page
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const apart = fingers.size === 2 && spread();
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 1) {
        const scale = Math.PI / canvas.clientHeight;
        orbit.turn(-(event.clientX - before[0]) * scale, (event.clientY - before[1]) * scale);
      } else if (apart && spread()) orbit.zoom(apart / spread());
      changed();
    });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) canvas.addEventListener(kind, release);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      orbit.zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.001)));
      changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { orbit.reset(); changed(); });
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return; // the browser's
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      if (turns[event.key]) orbit.turn(...turns[event.key]);
      else if (event.key === "+" || event.key === "-") orbit.zoom(event.key === "+" ? 0.9 : 1 / 0.9);
      else return;
      event.preventDefault();
      changed();
    });
  }

  const LIVE = 12; // viewers that draw at once: browsers keep some 16 WebGL contexts, and drop the oldest
  const RETRIES = 3; // after a context was lost, a second apart; then the viewer waits for a tap
  let viewers = [];

  // Voxels in an element, whose picture stands there while they are not drawn.
  class Viewer {
    constructor(element, fixed) {
      this.element = element;
      this.fixed = fixed;
      this.scene = JSON.parse(element.querySelector("script[type='application/json']").textContent);
      this.picture = element.querySelector("img");
      this.orbit = new Orbit(this.scene);
      this.spinning = !fixed && !matchMedia("(prefers-reduced-motion)").matches;
      this.visible = undefined; // until the browser says so
      this.live = false;
      this.retries = RETRIES;
      this.used = 0; // when it was last tapped or started
    }

    // Take a context and draw; what cannot be shown leaves the picture.
    async start() {
      this.live = true;
      this.used = performance.now();
      try {
        await this.begin();
        this.element.removeAttribute("title");
      } catch (problem) {
        this.stop();
        this.broken = true;
        this.element.title = `shown as a picture: ${problem.message}`;
      }
    }

    // The browser took the context away.
    lose() {
      this.focused = document.activeElement === this.canvas;
      this.stop();
      if (this.retries-- > 0) setTimeout(() => balance(), 1000);
      else this.broken = true;
    }

    // Somebody wants to turn it: another one gives way, if need be.
    wake() {
      this.visible = true;
      this.broken = false;
      this.retries = RETRIES;
      this.used = performance.now();
      if (!this.live) balance(this);
    }

    // Give the context back, and show the picture.
    stop() {
      this.live = false;
      this.resized?.disconnect();
      if (this.canvas) {
        this.canvas.remove();
        if (this.picture) this.element.append(this.picture);
        this.gl?.getExtension("WEBGL_lose_context")?.loseContext();
      }
      this.canvas = this.gl = this.ask = null;
      this.element.dataset.shown = "picture";
    }

    async begin() {
      const { element, fixed, scene, orbit } = this;
      const canvas = document.createElement("canvas");
      const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: Boolean(fixed) });
      if (!gl) throw new Error("no WebGL2");
      Object.assign(this, { canvas, gl });
      canvas.addEventListener("webglcontextlost", (event) => {
        event.preventDefault();
        if (this.canvas === canvas) this.lose();
      });
      const data = await inflate(element.querySelector("script[type='text/plain']").textContent);
      if (this.canvas !== canvas) return; // stopped meanwhile
      const laid = layOut(scene, data), program = compile(gl), { place, cell } = upload(gl, program, laid, scene);
      let quality = 1, moving = 0, asked = false, last = 0;
      const draw = () => {
        const box = element.getBoundingClientRect();
        const ratio = fixed ? 1 : Math.min(devicePixelRatio, 2) * (moving ? quality : 1);
        const width = fixed ? fixed.width : Math.max(1, Math.round(box.width * ratio));
        const height = fixed ? fixed.height : Math.max(1, Math.round(box.height * ratio));
        if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
        const focal = Math.min(scene.focal[0] * width, scene.focal[1] * height);
        const { rows, eye } = fixed || orbit.pose();
        const lens = fixed ? fixed.lens : [focal, focal, (width - 1) / 2, (height - 1) / 2];
        const corner = scene.centre.map((value) => value - scene.radius);
        gl.viewport(0, 0, width, height);
        gl.uniform3f(place("origin"), ...minus(eye, corner).map((value) => value / cell + 0.5));
        gl.uniformMatrix3fv(place("rotation"), false, rows.flat()); // by columns: the transpose of the rows
        gl.uniform4f(place("lens"), ...lens);
        gl.uniform1f(place("height"), height);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
      };
      const frame = (now) => {
        asked = false;
        if (this.canvas !== canvas) return;
        const elapsed = now - last;
        last = now;
        if (moving && elapsed < 500) {
          if (elapsed > 40) quality = Math.max(0.25, 0.85 * quality);
          else if (elapsed < 20) quality = Math.min(1, 1.05 * quality);
        }
        if (this.spinning && this.visible) orbit.turn(Math.min(elapsed, 100) * 0.0006, 0);
        moving = this.spinning ? 1 : Math.max(0, moving - 1);
        draw();
        if ((moving || this.spinning) && this.visible) ask();
      };
      const ask = () => { if (!asked) { asked = true; requestAnimationFrame(frame); } };
      this.ask = ask;
      if (fixed) Object.assign(canvas.style, { position: "fixed", inset: "0 auto auto 0", width: `${fixed.width}px`,
        height: `${fixed.height}px`, zIndex: 1 });
      draw();
      this.picture?.remove();
      element.append(canvas);
      element.dataset.shown = "voxels";
      if (fixed) return;
      canvas.tabIndex = 0;
      canvas.setAttribute("aria-label", "Turn by dragging or the arrow keys, zoom by the wheel or two fingers");
      control(canvas, orbit, () => { this.spinning = false; moving = 12; ask(); });
      if (this.focused) canvas.focus();
      this.focused = false;
      this.resized = new ResizeObserver(ask);
      this.resized.observe(element);
    }
  }

  // Start viewers that can be seen, as many as LIVE: those beyond the borders of the window give way, and to one that
  // is tapped the one that was used longest ago.
  function balance(tapped) {
    for (const viewer of viewers.filter((each) => !each.element.isConnected)) viewer.stop();
    viewers = viewers.filter((each) => each.element.isConnected);
    const waiting = viewers.filter((each) => each.visible && !each.live && !each.broken);
    for (const viewer of tapped ? [tapped] : waiting) {
      const live = viewers.filter((each) => each.live).sort((a, b) => a.used - b.used);
      if (live.length >= LIVE) {
        const idle = live.find((each) => each.visible === false) || (tapped && live[0]);
        if (!idle) return;
        idle.stop();
      }
      viewer.start();
    }
  }

  // One for all viewers: what the browser says of several at once is known of all before one gives way.
  const owners = new WeakMap(); // the viewer of an element
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const viewer = owners.get(entry.target);
      viewer.visible = entry.isIntersecting;
      if (viewer.visible && !viewers.includes(viewer)) viewers.push(viewer); // put back where it was taken from
      if (viewer.visible && viewer.live) viewer.ask?.();
    }
    balance();
  });

  return async function showVoxels(element) {
    const fixed = addressed();
    let viewer;
    try {
      viewer = new Viewer(element, fixed);
    } catch (problem) {
      element.dataset.shown = "picture";
      element.title = `shown as a picture: ${problem.message}`;
      return;
    }
    viewers.push(viewer);
    if (!fixed) {
      owners.set(element, viewer);
      observer.observe(element);
      element.addEventListener("pointerdown", () => viewer.wake());
    }
    if (viewers.filter((each) => each.live).length < LIVE) await viewer.start();
    else element.dataset.shown = "picture";
  };
})();
