// The list ---------------------------------------------------------------------------------------

const LINE = 27;                   // height of a line, as in the style [px]
const SPARE_LINES = 10;            // drawn above and below those that are seen
const CHANGED = {
  moved: ['moved more than 0.2 m', t => t.shift > 0.2],
  turned: ['turned more than 2°', t => t.turn > 2],
  flipped: ['heading flipped', t => t.flips > 0],
  written: ['changed by the decisions', t => view.changed.has(t.id)],
  resized: ['resized more than 0.2 m', t => t.resized > 0.2],
};
const sumOf = counts => Object.entries(counts).map(([name, count]) => `${name} ${count}`).join(', ');
const partsOf = why => why.split('; ').filter(Boolean);
// The reasons of a risk without their figures; how many boxes were kept is no reason of a risk.
const causesOf = track => partsOf(track.why).filter(part => !/^\d+ kept: /.test(part)).map(part => part.split(' (')[0]);
const rulesOf = track => [...new Set(track.rules.map(([name]) => name))];

// Name, title, value to sort by, text, width [em], meaning.
/** @returns {[string, string, (track: Track) => any, (track: Track) => any, number, string][]} */
function columns() {
  /** @type {[string, string, (track: Track) => any, (track: Track) => any, number, string][]} */
  const all = [
    ['rank', '#', t => t.rank, t => t.rank, 3, 'place in review.csv: largest risk first'],
    ['id', 'track', t => t.id, t => t.id || 'no id', 6, 'track id'],
    ['class', 'class', t => t.class, t => t.class, 6.5, 'class name'],
    ['risk', 'risk [m]', t => t.risk, t => number(t.risk), 5.5, 'expected error: the shift of a car 4.5 m long, along its heading, that loses as much 3D IoU'],
    ['decision', 'decision', t => decidedOf(t), t => decidedOf(t), 9, 'your decision, and the number of boxes with one of their own'],
    ['why', 'why', t => t.why, t => partsOf(t.why)[0] ?? '', 18, 'the most unusual part of the risk; ends are front and rear'],
    ['points', 'points', t => t.points, t => number(t.points, 0), 5, 'median of the points inside the boxes'],
    ['near', 'near', t => t.near, t => number(t.near, 0), 5, 'median of the points within 0.6 m of the boxes and above their lower face: most ghosts have none'],
    ['boxes', 'boxes', t => t.boxes, t => t.boxes + (t.interpolated ? ` + ${t.interpolated}` : ''), 6, 'boxes of the input + boxes that were added'],
    ['rules', 'rules', t => rulesOf(t).length || null, t => rulesOf(t).join(', '), 8, 'rules of boxreg check that the refined boxes violate'],
    ['iou', 'IoU', t => t.after.iou, t => `${number(t.before.iou, 3)} → ${number(t.after.iou, 3)}`, 9, 'mean 3D IoU with the true boxes, input → refined'],
    ['refined', 'refined', t => t.refined, t => isKnown(t.refined) ? number(100 * t.refined, 0) + ' %' : '–', 5.5, 'part of the input boxes that were refined'],
    ['shift', 'moved [m]', t => t.shift, t => number(t.shift), 6.5, 'mean distance between input and refined centres'],
    ['turn', 'turned [°]', t => t.turn, t => number(t.turn, 1), 6.5, 'mean yaw change, without flips'],
    ['resized', 'resized [m]', t => t.resized, t => number(t.resized), 7, 'largest change of the median length, width or height'],
    ['flips', 'flips', t => t.flips, t => t.flips || '', 4, 'boxes whose heading was turned by 180°'],
    ['deviation', 'σ [m]', t => t.deviation, t => number(t.deviation), 4.5, 'median horizontal standard deviation of the centres'],
    ['sharper', 'cells [%]', t => t.sharper, t => number(t.sharper, 0), 5.5, `change of the number of cells of ${DATA.cell} m that the points of all sweeps fill: negative is sharper`],
    ['reasons', 'kept because', t => sumOf(t.reasons), t => sumOf(t.reasons), 12, 'reasons of the input boxes that were returned unchanged'],
  ];
  const hidden = new Set([...(DATA.has_truth ? [] : ['iou']), ...(IS_REVIEW ? [] : ['decision']), ...(view.sort === 'near' ? [] : ['near'])]);
  return all.filter(([name]) => !hidden.has(name));
}
const TEXT = new Set(['id', 'class', 'why', 'decision', 'rules', 'reasons']);

