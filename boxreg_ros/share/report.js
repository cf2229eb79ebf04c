'use strict';
// The page of `boxreg relabel --report` and `boxreg review`. Boxes are x y z length width height
// roll pitch yaw [m, rad]; R = Rz(yaw) Ry(pitch) Rx(roll).

const $ = id => document.getElementById(id);
const IS_REVIEW = document.documentElement.hasAttribute('data-review');
const STEP = 0.02;                 // of a key that moves or resizes a box [m]
const TURN = 0.5 * Math.PI / 180;  // of a key that turns a box [rad]
const FACES = ['front', 'rear', 'left', 'right', 'top'];
const MIN_FACE_POINTS = 5;         // fewer points do not show where a face is
const OUTER_PART = 0.1;            // of the points near a face are its outermost points
const FRAME = 12;                  // time for the 3D view at 60 frames per second [ms]
const PAUSE = 120;                 // between two steps of one who stops to look [ms]
const ZOOM_STEP = 1.25;             // of a key
const MAX_ZOOM = 10;               // a box of 5 m then shows 1 mm per pixel
const CHANGED = {
  moved: ['moved more than 0.2 m', t => t.shift > 0.2],
  turned: ['turned more than 2°', t => t.turn > 2],
  flipped: ['heading flipped', t => t.flips > 0],
  resized: ['resized more than 0.2 m', t => t.resized > 0.2],
};
let DATA;
const MEANINGS = [                  // of words in the reasons of a risk
  ['uncertain', 'expected error by the standard deviations of the estimate'],
  ['off their points', 'the outermost points of these faces are not where the estimate expects them'],
  ['points left outside', 'more of the points near the box are outside of it than in other tracks'],
  ['estimates disagree', 'the early and the final estimate overlap less than their deviations explain'],
  ['size unlike its class', 'extents more than two deviations off the median of the class'],
  ['id switch', 'the track jumps by more than half an extent: it may go on with another object'],
  ['kept as in the input', 'the input box was returned unchanged'],
  ['few points', 'median of the points per box'],
];
const view = { track: -1, part: null, row: 0, sort: 'rank', descending: false, shown: [], place: 0, mode: 'sweep',
               space: false, charts: false, pending: false, edit: null, isMoved: false, playing: 0, zoom: 1 };
const decisions = new Map();       // by track and stamp
const decidedBoxes = new Map();    // their number by track
const made = [];                   // what held before each decision, for undo

// Small helpers ---------------------------------------------------------------------------------

const isKnown = value => value !== null && value !== undefined && Number.isFinite(value);
const number = (value, digits = 2) => isKnown(value) ? value.toLocaleString('en', { minimumFractionDigits: digits, maximumFractionDigits: digits }) : '–';
const colour = name => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();
const keyOf = (id, stamp = '') => id + '\n' + stamp;

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) made[name] = value;
    else if (value === true) made.setAttribute(name, '');
    else if (value !== false && value !== null) made.setAttribute(name, value);
  }
  made.append(...children.filter(child => child !== null));
  return made;
}

function fill(parent, ...children) { parent.replaceChildren(...children.filter(child => child !== null)); }

async function inflate(base64) {
  const bytes = Uint8Array.from(atob(base64), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).text();
}

// While the page is read, an element may be missing or incomplete: whole is one that another follows.
async function textOf(id) {
  if (!$(id)?.nextSibling && document.readyState === 'loading') {
    await new Promise(done => document.addEventListener('DOMContentLoaded', done, { once: true }));
  }
  return $(id).textContent;
}

// The page as it is now has been painted.
function painted() { return new Promise(done => requestAnimationFrame(() => setTimeout(done))); }

function fail(text) {
  $('failure').textContent = text;
  $('failure').hidden = false;
}

// Geometry --------------------------------------------------------------------------------------

function rotation([, , , , , , roll, pitch, yaw]) {
  const [a, b, c, d, e, f] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch), Math.cos(roll), Math.sin(roll)];
  return [[a * c, a * d * f - b * e, a * d * e + b * f], [b * c, b * d * f + a * e, b * d * e - a * f], [-d, c * f, c * e]];
}

function toFrame(point, box, R) {
  const d = [point[0] - box[0], point[1] - box[1], point[2] - box[2]];
  return [0, 1, 2].map(k => d[0] * R[0][k] + d[1] * R[1][k] + d[2] * R[2][k]);
}

function fromFrame(point, box, R) {
  return [0, 1, 2].map(k => box[k] + R[k][0] * point[0] + R[k][1] * point[1] + R[k][2] * point[2]);
}

function flipped(box) { const turned = box.slice(); turned[8] += Math.PI; return turned; }

function quaternion([, , , , , , roll, pitch, yaw]) {
  const [c, s] = [[roll, pitch, yaw].map(v => Math.cos(v / 2)), [roll, pitch, yaw].map(v => Math.sin(v / 2))];
  return [s[0] * c[1] * c[2] - c[0] * s[1] * s[2], c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
          c[0] * c[1] * s[2] - s[0] * s[1] * c[2], c[0] * c[1] * c[2] + s[0] * s[1] * s[2]];
}

function corners(box) {
  const R = rotation(box);
  return [-1, 1].flatMap(z => [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([x, y]) =>
    fromFrame([x * box[3] / 2, y * box[4] / 2, z * box[5] / 2], box, R)));
}

// A part of the file: the boxes and points of a track -------------------------------------------

