// The scene: the whole cloud of a sweep from above or in 3D, all boxes, and objects that are missing -

const CLICK = 4;                   // a pointer that moves less has clicked [px]
const LABELLED = 5;                // ids are written at this zoom and above [px/m]
const ROAD = 0.4;                  // above the road: points of objects [m]
const SHOWN = 90;                  // of the drive around the sensor [m]
const PICKED = 6;                  // a click is on a point this near [px]
const TILT = { usual: 1, most: 1.3, pace: 0.006 };  // of the view in 3D, from above [rad], and of a drag [rad/px]
/** @type {{ [name: string]: any, sweep: Sweep, boxes: SceneBox[], fit: Fit, slim: Map<number, SlimPart> }} */
const scene = { at: 0, zoom: 0, offset: [0, 0], tilt: 0, turn: 0, sweep: null, boxes: [], isAdding: false, fit: null, proposals: [], proposal: -1, playing: 0, slim: new Map() };
/** @type {Record<string, [string, number, number]>} */
const LOOKS = { road: ['around', 0.45, 1], object: ['points', 0.9, 1.6] };  // colour, opacity, size [px]
const sceneStamp = () => DATA.stamps[scene.at];

// Boxes of a track of the report without its points: those of all tracks stay read.
async function slimPart(s) {
  if (DATA.tracks[s].part) return DATA.tracks[s].part;
  if (!scene.slim.has(s)) {
    const { origin, usable, stamps, status } = await loadPart(s);
    scene.slim.set(s, { origin, usable, stamps, status });
  }
  return scene.slim.get(s);
}

// All boxes at a number of the drive, in the fixed frame, with their tracks.
async function boxesAt(at) {
  const found = [];
  for (const track of TRACKS) {
    for (const [s, k] of track.members().filter(([t, l]) => DATA.tracks[t].at[l] === at)) {
      const part = await slimPart(s), box = part.usable[k];
      if (box) found.push({ track, box: moved(box, part.origin, 1), isGone: isDeleted(s, k) || part.status[k] === 'rejected' });
    }
  }
  return found;
}

async function showScene(at, isNew = false) {
  if (!DATA.stamps.length) return;
  at = Math.max(0, Math.min(DATA.stamps.length - 1, at));
  if (at === scene.at && scene.sweep && !isNew) return;
  if (at !== scene.at) scene.fit = null;
  scene.at = at;
  $('scene-time').max = DATA.stamps.length - 1;
  $('scene-time').value = at;
  const stamp = sceneStamp();
  if (!scene.sweep) $('scene-clock').textContent = 'reading the recording …';
  let sweep;
  try {
    sweep = await sweepAt(stamp);
  } catch (error) {
    $('scene-clock').textContent = '';
    return failReading(error);
  }
  const boxes = await boxesAt(at);
  if (scene.at !== at) return;
  Object.assign(scene, { sweep, boxes });
  scene.zoom ||= $('scene-view').clientWidth / SHOWN;
  scene.road = roadOf(sweep);
  const count = sweep.points.length / 3;
  const missing = isAway(sweep, stamp) ? `no cloud here: that of ${number(secondsOf(sweep.stamp), 2)} s` : '';
  $('scene-clock').textContent = [`${number(DATA.times[at], 2)} s`, missing, `${number(count, 0)} points`, `${boxes.length} boxes`].filter(Boolean).join(' · ');
  clearTimeout(view.hashTimer);
  view.hashTimer = setTimeout(() => { if (!$('drive').hidden) history.replaceState(null, '', '#' + new URLSearchParams({ scene: stamp })); }, 200);
  drawScene();
  drawCameras();
}

// The height of the road below the sensor: the lower tenth of the points near it.
function roadOf({ points, sensor, origin }) {
  const heights = [];
  for (let i = 0; i < points.length; i += 3) {
    if (Math.hypot(points[i] + origin[0] - sensor[0], points[i + 1] + origin[1] - sensor[1]) < 25) heights.push(points[i + 2]);
  }
  return heights.sort((a, b) => a - b)[heights.length / 10 | 0] ?? 0;
}

