// Whole clouds of the recording, which the server reads when they are asked for -------------------

const MAX_SWEEPS = 24;             // that stay read
const AWAY = 0.15;                 // a sweep farther from a stamp is not that of its boxes [s]
const HEAD = 64;                   // bytes before the points: stamp, origin, position and heading of the sensor
const sweeps = new Map();          // by stamp, as promises
let hasScene = false;              // whether the server knows the recording

// A sweep: stamp, sensor, and points relative to an origin, as x y z one after the other.
function sweepAt(stamp) {
  if (!sweeps.has(stamp)) {
    sweeps.set(stamp, readSweep(stamp));
    if (sweeps.size > MAX_SWEEPS) sweeps.delete(sweeps.keys().next().value);
  }
  return sweeps.get(stamp);
}

async function readSweep(stamp) {
  const response = await fetch('sweep?stamp=' + stamp);
  if (!response.ok) {
    sweeps.delete(stamp);
    throw new Error(await response.text());
  }
  const bytes = await response.arrayBuffer(), head = new Float64Array(bytes, 8, 7);
  return { stamp: String(new BigInt64Array(bytes, 0, 1)[0]), origin: [...head.subarray(0, 3)], sensor: [...head.subarray(3, 7)], points: new Float32Array(bytes, HEAD) };
}

// Whether a sweep, the nearest to a stamp, is too far from it: clouds are missing there.
const isAway = (sweep, stamp) => Math.abs(secondsOf(sweep.stamp) - secondsOf(stamp)) > AWAY;

const failReading = error => fail(`No whole clouds are shown: ${error.message}. Put the recording back where it was; decisions are saved without it.`);

// The cloud around the box that is shown, in the axes of the track.
async function loadCloud() {
  const track = view.open, stamp = view.part.stamps[view.row];
  if (!hasScene || view.cloud?.stamp === stamp && view.cloud.track === track) return;
  let found;
  try {
    found = await sweepAt(stamp);
  } catch (error) {
    hasScene = false;  // the neighbours' points are shown instead
    return failReading(error);
  }
  if (view.open !== track || view.part.stamps[view.row] !== stamp || isAway(found, stamp)) return;
  const box = view.part.usable[view.row];
  const shift = [0, 1, 2].map(k => found.origin[k] - view.part.origin[k]);
  const points = [];
  for (let i = 0; box && i < found.points.length; i += 3) {
    const point = [found.points[i] + shift[0], found.points[i + 1] + shift[1], found.points[i + 2] + shift[2]];
    if (Math.hypot(point[0] - box[0], point[1] - box[1]) < REACH) points.push(point);
  }
  view.cloud = { stamp, track, points };
  drawViews();
}

// The points of all sweeps in the boxes of the track, from whole clouds.
async function loadAccumulated(mode) {
  const part = view.part, key = JSON.stringify([view.open.id, mode]);
  if (!hasScene || view.accumulated?.key === key && view.accumulated.part === part) return;
  view.accumulated = { key, part, points: null };
  const boxes = [...part.usable.keys()].flatMap(row => {
    const box = part.usable[row] && frameBox(part, row, mode);
    return box ? [{ stamp: part.stamps[row], box: moved(box, part.origin, 1) }] : [];
  });
  if (!boxes.length) return;
  const response = await fetch('accumulated', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ boxes }) });
  if (!response.ok) return;
  const values = new Float32Array(await response.arrayBuffer()), points = [];
  for (let i = 0; i < values.length; i += 3) points.push([values[i], values[i + 1], values[i + 2]]);
  if (view.accumulated?.key !== key) return;
  view.accumulated.points = points;
  if (view.part === part) drawViews();
}
