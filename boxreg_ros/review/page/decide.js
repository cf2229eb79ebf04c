// Decisions about the open track and its boxes ---------------------------------------------------

const MAX_GAP = 5;                 // between two tracks that may be one object [s]
const MAX_PROPOSALS = 8;
const current = () => view.open;
const boxAt = row => current().members()[row];
const heldOf = scope => log.held.get(scopeKey('judgement', scope));
// The box of a person at a row: a pin, or a box that an added object is followed from.
function pinOf(row) {
  const scope = scopeOfBox(boxAt(row)), topic = isAdded(...boxAt(row)) ? 'addition' : 'judgement';
  const found = log.held.get(scopeKey(topic, scope));
  return ['pin', 'add'].includes(found?.decision) ? found : null;
}

const isOfTrack = row => !row.stamp_ns || Boolean(row.end_ns);

// The judgement of a track: that of its first box, those about single boxes left out.
function judgementOf(track) {
  const inputs = track.pieces.flatMap(({ s }) => DATA.tracks[s].inputs);
  if (!inputs.some(input => log.ofInput.has(input))) return undefined;
  const [s, k] = track.members()[0];
  return covering('judgement', inputOf(s, k), stampOf(s, k)).filter(isOfTrack).at(-1);
}

// The judgement of a box, as in a run: its own, else that of a range, else of its track; of equal ones the last.
const closenessOf = row => (row.stamp_ns ? (row.end_ns ? 1 : 2) : 0);
const judgementAt = (s, k) => covering('judgement', inputOf(s, k), stampOf(s, k)).reduce((a, b) => (closenessOf(a) > closenessOf(b) ? a : b), /** @type {any} */ ({})).decision;

// Whether a person has accepted or corrected a box.
const isAccepted = (s, k) => ['accept', 'pin'].includes(judgementAt(s, k));

// The judgement of the box that is shown alone, or of its range.
function judgementOfBox() {
  const scope = scopeOfBox(boxAt(view.row));
  return heldOf(scope) ?? covering('judgement', scope.track_id, scope.stamp_ns).filter(row => row.stamp_ns && !isWholeOf(row)).at(-1);
}

// Whether a range is that of the whole open track, which may be a part of one of the input.
function isWholeOf(row) {
  const [s, k] = boxAt(0), [t, l] = boxAt(view.part.stamps.length - 1);
  return Boolean(row.end_ns) && covers(row, stampOf(s, k)) && covers(row, stampOf(t, l));
}

// The boxes of a decision: the track, or the box that is shown, or those since the mark.
function chosenScopes(isBox) {
  if (!isBox) return scopesOf(current().members());
  if (view.mark === null) return [scopeOfBox(boxAt(view.row))];
  const [first, last] = [view.mark, view.row].sort((a, b) => a - b);
  return scopesOf(current().members().slice(first, last + 1));
}

// The rows of a topic that hold for any of some boxes.
const heldOver = (topic, boxes) => [...new Set(boxes.flatMap(([s, k]) => covering(topic, inputOf(s, k), stampOf(s, k))))];

// Decide, about the marked boxes once.
async function decideAbout(rows) {
  const isDone = await decide(rows);
  if (isDone && view.mark !== null) mark();
  return isDone;
}

async function judge(kind, isBox) {
  if (kind === 'reject' && isAdded(...boxAt(view.row))) return fail('There is no input to keep: delete this object, or undo its addition.');
  const held = isBox ? judgementOfBox() : judgementOf(current());
  if (held?.decision === kind && (!isBox || view.mark === null)) {
    const rows = isBox ? [held] : heldOver('judgement', current().members()).filter(isOfTrack);
    return decide(rows.map(row => ({ ...takenBack(row), comment: row.comment })));
  }
  const { id } = current(), boxes = isBox ? [] : current().members();
  if (!await decideAbout(chosenScopes(isBox).map(scope => rowOf(scope, kind, { comment: heldOf(scope)?.comment ?? '' })))) return false;
  const others = boxes.filter(box => (kind === 'accept' ? ['reject'] : kind === 'reject' ? ['accept', 'pin'] : []).includes(judgementAt(...box))).length;
  if (others) say(`Track ${id}, but for boxes with a decision of their own: ${others} ${kind === 'accept' ? 'rejected' : 'accepted or pinned'}.`);
  return true;
}