// Rejected by the run alone: no label, unless a person accepts it.
const MISTAKES = 'rejected: look for mistakes';
const isRejected = track => track.status.rejected > 0 && Object.keys(track.status).length === 1;
const isGone = track => track.deleted > 0 && track.deleted === track.members().length;

// The decision about a track, and how many of its boxes have one.
function decidedOf(track) {
  const own = judgementOf(track);
  const word = own?.decision === 'none' ? 'comment' : own?.decision;
  const inputs = new Set(track.pieces.flatMap(({ s }) => DATA.tracks[s].inputs));
  const single = [...inputs].flatMap(input => log.ofInput.get(input) ?? []).filter(row => row.stamp_ns && TOPIC_OF[row.decision] === 'judgement');
  const boxes = single.length && (track.isWhole ? single : single.filter(row => track.members().some(([s, k]) => inputOf(s, k) === row.track_id && covers(row, stampOf(s, k))))).length;
  const gone = isGone(track) ? 'delete' : track.deleted ? `${track.deleted} deleted` : '';
  const edits = [track.isWhole ? '' : track.pieces.some(({ s }) => DATA.tracks[s].id !== track.id) ? 'id' : 'split', track.pieces.some(({ s }) => DATA.tracks[s].class !== track.class) ? 'class' : ''];
  return [word, gone, ...edits, boxes ? `${boxes} ${boxes === 1 ? 'box' : 'boxes'}` : ''].filter(Boolean).join(', ');
}

function compare(a, b) {
  if (typeof a === 'string') return a.localeCompare(b, 'en', { numeric: true });
  const known = [isKnown(a), isKnown(b)];
  if (!known[0] || !known[1]) return Number(known[1]) - Number(known[0]);
  return a - b;
}

// Those with the most points near them are the likeliest mistakes: ghosts have few.
function sortMistakes() {
  if ($('f-status').value === MISTAKES) [view.sort, view.descending] = ['near', true];
  else if (view.sort === 'near') [view.sort, view.descending] = ['rank', false];
  drawList();
}

function isShown(track) {
  const text = $('f-text').value.trim().toLowerCase();
  const [name, status, reason, rule, change, decision] = ['class', 'status', 'reason', 'rule', 'change', 'decision'].map(f => $('f-' + f).value);
  if (text && !track.id.toLowerCase().includes(text) && !track.class.toLowerCase().includes(text)) return false;
  if (name && track.class !== name.slice(1)) return false;
  if (status === MISTAKES ? !isRejected(track) : status && !(status in track.status)) return false;
  if (reason && !causesOf(track).includes(reason) && !(reason in track.reasons)) return false;
  if (rule && !rulesOf(track).includes(rule)) return false;
  if (change && !CHANGED[change][1](track)) return false;
  if ((track.points ?? 0) < Number($('f-points').value)) return false;
  if (Number($('f-risk').value) > 0 && !(track.risk >= Number($('f-risk').value))) return false;
  const decided = decidedOf(track);
  return !decision || (decision === 'open' ? !decided : decided.includes(decision));
}

function drawList() {
  const found = columns();
  const [, , value] = found.find(([name]) => name === view.sort) ?? found[0];
  view.shown = TRACKS.filter(isShown);
  const sign = view.descending ? -1 : 1;
  view.shown.sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    const missing = typeof x !== 'string' && (!isKnown(x) || !isKnown(y));
    return (missing ? 1 : sign) * compare(x, y) || a.index - b.index;
  });
  fill($('rows').querySelector('colgroup'), ...found.map(([, , , , width]) => element('col', { style: `width: ${width}em` })));
  fill($('rows').querySelector('thead'), element('tr', {}, ...found.map(([name, title, , , , meaning]) => {
    const order = name === view.sort ? (view.descending ? 'descending' : 'ascending') : null;
    return element('th', { class: TEXT.has(name) ? '' : 'n', scope: 'col', 'aria-sort': order },
      element('button', { 'data-sort': name, title: meaning, onclick: () => sortBy(name) }, title));
  })));
  drawLines();
  const place = view.shown.findIndex(track => track.index === view.track);
  if (place >= 0) view.place = place;
  $('tab-count').textContent = number(TRACKS.length, 0);
  const decided = TRACKS.filter(track => decidedOf(track)).length;
  $('f-count').textContent = `${view.shown.length} of ${TRACKS.length} tracks` + (IS_REVIEW ? `, ${decided} decided` : '');
  $('f-clear').hidden = filters().every(input => input.value === input.defaultValue || (input.matches('select') && !input.value));
}

