// The correction of a box ------------------------------------------------------------------------

const STEP = 0.02;                 // of a key that moves or resizes a box [m]
const TURN = 0.5 * Math.PI / 180;  // of a key that turns a box [rad]
const GRIP = 8;                    // reach of a face, or of the stroke at the front [px]
const LEAST_SIZE = 0.1;            // [m]
const DEGREES = 180 / Math.PI;
// Name, letter, column of the box, scale, digits.
/** @type {[string, string, number, number, number][]} */
const TYPED = [['x', 'x', 0, 1, 2], ['y', 'y', 1, 1, 2], ['z', 'z', 2, 1, 2], ['length', 'l', 3, 1, 2], ['width', 'w', 4, 1, 2], ['height', 'h', 5, 1, 2], ['yaw', 'yaw', 8, DEGREES, 1]];

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

function edit() {
  if (!IS_REVIEW) return;
  if (view.isPlaying) play();
  if (!view.part.usable[view.row]) return fail('This box has numbers that are not finite: correct another box of the track.');
  const human = currentBoxes().find(([name]) => name === 'human');
  view.edit = (human ? human[1] : view.part.usable[view.row]).slice();
  view.steps = [];
  view.isMoved = false;
  view.risks = view.followed = null;
  $('mode').value = 'sweep';
  step(view.row, true);
  $('top').focus({ preventScroll: true });
}

async function pin() {
  const edited = view.edit, box = moved(edited, view.part.origin, 1);
  const scope = scopeOfBox(boxAt(view.row));
  const comment = heldOf(scope)?.comment ?? '';
  const seed = isAdded(...boxAt(view.row)) ? seedsOf(scope.track_id)[0] : null;
  view.isMoved = false;  // what follows a decision may open another track
  if (!await decide([seed ? rowOf(scope, 'add', { box, value: seed.value }) : rowOf(scope, 'pin', { box, comment })])) {
    view.isMoved = view.edit === edited;  // it is not saved: the box stays
    return;
  }
  if (view.edit === edited) view.edit = null;
  view.solved = null;
  step(view.row, true);
}

// What a drag, or a key, begins with can be undone.
function rememberEdit() { view.steps.push(view.edit.slice()); }

function undoEdit() {
  const before = view.steps.pop();
  if (!before) return;
  view.edit = before;
  redrawEdit();
}

function moveEdit(along, across, up) {
  view.edit.splice(0, 3, ...fromFrame([along, across, up], view.edit, rotation(view.edit)));
  redrawEdit();
}

// Move the face on one side of an axis outward; the opposite face stays.
function resizeEdit(axis, sign, by) {
  const size = Math.max(LEAST_SIZE, view.edit[3 + axis] + by);
  const shift = [0, 0, 0];
  shift[axis] = sign * (size - view.edit[3 + axis]) / 2;
  view.edit[3 + axis] = size;
  moveEdit(...shift);
}

function redrawEdit() {
  view.isMoved = true;
  view.redraw ||= requestAnimationFrame(() => {
    view.redraw = 0;
    if (!view.edit) return;
    drawViews();
    drawNumbers();
    askRisk();
  });
}

// The risk of the box as it is dragged, and the boxes before and after it that follow it, one request after the other.
async function askRisk() {
  const [s, k] = boxAt(view.row);
  view.riskWanted = true;
  if (view.isAsking) return;
  view.isAsking = true;
  while (view.riskWanted && view.edit) {
    view.riskWanted = false;
    const edited = view.edit, box = moved(edited, view.part.origin, 1), stamp = view.part.stamps[view.row];
    try {
      const risks = isAdded(s, k) ? null : await post('risk', { index: s, row: k, class: current().class, box });
      const found = isAdded(s, k) ? await followed(inputOf(s, k), stamp, box)
        : await post('solve', { ...solvable(current()), pins: { ...pinsOf(), [stamp]: box }, near: stamp });
      if (view.edit !== edited) break;  // it is another box, or none
      view.risks = risks;
      view.followed = new Map(found.stamps.map((one, at) => [one, found.boxes[at]]));
    } catch { break; }  // the page says when the server is gone: with the next decision
    drawNumbers();
    drawViews();
  }
  view.isAsking = false;
}

// The boxes of an added object as it is followed with one more box.
async function followed(id, stamp, box) {
  const seeds = [...seedsOf(id).filter(row => row.stamp_ns !== stamp), { stamp_ns: stamp, box }];
  const { part } = await askToFollow(id, seedsOf(id)[0].value, seeds);
  return { stamps: part.stamps, boxes: part.boxes.map(one => moved(one, part.origin, 1)) };
}

// A track and its pinned boxes, as the server solves it.
function solvable(track) {
  const pieces = track.pieces.flatMap(({ s, rows }) => runsOfRows(s, rows).map(([a, b]) => ({ index: s, begin: stampOf(s, a), end: stampOf(s, b) })));
  return { class: track.class, pieces };
}

