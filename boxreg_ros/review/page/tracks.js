// Tracks as decided ------------------------------------------------------------------------------
// A track of the page consists of boxes [s, k]: row k of track s of the report.

const MAX_AROUND = 12;             // neighbours that are drawn
const REACH = 20;                  // of them [m]
const MAX_CACHED = 64;             // parts of the file that stay read
const cached = new Map();

const inputOf = (s, k) => { const { inputs, owners } = DATA.tracks[s]; return inputs[owners ? owners[k] : 0] ?? DATA.tracks[s].id; };
const stampOf = (s, k) => DATA.stamps[DATA.tracks[s].at[k]];
const decidedValue = (topic, s, k) => covering(topic, inputOf(s, k), stampOf(s, k)).at(-1)?.value;
// A box that a person has set where one was deleted is there again.
const isDeleted = (s, k) => (log.ofInput.get(inputOf(s, k)) ?? []).filter(row => ['delete', 'pin', 'add'].includes(row.decision) && covers(row, stampOf(s, k))).at(-1)?.decision === 'delete';

function buildTracks() {
  const groups = new Map();
  DATA.tracks.forEach((source, s) => {
    if (source.withdrawn) return;
    for (const [id, rows] of rowsById(source, s)) {
      if (!groups.has(id)) groups.set(id, []);
      groups.get(id).push({ s, rows });
    }
  });
  return [...groups].map(([id, pieces], index) => trackOf(id, pieces, index));
}

// The rows of a track of the report by the id they have now; null stands for all of them.
function rowsById(source, s) {
  const isRenamed = source.inputs.some(input => (log.ofInput.get(input) ?? []).some(row => row.decision === 'rename'));
  if (!isRenamed) return [[source.id, null]];
  const found = new Map();
  source.at.forEach((_, k) => {
    const id = decidedValue('id', s, k) ?? source.id;
    if (!found.has(id)) found.set(id, []);
    found.get(id).push(k);
  });
  return found;
}

function trackOf(id, pieces, index) {
  const sources = pieces.map(({ s }) => DATA.tracks[s]);
  const riskiest = sources.reduce((a, b) => (b.risk > a.risk ? b : a));
  const track = { ...riskiest, id, pieces, index, rank: index + 1, isWhole: pieces.length === 1 && pieces[0].rows === null,
                  get deleted() { return topics.has('deletion') ? this.members().filter(([s, k]) => isDeleted(s, k)).length : 0; } };
  let boxes;
  track.members = () => boxes ??= pieces.flatMap(({ s, rows }) => (rows ?? DATA.tracks[s].at.map((_, k) => k)).map(k => [s, k]))
    .sort(([s, k], [t, l]) => DATA.tracks[s].at[k] - DATA.tracks[t].at[l]);
  const inputs = new Set(sources.flatMap(source => source.inputs));
  const topics = new Set([...inputs].flatMap(input => (log.ofInput.get(input) ?? []).map(row => TOPIC_OF[row.decision])));
  if (topics.has('class')) track.class = decidedValue('class', ...track.members()[0]) ?? track.class;
  if (!track.isWhole) {
    const times = track.members().map(([s, k]) => DATA.times[DATA.tracks[s].at[k]]);
    Object.assign(track, { boxes: times.length, interpolated: 0, begin: times[0], seconds: times.at(-1) - times[0],
                           path: pieces.flatMap(pathOf) });
  }
  track.sharper = track.before.cells ? 100 * (track.after.cells / track.before.cells - 1) : null;
  return track;
}

// The places on the map of a part of a track of the report.
function pathOf({ s, rows }) {
  const { path, rows: picks } = DATA.tracks[s], own = new Set(rows ?? picks);
  return path.filter((_, k) => own.has(picks[k]));
}

// The track that is open stays open, by the box that is shown.
async function rebuildTracks() {
  const shown = view.open?.members()[view.row];
  TRACKS = buildTracks();
  $('map').replaceChildren();  // it is drawn again when it is shown
  if (!shown) return;
  const [s, k] = shown;
  const index = TRACKS.findIndex(track => track.members().some(([t, l]) => t === s && l === k));
  view.track = -1;
  if (index < 0) view.open = view.part = view.edit = null;
  else await openTrack(index, null, TRACKS[index].members().findIndex(([t, l]) => t === s && l === k));
}

// Decisions are about ids and stamps of the input: the fewest scopes that are just these boxes.
function scopesOf(boxes) {
  const chosen = new Map();
  for (const [s, k] of boxes) {
    const input = inputOf(s, k);
    if (!chosen.has(input)) chosen.set(input, new Set());
    chosen.get(input).add(DATA.tracks[s].at[k]);
  }
  return [...chosen].flatMap(([input, wanted]) => {
    const runs = [];
    let isOpen = false;
    const every = stampsOfInput(input);
    for (const at of every) {
      if (!wanted.has(at)) { isOpen = false; continue; }
      if (isOpen) runs.at(-1)[1] = at;
      else runs.push([at, at]);
      isOpen = true;
    }
    if (wanted.size === every.length) return [{ track_id: input, stamp_ns: '', end_ns: '' }];
    return runs.map(([a, b]) => ({ track_id: input, stamp_ns: DATA.stamps[a], end_ns: a === b ? '' : DATA.stamps[b] }));
  });
}