async function loadPart(index) {
  const part = JSON.parse(await inflate(await textOf('part-' + index)));
  const bytes = Uint8Array.from(atob(part.points), c => c.charCodeAt(0));
  part.points = new Int16Array(bytes.buffer);
  part.first = [0];
  for (const count of part.counts) part.first.push(part.first.at(-1) + count);
  part.usable = part.boxes.map((box, k) => (box[0] === null ? (part.given[k][0] === null ? null : part.given[k]) : box));
  part.residuals = part.usable.map((box, k) => faceResiduals(part, k, box));
  return part;
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

// Distance of the outermost points from each face that is turned to the sensor [m].
function faceResiduals(part, row, box) {
  const none = FACES.map(() => null);
  const sensor = part.sensor[row];
  if (!box || sensor[0] === null) return none;
  const R = rotation(box);
  const from = toFrame(sensor, box, R);
  const points = pointsAt(part, row).map(point => toFrame(point, box, R));
  const half = [box[3] / 2, box[4] / 2, box[5] / 2];
  const isNear = point => [0, 1, 2].every(a => Math.abs(point[a]) < half[a] + 0.3) && point[2] > -0.6 * half[2];
  const near = points.filter(isNear);
  return FACES.map((_, face) => {
    const axis = face >> 1, sign = face % 2 ? -1 : 1;
    if (sign * from[axis] < half[axis]) return null;
    const outer = near.map(point => sign * point[axis] - half[axis]).filter(d => d > -0.5).sort((a, b) => b - a);
    const count = Math.ceil(OUTER_PART * outer.length);
    if (outer.length < MIN_FACE_POINTS) return null;
    return outer.slice(0, count).reduce((a, b) => a + b) / count;
  });
}

// The list --------------------------------------------------------------------------------------

const decisionOf = (id, stamp = '') => decisions.get(keyOf(id, stamp));
const sumOf = counts => Object.entries(counts).map(([name, count]) => `${name} ${count}`).join(', ');
const partsOf = why => why.split('; ').filter(Boolean);
// The reasons of a risk without their figures; how many boxes were kept is no reason of a risk.
const causesOf = track => partsOf(track.why).filter(part => !/^\d+ kept: /.test(part)).map(part => part.split(' (')[0]);
const rulesOf = track => [...new Set(track.rules.map(([name]) => name))];

// Name, title, value to sort by, text, meaning.
function columns() {
  const all = [
    ['rank', '#', t => t.rank, t => t.rank, 'place in review.csv: largest risk first'],
    ['id', 'track', t => t.id, t => t.id || 'no id', 'track id'],
    ['class', 'class', t => t.class, t => t.class, 'class name of the input'],
    ['risk', 'risk [m]', t => t.risk, t => number(t.risk), 'expected error: the shift of a car 4.5 m long, along its heading, that loses as much 3D IoU'],
    ['decision', 'decision', t => decidedOf(t), t => decidedOf(t), 'your decision, and the number of boxes with one of their own'],
    ['why', 'why', t => t.why, t => partsOf(t.why)[0] ?? '', 'the most unusual part of the risk; ends are front and rear'],
    ['points', 'points', t => t.points, t => number(t.points, 0), 'median of the points inside the boxes'],
    ['boxes', 'boxes', t => t.boxes, t => t.boxes + (t.interpolated ? ` + ${t.interpolated}` : ''), 'boxes of the input + boxes that were added'],
    ['rules', 'rules', t => rulesOf(t).length || null, t => rulesOf(t).join(', '), 'rules of boxreg check that the refined boxes violate'],
    ['iou', 'IoU', t => t.after.iou, t => `${number(t.before.iou, 3)} → ${number(t.after.iou, 3)}`, 'mean 3D IoU with the true boxes, input → refined'],
    ['refined', 'refined', t => t.refined, t => isKnown(t.refined) ? number(100 * t.refined, 0) + ' %' : '–', 'part of the input boxes that were refined'],
    ['shift', 'moved [m]', t => t.shift, t => number(t.shift), 'mean distance between input and refined centres'],
    ['turn', 'turned [°]', t => t.turn, t => number(t.turn, 1), 'mean yaw change, without flips'],
    ['resized', 'resized [m]', t => t.resized, t => number(t.resized), 'largest change of the median length, width or height'],
    ['flips', 'flips', t => t.flips, t => t.flips || '', 'boxes whose heading was turned by 180°'],
    ['deviation', 'σ [m]', t => t.deviation, t => number(t.deviation), 'median horizontal standard deviation of the centres'],
    ['sharper', 'cells [%]', t => t.sharper, t => number(t.sharper, 0), `change of the number of cells of ${DATA.cell} m that the points of all sweeps fill: negative is sharper`],
    ['reasons', 'kept because', t => sumOf(t.reasons), t => sumOf(t.reasons), 'reasons of the input boxes that were returned unchanged'],
  ];
  const hidden = new Set([...(DATA.has_truth ? [] : ['iou']), ...(IS_REVIEW ? [] : ['decision'])]);
  return all.filter(([name]) => !hidden.has(name));
}
const TEXT = new Set(['id', 'class', 'why', 'decision', 'rules', 'reasons']);

// The decision about a track, and how many of its boxes have one.
function decidedOf(track) {
  const own = decisionOf(track.id);
  const word = own?.decision === 'none' ? 'comment' : own?.decision;
  const boxes = decidedBoxes.get(track.id) ?? 0;
  return [word, boxes ? `${boxes} ${boxes === 1 ? 'box' : 'boxes'}` : ''].filter(Boolean).join(', ');
}

function compare(a, b) {
  if (typeof a === 'string') return a.localeCompare(b, 'en', { numeric: true });
  const known = [isKnown(a), isKnown(b)];
  if (!known[0] || !known[1]) return known[1] - known[0];
  return a - b;
}

function isShown(track) {
  const text = $('f-text').value.trim().toLowerCase();
  const [name, status, reason, rule, change, decision] = ['class', 'status', 'reason', 'rule', 'change', 'decision'].map(f => $('f-' + f).value);
  if (text && !track.id.toLowerCase().includes(text) && !track.class.toLowerCase().includes(text)) return false;
  if (name && track.class !== name.slice(1)) return false;
  if (status && !(status in track.status)) return false;
  if (reason && !causesOf(track).includes(reason) && !(reason in track.reasons)) return false;
  if (rule && !rulesOf(track).includes(rule)) return false;
  if (change && !CHANGED[change][1](track)) return false;
  if ((track.points ?? 0) < Number($('f-points').value)) return false;
  if (Number($('f-risk').value) > 0 && !(track.risk >= Number($('f-risk').value))) return false;
  const decided = decidedOf(track);
  return !decision || (decision === 'open' ? !decided : decided.includes(decision));
}

function drawList() {
  decidedBoxes.clear();
  for (const { track_id: id, stamp_ns: stamp } of decisions.values()) if (stamp) decidedBoxes.set(id, (decidedBoxes.get(id) ?? 0) + 1);
  const found = columns();
  const [, , value] = found.find(([name]) => name === view.sort) ?? found[0];
  view.shown = DATA.tracks.filter(isShown);
  const sign = view.descending ? -1 : 1;
  view.shown.sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    const missing = typeof x !== 'string' && (!isKnown(x) || !isKnown(y));
    return (missing ? 1 : sign) * compare(x, y) || a.index - b.index;
  });
  fill($('rows').querySelector('thead'), element('tr', {}, ...found.map(([name, title, , , meaning]) => {
    const isSorted = name === view.sort;
    return element('th', { class: TEXT.has(name) ? '' : 'n', 'aria-sort': isSorted ? (view.descending ? 'descending' : 'ascending') : null },
      element('button', { 'data-sort': name, title: meaning, onclick: () => sortBy(name) }, title + (isSorted ? (view.descending ? ' ▾' : ' ▴') : '')));
  })));
  const body = $('rows').querySelector('tbody'), lines = view.shown.map(track => lineOf(track, found));
  const drawn = [...body.children];
  // A decision seldom changes the list: a thousand lines need not be laid out again.
  if (lines.length !== drawn.length || lines.some((line, k) => line !== drawn[k])) body.replaceChildren(...lines);
  const place = view.shown.findIndex(track => track.index === view.track);
  if (place >= 0) view.place = place;
  const decided = DATA.tracks.filter(track => decidedOf(track)).length;
  $('f-count').textContent = `${view.shown.length} of ${DATA.tracks.length} tracks` + (IS_REVIEW ? `, ${decided} decided` : '');
  $('f-clear').hidden = filters().every(input => input.value === input.defaultValue || (input.matches('select') && !input.value));
}

