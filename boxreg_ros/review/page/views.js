// The views of a box -----------------------------------------------------------------------------

const ZOOM_STEP = 1.25;            // of a key, or of a notch of the wheel
const SLAB = 1.5;                  // around the object, of neighbours in the views from the side and the front [m]
const DENSE = 1500;                // more points are drawn smaller
const RULED = 60;                  // views that are smaller have no ruler [px]
const CLOSE = 8;                   // of points and neighbours in the 3D view [m]
const ZOOM = { least: 0.1, most: 20 };
// The axes to the right and upwards, by view, and the corners of the outline that is seen.
/** @type {Record<string, [number, number, number[]]>} */
const VIEWS = { top: [0, 1, [4, 5, 6, 7]], side: [0, 2, [0, 1, 5, 4]], front: [1, 2, [0, 3, 7, 4]] };
const NAMES = ['around', 'beside', 'input', 'refined', 'truth', 'solved', 'human'];
const DASHES = { input: [6, 4], truth: [2, 3], beside: [1, 3] };

function currentBoxes() {
  const part = view.part, row = view.row;
  const boxes = [['input', part.given[row]], ['refined', part.boxes[row]]];
  if (DATA.has_truth) boxes.push(['truth', part.truth[row]]);
  const solved = view.solved?.get(part.stamps[row]);
  if (solved) boxes.push(['solved', moved(solved, part.origin, -1)]);
  const pin = pinOf(view.row);
  const human = view.edit ?? (pin ? moved(pin.box, part.origin, -1) : null);
  if (human) boxes.push(['human', human]);
  return boxes.filter(([, box]) => box && box[0] !== null);
}

const moved = (box, origin, sign) => box.map((v, k) => (k < 3 ? v + sign * origin[k] : v));

// How far the views of a track reach from the centre of its boxes [m].
function limitsOf(part) {
  const limits = [1, 0.6, 0.6];
  for (const box of [...part.usable, ...part.given]) {
    if (box && box[0] !== null) [3, 4, 5].forEach((c, k) => { limits[k] = Math.max(limits[k], box[c] / 2 + 0.7); });
  }
  return limits;
}

function drawViews() {
  const part = view.part;
  if (!part.usable[view.row]) return drawNothing();
  const mode = $('mode').value;
  const cacheKey = mode === 'sweep' ? view.row : mode;
  if (view.cacheKey !== cacheKey || view.cachePart !== part) {
    view.local = localPoints(part, view.row, mode);
    view.accumulated = null;
    view.cacheKey = cacheKey;
    view.cachePart = part;
  }
  const frame = frameBox(part, view.row, mode) ?? part.usable[view.row];
  view.frame = frame;
  view.R = rotation(frame);
  const inFrame = point => toFrame(point, frame, view.R);
  let boxes = currentBoxes();
  if (mode === 'before') boxes = boxes.filter(([name]) => name !== 'refined');
  if (mode === 'after') boxes = boxes.filter(([name]) => name !== 'input');
  if (mode === 'sweep') loadCloud();
  else loadAccumulated(mode);
  if (mode !== 'sweep' && view.accumulated?.points) view.local = view.accumulated.points;
  const near = mode === 'sweep' ? aroundAt(part.stamps[view.row], part.origin) : [];
  const cloud = mode === 'sweep' && view.cloud?.track === view.open && view.cloud.stamp === part.stamps[view.row] ? view.cloud.points : null;
  view.far = cloud ? cloud.map(inFrame) : near.flatMap(({ points }) => points.map(inFrame));
  view.lines = [...near.map(({ box }) => ['around', box]), ...boxesBeside(), ...boxes]
    .map(([name, box]) => ({ name, dash: DASHES[name] ?? [], corners: corners(box).map(inFrame) }));
  for (const [name, axes] of Object.entries(VIEWS)) drawFlat($(name), ...axes);
  drawSpace();
  drawCamera();
  const labels = { around: 'neighbours', refined: part.status[view.row] === 'kept' ? 'kept' : 'refined', truth: 'true', solved: 'solved again', beside: 'before and after' };
  const shown = NAMES.filter(name => view.lines.some(line => line.name === name));
  fill($('legend'), ...shown.map(name => element('span', {}, element('i', { style: `border-color: var(--${name}); border-top-style: ${{ input: 'dashed', truth: 'dotted', beside: 'dotted' }[name] ?? 'solid'}` }), labels[name] ?? name)));
}

const BESIDE = 5;                  // boxes before and after the one that is dragged

// While a box is dragged: the boxes beside it in time, as they follow it.
function boxesBeside() {
  if (!view.edit || !view.followed) return [];
  const rows = Array.from({ length: 2 * BESIDE + 1 }, (_, k) => view.row + k - BESIDE).filter(row => row !== view.row);
  return rows.map(row => view.followed.get(view.part.stamps[row])).filter(Boolean).map(box => ['beside', moved(box, view.part.origin, -1)]);
}

