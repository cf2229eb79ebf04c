// Camera images with the boxes in them -----------------------------------------------------------

const NEAREST = 0.2;               // parts of a box nearer to a camera are not drawn [m]
const WIDEST = 1.4;                // the model of a lens holds up to this angle off its axis [rad]
const PARTS = 8;                   // of an edge, which a lens bends
const MAX_IMAGES = 24;             // that stay read
const BOX_EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const images = new Map();          // by camera and stamp, as promises
const cameras = { at: new Map(), wanted: '', shown: '' };

// The cameras with their poses at a stamp.
function camerasAt(stamp) {
  if (!cameras.at.has(stamp)) {
    cameras.at.set(stamp, fetch('cameras?stamp=' + stamp).then(async response => (response.ok ? response.json() : [])));
    if (cameras.at.size > 200) cameras.at.delete(cameras.at.keys().next().value);
  }
  return cameras.at.get(stamp);
}

// An image nearest to a stamp: bitmap, its stamp, and the pose of the camera then.
function imageAt(index, stamp) {
  const key = `${index} ${stamp}`;
  if (!images.has(key)) {
    images.set(key, readImage(index, stamp));
    if (images.size > MAX_IMAGES) images.delete(images.keys().next().value);
  }
  return images.get(key);
}

async function readImage(index, stamp) {
  const response = await fetch(`image?camera=${index}&stamp=${stamp}`);
  if (!response.ok) return { error: await response.text() };
  try {
    return { bitmap: await createImageBitmap(await response.blob()), stamp: response.headers.get('x-stamp'), pose: JSON.parse(response.headers.get('x-pose')) };
  } catch {
    return { error: 'the image is damaged' };
  }
}

const inCamera = (pose, point) => [0, 1, 2].map(k => pose[k][0] * point[0] + pose[k][1] * point[1] + pose[k][2] * point[2] + pose[k][3]);

// The pixel of a point in the axes of a camera; null where there is none.
/** @param {Camera} camera @param {number[]} point */
function pixelOf({ matrix, distortion, model }, [x, y, z]) {
  if (z < NEAREST || Math.atan2(Math.hypot(x, y), z) > WIDEST) return null;
  let [u, v] = [x / z, y / z];
  if (distortion.length >= 4) [u, v] = (/equidistant|fisheye|kannala/i.test(model) ? bentByAngle : bent)(distortion, u, v);
  const [a, b, c] = [0, 1, 2].map(k => matrix[k][0] * u + matrix[k][1] * v + matrix[k][2] + matrix[k][3] / z);
  return [a / c, b / c];
}

// Plumb bob and its rational form.
/** @type {(values: number[], u: number, v: number) => number[]} */
const bent = ([k1, k2, p1, p2, k3 = 0, k4 = 0, k5 = 0, k6 = 0], u, v) => {
  const r2 = u * u + v * v;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v];
};

/** @type {(values: number[], u: number, v: number) => number[]} */
const bentByAngle = ([k1, k2, k3, k4], u, v) => {
  const r = Math.hypot(u, v), angle = Math.atan(r), a2 = angle * angle;
  const scale = r > 1e-9 ? angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r : 1;
  return [u * scale, v * scale];
};

// How well a camera sees a box in the fixed frame: its place from the middle of the image; larger is worse.
function offMiddle(camera, box) {
  if (!camera.pose || !camera.matrix) return Infinity;
  const pixel = pixelOf(camera, inCamera(camera.pose, box));
  if (!pixel) return Infinity;
  const [width, height] = camera.size;
  const off = Math.max(Math.abs(pixel[0] / width - 0.5), Math.abs(pixel[1] / height - 0.5));
  return off < 0.6 ? off : Infinity;
}

// The outline of a box in the fixed frame, as lines of pixels.
function outlineIn(camera, pose, box) {
  const c = corners(box).map(corner => inCamera(pose, corner));
  return BOX_EDGES.map(([a, b]) => Array.from({ length: PARTS + 1 }, (_, i) =>
    pixelOf(camera, [0, 1, 2].map(k => c[a][k] + i / PARTS * (c[b][k] - c[a][k])))));
}

const MAX_DOTS = 12000;             // points that are drawn in an image
const FARTHEST = 60;               // the last colour of distances [m]

// Points of a sweep in an image, red nearby, blue far away.
function drawDots(context, at, camera, pose, { points, origin }) {
  const every = 3 * Math.ceil(points.length / 3 / MAX_DOTS);
  for (let i = 0; i < points.length; i += every) {
    const point = inCamera(pose, [points[i] + origin[0], points[i + 1] + origin[1], points[i + 2] + origin[2]]), pixel = pixelOf(camera, point);
    if (!pixel || pixel[0] < 0 || pixel[1] < 0 || pixel[0] > camera.size[0] || pixel[1] > camera.size[1]) continue;
    context.fillStyle = `hsl(${240 * Math.min(1, point[2] / FARTHEST)} 90% 50%)`;
    const [x, y] = at(pixel);
    context.fillRect(x - 1, y - 1, 2, 2);
  }
}