// The line of a track in the list; only its decision changes.
function lineOf(track, found) {
  track.line ??= element('tr', { class: 'link', 'data-track': track.index, 'aria-selected': String(track.index === view.track), onclick: () => openTrack(track.index) },
    ...found.map(([name, , , text]) => {
      const shown = String(text(track));
      return element('td', { class: TEXT.has(name) ? name : 'n', title: TEXT.has(name) ? (name === 'why' ? track.why : shown) : null }, shown);
    }));
  const decision = track.line.querySelector('.decision');
  if (decision) decision.textContent = decision.title = decidedOf(track);
  return track.line;
}

const filters = () => [...document.querySelectorAll('.filters input, .filters select')];

function clearFilters() {
  for (const input of filters()) input.value = input.matches('select') ? '' : input.defaultValue;
  drawList();
}

function sortBy(name) {
  view.descending = view.sort === name ? !view.descending : !TEXT.has(name) && name !== 'rank';
  view.sort = name;
  drawList();
}

function options(id, first, entries) {
  fill($(id), element('option', { value: '' }, first), ...entries.map(([value, text]) => element('option', { value }, text)));
}

function setUpList() {
  DATA.tracks.forEach((track, index) => {
    track.index = index;
    track.rank = index + 1;
    track.sharper = track.before.cells ? 100 * (track.after.cells / track.before.cells - 1) : null;
  });
  const every = key => [...new Set(DATA.tracks.flatMap(track => key(track)))].sort();
  options('f-class', 'any class', every(t => [t.class]).map(name => ['=' + name, name]));
  options('f-status', 'any status', every(t => Object.keys(t.status)).map(name => [name, name]));
  options('f-reason', 'any reason', [...every(causesOf).map(name => [name, name]), ...every(t => Object.keys(t.reasons)).map(name => [name, 'kept: ' + name])]);
  options('f-rule', 'any rule', every(rulesOf).map(name => [name, name]));
  options('f-change', 'any change', Object.entries(CHANGED).map(([name, [text]]) => [name, text]));
  options('f-decision', 'any decision', [['open', 'no decision'], ['accept', 'accepted'], ['reject', 'rejected'], ['unsure', 'unsure'], ['comment', 'comment only'], ['box', 'boxes decided']]);
  $('f-decision').hidden = !IS_REVIEW;
  for (const input of filters()) input.oninput = drawList;
  $('f-clear').onclick = clearFilters;
  drawList();
}

// Overview --------------------------------------------------------------------------------------

function drawOverview() {
  const [before, after] = DATA.total;
  const rows = [
    ['heading flips between two boxes', 'flips', 0, 1, ''],
    ['jitter of the centre', 'jitter', 3, 1, ' m'],
    ['jitter of the yaw', 'yaw_jitter', 2, 180 / Math.PI, '°'],
    ['spread of the size of a track', 'size_spread', 3, 1, ' m'],
    [`cells of ${DATA.cell} m filled by the points of all sweeps`, 'cells', 0, 1, ''],
    ...(DATA.has_truth ? [['3D IoU with the true boxes', 'iou', 3, 1, '']] : []),
  ];
  fill($('quality'), element('tr', {}, ...['', 'input', 'refined', 'change'].map((t, k) => element('th', { class: k ? 'n' : '' }, t))),
    ...rows.map(([title, name, digits, scale, unit]) => {
      const [a, b] = [before[name], after[name]];
      const part = a && isKnown(a) && isKnown(b) ? 100 * (b / a - 1) : null;
      const isBetter = (name === 'iou') === (part > 0);
      return element('tr', {}, element('td', {}, title), ...[a, b].map(v => element('td', { class: 'n' }, isKnown(v) ? number(scale * v, digits) + unit : '–')),
        element('td', { class: 'n ' + (part ? (isBetter ? 'better' : 'worse') : '') }, part === null ? '' : (part > 0 ? '+' : '') + number(part, 0) + ' %'));
    }));
  fill($('first'), element('tr', {}, ...['track', 'class', 'risk', 'why'].map(t => element('th', {}, t))),
    ...DATA.tracks.slice(0, 12).map(track => element('tr', { class: 'link', onclick: () => openTrack(track.index, track.riskiest) },
      element('td', {}, element('a', { href: hashOf(track.id, track.riskiest) }, track.id || 'no id')), element('td', {}, track.class),
      element('td', { class: 'n' }, `${number(track.risk)} m`), element('td', {}, ...reasonsOf(track)))));
}

// The reasons of a risk, each with its meaning as a tooltip.
function reasonsOf(track) {
  return partsOf(track.why).flatMap((part, k) => {
    const meaning = MEANINGS.find(([word]) => part.includes(word))?.[1];
    return [k ? '; ' : '', element('span', { title: meaning ?? null }, part)];
  });
}

const LAYOUT = () => ({
  paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)', showlegend: false, hovermode: 'closest', dragmode: 'pan',
  font: { color: colour('text'), size: 11, family: 'system-ui, sans-serif' }, margin: { l: 56, r: 8, t: 8, b: 34 },
});
const AXIS = () => ({ gridcolor: colour('line'), zerolinecolor: colour('line'), linecolor: colour('line') });
const CONFIG = { displaylogo: false, responsive: true, scrollZoom: true, displayModeBar: false };
let plotly;

function withPlotly() {
  plotly ??= (async () => {
    await painted();  // the script takes a second to start
    document.head.append(element('script', {}, await inflate(await textOf('plotly'))));
    $('plotly').remove();
  })();
  return plotly;
}

async function drawMap() {
  await withPlotly();
  const lines = { x: [], y: [], customdata: [], text: [] };
  for (const track of DATA.tracks) {
    for (const [k, [x, y]] of track.path.entries()) {
      lines.x.push(x); lines.y.push(y); lines.customdata.push([track.index, track.rows[k]]); lines.text.push(escaped(`${track.id} ${track.class}`));
    }
    lines.x.push(null); lines.y.push(null); lines.customdata.push([track.index, 0]); lines.text.push('');
  }
  const risky = DATA.tracks.filter(t => isKnown(t.risk) && t.path.length);
  const names = DATA.tracks.filter(t => t.path.length);
  const middle = track => track.path[track.path.length >> 1];
  await Plotly.newPlot('map', [
    { x: DATA.sensor.map(p => p[0]), y: DATA.sensor.map(p => p[1]), mode: 'lines', line: { color: colour('grey'), dash: 'dot', width: 1.5 }, hoverinfo: 'skip' },
    { ...lines, mode: 'lines+markers', line: { color: colour('refined'), width: 1.5 }, marker: { size: 4, color: colour('refined') }, hovertemplate: '%{text}<extra></extra>' },
    { x: risky.map(t => middle(t)[0]), y: risky.map(t => middle(t)[1]), customdata: risky.map(t => [t.index, t.rows[t.rows.length >> 1]]), text: risky.map(t => escaped(`${t.id} ${t.class}: ${number(t.risk)} m`)),
      mode: 'markers', hovertemplate: '%{text}<extra></extra>', marker: { size: risky.map(t => Math.min(30, 6 + 30 * t.risk)), color: colour('input'), opacity: 0.45 } },
    { x: names.map(t => middle(t)[0]), y: names.map(t => middle(t)[1]), customdata: names.map(t => [t.index, t.rows[t.rows.length >> 1]]), text: names.map(t => escaped(t.id)), mode: names.length <= 60 ? 'text' : 'none', textposition: 'top center', textfont: { size: 10, color: colour('grey') }, hoverinfo: 'skip' },
  ], { ...LAYOUT(), xaxis: { ...AXIS(), title: { text: 'x [m]' } }, yaxis: { ...AXIS(), title: { text: 'y [m]' }, scaleanchor: 'x' } }, CONFIG);
  $('map').on('plotly_click', event => {
    const [index, row] = event.points[0].customdata;
    openTrack(index, null, row);
  });
}