// A box with numbers that are not finite has no place.
function drawNothing() {
  view.local = view.far = view.lines = [];
  view.cacheKey = null;
  for (const [name, axes] of Object.entries(VIEWS)) drawFlat($(name), ...axes);
  drawSpace();
  fill($('legend'), 'no valid box at this stamp');
}

// One orthogonal view: its axes to the right and upwards, in the frame of the box.
function drawFlat(canvas, right, up, outline) {
  const scale = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
  if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
  const zoom = view.zoom * Math.min(width / (2 * view.limits[right]), height / (2 * view.limits[up]));
  canvas.zoom = zoom;
  const at = point => [width / 2 + zoom * (point[right] - view.center[right]), height / 2 - zoom * (point[up] - view.center[up])];
  // Points are many small rectangles: the processor draws them sooner than a software GPU does.
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  if (height > RULED) drawRuler(context, width, height, zoom, view.center[right]);
  const isDense = view.local.length > DENSE;
  // Neighbours behind each other would hide the object in the views from the side and the front.
  const depth = 3 - right - up, reach = view.frame ? view.frame[3 + depth] / 2 + SLAB : 0;
  const isNear = point => depth === 2 || Math.abs(point[depth]) < reach;
  drawPoints(context, (view.far ?? []).filter(isNear), at, 1.4, 0.4, 'around');
  // Points near the lower face may be road: they would hide the object from above.
  const shown = canvas.id === 'top' ? view.local.filter(point => point[2] >= -0.35 * view.frame[5]) : view.local;
  drawPoints(context, shown, at, isDense ? 1.4 : 2.4, isDense ? 0.35 : 0.85, 'points');
  for (const { name, dash, corners: c } of view.lines) {
    if (name === 'around' && !c.some(isNear)) continue;
    context.strokeStyle = colour(name);
    context.lineWidth = name === 'human' ? 2.5 : ['around', 'beside'].includes(name) ? 1 : 1.8;
    context.setLineDash(dash);
    context.beginPath();
    outline.forEach((k, i) => context[i ? 'lineTo' : 'moveTo'](...at(c[k])));
    context.closePath();
    if (right === 0) {
      const nose = [0, 1, 2].map(k => (c[0][k] + c[3][k] + c[4][k] + c[7][k]) / 4);
      const middle = [0, 1, 2].map(k => c.reduce((sum, corner) => sum + corner[k] / 8, 0));
      context.moveTo(...at(nose));
      context.lineTo(...at([0, 1, 2].map(k => nose[k] + 0.15 * (nose[k] - middle[k]))));
    }
    context.stroke();
  }
  context.setLineDash([]);
}

function drawRuler(context, width, height, zoom, center) {
  context.strokeStyle = colour('line');
  context.fillStyle = colour('grey');
  context.lineWidth = 1;
  context.font = '10px system-ui, sans-serif';
  const pitch = [1, 2, 5, 10, 20].find(metres => zoom * metres > 25) ?? 50;
  const [first, last] = [-1, 1].map(sign => center + sign * width / 2 / zoom);
  for (let metre = Math.ceil(first / pitch) * pitch; metre <= last; metre += pitch) {
    const x = width / 2 + zoom * (metre - center);
    context.beginPath();
    context.moveTo(x, height - 4);
    context.lineTo(x, height);
    context.stroke();
    context.fillText(String(metre), x + 2, height - 3);
  }
}

function drawPoints(context, points, at, size, alpha, name) {
  context.globalAlpha = alpha;
  context.fillStyle = colour(name);
  for (const point of points) {
    const [x, y] = at(point);
    context.fillRect(x - size / 2, y - size / 2, size, size);
  }
  context.globalAlpha = 1;
}

const NOTCH = 100;                 // of a wheel [px]
const LINES = [1, 16, 400];        // pixels of a pixel, a line and a page of the wheel
// How much a turn of the wheel zooms: by its length. A pinch on a trackpad is a turn with Ctrl, of a tenth of the length.
function wheelFactor(event) {
  const notches = event.deltaY * LINES[event.deltaMode] / NOTCH;
  return ZOOM_STEP ** Math.max(-3, Math.min(3, -(event.ctrlKey ? 10 : 1) * notches));
}