async function comment(isBox, text) {
  const box = boxAt(view.row), scopes = isBox ? [scopeOfBox(box)] : chosenScopes(false);
  // A pin that is stated again does not bring a box back that was deleted since.
  const deletions = isBox && isDeleted(...box) ? heldOver('deletion', [box]) : [];
  return decide([...scopes.map(scope => {
    const held = heldOf(scope);
    return rowOf(scope, held?.decision ?? 'none', { comment: text, box: held?.box ?? null });
  }), ...deletions]);
}

async function acceptAndGoOn() {
  if (isCorrecting()) return;
  const taken = new Set(await notePage(''));
  const open = view.shown.filter(track => !decidedOf(track) && track.index !== view.track && !taken.has(track.id));
  if (judgementOf(current())?.decision !== 'accept' && !await judge('accept', false)) return;
  if (!open.length) return say('All tracks of the list are decided.');
  const place = open.find(track => view.shown.indexOf(track) > view.place) ?? open[0];
  openTrack(place.index);
}

// Accept the tracks of the list that have no decision and a smaller risk, at once: one step to undo.
async function acceptBelow() {
  if (isCorrecting()) return;
  const text = await ask('Accept all with a risk below [m]', 'Of the tracks in the list without a decision; rejected ones are left out.', [], [], '0.3');
  const limit = Number(text);
  if (!text || !(limit > 0)) return;
  const open = view.shown.filter(track => !decidedOf(track) && !isRejected(track) && track.risk < limit);
  if (!open.length) return say('No track of the list is below.');
  const rows = open.flatMap(track => scopesOf(track.members()).map(scope => rowOf(scope, 'accept')));
  if (await decide(rows)) say(`${open.length} ${open.length === 1 ? 'track' : 'tracks'} accepted; z undoes it.`);
}

// Note the track that this page has open; the ids of those that other pages have.
const page = crypto.randomUUID?.() ?? String(Math.random());
async function notePage(track) {
  return post('open', { page, track }).catch(() => []);
}

// Delete the track, the box or the range; once more takes that back.
async function remove(isBox) {
  if (isCorrecting()) return;
  const deleted = scopes => scopes.map(scope => rowOf(scope, 'delete'));
  if (isBox ? !isDeleted(...boxAt(view.row)) : !isGone(current())) return decideAbout(deleted(chosenScopes(isBox)));
  const restored = isBox ? [boxAt(view.row)] : current().members();
  const held = heldOver('deletion', restored);
  // A restored box may be one of a range: the others of it stay deleted.
  const others = isBox ? current().members().filter(box => box !== restored[0] && isDeleted(...box) && held.some(row => row.track_id === inputOf(...box) && covers(row, stampOf(...box)))) : [];
  return decide([...held.map(takenBack), ...deleted(scopesOf(others))]);
}

function freshId(id) {
  const known = new Set([...TRACKS.map(track => track.id), ...DATA.tracks.flatMap(track => track.inputs)]);
  for (let k = 2; ; k++) if (!known.has(`${id}_${k}`)) return `${id}_${k}`;
}

// The box that is shown, and all after it, become a track of their own.
async function split() {
  if (isCorrecting()) return;
  if (!view.row) return fail('A track is split before a box that is not its first: go to the first box of the new track.');
  const rest = current().members().slice(view.row);
  return decide(scopesOf(rest).map(scope => rowOf(scope, 'rename', { value: freshId(current().id) })));
}

