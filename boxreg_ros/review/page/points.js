// Clouds of points, drawn by the GPU below the boxes of the drive, or of a track --------------------
// One program a canvas, and one call for each cloud. Positions are relative to an origin nearby, so that
// numbers of 32 bits are exact to a tenth of a millimetre, and are uploaded once.

const MAX_BUFFERS = 24;            // clouds that stay on the GPU
// While the view moves, every `every`-th point is drawn, so that a frame takes less than SLOW; all of them when it rests.
const SLOW = 66, QUICK = 33;       // frames that take longer get fewer points, quicker ones more [ms]: 15 and 30 a second
const REST = 1000;                 // after the last frame [ms]
const MAX_EVERY = 21;              // WebGL steps over at most 255 bytes
const VERTEX = `#version 300 es
in vec3 place; in vec4 tint; uniform vec3 center; uniform vec4 turn; uniform vec2 scale; uniform float size; out vec4 colour;
void main() {
  vec3 d = place - center;
  vec2 flat_ = vec2(turn.x * d.x + turn.y * d.y, turn.x * d.y - turn.y * d.x);
  float up = turn.z * flat_.y + turn.w * d.z, depth = turn.w * flat_.y - turn.z * d.z;
  gl_Position = vec4(scale * vec2(flat_.x, up), clamp(depth / 1000.0, -1.0, 1.0), 1.0);
  gl_PointSize = size;
  colour = tint;
}`;
const FRAGMENT = `#version 300 es
precision highp float; in vec4 colour; out vec4 shown;
void main() { shown = vec4(colour.rgb * colour.a, colour.a); }`;

/** @type {Map<HTMLElement, any>} */
const gpus = new Map();            // by canvas

// The context of a canvas with its program; without `gl` where there is no WebGL 2: points are drawn by the processor then.
function gpuOf(canvas) {
  if (gpus.has(canvas)) return gpus.get(canvas);
  const gl = canvas.getContext('webgl2', { antialias: false, alpha: true });
  /** @type {any} */
  const gpu = { gl, buffers: new Map() };
  gpus.set(canvas, gpu);
  if (!gl) return gpu;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gpu.program = program;
  gpu.at = Object.fromEntries(['center', 'turn', 'scale', 'size'].map(name => [name, gl.getUniformLocation(program, name)]));
  canvas.addEventListener('webglcontextlost', event => event.preventDefault(), { once: true });
  canvas.addEventListener('webglcontextrestored', () => { gpus.delete(canvas); redrawClouds(); }, { once: true });
  return gpu;
}

function redrawClouds() {
  drawScene();
  if (view.part && !$('tracks').hidden) drawSpace();
}

// The buffers of a cloud: places, and colours that are uploaded again when `key` changes.
function bufferOf(gpu, sweep, key) {
  const { gl } = gpu;
  let known = gpu.buffers.get(sweep);
  if (!known) {
    known = { array: gl.createVertexArray(), places: gl.createBuffer(), tints: gl.createBuffer(), key: null };
    gl.bindVertexArray(known.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, known.places);
    gl.bufferData(gl.ARRAY_BUFFER, sweep.points, gl.STATIC_DRAW);
  }
  if (known.key !== key) {
    gl.bindBuffer(gl.ARRAY_BUFFER, known.tints);
    gl.bufferData(gl.ARRAY_BUFFER, tintsOf(sweep), gl.STATIC_DRAW);
    known.key = key;
  }
  gpu.buffers.delete(sweep);
  gpu.buffers.set(sweep, known);  // the newest is last
  for (const [old, { array, places, tints }] of gpu.buffers) {
    if (gpu.buffers.size <= MAX_BUFFERS) break;
    gpu.buffers.delete(old);
    gl.deleteVertexArray(array);
    gl.deleteBuffer(places);
    gl.deleteBuffer(tints);
  }
  return known;
}

// The attributes of the bound array: places and tints of every `every`-th point.
function setStep({ gl, program }, known, every) {
  if (known.every === every) return;
  known.every = every;
  /** @type {[string, WebGLBuffer, number, number, number][]} */
  const columns = [['place', known.places, 3, gl.FLOAT, 12], ['tint', known.tints, 4, gl.UNSIGNED_BYTE, 4]];
  for (const [name, buffer, count, kind, size] of columns) {
    const at = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, count, kind, kind !== gl.FLOAT, every * size, 0);
  }
}

// Of how many points one is drawn: after the time since the frame before.
function everyOf(gpu) {
  const now = performance.now(), gap = now - (gpu.last ?? -Infinity);
  gpu.last = now;
  clearTimeout(gpu.resting);
  if (gap > REST) return 1;
  gpu.every ??= 1;
  if (gap > SLOW) gpu.every = Math.min(MAX_EVERY, Math.ceil(gpu.every * gap / SLOW));
  else if (gap < QUICK) gpu.every = Math.max(1, gpu.every - 1);
  if (gpu.every > 1) gpu.resting = setTimeout(redrawClouds, REST + 1);
  return gpu.every;
}