// Zoom all views; the place under the pointer, in the frame of the box, stays there.
function zoomBy(factor, canvas = null, event = null) {
  const before = view.zoom;
  view.zoom = Math.max(ZOOM.least, Math.min(ZOOM.most, view.zoom * factor));
  if (canvas) {
    const bounds = canvas.getBoundingClientRect(), [right, up] = VIEWS[canvas.id];
    const part = (1 - before / view.zoom) / canvas.zoom;
    view.center[right] += part * (event.clientX - bounds.left - bounds.width / 2);
    view.center[up] -= part * (event.clientY - bounds.top - bounds.height / 2);
  }
  drawViews();
}

// Two fingers: `zoom` gets the factor, and the event with the place.
function setUpPinch(canvas, zoom) {
  const fingers = new Map();
  const apart = () => { const [a, b] = [...fingers.values()]; return Math.max(1, Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY)); };
  canvas.addEventListener('pointerdown', event => { if (event.pointerType === 'touch') fingers.set(event.pointerId, event); });
  canvas.addEventListener('pointermove', event => {
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.size === 2 ? apart() : 0;
    fingers.set(event.pointerId, event);
    if (!before) return;
    event.stopImmediatePropagation();  // it moves nothing
    zoom(apart() / before, event);
  });
  for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, event => fingers.delete(event.pointerId));
}

// Views are drawn again when they change their size: a camera may have appeared beside them.
function setUpSizes() {
  const observer = new ResizeObserver(() => {
    if (!view.part || $('tracks').hidden) return;
    drawViews();
    drawCursor();
  });
  for (const name of [...Object.keys(VIEWS), 'space']) observer.observe($(name));
}

function resetViews() {
  view.zoom = 1;
  view.center = [0, 0, 0];
  drawViews();
}

// The track in 3D, as the drive is drawn, in the frame of its box --------------------------------

/** @type {{ zoom: number, tilt: number, turn: number, clouds: any[], of: any[] }} */
const space = { zoom: 1, tilt: 1.1, turn: -0.6, clouds: [], of: [] };  // seen from behind, a little from the right [rad]

function spaceAxes() {
  const canvas = $('space-lines'), [along, across, up] = view.limits, reach = Math.hypot(along, across);
  space.zoom = view.zoom * Math.min(canvas.clientWidth / (2 * reach), canvas.clientHeight / (2 * (up + reach * Math.cos(space.tilt))));
  return axesOf(canvas, [0, 0, 0], space);
}

// The points as clouds, made again when they are others.
function spaceClouds() {
  if (space.of[0] === view.local && space.of[1] === view.far) return space.clouds;
  const cloud = (points, name, alpha) => ({ points: new Float32Array(points.flat()), origin: [0, 0, 0], name, alpha });
  const far = (view.far ?? []).filter(point => Math.hypot(...point) < CLOSE);
  space.of = [view.local, view.far];
  return (space.clouds = [cloud(view.local, 'points', 1), cloud(far, 'around', 0.6)]);  // of two at one place the first is seen
}

function drawSpace() {
  const canvas = $('space-lines'), scale = devicePixelRatio, axes = spaceAxes(), clouds = spaceClouds();
  const isDense = view.local.length > DENSE;
  canvas.width = Math.round(axes.width * scale);
  canvas.height = Math.round(axes.height * scale);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  if (!drawClouds($('space-points'), clouds, axes, colour('points'), isDense ? 1.4 : 2.4)) {
    drawPoints(context, (view.far ?? []).filter(point => Math.hypot(...point) < CLOSE), axes.to, 1.4, 0.6, 'around');
    drawPoints(context, view.local, axes.to, isDense ? 1.4 : 2.4, 1, 'points');
  }
  for (const { name, dash, corners: c } of view.lines) {
    if (name === 'around' && !c.every(point => Math.hypot(...point) < CLOSE)) continue;
    context.strokeStyle = colour(name);
    context.lineWidth = name === 'around' ? 1 : 2;
    context.setLineDash(dash);
    context.beginPath();
    for (const edge of BOX_EDGES) {
      const [a, b] = edge.map(k => axes.to(c[k]));
      context.moveTo(...a);
      context.lineTo(...b);
    }
    context.stroke();
  }
  context.setLineDash([]);
}

// A drag turns it; the wheel zooms all views.
function setUpSpace() {
  const canvas = $('space-lines');
  let last = null;
  setUpPinch(canvas, factor => view.part && zoomBy(factor));
  canvas.onpointerdown = event => {
    canvas.setPointerCapture(event.pointerId);
    last = event;
  };
  canvas.onpointermove = event => {
    if (!last || !view.part) return;
    space.turn -= TILT.pace * (event.clientX - last.clientX);
    space.tilt = Math.max(0, Math.min(TILT.most, space.tilt - TILT.pace * (event.clientY - last.clientY)));
    last = event;
    drawSpace();
  };
  canvas.onpointerup = canvas.onpointercancel = () => { last = null; };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    if (view.part) zoomBy(wheelFactor(event));
  }, { passive: false });
}