// Tracks that end before the open one begins, or begin after it ends, the nearest first.
function continuations() {
  const own = current(), end = own.begin + own.seconds;
  return TRACKS.filter(track => track !== own && track.path.length).flatMap(track => {
    const gap = Math.max(track.begin - end, own.begin - track.begin - track.seconds);
    if (gap <= 0 || gap > MAX_GAP || !own.path.length) return [];
    const [a, b] = track.begin > end ? [own.path.at(-1), track.path[0]] : [track.path.at(-1), own.path[0]];
    return [{ track, gap, away: Math.hypot(a[0] - b[0], a[1] - b[1]) }];
  }).sort((a, b) => a.away - b.away).slice(0, MAX_PROPOSALS);
}

async function join() {
  if (isCorrecting()) return;
  const proposals = continuations().map(({ track, gap, away }) => [track.id, `${track.id} ${track.class}: ${number(gap, 1)} s and ${number(away, 1)} m apart`]);
  const id = await ask('Join with track', proposals.length ? 'Tracks that continue this one' : 'No track continues this one', proposals, TRACKS.map(track => track.id));
  if (id === null) return;
  const other = TRACKS.find(track => track.id === id);
  if (!other || other === current()) return fail(`No other track ${id}: choose one of the list.`);
  const own = new Set(view.part.stamps);
  if (other.members().some(([s, k]) => own.has(stampOf(s, k)))) return fail(`Tracks ${current().id} and ${id} have boxes at the same time: split or delete these first.`);
  return decide(scopesOf(other.members()).map(scope => rowOf(scope, 'rename', { value: current().id })));
}

async function rename() {
  if (isCorrecting()) return;
  const id = await ask('New id of the track', '', [], [], current().id);
  if (!id || id === current().id) return;
  if (TRACKS.some(track => track.id === id)) return fail(`There is a track ${id} already: join them.`);
  return decide(scopesOf(current().members()).map(scope => rowOf(scope, 'rename', { value: id })));
}

// The classes to choose from: those of the file that the server was given, else of the drive; the first nine have keys.
const classNames = () => (view.classes.length ? view.classes : [...new Set(DATA.tracks.map(track => track.class))].sort());

async function reclass() {
  if (isCorrecting()) return;
  const names = classNames();
  return classify(await ask('Class of the track', '', names.map((one, k) => [one, k < 9 ? `${k + 1} ${one}` : one]), names, current().class));
}

async function classify(name) {
  if (!name || isCorrecting() || (name === current().class && view.mark === null)) return;
  if (view.classes.length && !view.classes.includes(name)) return fail(`No class ${name} in the list: choose one of ${view.classes.join(', ')}.`);
  return decideAbout(chosenScopes(view.mark !== null).map(scope => rowOf(scope, 'reclass', { value: name })));
}

// The attributes of a box: as decided, else as in the input. Values are text; true is not said.
const USUAL_ATTRIBUTES = ['occluded=true', 'occluded=partly', 'truncated=true', 'parked=true'];
function attributesAt(row) {
  const [s, k] = boxAt(row), found = { ...view.part.attributes?.[row] };
  for (const { decision, value } of covering('attribute', inputOf(s, k), stampOf(s, k))) {
    if (decision === 'remove') delete found[value];
    else found[value.split('=')[0]] = value.slice(value.indexOf('=') + 1);
  }
  return found;
}

const attributeText = (name, value) => ({ true: name, false: `not ${name}` }[value] ?? `${name}: ${value}`);
const attributesText = row => Object.entries(attributesAt(row)).filter(([, value]) => value !== 'false').map(([name, value]) => attributeText(name, value)).join(', ');

// Set an attribute of the track, of the marked boxes or, with `isBox`, of this one.
async function describe(isBox) {
  if (isCorrecting()) return;
  const held = attributesAt(view.row);
  const known = Object.entries(held).filter(([name]) => !['occluded', 'truncated', 'parked'].includes(name)).map(([name, value]) => `${name}=${value}`);
  const offered = [...USUAL_ATTRIBUTES, ...known].map(one => {
    const [name, value] = one.split('=');
    return held[name] === value ? `${name}=false` : one;
  });
  const text = await ask(`Attribute of ${view.mark !== null ? 'the marked boxes' : isBox ? 'this box' : 'the track'}`, 'NAME=VALUE, a name alone for true, or NAME= to remove it',
    offered.map((one, k) => [one, `${k + 1} ${attributeText(...one.split('='))}`]), offered);
  const [name, value = 'true'] = (text ?? '').split(/=(.*)/s).map(part => part.trim());
  if (!name) return;
  const decision = value ? ['attribute', { value: `${name}=${value}` }] : ['remove', { value: name }];
  return decideAbout(chosenScopes(isBox || view.mark !== null).map(scope => rowOf(scope, ...decision)));
}