// Plotly reads some tags in texts.
const escaped = text => text.replace(/[&<>]/g, c => ({ '&': '&amp;', '<': '&lt;', '>': '&gt;' })[c]);

// A track ---------------------------------------------------------------------------------------

function hashOf(id, stamp) {
  return '#' + new URLSearchParams({ track: id, ...(stamp ? { stamp } : {}) });
}

async function openTrack(index, stamp = null, row = null) {
  showTab('tracks');
  const track = DATA.tracks[index];
  if (index !== view.track) {
    if (isCorrecting()) return;
    view.track = index;
    view.place = Math.max(0, view.shown.indexOf(track));
    view.edit = null;
    for (const one of DATA.tracks) one.line?.setAttribute('aria-selected', String(one === track));
    track.line?.scrollIntoView({ block: 'nearest' });
    const part = await loadPart(index);
    if (view.track !== index) return;
    view.part = part;
    view.charts = false;
    view.limits = limitsOf(part);
    view.zoom = 1;
    $('time').max = part.stamps.length - 1;
    row ??= part.num_points.indexOf(Math.max(...part.num_points));  // the object is seen best there
    drawTitle(track);
  }
  if (stamp) row = nearestRow(stamp);
  if (view.part) step(row ?? view.row, true);
  drawCharts();
}

function nearestRow(stamp) {
  let best = 0n, row = 0;
  view.part.stamps.forEach((own, k) => {
    const off = BigInt(own) - BigInt(/^\d+$/.test(stamp) ? stamp : 0);
    const away = off < 0n ? -off : off;
    if (k === 0 || away < best) { best = away; row = k; }
  });
  return row;
}

function drawTitle(track) {
  const facts = [`${track.boxes} boxes in ${number(track.seconds, 1)} s`, `${number(track.points, 0)} points (median)`,
    `moved ${number(track.shift)} m`, `turned ${number(track.turn, 1)}°`, track.flips ? `${track.flips} heading ${track.flips === 1 ? 'flip' : 'flips'} corrected` : '',
    `extents ${track.extents.map(e => e.map(v => number(v)).join(' × ')).join(' → ')} m`,
    isKnown(track.after.iou) ? `3D IoU ${number(track.before.iou, 3)} → ${number(track.after.iou, 3)}` : '', sumOf(track.reasons)];
  const violations = track.rules.map(([rule, stamp, text]) => element('a', { href: hashOf(track.id, stamp) }, `${rule}: ${text}`));
  fill($('title'), element('b', {}, track.id || 'no id'), element('span', {}, track.class),
    element('span', {}, `risk ${number(track.risk)} m: `, ...reasonsOf(track), ' · ', element('a', { href: hashOf(track.id, track.riskiest), title: 'key g' }, 'riskiest box')),
    ...violations, element('span', { class: 'grey' }, facts.filter(Boolean).join(' · ')));
}

// A correction that is neither pinned nor discarded is not left.
function isCorrecting() {
  if (!view.edit || !view.isMoved) return false;
  fail('The correction of this box is not saved: Enter pins it, Escape discards it.');
  return true;
}

function discard() {
  view.edit = null;
  view.isMoved = false;
  $('failure').hidden = true;
  step(view.row, true);
}

function step(row, isNew = false) {
  const part = view.part;
  row = Math.max(0, Math.min(part.stamps.length - 1, row));
  if (row === view.row && !isNew) return;
  if (row !== view.row && isCorrecting()) {
    $('time').value = view.row;
    return;
  }
  if (row !== view.row) view.edit = null;
  view.row = row;
  $('time').value = row;
  const mark = decisionOf(DATA.tracks[view.track].id, part.stamps[row]);
  const facts = [`${row + 1}/${part.stamps.length}`, `${number(part.times[row], 2)} s`, part.status[row] + (part.reasons[row] ? ` (${part.reasons[row]})` : ''),
    mark ? (mark.decision === 'none' ? mark.comment : mark.decision) : '', `${part.num_points[row]} points`, `risk ${number(part.risk[row])} m`,
    isKnown(part.iou[1][row]) ? `IoU ${number(part.iou[0][row])} → ${number(part.iou[1][row])}` : ''];
  $('clock').textContent = facts.filter(Boolean).join(' · ');
  $('clock').title = `${$('clock').textContent} · stamp ${part.stamps[row]} ns`;
  clearTimeout(view.hashTimer);  // browsers limit how often the address may change
  view.hashTimer = setTimeout(() => history.replaceState(null, '', hashOf(DATA.tracks[view.track].id, part.stamps[view.row])), 200);
  drawViews();
  drawCursor();
  if (IS_REVIEW) drawDecisions();
}

function currentBoxes() {
  const part = view.part, row = view.row;
  const boxes = [['input', part.given[row], [6, 4]]];
  boxes.push(['refined', part.boxes[row], []]);
  if (DATA.has_truth) boxes.push(['truth', part.truth[row], [2, 3]]);
  const pin = decisionOf(DATA.tracks[view.track].id, part.stamps[row]);
  const human = view.edit ?? (pin?.decision === 'pin' ? pin.box.map((v, k) => k < 3 ? v - part.origin[k] : v) : null);
  if (human) boxes.push(['human', human, []]);
  return boxes.filter(([, box]) => box && box[0] !== null);
}

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
    view.cacheKey = cacheKey;
    view.cachePart = part;
  }
  const frame = frameBox(part, view.row, mode) ?? part.usable[view.row];
  view.frame = frame;
  view.R = rotation(frame);
  let boxes = currentBoxes();
  if (mode === 'before') boxes = boxes.filter(([name]) => name !== 'refined');
  if (mode === 'after') boxes = boxes.filter(([name]) => name !== 'input');
  view.lines = boxes.map(([name, box, dash]) => ({ name, box, dash, corners: corners(box).map(c => toFrame(c, frame, view.R)) }));
  drawFlat($('top'), 1);
  drawFlat($('side'), 2);
  drawSpace();
  const labels = { input: 'input', refined: part.status[view.row] === 'kept' ? 'kept' : 'refined', truth: 'true', human: 'human' };
  fill($('legend'), ...view.lines.map(({ name, dash }) => element('span', {}, element('i', { style: `border-color: var(--${name}); border-top-style: ${dash.length ? (dash[0] > 3 ? 'dashed' : 'dotted') : 'solid'}` }), labels[name])));
}