// Draw an image with boxes `{ name, box, isBold }` and the points of a sweep, if any; `focus` is a box that it is enlarged around, or null.
function drawImage(canvas, camera, found, boxes, focus, sweep = null) {
  const scale = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  if (found.error) return;
  const { bitmap, pose } = found, whole = Math.min(width / bitmap.width, height / bitmap.height);
  let [zoom, middle] = [whole, [bitmap.width / 2, bitmap.height / 2]];
  const model = pose && camera.matrix ? camera : null;
  if (model && focus) {
    const seen = outlineIn(model, pose, focus).flat().filter(Boolean);
    if (seen.length) {
      const [low, high] = [0, 1].map(k => seen.map(p => p[k])).map(values => [Math.min(...values), Math.max(...values)]).reduce(([a, b], [l, h]) => [[...a, l], [...b, h]], [[], []]);
      zoom = Math.max(whole, Math.min(8 * whole, 0.4 * width / Math.max(1, high[0] - low[0]), 0.4 * height / Math.max(1, high[1] - low[1])));
      const half = [width / 2 / zoom, height / 2 / zoom], size = [bitmap.width, bitmap.height];
      middle = [0, 1].map(k => (2 * half[k] > size[k] ? size[k] / 2 : Math.max(half[k], Math.min(size[k] - half[k], (low[k] + high[k]) / 2))));
    }
  }
  /** @type {(pixel: number[]) => [number, number]} */
  const at = ([u, v]) => [width / 2 + zoom * (u + 0.5 - middle[0]), height / 2 + zoom * (v + 0.5 - middle[1])];
  canvas.at = at;
  context.drawImage(bitmap, ...at([-0.5, -0.5]), zoom * bitmap.width, zoom * bitmap.height);
  if (!model) return;
  if (sweep) drawDots(context, at, model, pose, sweep);
  for (const { name, box, isBold } of boxes) {
    context.strokeStyle = colour(name);
    context.lineWidth = isBold ? 2 : 1;
    context.setLineDash(DASHES[name] ?? []);
    context.beginPath();
    for (const line of outlineIn(model, pose, box)) line.forEach((pixel, i) => pixel && context[i && line[i - 1] ? 'lineTo' : 'moveTo'](...at(pixel)));
    context.stroke();
  }
  context.setLineDash([]);
}

// The box of the open track at a time between two of its stamps, in the fixed frame.
function boxAtTime(part, row, stamp) {
  const off = Number(BigInt(stamp) - BigInt(part.stamps[row])) * 1e-9, other = row + Math.sign(off);
  const [box, next] = [part.usable[row], part.usable[other]];
  if (!off || !next) return moved(box, part.origin, 1);
  const share = Math.min(1, off / (part.times[other] - part.times[row]));
  const turn = Math.atan2(Math.sin(next[8] - box[8]), Math.cos(next[8] - box[8]));
  const between = box.map((v, k) => (k < 3 ? v + share * (next[k] - v) : k === 8 ? v + share * turn : v));
  return moved(between, part.origin, 1);
}

// The image of the open track: of the camera that was chosen, or that sees the box best.
async function drawCamera() {
  if (!hasScene || !view.part?.usable[view.row]) return void ($('camera').hidden = true);
  const part = view.part, row = view.row, stamp = part.stamps[row];
  const key = cameras.wanted = `${view.open.id} ${stamp}`;
  const known = await camerasAt(stamp);
  $('camera').hidden = !known.length;
  if (!known.length || cameras.wanted !== key) return;
  const center = moved(part.usable[row], part.origin, 1), chosen = $('camera-choice').value;
  fillCameras(known);
  const best = known.map((camera, index) => [offMiddle(camera, center), index]).sort((a, b) => a[0] - b[0])[0];
  const index = chosen === '' ? best[1] : Number(chosen), camera = known[index];
  const found = await imageAt(index, stamp);
  if (cameras.wanted !== key || view.part !== part) return;
  cameras.shown = key;
  const late = found.error ? 0 : Number(BigInt(found.stamp) - BigInt(stamp)) * 1e-6;
  const isSeen = offMiddle(camera, center) < Infinity;
  const note = !camera.matrix ? 'no camera model recorded' : !(found.pose ?? camera.pose) ? 'no transform to this camera' : isSeen ? '' : 'the box is not in this image';
  $('camera-text').textContent = [camera.topic, found.error ?? `${late > 0 ? '+' : ''}${number(late, 0)} ms`, note].filter(Boolean).join(' · ');
  const shift = boxAtTime(part, row, found.stamp ?? stamp).map((v, k) => v - center[k]);
  const boxes = currentBoxes().map(([name, box]) => ({ name, box: moved(box, part.origin, 1).map((v, k) => v + (k < 3 || k === 8 ? shift[k] : 0)), isBold: true }));
  drawImage($('camera-view'), camera, found, boxes, isSeen ? boxes.find(({ name }) => name !== 'input')?.box ?? center : null);
}

function fillCameras(known) {
  const choice = $('camera-choice');
  if (choice.options.length === known.length + 1) return;
  fill(choice, element('option', { value: '' }, 'best camera'), ...known.map(({ topic }, index) => element('option', { value: index }, topic)));
}

// All images of the sweep of the drive that is shown, each with all boxes.
async function drawCameras() {
  const stamp = sceneStamp(), known = await camerasAt(stamp), box = $('drive-cameras');
  box.hidden = $('scene-image').hidden = !known.length;
  if (box.children.length !== known.length) {
    fill(box, ...known.map(({ topic }) => element('figure', {}, element('figcaption', {}, topic), element('canvas', { role: 'img', 'aria-label': `Image of ${topic}` }))));
    drawScene();
  }
  for (const [index, camera] of known.entries()) {
    imageAt(index, stamp).then(found => {
      if (stamp !== sceneStamp() || $('drive').hidden) return;
      const boxes = scene.boxes.filter(({ isGone: gone }) => !gone).map(({ track, box: one }) => ({ name: 'refined', box: one, isBold: track === view.open }));
      if (scene.fit) boxes.push({ name: 'human', box: scene.fit.box, isBold: true });
      box.children[index].querySelector('figcaption').textContent = [camera.topic, found.error].filter(Boolean).join(' · ');
      drawImage(box.children[index].querySelector('canvas'), camera, found, boxes, null, $('scene-in-image').checked ? scene.sweep : null);
    });
  }
}