// Turn the whole track by 180°: an added object is followed again from its turned boxes; else each box is
// pinned as it is shown, turned, so that no later step decides about its heading.
async function turnRound() {
  if (isCorrecting()) return;
  const rows = current().members().flatMap(([s, k], row) => {
    const scope = scopeOfBox([s, k]), held = pinOf(row), shown = view.part.usable[row];
    const isSeed = isAdded(s, k);
    if ((isSeed && !held) || !shown || isDeleted(s, k)) return [];
    const box = flipped(held ? held.box : moved(shown, view.part.origin, 1));
    return [isSeed ? rowOf(scope, 'add', { box, value: held.value }) : rowOf(scope, 'pin', { box, comment: held?.comment ?? '' })];
  });
  return rows.length ? decide(rows) : undefined;
}

// Ask for a text; null if the person gives none.
function ask(title, note, proposals, known, value = '') {
  const dialog = $('ask'), input = $('ask-text');
  $('ask-title').textContent = title;
  $('ask-note').textContent = note;
  input.value = value;
  fill($('ask-known'), ...known.map(one => element('option', { value: one })));
  fill($('ask-proposals'), ...proposals.map(([one, text]) => element('button', { type: 'button', onclick: () => dialog.close('=' + one) }, text)));
  dialog.returnValue = '';
  dialog.onkeydown = event => {
    const chosen = proposals[Number(event.key) - 1];
    if (!chosen || event.target === input) return;
    event.preventDefault();
    dialog.close('=' + chosen[0]);
  };
  dialog.showModal();
  if (proposals.length && !value) $('ask-proposals').firstChild.focus();
  else input.select();
  return new Promise(done => { dialog.onclose = () => done(dialog.returnValue.startsWith('=') ? dialog.returnValue.slice(1) : null); });
}

// Solve the open track again, with its pinned boxes; the result is shown beside the first one.
async function solve() {
  if (!IS_REVIEW || isCorrecting()) return;
  const track = current();
  if (track.pieces.some(({ s }) => DATA.tracks[s].added)) return say('An added object is solved whenever one of its boxes is corrected.');
  const pins = pinsOf();
  say('Solving …');
  const begin = performance.now();
  let found;
  try {
    found = await post('solve', { ...solvable(track), pins });
  } catch (error) {
    say('');
    return fail(`The track was not solved: ${error.message}`);
  }
  if (current() !== track) return;
  view.solved = new Map(found.stamps.map((stamp, k) => [stamp, found.boxes[k]]));
  const ious = view.part.stamps.map((stamp, row) => {
    const [box, before] = [view.solved.get(stamp), view.part.usable[row]];
    return box && before ? overlap(moved(box, view.part.origin, -1), before) : null;
  }).filter(isKnown);
  const least = Math.min(...ious), mean = ious.reduce((a, b) => a + b, 0) / ious.length;
  const pinned = Object.keys(pins).length;
  say(`Solved with ${pinned} pinned ${pinned === 1 ? 'box' : 'boxes'} in ${number((performance.now() - begin) / 1000, 1)} s: IoU with the result before ${number(mean)}, least ${number(least)}. Ctrl-S writes the labels.`);
  drawViews();
}

// The rows of a part of a track of the report, as first and last of each run.
function runsOfRows(s, rows) {
  const runs = [];
  for (const k of rows ?? DATA.tracks[s].at.keys()) {
    if (runs.length && runs.at(-1)[1] === k - 1) runs.at(-1)[1] = k;
    else runs.push([k, k]);
  }
  return runs;
}