// The lines that are seen: a thousand need not be laid out.
function drawLines() {
  const box = $('rows'), found = columns();
  const top = Math.min(box.scrollTop, Math.max(0, LINE * view.shown.length - box.clientHeight));  // a filter may have shortened the list
  const first = Math.max(0, Math.floor(top / LINE) - SPARE_LINES);
  const last = Math.min(view.shown.length, Math.ceil((top + box.clientHeight) / LINE) + SPARE_LINES);
  const space = lines => (lines > 0 ? [element('tr', { 'aria-hidden': 'true' }, element('td', { class: 'space', colspan: found.length, style: `height: ${LINE * lines}px` }))] : []);
  const hint = TRACKS.length ? '' : 'No boxes.' + (hasScene ? ' Objects are added in Drive: i, then a click on the points, or p for those that are proposed.' : '');
  $('detail').hidden = Boolean(hint);
  $('decide').hidden = Boolean(hint) || !IS_REVIEW;
  $('rows-hint').textContent = hint;
  fill(box.querySelector('tbody'), ...space(first), ...view.shown.slice(first, last).map(track => lineOf(track, found)), ...space(view.shown.length - last));
  box.querySelector('table').setAttribute('aria-rowcount', view.shown.length);
}

function lineOf(track, found) {
  return element('tr', { class: 'link' + (isGone(track) ? ' gone' : ''), 'data-track': track.index, 'aria-selected': String(track.index === view.track), onclick: () => openTrack(track.index) },
    ...found.map(([name, , , text]) => {
      const shown = String(text(track));
      return element('td', { class: TEXT.has(name) ? name : 'n', title: TEXT.has(name) ? (name === 'why' ? track.why : shown) : null }, shown);
    }));
}

// Select the line of the open track, and bring it into view.
function selectLine() {
  const place = view.shown.findIndex(track => track.index === view.track), box = $('rows');
  if (place >= 0) {
    const head = box.querySelector('thead').offsetHeight, top = place * LINE;
    if (top < box.scrollTop) box.scrollTop = top;
    else if (top + head + LINE > box.scrollTop + box.clientHeight) box.scrollTop = top + head + LINE - box.clientHeight;
  }
  drawLines();
}

/** @returns {any[]} */
const filters = () => [...document.querySelectorAll('#list .filters input, #list .filters select')];

function clearFilters() {
  for (const input of filters()) input.value = input.matches('select') ? '' : input.defaultValue;
  sortMistakes();
}

function sortBy(name) {
  const isKeyed = document.activeElement?.matches('[data-sort]');
  view.descending = view.sort === name ? !view.descending : !TEXT.has(name) && name !== 'rank';
  view.sort = name;
  drawList();
  if (isKeyed) $('rows').querySelector(`[data-sort=${name}]`).focus();
}

function options(id, first, entries) {
  fill($(id), element('option', { value: '' }, first), ...entries.map(([value, text]) => element('option', { value }, text)));
}

function setUpList() {
  const every = key => [...new Set(DATA.tracks.flatMap(track => key(track)))].sort();
  options('f-class', 'any class', every(t => [t.class]).map(name => ['=' + name, name]));
  options('f-status', 'any status', [...every(t => Object.keys(t.status)).map(name => [name, name]), ...(DATA.tracks.some(isRejected) ? [[MISTAKES, MISTAKES]] : [])]);
  options('f-reason', 'any reason', [...every(causesOf).map(name => [name, name]), ...every(t => Object.keys(t.reasons)).map(name => [name, 'kept: ' + name])]);
  options('f-rule', 'any rule', every(rulesOf).map(name => [name, name]));
  options('f-change', 'any change', Object.entries(CHANGED).map(([name, [text]]) => [name, text]));
  options('f-decision', 'any decision', [['open', 'no decision'], ['accept', 'accepted'], ['reject', 'rejected'], ['unsure', 'unsure'], ['delete', 'deleted'], ['id', 'id changed'], ['class', 'class changed'], ['comment', 'comment only'], ['box', 'boxes decided']]);
  $('f-decision').hidden = !IS_REVIEW;
  for (const input of filters()) input.oninput = drawList;
  $('f-status').oninput = sortMistakes;
  $('f-clear').onclick = clearFilters;
  $('rows').onscroll = drawLines;
  drawList();
}