// A box with numbers that are not finite has no place.
function drawNothing() {
  view.local = view.lines = [];
  view.cacheKey = null;
  drawFlat($('top'), 1);
  drawFlat($('side'), 2);
  drawSpace();
  fill($('legend'), 'no valid box at this stamp');
}

// The top view (axis 1) or the side view (axis 2), heading to the right.
function drawFlat(canvas, axis) {
  const scale = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
  if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
  const zoom = view.zoom * Math.min(width / (2 * view.limits[0]), height / (2 * view.limits[axis]));
  canvas.zoom = zoom;
  const at = point => [width / 2 + zoom * point[0], height / 2 - zoom * point[axis]];
  // Points are many small rectangles: the processor draws them sooner than a software GPU does.
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  context.strokeStyle = colour('line');
  context.fillStyle = colour('grey');
  context.lineWidth = 1;
  context.font = '10px system-ui, sans-serif';
  for (let metre = -Math.floor(width / 2 / zoom); metre <= width / 2 / zoom; metre++) {
    const x = width / 2 + zoom * metre;
    context.beginPath(); context.moveTo(x, height - 4); context.lineTo(x, height); context.stroke();
    if (zoom > 25 || metre % 2 === 0) context.fillText(String(metre), x + 2, height - 3);
  }
  const isDense = view.local.length > 1500;
  const size = isDense ? 1.4 : 2.4;
  context.globalAlpha = isDense ? 0.35 : 0.85;
  context.fillStyle = colour('points');
  for (const point of view.local) {
    // Points near the lower face may be road: they would hide the object from above.
    if (axis === 1 && point[2] < -0.35 * view.frame[5]) continue;
    const [x, y] = at(point);
    context.fillRect(x - size / 2, y - size / 2, size, size);
  }
  context.globalAlpha = 1;
  for (const { name, dash, corners: c } of view.lines) {
    context.strokeStyle = colour(name);
    context.lineWidth = name === 'human' ? 2.5 : 1.8;
    context.setLineDash(dash);
    const nose = [0, 1, 2].map(k => (c[0][k] + c[3][k] + c[4][k] + c[7][k]) / 4);
    const middle = [0, 1, 2].map(k => c.reduce((sum, corner) => sum + corner[k] / 8, 0));
    const tip = [0, 1, 2].map(k => nose[k] + 0.15 * (nose[k] - middle[k]));
    const outline = axis === 1 ? [4, 5, 6, 7] : [0, 1, 5, 4];
    context.beginPath();
    outline.forEach((k, i) => context[i ? 'lineTo' : 'moveTo'](...at(c[k])));
    context.closePath();
    context.moveTo(...at(nose)); context.lineTo(...at(tip));
    context.stroke();
  }
  context.setLineDash([]);
}

function zoomBy(factor) {
  view.zoom = Math.max(1, Math.min(MAX_ZOOM, view.zoom * factor));
  drawViews();
}

const EDGES = [0, 1, 2, 3, 0, 4, 5, 6, 7, 4, null, 1, 5, null, 2, 6, null, 3, 7];

function spaceTraces() {
  const every = view.local.length > 6000 ? Math.ceil(view.local.length / 6000) : 1;
  const points = view.local.filter((_, k) => k % every === 0);
  const traces = [{ type: 'scatter3d', mode: 'markers', hoverinfo: 'skip', x: points.map(p => p[0]), y: points.map(p => p[1]), z: points.map(p => p[2]),
                    marker: { size: every > 1 || points.length > 1500 ? 1.2 : 2.2, color: colour('points') } }];
  for (const name of ['input', 'refined', 'truth', 'human']) {
    const found = view.lines.find(line => line.name === name);
    const way = found ? EDGES.map(k => k === null ? [null, null, null] : found.corners[k]) : [[null, null, null]];
    traces.push({ type: 'scatter3d', mode: 'lines', hoverinfo: 'skip', x: way.map(p => p[0]), y: way.map(p => p[1]), z: way.map(p => p[2]),
                  line: { color: colour(name), width: 4, dash: { input: 'dash', truth: 'dot' }[name] ?? 'solid' } });
  }
  return traces;
}

// One drawing is under way at most; the newest state follows it.
async function drawSpace() {
  view.wanted = true;
  if (view.pending) return;
  view.pending = true;
  await withPlotly();
  while (view.wanted && view.part) {
    view.wanted = false;
    // Where a drawing takes longer than a frame, it waits until the stepping pauses.
    if (view.spaceCost > FRAME) {
      await new Promise(done => setTimeout(done, PAUSE));
      if (view.wanted) continue;
    }
    const begin = performance.now();
    const traces = spaceTraces();
    if (!view.space) {
      const axis = { visible: false, showspikes: false };
      const [x, y, z] = view.limits;
      await Plotly.newPlot('space', traces, { ...LAYOUT(), margin: { l: 0, r: 0, t: 0, b: 0 }, dragmode: 'orbit',
        scene: { aspectmode: 'data', xaxis: axis, yaxis: axis, zaxis: axis, camera: { eye: { x: -1.3, y: -1.9, z: 1.1 } } } }, CONFIG);
      view.space = true;
    } else {
      const data = name => traces.map(trace => trace[name]);
      await Plotly.restyle('space', { x: data('x'), y: data('y'), z: data('z'), 'marker.size': traces.map(t => t.marker?.size ?? null) });
    }
    view.spaceCost = performance.now() - begin;
    await new Promise(requestAnimationFrame);
  }
  view.pending = false;
}

// From top to bottom: name, unit, height.
const CHARTS = [['risk', 'm', 1], ['along', 'm', 1], ['across', 'm', 1], ['up', 'm', 1], ['yaw', '°', 1], ['size', 'm', 1.3], ['faces', 'm', 1.5]];
const SIZES = ['length', 'width', 'height'];
const SIZE_COLOURS = ['refined', 'truth', 'human'];
const FACE_COLOURS = ['refined', 'input', 'truth', 'human', 'points'];

// The number of a chart behind the name of an axis: the first one has none.
function chartNumber(name) {
  const at = CHARTS.findIndex(([one]) => one === name);
  return at ? at + 1 : '';
}

// The area between two curves over time, where both are known.
function band(part, axes, name, low, high) {
  const known = part.times.map((_, i) => i).filter(i => isKnown(low[i]) && isKnown(high[i]));
  return { ...axes, x: [...known, ...known.toReversed()].map(i => part.times[i]), y: [...known.map(i => high[i]), ...known.toReversed().map(i => low[i])],
           fill: 'toself', fillcolor: colour(name) + '33', line: { width: 0 }, mode: 'lines', hoverinfo: 'skip' };
}