// The buttons.
function drawDecisions() {
  drawNumbers();
  for (const id of ['detail', 'decide']) $(id).classList.toggle('editing', Boolean(view.edit));
  if (document.activeElement?.id.startsWith('comment')) return;
  const button = (name, text, title, onclick, isPressed = null) => element('button', { 'data-do': name, title, onclick, 'aria-pressed': isPressed === null ? null : String(isPressed) }, text);
  const track = current(), isMarked = view.mark !== null;
  const focused = document.activeElement?.getAttribute('data-do');
  const what = isMarked ? 'Boxes' : 'Box';
  fill($('decide-track'), element('span', {}, 'Track'), ...judgements(false),
    button('next', 'Accept, next', 'Accept the track and open the next one without a decision (Enter)', acceptAndGoOn));
  fill($('edit-track'), element('span'),
    button('delete', 'Delete', 'Delete the track, or restore it (d)', () => remove(false), isGone(track)),
    button('split', 'Split', 'This box and all after it become a track of their own (s)', split),
    button('join', 'Join …', 'Join with a track that continues this one (j)', join),
    button('rename', 'Id …', 'Change the id (n)', rename),
    button('reclass', 'Class …', 'Change the class, of the track or of the marked boxes (k)', reclass),
    button('describe', 'Attribute …', 'Occluded, truncated, parked or another attribute of the track, or of the marked boxes (x)', () => describe(false)),
    button('turn', 'Turn', 'Turn the whole track by 180° (t)', turnRound),
    button('solve', 'Solve', 'Solve the track again with the pinned boxes (o)', solve),
    button('undo', 'Undo', 'Undo your last decision, of any track (z)', undo), button('redo', 'Redo', 'Do it again (y)', redo));
  fill($('decide-box'), element('span', {}, what), ...judgements(true),
    button('delete-box', 'Delete', `Delete, or restore, ${isMarked ? 'the marked boxes' : 'this box'} (Shift d)`, () => remove(true), isDeleted(...boxAt(view.row))),
    button('mark', isMarked ? `From ${view.mark + 1}` : 'From', 'Decide about all boxes from here to the one shown then (b)', mark, isMarked),
    view.edit ? button('pin', 'Pin', 'Save this box (Enter)', pin) : button('edit', pinOf(view.row) ? 'Edit pin' : 'Edit', 'Correct this box (e)', edit),
    view.edit ? button('cancel', 'Cancel', 'Discard this correction (Escape)', discard)
      : (pinOf(view.row) ? button('unpin', 'Unpin', 'Remove the pin', () => decide([takenBack(pinOf(view.row))])) : null));
  if (focused) $('decide').querySelector(`[data-do=${focused}]`)?.focus();

  // The buttons and the comment for the track, or for the box.
  function judgements(isBox) {
    const suffix = isBox ? '-box' : '', named = isBox ? (isMarked ? 'the marked boxes' : 'this box') : 'the track', shift = isBox ? 'Shift ' : '';
    const held = isBox ? judgementOfBox() : judgementOf(track);
    const one = (kind, text, effect) => button(kind + suffix, text, `${text} ${named}${effect} (${shift}${kind[0]})`, () => judge(kind, isBox), held?.decision === kind);
    const input = element('input', { id: 'comment' + suffix, placeholder: `Comment on ${isBox ? 'this box' : 'the track'} (${shift}c)`, 'aria-label': `Comment on ${isBox ? 'this box' : 'the track'}`,
      onchange: event => comment(isBox, event.target.value) });
    input.value = held?.comment ?? '';
    if (held?.who) input.title = `${held.decision}: ${held.who}, ${held.when}`;
    return [one('accept', 'Accept', ''), one('reject', 'Reject', ': keep the input'), one('unsure', 'Unsure', ''), input];
  }
}

function mark() {
  view.mark = view.mark === null ? view.row : null;
  step(view.row, true);
}