// Draw clouds with points of a size [px]; whether there is a GPU to do so.
function drawClouds(canvas, clouds, axes, key, size) {
  const gpu = gpuOf(canvas), { gl } = gpu;
  if (!gl) return false;
  const scale = devicePixelRatio, { width, height, zoom, tilt, turn } = axes;
  const [wide, high] = [width, height].map(v => Math.round(v * scale));
  if (canvas.width !== wide) canvas.width = wide;  // to set it again allocates it again
  if (canvas.height !== high) canvas.height = high;
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST);  // the foremost point is seen; the page is behind pale ones
  gl.useProgram(gpu.program);
  gl.uniform4f(gpu.at.turn, Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt));
  gl.uniform2f(gpu.at.scale, 2 * zoom / width, 2 * zoom / height);
  gl.uniform1f(gpu.at.size, scale * size);
  const every = everyOf(gpu);
  for (const sweep of clouds) {
    const known = bufferOf(gpu, sweep, key);
    gl.bindVertexArray(known.array);
    setStep(gpu, known, every);
    const [x, y, z] = axes.center.map((v, k) => v - sweep.origin[k]);
    gl.uniform3f(gpu.at.center, x, y, z);
    gl.drawArrays(gl.POINTS, 0, Math.ceil(sweep.points.length / 3 / every));
  }
  gl.bindVertexArray(null);
  return true;
}

// Colours --------------------------------------------------------------------------------------

const CLOSE_UP = 20;               // points are drawn larger from this zoom on [px/m]
const HIGH = 3;                    // above the road: the last colour of heights [m]
const STATUS_COLOURS = { refined: 'refined', kept: 'input', human: 'human', interpolated: 'truth', extended: 'truth', coasted: 'truth' };
const rgbOf = name => colour(name).match(/[0-9a-f]{2}/gi).map(v => parseInt(v, 16));

// A hue for a number of a list, far from those before it: steps of the golden angle.
const hueOf = k => (137.5 * k) % 360;
const textHash = text => [...text].reduce((sum, c) => (31 * sum + c.charCodeAt(0)) % 9973, 7);

// The colour of a box, as a style.
function boxColour({ track, isGone: gone, status }) {
  const mode = $('scene-colour').value;
  if (gone) return colour('around');
  if (mode === 'class') return `hsl(${hueOf(classNames().indexOf(track.class) + 1)} 70% 45%)`;
  if (mode === 'track') return `hsl(${hueOf(textHash(track.id))} 70% 45%)`;
  if (mode === 'status') return colour(STATUS_COLOURS[status] ?? 'around');
  return colour('refined');
}

const painter = document.createElement('canvas').getContext('2d', { willReadFrequently: true });

function rgbOfStyle(style) {
  painter.fillStyle = style;
  painter.fillRect(0, 0, 1, 1);
  return painter.getImageData(0, 0, 1, 1).data;
}

// Red, green, blue and opacity of each point of a cloud: one colour that it names, or those of the drive.
function tintsOf(sweep) {
  if (sweep.name) {
    const tint = [...rgbOf(sweep.name), 255 * sweep.alpha];
    return Uint8Array.from({ length: sweep.points.length / 3 * 4 }, (_, k) => tint[k % 4]);
  }
  const mode = $('scene-colour').value, { points } = sweep, tints = new Uint8Array(points.length / 3 * 4);
  const [road, object] = [rgbOf(LOOKS.road[0]), rgbOf(LOOKS.object[0])];
  for (let i = 0, j = 0; i < points.length; i += 3, j += 4) {
    const above = points[i + 2] - scene.road, isObject = above > ROAD;
    const [r, g, b] = mode === 'height' ? heightColour(above) : isObject ? object : road;
    tints[j] = r; tints[j + 1] = g; tints[j + 2] = b;
    tints[j + 3] = 255 * (isObject || mode === 'height' ? LOOKS.object[1] : LOOKS.road[1]);
  }
  if (['class', 'track', 'status'].includes(mode) && sweep === scene.sweep) tintBoxes(sweep, tints);
  return tints;
}

// From blue on the road to red above: the hues between, each as bright.
function heightColour(above) {
  const t = Math.max(0, Math.min(1, above / HIGH)), hue = 4 * (1 - t);
  const channel = k => { const v = (k + hue) % 6; return 200 * (1 - Math.max(0, Math.min(v, 4 - v, 1))) + 30; };
  return [channel(5), channel(3), channel(1)];
}

// The points in a box have its colour.
function tintBoxes({ points, origin }, tints) {
  for (const one of scene.boxes) {
    const { box } = one, R = rotation(box), reach = Math.hypot(box[3], box[4], box[5]) / 2;
    const [x, y, z] = [0, 1, 2].map(k => box[k] - origin[k]), [r, g, b] = rgbOfStyle(boxColour(one));
    for (let i = 0, j = 0; i < points.length; i += 3, j += 4) {
      const d = [points[i] - x, points[i + 1] - y, points[i + 2] - z];
      if (Math.abs(d[0]) > reach || Math.abs(d[1]) > reach) continue;
      const isInside = [0, 1, 2].every(k => Math.abs(d[0] * R[0][k] + d[1] * R[1][k] + d[2] * R[2][k]) <= box[3 + k] / 2);
      if (isInside) tints.set([r, g, b, 255], j);
    }
  }
}