// From the fixed frame to the canvas, and from there to the road. The view is orthogonal: turned about
// the vertical, then tilted. `depth` is larger farther away.
function sceneAxes() {
  const canvas = $('scene-view'), { sensor, origin } = scene.sweep, { zoom, offset, tilt, turn } = scene;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const center = [sensor[0] + offset[0], sensor[1] + offset[1], origin[2] + scene.road];
  const [c, s, flat, steep] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  const turned = (x, y) => [c * (x - center[0]) + s * (y - center[1]), c * (y - center[1]) - s * (x - center[0])];
  return {
    width, height,
    /** @type {(place: number[]) => [number, number]} */
    to: ([x, y, z = center[2]]) => {
      const [right, ahead] = turned(x, y);
      return [width / 2 + zoom * right, height / 2 - zoom * (flat * ahead + steep * (z - center[2]))];
    },
    /** @type {(place: number[]) => number} */
    depth: ([x, y, z]) => steep * turned(x, y)[1] - flat * (z - center[2]),
    from: event => {
      const bounds = canvas.getBoundingClientRect();
      const right = (event.clientX - bounds.left - width / 2) / zoom, ahead = (height / 2 - event.clientY + bounds.top) / zoom / flat;
      return [center[0] + c * right - s * ahead, center[1] + s * right + c * ahead];
    },
  };
}

// The place on the road below the pointer, or below the foremost point of an object that it is on.
function pickedPlace(event) {
  const { to, depth, from } = sceneAxes(), { points, origin } = scene.sweep, bounds = $('scene-view').getBoundingClientRect();
  const [x, y] = [event.clientX - bounds.left, event.clientY - bounds.top];
  let best = null, least = Infinity;
  for (let i = 0; i < points.length; i += 3) {
    if (points[i + 2] <= scene.road + ROAD) continue;
    const point = [points[i] + origin[0], points[i + 1] + origin[1], points[i + 2] + origin[2]], at = to(point);
    if (Math.hypot(at[0] - x, at[1] - y) < PICKED && depth(point) < least) [best, least] = [point, depth(point)];
  }
  return best ? best.slice(0, 2) : from(event);
}