function chartTraces() {
  const part = view.part;
  const traces = [];
  const degrees = 180 / Math.PI;
  traces.push({ xaxis: 'x', yaxis: 'y' + chartNumber('risk'), name: 'risk', x: part.times, y: part.risk, mode: 'lines+markers', line: { width: 1 }, marker: { size: 4, color: colour('input') } });
  ['along', 'across', 'up', 'yaw'].forEach((axis, k) => {
    const scale = k === 3 ? degrees : 1;
    const axes = { xaxis: 'x', yaxis: 'y' + chartNumber(axis) };
    const reach = part.deviations.map(d => d[k] === null ? null : 2 * scale * d[k]);
    traces.push(band(part, axes, 'refined', reach.map(r => r === null ? null : -r), reach));
    for (const [name, shape, is] of [['refined', 'circle', s => s === 'refined'], ['input', 'x', s => s === 'kept'], ['human', 'diamond', s => s === 'human']]) {
      const rows = part.times.map((_, i) => i).filter(i => is(part.status[i]));
      traces.push({ ...axes, name: name === 'input' ? 'kept' : name, x: rows.map(i => part.times[i]), y: rows.map(i => part.change[i][k] === null ? null : scale * part.change[i][k]),
                    mode: name === 'refined' ? 'lines+markers' : 'markers', line: { width: 1 }, marker: { size: 4, symbol: shape, color: colour(name) } });
    }
  });
  SIZES.forEach((name, k) => {
    const axes = { xaxis: 'x', yaxis: 'y' + chartNumber('size') };
    const line = { ...axes, x: part.times, mode: 'lines', name };
    const size = part.boxes.map(box => box[3 + k]), reach = part.extent_deviations.map(d => d[k] === null ? null : 2 * d[k]);
    traces.push(band(part, axes, SIZE_COLOURS[k], size.map((v, i) => reach[i] === null ? null : v - reach[i]), size.map((v, i) => reach[i] === null ? null : v + reach[i])));
    traces.push({ ...line, y: part.given.map(box => box[3 + k]), line: { color: colour('input'), dash: 'dash', width: 1.2 } });
    traces.push({ ...line, y: size, line: { color: colour(SIZE_COLOURS[k]), width: 1.8 } });
  });
  const marks = ['circle', 'square', 'triangle-up', 'triangle-down', 'x'];
  FACES.forEach((face, k) => traces.push({ xaxis: 'x', yaxis: 'y' + chartNumber('faces'), name: face, x: part.times, y: part.residuals.map(r => r[k]), mode: 'lines+markers',
                                           line: { width: 1, color: colour(FACE_COLOURS[k]) }, marker: { size: 4, symbol: marks[k], color: colour(FACE_COLOURS[k]) } }));
  return traces;
}

async function drawCharts() {
  await withPlotly();
  if (!view.part || view.charts || $('tracks').hidden) return;
  view.charts = true;
  const tinted = (words, names) => words.map((word, k) => `<span style="color: ${colour(names[k])}">${word}</span>`).join(', ');
  const notes = {
    risk: 'expected error of each box; click a point to go there',
    along: 'refined − input, in the axes of the box; band: ± 2σ',
    size: `${tinted(SIZES, SIZE_COLOURS)}; band: ± 2σ; dashed: input`,
    faces: `outermost points − face: ${tinted(FACES.map((f, k) => '●■▲▼✕'[k] + ' ' + f), FACE_COLOURS)}`,
  };
  const layout = { ...LAYOUT(), margin: { l: 56, r: 8, t: 16, b: 34 }, xaxis: { ...AXIS(), title: { text: 'time [s]' }, anchor: 'y' + chartNumber('faces') }, annotations: [] };
  const gap = 0.035;
  const unit = (1 - gap * (CHARTS.length - 1)) / CHARTS.reduce((sum, [, , height]) => sum + height, 0);
  let top = 1;
  for (const [name, unitName, height] of CHARTS) {
    const bottom = Math.max(0, top - unit * height);
    layout['yaxis' + chartNumber(name)] = { ...AXIS(), domain: [bottom, top], title: { text: `${name} [${unitName}]` }, nticks: 6, fixedrange: true, ...(name === 'risk' ? { rangemode: 'tozero' } : {}) };
    if (notes[name]) layout.annotations.push({ text: notes[name], xref: 'paper', yref: 'paper', x: 0, y: top, xanchor: 'left', yanchor: 'bottom', showarrow: false, font: { size: 10, color: colour('grey') } });
    top = bottom - gap;
  }
  await Plotly.react('charts', chartTraces(), layout, CONFIG);
  $('charts').removeAllListeners?.('plotly_click');
  $('charts').on('plotly_click', event => { const row = view.part.times.indexOf(event.points[0].x); if (row >= 0) step(row); });
  $('charts').removeAllListeners?.('plotly_relayout');
  $('charts').on('plotly_relayout', drawCursor);
  drawCursor();
}

function drawCursor() {
  const layout = $('charts')._fullLayout;
  $('cursor').hidden = !layout?.xaxis || !view.charts;
  if ($('cursor').hidden) return;
  const x = layout.xaxis._offset + layout.xaxis.l2p(view.part.times[view.row]);
  $('cursor').style.transform = `translateX(${x}px)`;
  $('cursor').style.height = layout.height - layout.margin.b + 'px';
}

function play() {
  if (!view.isPlaying && isCorrecting()) return;
  cancelAnimationFrame(view.playing);
  view.isPlaying = !view.isPlaying;
  $('play').textContent = view.isPlaying ? '⏸' : '▶';
  $('play').setAttribute('aria-label', view.isPlaying ? 'Pause' : 'Play');
  if (!view.isPlaying) return;
  const last = view.part.stamps.length - 1;
  if (view.row === last) step(0);
  const from = performance.now() - 1000 * (view.part.times[view.row] - view.part.times[0]);
  const next = now => {
    const seconds = view.part.times[0] + (now - from) / 1000;
    while (view.row < view.part.stamps.length - 1 && view.part.times[view.row + 1] <= seconds) step(view.row + 1);
    if (view.row < view.part.stamps.length - 1) view.playing = requestAnimationFrame(next);
    else play();
  };
  view.playing = requestAnimationFrame(next);
}

// Decisions -------------------------------------------------------------------------------------

