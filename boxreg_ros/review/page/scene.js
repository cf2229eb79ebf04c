// The scene: the whole cloud of a sweep from above or in 3D, all boxes, and objects that are missing -

const CLICK = 4;                   // a pointer that moves less has clicked [px]
const LABELLED = 5;                // ids are written at this zoom and above [px/m]
const ROAD = 0.4;                  // above the road: points of objects [m]
const SHOWN = 90;                  // of the drive around the sensor [m]
const DRAWN = [4.5, 1.9, 1.6];     // length, width and height of a box by hand where the drive has none of its class [m]
const PICKED = 6;                  // a click is on a point this near [px]
const TILT = { usual: 1, most: 1.3, pace: 0.006 };  // of the view in 3D, from above [rad], and of a drag [rad/px]
/** @type {{ [name: string]: any, zoom: number, tilt: number, turn: number, sweep: Sweep, boxes: SceneBox[], fit: Fit, slim: Map<number, SlimPart> }} */
const scene = { at: 0, zoom: 0, offset: [0, 0], tilt: 0, turn: 0, sweep: null, boxes: [], clouds: [], isAdding: false, fit: null, proposals: [], proposal: -1, playing: 0, slim: new Map() };
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
      if (box) found.push({ s, k, track, status: part.status[k], box: moved(box, part.origin, 1), isGone: isDeleted(s, k) || (part.status[k] === 'rejected' && !isAccepted(s, k)) });
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
  Object.assign(scene, { sweep, boxes, clouds: [sweep] });
  scene.zoom ||= $('scene-view').clientWidth / SHOWN;
  scene.road = roadOf(sweep);
  const count = sweep.points.length / 3;
  const missing = isAway(sweep, stamp) ? `no cloud here: that of ${number(secondsOf(sweep.stamp), 2)} s` : '';
  $('scene-clock').textContent = [`${number(DATA.times[at], 2)} s`, missing, `${number(count, 0)} points`, `${boxes.length} boxes`].filter(Boolean).join(' · ');
  clearTimeout(view.hashTimer);
  view.hashTimer = setTimeout(() => { if (!$('drive').hidden) history.replaceState(null, '', '#' + new URLSearchParams({ scene: stamp })); }, 200);
  drawScene();
  drawCameras();
  addClouds(at);
}

// Draw the sweeps nearest to this one with it, as they are read.
async function addClouds(at) {
  const count = Number($('scene-sweeps').value);
  const near = DATA.stamps.map((_, k) => k).sort((a, b) => Math.abs(a - at) - Math.abs(b - at)).slice(1, count);
  for (const k of near) {
    const cloud = await sweepAt(DATA.stamps[k]).catch(() => null);
    if (scene.at !== at || Number($('scene-sweeps').value) !== count) return;
    if (cloud && !scene.clouds.includes(cloud)) scene.clouds.push(cloud);
  }
  if (near.length) drawScene();
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
  const { sensor, origin } = scene.sweep, { offset } = scene;
  return axesOf($('scene-view'), [sensor[0] + offset[0], sensor[1] + offset[1], origin[2] + scene.road], scene);
}