const scopeOfBox = ([s, k]) => ({ track_id: inputOf(s, k), stamp_ns: stampOf(s, k), end_ns: '' });

// The rows of the drive, sorted, in which an id of the input has a box.
function stampsOfInput(input) {
  const found = DATA.tracks.flatMap((source, s) => source.inputs.includes(input) || source.id === input
    ? source.at.filter((_, k) => inputOf(s, k) === input) : []);
  return [...new Set(found)].sort((a, b) => a - b);
}

// The boxes and points of a track of the report.
async function loadPart(s) {
  if (DATA.tracks[s].part) return DATA.tracks[s].part;
  if (cached.has(s)) return cached.get(s);
  const part = decoded(JSON.parse(await inflate(await textOf('part-' + s))));
  cached.set(s, part);
  if (cached.size > MAX_CACHED) cached.delete(cached.keys().next().value);
  return part;
}

function decoded(part) {
  part.points = new Int16Array(bytesOf(part.points).buffer);
  complete(part);
  return part;
}

function complete(part) {
  part.first = [0];
  for (const count of part.counts) part.first.push(part.first.at(-1) + count);
  part.usable = part.boxes.map((box, k) => (box[0] === null ? (part.given[k][0] === null ? null : part.given[k]) : box));
}

const ROW_FIELDS = ['stamps', 'times', 'status', 'reasons', 'flipped', 'change', 'deviations', 'extent_deviations', 'risk', 'faces', 'num_points', 'counts'];
const BOX_FIELDS = ['given', 'boxes', 'truth', 'sensor'];

async function loadTrack(track) {
  const parts = new Map();
  for (const { s } of track.pieces) parts.set(s, await loadPart(s));
  if (track.isWhole) return parts.get(track.pieces[0].s);
  const { origin } = parts.values().next().value;
  const whole = { origin, iou: [[], []], points: [], attributes: [] };
  for (const name of [...ROW_FIELDS, ...BOX_FIELDS]) whole[name] = [];
  for (const [s, k] of track.members()) {
    const part = parts.get(s);
    for (const name of ROW_FIELDS) whole[name].push(part[name][k]);
    for (const name of BOX_FIELDS) whole[name].push(part[name][k].map((v, i) => (v === null || i > 2 ? v : v + part.origin[i] - origin[i])));
    whole.attributes.push(part.attributes?.[k] ?? {});
    for (const which of [0, 1]) whole.iou[which].push(part.iou[which][k]);
    for (let i = 3 * part.first[k]; i < 3 * part.first[k + 1]; i++) whole.points.push(part.points[i]);
  }
  complete(whole);
  return whole;
}

// The nearest other tracks of the same time, as their parts.
async function loadAround(track) {
  const own = new Set(track.pieces.map(({ s }) => s));
  const end = track.begin + track.seconds;
  const away = other => Math.min(...other.path.flatMap(([x, y]) => track.path.map(([u, v]) => Math.hypot(x - u, y - v))));
  /** @type {[number, number][]} */
  const near = DATA.tracks.map((other, s) => /** @type {[number, Source]} */ ([s, other]))
    .filter(([s, other]) => !own.has(s) && other.begin <= end && other.begin + other.seconds >= track.begin)
    .map(([s, other]) => /** @type {[number, number]} */ ([s, away(other)])).filter(([, distance]) => distance < REACH)
    .sort((a, b) => a[1] - b[1]).slice(0, MAX_AROUND);
  const found = [];
  for (const [s] of near) {
    const part = await loadPart(s);
    found.push({ s, part, rows: new Map(part.stamps.map((stamp, k) => [stamp, k])) });
  }
  return found;
}

// Neighbours at a stamp: boxes and points relative to an origin.
function aroundAt(stamp, origin) {
  return view.around.flatMap(({ s, part, rows }) => {
    const k = rows.get(stamp);
    if (k === undefined || !part.usable[k] || isDeleted(s, k)) return [];
    const moved = values => values.map((v, i) => (i > 2 ? v : v + part.origin[i] - origin[i]));
    return [{ box: moved(part.usable[k]), points: pointsAt(part, k).map(moved), id: DATA.tracks[s].id }];
  });
}

function pointsAt(part, row) {
  const box = part.usable[row];
  const points = [];
  for (let k = part.first[row]; k < part.first[row + 1]; k++) {
    points.push([0, 1, 2].map(a => box[a] + part.points[3 * k + a] / 1000));
  }
  return points;
}

function frameBox(part, row, mode) {
  const given = part.given[row];
  if (mode !== 'before') return part.usable[row];
  if (given[0] === null) return null;
  return part.flipped[row] ? flipped(given) : given;
}

function localPoints(part, row, mode) {
  const rows = mode === 'sweep' ? [row] : part.usable.keys();
  const local = [];
  for (const one of rows) {
    const box = part.usable[one] && frameBox(part, one, mode);
    if (!box) continue;
    const R = rotation(box);
    for (const point of pointsAt(part, one)) local.push(toFrame(point, box, R));
  }
  return local;
}