function drawDecisions() {
  if (document.activeElement?.id.startsWith('comment')) return;
  const stamp = view.part.stamps[view.row];
  const own = decisionOf(DATA.tracks[view.track].id, stamp);
  const button = (name, text, title, onclick, isPressed = null) => element('button', { 'data-do': name, title, onclick, 'aria-pressed': isPressed === null ? null : String(isPressed) }, text);
  fill($('decide-track'), element('span', {}, 'Track'), ...judgements('', ''), button('undo', 'Undo', 'Undo the last decision, of any track (z)', undo));
  fill($('decide-box'), element('span', {}, 'Box'), ...judgements('-box', stamp),
    view.edit ? button('pin', 'Pin', 'Save this box (Enter)', pin) : button('edit', own?.decision === 'pin' ? 'Edit pin' : 'Edit', 'Correct this box (e)', edit),
    view.edit ? button('cancel', 'Cancel', 'Discard this correction (Escape)', discard) : (own?.decision === 'pin' ? button('unpin', 'Unpin', 'Remove the pin', () => decide('none', stamp)) : null));
  $('detail').classList.toggle('editing', Boolean(view.edit));

  // The buttons and the comment for the track, or for the box of a stamp.
  function judgements(suffix, stamp) {
    const what = stamp ? 'this box' : 'the track', shift = stamp ? 'Shift ' : '';
    const held = decisionOf(DATA.tracks[view.track].id, stamp);
    const judge = (decision, text, effect) => button(decision + suffix, text, `${text} ${what}${effect} (${shift}${decision[0]})`, () => decide(decision, stamp), held?.decision === decision);
    const comment = element('input', { id: 'comment' + suffix, placeholder: `Comment on ${what} (${shift}c)`, 'aria-label': `Comment on ${what}`,
      onchange: event => decide(held?.decision ?? 'none', stamp, event.target.value, held?.box ?? null) });
    comment.value = held?.comment ?? '';
    return [judge('accept', 'Accept', ''), judge('reject', 'Reject', ': keep the input'), judge('unsure', 'Unsure', ''), comment];
  }
}

async function send(row) {
  const response = await fetch('decisions', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(row) });
  if (!response.ok) throw new Error(await response.text());
}

async function store(row) {
  try {
    await send(row);
  } catch (error) {
    fail(`The decision was not saved: ${error.message}. Check that boxreg review still runs, then decide again.`);
    return false;
  }
  $('failure').hidden = true;
  decisions.set(keyOf(row.track_id, row.stamp_ns), row);
  if (row.decision === 'none' && !row.comment) decisions.delete(keyOf(row.track_id, row.stamp_ns));
  drawList();
  if (view.part) step(view.row, true);
  return true;
}

async function decide(decision, stamp = '', comment = null, box = null) {
  const id = DATA.tracks[view.track].id;
  const before = decisionOf(id, stamp) ?? { track_id: id, stamp_ns: stamp, decision: 'none', comment: '', box: null };
  if (comment === null && before.decision === decision && decision !== 'pin') decision = 'none';
  if (await store({ track_id: id, stamp_ns: stamp, decision, comment: comment ?? before.comment, box })) made.push(before);
}

async function undo() {
  const before = made.at(-1);
  if (!before || isCorrecting() || !await store(before)) return;
  made.pop();
  openTrack(DATA.tracks.findIndex(track => track.id === before.track_id), before.stamp_ns || null);
}

function edit() {
  if (!IS_REVIEW) return;
  if (view.isPlaying) play();
  if (!view.part.usable[view.row]) return fail('This box has numbers that are not finite: correct another box of the track.');
  const human = currentBoxes().find(([name]) => name === 'human');
  view.edit = (human ? human[1] : view.part.usable[view.row]).slice();
  view.isMoved = false;
  $('mode').value = 'sweep';
  step(view.row, true);
  $('top').focus({ preventScroll: true });
}

async function pin() {
  const { origin, stamps } = view.part;
  const box = view.edit.map((v, k) => k < 3 ? v + origin[k] : v);
  view.edit = null;
  view.isMoved = false;
  $('failure').hidden = true;
  await decide('pin', stamps[view.row], null, box);
}

function moveEdit(along, across, up) {
  const R = rotation(view.edit);
  const moved = fromFrame([along, across, up], view.edit, R);
  view.edit.splice(0, 3, ...moved);
  redrawEdit();
}

// Move the face on one side of an axis outward; the opposite face stays.
function resizeEdit(axis, sign, by) {
  const size = Math.max(0.1, view.edit[3 + axis] + by);
  const shift = [0, 0, 0];
  shift[axis] = sign * (size - view.edit[3 + axis]) / 2;
  view.edit[3 + axis] = size;
  moveEdit(...shift);
}

function redrawEdit() { view.isMoved = true; if (!view.redraw) view.redraw = requestAnimationFrame(() => { view.redraw = 0; if (view.edit) drawViews(); }); }

function setUpDragging(canvas, axis) {
  let grip = null;
  const place = event => {
    const bounds = canvas.getBoundingClientRect();
    const flat = [0, 0, 0];
    flat[0] = (event.clientX - bounds.left - bounds.width / 2) / canvas.zoom;
    flat[axis] = -(event.clientY - bounds.top - bounds.height / 2) / canvas.zoom;
    return toFrame(fromFrame(flat, view.frame, view.R), view.edit, rotation(view.edit));
  };
  canvas.onpointerdown = event => {
    if (!view.edit) return;
    const at = place(event), reach = 8 / canvas.zoom;
    const half = [3, 4, 5].map(c => view.edit[c] / 2);
    grip = { last: at, face: null, turns: false };
    if (axis === 1 && Math.abs(at[1]) < half[1] / 2 && at[0] > half[0] + reach) grip.turns = true;
    for (const a of [0, axis]) if (Math.abs(Math.abs(at[a]) - half[a]) < reach && !grip.turns) grip.face = [a, Math.sign(at[a])];
    canvas.setPointerCapture(event.pointerId);
  };
  canvas.onpointermove = event => {
    if (!grip || !view.edit) return;
    const at = place(event);
    if (grip.turns) view.edit[8] += Math.atan2(at[1], at[0]);
    else if (grip.face) resizeEdit(...grip.face, grip.face[1] * at[grip.face[0]] - view.edit[3 + grip.face[0]] / 2);
    else moveEdit(...[0, 1, 2].map(k => k === 0 || k === axis ? at[k] - grip.last[k] : 0));
    redrawEdit();
  };
  canvas.addEventListener('wheel', event => {
    if (!event.ctrlKey) return;  // the wheel alone scrolls the page
    event.preventDefault();
    zoomBy(event.deltaY < 0 ? ZOOM_STEP : 1 / ZOOM_STEP);
  }, { passive: false });
  canvas.onpointerup = canvas.onpointercancel = () => { grip = null; };
}

// Keys ------------------------------------------------------------------------------------------