function drawScene() {
  if (!scene.sweep || $('drive').hidden) return;
  const canvas = $('scene-view'), scale = devicePixelRatio, { width, height, to } = sceneAxes();
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  const { points, origin, sensor } = scene.sweep;
  for (const isObject of [false, true]) {
    const [name, alpha, size] = isObject ? LOOKS.object : LOOKS.road;
    context.fillStyle = colour(name);
    context.globalAlpha = alpha;
    for (let i = 0; i < points.length; i += 3) {
      if (points[i + 2] > scene.road + ROAD !== isObject) continue;
      const [x, y] = to([points[i] + origin[0], points[i + 1] + origin[1], points[i + 2] + origin[2]]);
      if (x > 0 && y > 0 && x < width && y < height) context.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }
  context.globalAlpha = 1;
  context.font = '11px system-ui, sans-serif';
  for (const { track, box, isGone: gone } of scene.boxes) drawSceneBox(context, to, box, gone ? 'around' : 'refined', track.id, gone, track === view.open);
  if (scene.fit) drawSceneBox(context, to, scene.fit.box, 'human', scene.fit.class, false, true);
  const [x, y] = to(sensor), nose = to([sensor[0] + 2 * Math.cos(sensor[3]), sensor[1] + 2 * Math.sin(sensor[3])]);
  context.strokeStyle = colour('input');
  context.lineWidth = 2;
  context.beginPath();
  context.arc(x, y, 4, 0, 2 * Math.PI);
  context.moveTo(x, y);
  context.lineTo(...nose);
  context.stroke();
  drawSceneTools();
}

function drawSceneBox(context, to, box, name, text, isDashed, isBold) {
  const space = corners(box), c = space.map(to), middle = k => (space[4][k] + space[6][k]) / 2;
  const nose = [0, 1, 2].map(k => (space[4][k] + space[7][k]) / 2);
  const lines = [...BOX_EDGES.map(edge => edge.map(k => c[k])), [nose, nose.map((v, k) => v + 0.25 * (v - middle(k)))].map(to)];
  context.strokeStyle = context.fillStyle = colour(name);
  context.lineWidth = isBold ? 2.5 : 1.5;
  context.setLineDash(isDashed ? [4, 4] : []);
  context.beginPath();
  for (const [a, b] of lines) {
    context.moveTo(...a);
    context.lineTo(...b);
  }
  context.stroke();
  context.setLineDash([]);
  if (scene.zoom >= LABELLED || isBold) context.fillText(text, Math.max(...c.map(p => p[0])) + 3, Math.min(...c.map(p => p[1])) + 9);
}

// What is offered while an object is added.
function drawSceneTools() {
  $('scene-add').setAttribute('aria-pressed', String(scene.isAdding));
  $('scene-view').style.cursor = scene.isAdding ? 'crosshair' : 'grab';
  $('scene-fit').hidden = !scene.fit;
  drawProposals();
  $('scene-hint').textContent = scene.fit ? `${number(scene.fit.points, 0)} points, ${scene.fit.box.slice(3, 6).map(v => number(v, 1)).join(' × ')} m. Enter follows it both ways.`
    : scene.isAdding ? 'Click the points of the object.' : 'Click a box to open its track. Drag moves, the wheel zooms, a drag with Shift turns.';
}

function sceneBoxAt(place) {
  return scene.boxes.find(({ box }) => {
    const [along, across] = toFrame([...place, box[2]], box, rotation(box));
    return Math.abs(along) < box[3] / 2 && Math.abs(across) < box[4] / 2;
  });
}

function startAdding(isAdding = !scene.isAdding) {
  scene.isAdding = isAdding;
  scene.fit = null;
  drawScene();
}

// The box of the object at a place, of its class by size or of the one chosen.
async function fitAt(place, name = '') {
  const sizes = new Map();
  for (const track of TRACKS) {
    if (!track.extents[1].every(isKnown)) continue;
    if (!sizes.has(track.class)) sizes.set(track.class, []);
    sizes.get(track.class).push(track.extents[1]);
  }
  const median = values => values.sort((a, b) => a - b)[values.length >> 1];
  const extents = Object.fromEntries([...sizes].map(([one, rows]) => [one, [0, 1, 2].map(k => median(rows.map(row => row[k])))]));
  const stamp = sceneStamp();
  let found;
  try {
    found = await post('fit', { stamp, place, class: name, extents });
  } catch (error) {
    return fail(error.message);
  }
  if (stamp !== sceneStamp()) return;
  offerFit({ ...found, stamp: scene.sweep.stamp, place });
}

// Proposals of the run that no object of a person covers yet.
function openProposals() {
  const added = DATA.tracks.filter(track => track.added && track.part && !track.withdrawn).map(track => track.part);
  return scene.proposals.filter(({ stamp, box }) => !added.some(part => {
    const own = part.usable[nearestRow(stamp, part)];
    return own && numInside([box], moved(own, part.origin, 1)) > 0;
  }));
}

function drawProposals() {
  const open = openProposals(), choice = $('scene-proposals');
  choice.hidden = !open.length;
  fill(choice, element('option', { value: '' }, `${open.length} proposed`), ...open.map((one, k) =>
    element('option', { value: k, selected: k === scene.proposal }, `${one.class} at ${number(secondsOf(one.stamp), 1)} s, ${one.points} points`)));
}

// Show a proposal as an object that is about to be added.
async function showProposal(index) {
  const one = openProposals()[index];
  if (!one) return;
  scene.proposal = index;
  const away = DATA.stamps.map(stamp => Math.abs(secondsOf(stamp) - secondsOf(one.stamp)));
  await showScene(away.indexOf(Math.min(...away)), true);
  scene.offset = [0, 1].map(k => one.box[k] - scene.sweep.sensor[k]);
  offerFit({ ...one, stamp: scene.sweep.stamp, place: one.box.slice(0, 2) });
}

const nextProposal = () => showProposal((scene.proposal + 1) % Math.max(1, openProposals().length));

// Offer a box of an object: its class can be chosen, Enter keeps it.
function offerFit(fit) {
  $('failure').hidden = true;
  scene.fit = fit;
  const names = [...new Set([...TRACKS.map(track => track.class), fit.class, 'car', 'truck', 'bus', 'cyclist', 'pedestrian'])].sort();
  fill($('scene-class'), ...names.map(one => element('option', { value: one, selected: one === fit.class }, one)));
  drawScene();
  drawCameras();
}

async function keepFit() {
  const { fit } = scene;
  if (!fit) return;
  scene.fit = null;
  scene.isAdding = false;
  scene.proposal = -1;
  drawSceneTools();
  await addObject(fit.stamp, fit.box, $('scene-class').value);
}

function playScene() {
  clearTimeout(scene.playing);
  scene.isPlaying = !scene.isPlaying;
  $('scene-play').textContent = scene.isPlaying ? 'Pause' : 'Play';
  const next = async () => {
    if (!scene.isPlaying) return;
    if (scene.at >= DATA.stamps.length - 1 || $('drive').hidden) return playScene();
    const begin = performance.now(), wait = 1000 * (DATA.times[scene.at + 1] - DATA.times[scene.at]);
    await showScene(scene.at + 1);
    scene.playing = setTimeout(next, Math.max(0, wait - performance.now() + begin));
  };
  next();
}

// Tilt and turn the view; from above the drive is shown as on the map.
function tiltScene(tilt, turn = 0) {
  scene.tilt = Math.max(0, Math.min(TILT.most, tilt));
  scene.turn = scene.tilt ? turn : 0;
  $('scene-space').setAttribute('aria-pressed', String(scene.tilt > 0));
  if (scene.sweep) drawScene();
}

const toggleSpace = () => (scene.tilt ? tiltScene(0) : tiltScene(TILT.usual, scene.sweep.sensor[3] - Math.PI / 2));

function zoomScene(factor, event = null) {
  const place = event && sceneAxes().from(event);
  scene.zoom = Math.max(1, Math.min(120, scene.zoom * factor));
  if (place) {
    const now = sceneAxes().from(event);
    scene.offset = scene.offset.map((v, k) => v + place[k] - now[k]);
  }
  drawScene();
}

function setUpScene() {
  const canvas = $('scene-view');
  let drag = null;
  canvas.onpointerdown = event => {
    if (!scene.sweep) return;
    canvas.setPointerCapture(event.pointerId);
    drag = { place: sceneAxes().from(event), x: event.clientX, y: event.clientY, far: 0, turns: event.shiftKey || event.button > 0 };
  };
  canvas.onpointermove = event => {
    if (!drag) {
      const found = scene.sweep && sceneBoxAt(sceneAxes().from(event));
      canvas.title = found ? `${found.track.id} ${found.track.class}` : '';
      return;
    }
    const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
    drag.far += Math.hypot(dx, dy);
    if (drag.far < CLICK) return;
    [drag.x, drag.y] = [event.clientX, event.clientY];
    if (drag.turns) return tiltScene(scene.tilt - TILT.pace * dy, scene.turn - TILT.pace * dx);
    const now = sceneAxes().from(event);
    scene.offset = scene.offset.map((v, k) => v + drag.place[k] - now[k]);
    drawScene();
  };
  canvas.onpointerup = event => {
    const isClick = drag && drag.far < CLICK;
    drag = null;
    if (!isClick) return;
    const place = pickedPlace(event);
    if (scene.isAdding) return void fitAt(place);
    const found = sceneBoxAt(place);
    if (found) openTrack(found.track.index, sceneStamp());
  };
  canvas.onpointercancel = () => { drag = null; };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    if (scene.sweep) zoomScene(event.deltaY < 0 ? ZOOM_STEP : 1 / ZOOM_STEP, event);
  }, { passive: false });
  $('camera-choice').onchange = drawCamera;
  $('scene-time').oninput = () => showScene(Number($('scene-time').value));
  $('scene-play').onclick = playScene;
  canvas.oncontextmenu = event => event.preventDefault();
  $('scene-space').onclick = toggleSpace;
  $('scene-proposals').onchange = event => showProposal(Number(event.target.value));
  $('scene-add').onclick = () => startAdding();
  $('scene-follow').onclick = keepFit;
  $('scene-cancel').onclick = () => startAdding(false);
  $('scene-class').onchange = event => fitAt(scene.fit.place, event.target.value);
}