// The same for any canvas, and the place in its middle.
function axesOf(canvas, center, { zoom, tilt, turn }) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [c, s, flat, steep] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  const turned = (x, y) => [c * (x - center[0]) + s * (y - center[1]), c * (y - center[1]) - s * (x - center[0])];
  return {
    width, height, center, zoom, tilt, turn,
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
  const canvas = $('scene-view'), scale = devicePixelRatio, axes = sceneAxes(), { width, height, to } = axes;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  const { points, origin, sensor } = scene.sweep, mode = $('scene-colour').value;
  const key = [mode, scene.road, colour('points'), mode === 'object' || mode === 'height' ? '' : `${scene.at} ${log.count}`].join(' ');
  const isDrawn = drawClouds($('scene-points'), scene.clouds, axes, key, scene.zoom > CLOSE_UP ? 2.5 : 1.6);
  for (const isObject of isDrawn ? [] : [false, true]) {
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
  for (const one of scene.boxes) drawSceneBox(context, to, one.box, boxColour(one), one.track.id, one.isGone, one.track === view.open);
  if (scene.fit) drawSceneBox(context, to, scene.fit.box, colour('human'), scene.fit.class, false, true);
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

function drawSceneBox(context, to, box, style, text, isDashed, isBold) {
  const space = corners(box), c = space.map(to), middle = k => (space[4][k] + space[6][k]) / 2;
  const nose = [0, 1, 2].map(k => (space[4][k] + space[7][k]) / 2);
  const lines = [...BOX_EDGES.map(edge => edge.map(k => c[k])), [nose, nose.map((v, k) => v + 0.25 * (v - middle(k)))].map(to)];
  context.strokeStyle = context.fillStyle = style;
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
    : scene.isAdding ? 'Click the points of the object, or drag from its rear to its front.' : 'Click opens a track. Drag moves, with Shift turns, with Ctrl draws a box; the wheel zooms.';
  $('scene-hint').title = $('scene-hint').textContent;
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

const MIN_TRACKS = 3;              // of a class, for its size to be used for what is drawn
// The median extents of each class of the drive with enough tracks.
function usualExtents(least = 1) {
  const sizes = new Map();
  for (const track of TRACKS) {
    if (!track.extents[1].every(isKnown)) continue;
    if (!sizes.has(track.class)) sizes.set(track.class, []);
    sizes.get(track.class).push(track.extents[1]);
  }
  const median = values => values.sort((a, b) => a - b)[values.length >> 1];
  return Object.fromEntries([...sizes].filter(([, rows]) => rows.length >= least).map(([one, rows]) => [one, [0, 1, 2].map(k => median(rows.map(row => row[k])))]));
}

// A box by hand: from its rear to its front, as wide and as high as its class.
/** @type {(rear: number[], front: number[]) => void} */
function drawByHand([x, y], [u, v]) {
  const usual = usualExtents(), name = classNames()[0] ?? 'car';
  const [, width, height] = usual[name] ?? DRAWN;
  const box = [(x + u) / 2, (y + v) / 2, scene.sweep.origin[2] + scene.road + height / 2, Math.hypot(u - x, v - y), width, height, 0, 0, Math.atan2(v - y, u - x)];
  offerFit({ box, class: name, points: numInside(scenePoints(), box), stamp: scene.sweep.stamp, place: box.slice(0, 2), isByHand: true });
}

// The box that was drawn: its class by length and height, as wide and as high as its points.
async function completeDrawn(rear, front) {
  const { fit } = scene;
  let found;
  try {
    found = await post('fit', { stamp: fit.stamp, place: rear, front, class: '', extents: usualExtents(MIN_TRACKS) });
  } catch (error) {
    return fail(error.message);
  }
  if (scene.fit === fit) offerFit({ ...fit, ...found, place: found.box.slice(0, 2) });
}

function scenePoints() {
  const { points, origin } = scene.sweep, found = [];
  for (let i = 0; i < points.length; i += 3) found.push([points[i] + origin[0], points[i + 1] + origin[1], points[i + 2] + origin[2]]);
  return found;
}

// Correct a box of the scene: that of a track, or below the pointer.
function editBox(track = view.open) {
  const one = scene.boxes.find(box => box === scene.hovered) ?? scene.boxes.find(box => box.track === track);
  if (!one) return say('Point at a box, or open its track first.');
  const { track_id: of, stamp_ns: stamp } = scopeOfBox([one.s, one.k]), pin = log.held.get(scopeKey(isAdded(one.s, one.k) ? 'addition' : 'judgement', scopeOfBox([one.s, one.k])));
  const box = ['pin', 'add'].includes(pin?.decision) ? pin.box : one.box;
  offerFit({ box: box.slice(), class: one.track.class, points: numInside(scenePoints(), box), stamp, place: box.slice(0, 2), isByHand: true, of });
}

// What the pointer takes hold of in the box that is offered, from above.
function sceneGrip(event) {
  if (!scene.fit || scene.isAdding || event.ctrlKey || event.shiftKey || event.button || scene.tilt) return null;
  const { box } = scene.fit, at = toFrame([...sceneAxes().from(event), box[2]], box, rotation(box));
  return gripOf(at, box, GRIP / scene.zoom, [0, 1]);
}

function dragFit(grip, event) {
  const fit = scene.fit, R = rotation(fit.box), at = toFrame([...sceneAxes().from(event), fit.box[2]], fit.box, R);
  const box = fit.box.slice(), shift = [0, 0, 0];
  if (grip.turns) box[8] += Math.atan2(at[1], at[0]);
  else if (grip.face) {
    const [axis, sign] = grip.face, size = Math.max(LEAST_SIZE, box[3 + axis] / 2 + sign * at[axis]);
    shift[axis] = sign * (size - box[3 + axis]) / 2;
    box[3 + axis] = size;
  } else for (const k of [0, 1]) shift[k] = at[k] - grip.last[k];
  box.splice(0, 3, ...fromFrame(shift, fit.box, R));
  Object.assign(fit, { box, place: box.slice(0, 2), isByHand: true, points: numInside(scenePoints(), box) });
  drawScene();
}

function flipFit() {
  if (!scene.fit) return;
  scene.fit.box = flipped(scene.fit.box);
  drawScene();
  drawCameras();
}

// Another class: what was drawn by hand or copied keeps its place and size.
function chooseClass(name) {
  if (!scene.fit || !name) return;
  if (!scene.fit.isByHand) return fitAt(scene.fit.place, name);
  offerFit({ ...scene.fit, class: name });
}

// Offer the box of the open track here, moved as between, or beyond, its two nearest boxes.
function copyBox() {
  const part = view.part, stamp = scene.sweep?.stamp;
  if (!part || !stamp) return say('Open the track first, then copy its box in Drive.');
  const at = secondsOf(stamp), rows = [...part.usable.keys()].filter(row => part.usable[row]);
  if (rows.length < 1) return;
  const [a, b = a] = rows.sort((j, k) => Math.abs(secondsOf(part.stamps[j]) - at) - Math.abs(secondsOf(part.stamps[k]) - at));
  const [first, second] = [a, b].map(row => moved(pinOf(row) ? moved(pinOf(row).box, part.origin, -1) : part.usable[row], part.origin, 1));
  const [s, t] = [a, b].map(row => secondsOf(part.stamps[row])), share = a === b ? 0 : (at - s) / (t - s);
  const box = first.map((v, k) => (k < 3 ? v + share * (second[k] - v) : v));
  offerFit({ box, class: current().class, points: numInside(scenePoints(), box), stamp, place: box.slice(0, 2), isByHand: true, of: scopeOfBox(boxAt(a)).track_id });
}

// The box of the object at a place, of its class by size or of the one chosen.
async function fitAt(place, name = '') {
  const extents = usualExtents(), stamp = sceneStamp();
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
  const names = [...new Set([...classNames(), fit.class, ...(view.classes.length ? [] : ['car', 'truck', 'bus', 'cyclist', 'pedestrian'])])];
  fill($('scene-class'), ...names.map(one => element('option', { value: one, selected: one === fit.class }, one)));
  drawScene();
  drawCameras();
}

// A copied box is one more of its track: a seed of an added object, else a pin, which a run uses as a keyframe.
/** @param {Fit} fit */
async function keepCopy({ of, stamp, box, class: name }) {
  const scope = { track_id: of, stamp_ns: stamp, end_ns: '' };
  if (!await decide([seedsOf(of).length ? rowOf(scope, 'add', { box, value: name }) : rowOf(scope, 'pin', { box })])) return false;
  const row = view.part ? view.part.stamps.indexOf(stamp) : -1;
  say(row >= 0 ? `Track ${of} has this box.` : `Track ${of} has this box in the labels that are written next.`);
  return true;
}

async function keepFit() {
  const { fit } = scene;
  if (!fit) return;
  if (scene.isKeeping) return;
  scene.isKeeping = true;
  const isAdded = await (fit.of ? keepCopy(fit) : addObject(fit.stamp, fit.box, $('scene-class').value, fit.isByHand));
  scene.isKeeping = false;
  if (!isAdded) return;  // it is not saved: the box stays
  scene.isAdding = false;
  scene.proposal = -1;
  if (scene.fit === fit) scene.fit = null;
  drawSceneTools();
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

function wholeScene() {
  scene.offset = [0, 0];
  scene.zoom = $('scene-view').clientWidth / SHOWN;
  drawScene();
}

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
  setUpPinch(canvas, (factor, event) => scene.sweep && zoomScene(factor, event));
  let drag = null;
  canvas.onpointerdown = event => {
    if (!scene.sweep) return;
    canvas.setPointerCapture(event.pointerId);
    drag = { place: sceneAxes().from(event), x: event.clientX, y: event.clientY, far: 0, turns: event.shiftKey || event.button > 0, draws: (scene.isAdding || event.ctrlKey) && !event.shiftKey && !event.button, grip: sceneGrip(event) };
  };
  canvas.onpointermove = event => {
    if (!drag) {
      const found = scene.hovered = scene.sweep && sceneBoxAt(sceneAxes().from(event));
      canvas.title = found ? `${found.track.id} ${found.track.class}` : '';
      return;
    }
    const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
    drag.far += Math.hypot(dx, dy);
    if (drag.far < CLICK) return;
    if (drag.grip) return dragFit(drag.grip, event);
    if (drag.draws) return drawByHand(drag.place, sceneAxes().from(event));
    [drag.x, drag.y] = [event.clientX, event.clientY];
    if (drag.turns) return tiltScene(scene.tilt - TILT.pace * dy, scene.turn - TILT.pace * dx);
    const now = sceneAxes().from(event);
    scene.offset = scene.offset.map((v, k) => v + drag.place[k] - now[k]);
    drawScene();
  };
  canvas.onpointerup = event => {
    const isClick = drag && drag.far < CLICK;
    const isHeld = drag?.grip;
    if (drag?.draws && !isClick && scene.fit) completeDrawn(drag.place, sceneAxes().from(event));
    drag = null;
    if (isHeld) drawCameras();
    if (!isClick || isHeld) return;
    const place = pickedPlace(event);
    if (scene.isAdding) return void fitAt(place);
    const found = sceneBoxAt(place);
    if (found) openTrack(found.track.index, sceneStamp());
  };
  canvas.onpointercancel = () => { drag = null; };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    if (scene.sweep) zoomScene(wheelFactor(event), event);
  }, { passive: false });
  $('camera-choice').onchange = drawCamera;
  $('scene-colour').onchange = drawScene;
  $('scene-sweeps').onchange = () => showScene(scene.at, true);
  $('scene-in-image').onchange = drawCameras;
  $('scene-time').oninput = () => showScene(Number($('scene-time').value));
  $('scene-play').onclick = playScene;
  canvas.oncontextmenu = event => event.preventDefault();
  $('scene-space').onclick = toggleSpace;
  $('scene-proposals').onchange = event => showProposal(Number(event.target.value));
  $('scene-add').onclick = () => startAdding();
  $('scene-follow').onclick = keepFit;
  $('scene-cancel').onclick = () => startAdding(false);
  $('scene-class').onchange = event => chooseClass(event.target.value);
}