function pinsOf() {
  const pins = {};
  view.part.stamps.forEach((stamp, row) => { const found = pinOf(row); if (found) pins[stamp] = found.box; });
  return pins;
}

// The numbers of the box, which can be typed, and what follows from them.
function drawNumbers() {
  $('numbers').hidden = !view.edit;
  if (!view.edit) return;
  const box = moved(view.edit, view.part.origin, 1);
  for (const [name, , column, scale, digits] of TYPED) {
    const input = $('n-' + name);
    if (document.activeElement !== input) input.value = (scale * box[column]).toFixed(digits);
  }
  const points = pointsAt(view.part, view.row), refined = view.part.usable[view.row];
  $('clock').textContent = `IoU with the ${view.part.status[view.row]} box ${number(overlap(view.edit, refined))} · ` +
    `${numInside(points, view.edit)} of ${points.length} points inside (before ${numInside(points, refined)})` + (view.risks ? ` · risk ${number(view.risks[0])} → ${number(view.risks[1])} m` : '');
}

function setUpNumbers() {
  for (const [name, letter, column, scale] of TYPED) {
    const input = element('input', { id: 'n-' + name, type: 'number', step: 'any', title: `${name} [${scale === 1 ? 'm' : '°'}]`, onchange: event => {
      const value = Number(event.target.value) / scale - (column < 3 ? view.part.origin[column] : 0);
      if (event.target.value === '' || (column >= 3 && column < 6 && value < LEAST_SIZE)) return drawNumbers();
      rememberEdit();
      view.edit[column] = value;
      redrawEdit();
    } });
    $('typed').append(element('label', { class: column < 2 ? 'place' : null }, letter + ' ', input));
  }
}

function setUpDragging(canvas) {
  const [right, up] = VIEWS[canvas.id];
  /** @type {any} */
  let grip = null;
  const place = event => {
    const bounds = canvas.getBoundingClientRect();
    const flat = view.center.slice();
    flat[right] += (event.clientX - bounds.left - bounds.width / 2) / canvas.zoom;
    flat[up] -= (event.clientY - bounds.top - bounds.height / 2) / canvas.zoom;
    return toFrame(fromFrame(flat, view.frame, view.R), view.edit, rotation(view.edit));
  };
  canvas.onpointerdown = event => {
    if (!view.part || !view.frame) return;
    canvas.setPointerCapture(event.pointerId);
    grip = (view.edit && gripAt(place(event), canvas)) || { pans: true };
    grip.at = [event.clientX, event.clientY];
    if (!grip.pans) rememberEdit();
  };
  canvas.onpointermove = event => {
    if (!grip) return;
    if (grip.pans) {
      view.center[right] -= (event.clientX - grip.at[0]) / canvas.zoom;
      view.center[up] += (event.clientY - grip.at[1]) / canvas.zoom;
      grip.at = [event.clientX, event.clientY];
      return drawViews();
    }
    if (!view.edit) return;
    const at = place(event);
    if (grip.turns) view.edit[8] += Math.atan2(at[1], at[0]);
    else if (grip.face && !$('lock').checked) resizeEdit(...grip.face, grip.face[1] * at[grip.face[0]] - view.edit[3 + grip.face[0]] / 2);
    else if (grip.face) moveEdit(...[0, 1, 2].map(k => (k === grip.face[0] ? at[k] - grip.face[1] * view.edit[3 + k] / 2 : 0)));
    else moveEdit(...[0, 1, 2].map(k => (k === right || k === up ? at[k] - grip.last[k] : 0)));
    redrawEdit();
  };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    zoomBy(wheelFactor(event), canvas, event);
  }, { passive: false });
  canvas.ondblclick = () => { if (!view.edit) resetViews(); };
  canvas.onpointerup = canvas.onpointercancel = () => { grip = null; };
}

// What a place in the axes of the box takes hold of: the stroke, a face, the box, or null.
function gripAt(at, canvas) {
  const [right, up] = VIEWS[canvas.id];
  return gripOf(at, view.edit, GRIP / canvas.zoom, [right, up]);
}

/** @returns {any} */
function gripOf(at, box, reach, [right, up]) {
  const half = [3, 4, 5].map(c => box[c] / 2);
  if (up === 1 && Math.abs(at[1]) < half[1] / 2 && at[0] > half[0] + reach && at[0] < 1.3 * half[0] + reach) return { turns: true };
  if ([right, up].some(a => Math.abs(at[a]) > half[a] + reach)) return null;
  const face = [right, up].find(a => Math.abs(Math.abs(at[a]) - half[a]) < reach);
  return { last: at, face: face === undefined ? null : [face, Math.sign(at[face])] };
}