const KEYS = {
  ArrowLeft: ['←  →', 'step one box; with Shift ten', event => step(view.row - (event.shiftKey ? 10 : 1))],
  ArrowRight: ['', '', event => step(view.row + (event.shiftKey ? 10 : 1))],
  Home: ['Home  End', 'first and last box', () => step(0)],
  End: ['', '', () => step(view.part.stamps.length - 1)],
  ' ': ['Space', 'play or pause', play],
  ArrowDown: ['↓  ↑', 'next and previous track of the list', () => nextTrack(1)],
  ArrowUp: ['', '', () => nextTrack(-1)],
  g: ['g', 'go to the riskiest box of the track', () => step(nearestRow(DATA.tracks[view.track].riskiest))],
  '+': ['+  −', 'zoom the top and side view; Ctrl with the wheel does too', () => zoomBy(ZOOM_STEP)],
  '-': ['', '', () => zoomBy(1 / ZOOM_STEP)],
  m: ['m', 'points of this sweep, or of all sweeps in the refined or input boxes', () => { const mode = $('mode'); mode.selectedIndex = (mode.selectedIndex + 1) % 3; drawViews(); }],
  '/': ['/', 'search', () => $('f-text').focus()],
  '?': ['?', 'show the keys', () => $('help').showModal()],
};
const stampOf = event => event.shiftKey ? view.part.stamps[view.row] : '';
const REVIEW_KEYS = {
  a: ['a', 'accept the track; with Shift this box', event => decide('accept', stampOf(event))],
  r: ['r', 'reject the track: its input boxes are kept; with Shift this box', event => decide('reject', stampOf(event))],
  u: ['u', 'unsure about the track; with Shift about this box', event => decide('unsure', stampOf(event))],
  c: ['c', 'comment on the track; with Shift on this box', event => $(event.shiftKey ? 'comment-box' : 'comment').focus()],
  e: ['e', 'correct this box', edit],
  z: ['z', 'undo the last decision', undo],
};
const EDIT_KEYS = {
  ArrowRight: ['←  →', 'move 2 cm along, as in the views; with Shift 10 cm', n => moveEdit(n * STEP, 0, 0)],
  ArrowLeft: ['', '', n => moveEdit(-n * STEP, 0, 0)],
  ArrowUp: ['↑  ↓', 'move across, as in the top view', n => moveEdit(0, n * STEP, 0)],
  ArrowDown: ['', '', n => moveEdit(0, -n * STEP, 0)],
  PageUp: ['PgUp  PgDn', 'move up and down', n => moveEdit(0, 0, n * STEP)],
  PageDown: ['', '', n => moveEdit(0, 0, -n * STEP)],
  '[': ['[  ]', 'turn by 0.5°', n => { view.edit[8] += n * TURN; redrawEdit(); }],
  ']': ['', '', n => { view.edit[8] -= n * TURN; redrawEdit(); }],
  f: ['f', 'flip the heading', () => { view.edit = flipped(view.edit); redrawEdit(); }],
  l: ['l w h', 'lengthen, widen, heighten by 2 cm; with Shift shrink', n => resizeEdit(0, 1, n > 1 ? -STEP : STEP)],
  w: ['', '', n => resizeEdit(1, 1, n > 1 ? -STEP : STEP)],
  h: ['', '', n => resizeEdit(2, 1, n > 1 ? -STEP : STEP)],
  Enter: ['Enter', 'pin the box', pin],
  Escape: ['Escape', 'discard the correction', discard],
};

function nextTrack(by) {
  const at = view.shown.findIndex(track => track.index === view.track);
  // A track that a filter has removed, as by its decision, leaves its place to the next one.
  const wanted = at < 0 ? view.place + Math.min(by, 0) : at + by;
  const next = view.shown[Math.max(0, Math.min(view.shown.length - 1, wanted))];
  if (next) openTrack(next.index);
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $('help').open) return;
  const target = event.target;
  if (target.matches('input:not([type=range]), textarea, select')) {
    if (event.key === 'Escape' || event.key === 'Enter') target.blur();
    return;
  }
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (target.matches('button, a') && (name === ' ' || name === 'Enter')) return;
  if (event.key !== '?' && event.key !== '/' && ($('tracks').hidden || !view.part)) return;
  const isZoom = name === '+' || name === '-';
  const key = view.edit && !isZoom ? EDIT_KEYS[name] : KEYS[name] ?? (IS_REVIEW ? REVIEW_KEYS[name] : undefined);
  if (!key) return;
  event.preventDefault();
  key[2](view.edit ? (event.shiftKey ? 5 : 1) : event);
}

function setUpKeys() {
  const groups = [KEYS, ...(IS_REVIEW ? [REVIEW_KEYS] : [])];
  const lines = group => Object.values(group).filter(([keys]) => keys).map(([keys, text]) => element('tr', {}, element('td', {}, element('kbd', {}, keys)), element('td', {}, text)));
  fill($('keys'), ...groups.flatMap(lines), ...(IS_REVIEW ? [element('tr', {}, element('th', { colspan: 2 }, 'While correcting a box')), ...lines(EDIT_KEYS)] : []));
  document.addEventListener('keydown', onKey);
  $('help-button').onclick = () => $('help').showModal();
}

// The page --------------------------------------------------------------------------------------

function showTab(name) {
  for (const one of ['overview', 'tracks', 'run']) {
    $(one).hidden = one !== name;
    $('tab-' + one).setAttribute('aria-selected', String(one === name));
  }
  if (name === 'overview' && !$('map').hasChildNodes()) setTimeout(drawMap);
}

async function followHash() {
  const hash = location.hash.slice(1);
  if (['overview', 'run', 'tracks'].includes(hash)) return selectTab(hash);
  const wanted = new URLSearchParams(hash);
  if (wanted.has('rule')) {
    clearFilters();
    $('f-rule').value = wanted.get('rule');
    drawList();
    return openTrack((view.shown[0] ?? DATA.tracks[0]).index);
  }
  if (!wanted.has('track')) return showTab('overview');
  const track = DATA.tracks.find(one => one.id === wanted.get('track'));
  if (!track) {
    showTab('overview');
    return fail(`No track ${wanted.get('track')} in this report.`);
  }
  await openTrack(track.index, wanted.get('stamp'));
}

function selectTab(name) {
  if (name === 'tracks') {
    const index = view.track >= 0 ? view.track : view.shown[0]?.index;
    if (index !== undefined) return openTrack(index);
  }
  history.replaceState(null, '', '#' + name);
  showTab(name);
}

function redrawAll() {
  view.space = view.charts = false;
  $('map').replaceChildren();
  if (!$('overview').hidden) drawMap();
  if (view.part && !$('tracks').hidden) { drawViews(); drawCharts(); }
}

async function main() {
  await painted();  // title and figures, before the lists of many tracks are made
  DATA = JSON.parse(await inflate($('data').textContent));
  if (IS_REVIEW) {
    $('decide').hidden = false;
    for (const row of await (await fetch('decisions')).json()) {
      if (row.decision === 'none' && !row.comment) decisions.delete(keyOf(row.track_id, row.stamp_ns));
      else decisions.set(keyOf(row.track_id, row.stamp_ns), row);
    }
  }
  setUpList();
  drawOverview();
  setUpKeys();
  setUpDragging($('top'), 1);
  setUpDragging($('side'), 2);
  for (const one of ['overview', 'tracks', 'run']) $('tab-' + one).onclick = () => {
    selectTab(one);
    if (one === 'tracks') $('rows').focus({ preventScroll: true });  // Space plays, and does not press the tab again
  };
  $('time').oninput = () => step(Number($('time').value));
  $('mode').onchange = drawViews;
  $('play').onclick = play;
  addEventListener('hashchange', followHash);
  addEventListener('resize', () => { if (view.part && !$('tracks').hidden) { drawViews(); drawCursor(); } });
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', redrawAll);
  await followHash();
  document.documentElement.dataset.ready = '';
}

addEventListener('unhandledrejection', event => fail(`This page failed: ${event.reason?.message ?? event.reason}`));
main();
