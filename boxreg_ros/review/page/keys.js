// Keys -------------------------------------------------------------------------------------------

const KEYS = {
  ArrowLeft: ['←  →', 'step one box; with Shift ten', event => step(view.row - (event.shiftKey ? 10 : 1))],
  ArrowRight: ['', '', event => step(view.row + (event.shiftKey ? 10 : 1))],
  Home: ['Home  End', 'first and last box', () => step(0)],
  End: ['', '', () => step(view.part.stamps.length - 1)],
  ' ': ['Space', 'play or pause', () => play()],
  ArrowDown: ['↓  ↑', 'next and previous track of the list', () => nextTrack(1)],
  ArrowUp: ['', '', () => nextTrack(-1)],
  g: ['g', 'go to the riskiest box of the track', () => step(nearestRow(current().riskiest))],
  '+': ['+  −', 'zoom the views; the wheel zooms at the pointer, dragging moves them', () => zoomBy(ZOOM_STEP)],
  '-': ['', '', () => zoomBy(1 / ZOOM_STEP)],
  0: ['0', 'the whole box in the views again; a double click does too', () => resetViews()],
  m: ['m', 'points of this sweep, or of all sweeps in the refined or input boxes', () => { const mode = $('mode'); mode.selectedIndex = (mode.selectedIndex + 1) % 3; drawViews(); }],
  '/': ['/', 'search', () => $('f-text').focus()],
  '?': ['?', 'show the keys', () => $('help').showModal()],
};
const REVIEW_KEYS = {
  Enter: ['Enter', 'accept the track, and open the next one without a decision', () => acceptAndGoOn()],
  a: ['a', 'accept the track; with Shift this box', event => judge('accept', event.shiftKey)],
  r: ['r', 'reject the track: its input boxes are kept; with Shift this box', event => judge('reject', event.shiftKey)],
  u: ['u', 'unsure about the track; with Shift about this box', event => judge('unsure', event.shiftKey)],
  d: ['d', 'delete the track, or restore it; with Shift this box', event => remove(event.shiftKey)],
  b: ['b', 'mark: decisions with Shift are about all boxes from here to the one shown then', () => mark()],
  s: ['s', 'split: this box and all after it become a track of their own', () => split()],
  j: ['j', 'join with a track that continues this one', () => join()],
  n: ['n', 'change the id of the track', () => rename()],
  t: ['t', 'turn the whole track by 180°: its boxes are pinned as they are shown, turned', () => turnRound()],
  k: ['k', 'change the class of the track, or of the marked boxes', () => reclass()],
  1: ['1 … 9', 'give the track, or the marked boxes, the class with this number', event => classify(classNames()[Number(event.key) - 1])],
  x: ['x', 'set an attribute of the track, as occluded or parked, or of the marked boxes; with Shift of this box', event => describe(event.shiftKey)],
  c: ['c', 'comment on the track; with Shift on this box', event => $(event.shiftKey ? 'comment-box' : 'comment').focus()],
  e: ['e', 'correct this box', () => edit()],
  o: ['o', 'solve the track again with its pinned boxes', () => solve()],
  i: ['i', 'add an object: click its points in the drive, then Enter follows it both ways', () => inDrive(() => startAdding(true))],
  p: ['p', 'the next object that the run proposes; Enter follows it', () => inDrive(nextProposal)],
  z: ['z  y', 'undo your last decision, and do it again', event => (event.shiftKey ? redo() : undo())],
  y: ['', '', () => redo()],
};
const SCENE_KEYS = {
  ArrowLeft: ['←  →', 'step one sweep; with Shift ten', event => showScene(scene.at - (event.shiftKey ? 10 : 1))],
  ArrowRight: ['', '', event => showScene(scene.at + (event.shiftKey ? 10 : 1))],
  Home: ['', '', () => showScene(0)],
  End: ['', '', () => showScene(DATA.stamps.length - 1)],
  ' ': ['', '', () => playScene()],
  '+': ['', '', () => zoomScene(ZOOM_STEP)],
  '-': ['', '', () => zoomScene(1 / ZOOM_STEP)],
  0: ['', '', () => wholeScene()],
  v: ['v', 'the scene in 3D, or from above; dragging with Shift, or with the right button, turns it', () => toggleSpace()],
  1: ['1 … 9', 'the class of the object that is added', event => chooseClass(classNames()[Number(event.key) - 1])],
  f: ['f', 'turn the object that is added by 180°', () => flipFit()],
  c: ['c', 'copy the box of the open track from the sweep nearest to this one', () => copyBox()],
  e: ['e', 'correct the box below the pointer, or of the open track: drag it, an edge or its front; Enter saves it', () => editBox()],
  i: ['', '', () => startAdding()],
  p: ['', '', () => nextProposal()],
  Enter: ['', '', () => keepFit()],
  Escape: ['', '', () => startAdding(false)],
  z: ['', '', event => (event.shiftKey ? redo() : undo())],
  y: ['', '', () => redo()],
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
  t: ['t', 'turn by 90°', () => { view.edit[8] += Math.PI / 2; redrawEdit(); }],
  f: ['f', 'flip the heading', () => { view.edit = flipped(view.edit); redrawEdit(); }],
  l: ['l w h', 'lengthen, widen, heighten by 2 cm; with Shift shrink', n => resizeEdit(0, 1, n > 1 ? -STEP : STEP)],
  w: ['', '', n => resizeEdit(1, 1, n > 1 ? -STEP : STEP)],
  h: ['', '', n => resizeEdit(2, 1, n > 1 ? -STEP : STEP)],
};
const END_EDIT_KEYS = {
  z: ['z', 'undo the last step of the correction', () => undoEdit()],
  Enter: ['Enter', 'pin the box', () => pin()],
  Escape: ['Escape', 'discard the correction', () => discard()],
};

function nextTrack(by) {
  const at = view.shown.findIndex(track => track.index === view.track);
  // A track that a filter has removed, as by its decision, leaves its place to the next one.
  const wanted = at < 0 ? view.place + Math.min(by, 0) : at + by;
  const next = view.shown[Math.max(0, Math.min(view.shown.length - 1, wanted))];
  if (next) openTrack(next.index);
}

function onKey(event) {
  if (document.querySelector('dialog[open]')) return;
  const isControl = (event.ctrlKey || event.metaKey) && !event.altKey;
  if (isControl && event.key.toLowerCase() === 's' && IS_REVIEW) {
    event.preventDefault();
    return void save();
  }
  if (isControl && event.key === 'p') {
    event.preventDefault();
    return void printPage();
  }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  // The focus stays in a dialog for a moment after it has closed.
  const target = event.target.closest('dialog') ? document.body : event.target;
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const plays = name === ' ' && target.matches('select, [type=number]');  // a space is no part of their values
  if (target.matches('input:not([type=range], [type=checkbox]), textarea, select') && !plays) {
    if (event.key === 'Escape' || event.key === 'Enter') target.blur();
    return;
  }
  const digit = /^[1-9]$/.test(name) ? '1' : name;
  const isTracks = !$('tracks').hidden && view.part, isScene = !$('drive').hidden;
  // A tab that is open already, and what the mouse has pressed, leave Enter to the page.
  if (name === 'Enter' && target.matches('button, a') && !target.matches('[role=tab][aria-selected=true]')) return;
  if (name === ' ' && target.matches('button, a, input') && !isTracks && !isScene) return;
  if (isScene && SCENE_KEYS[digit]) {
    event.preventDefault();
    return SCENE_KEYS[digit][2](event);
  }
  if (!isTracks && event.key !== '?' && event.key !== '/') return;
  const isView = ['+', '-', '0', ' '].includes(name);
  if (view.edit && !isView) {
    const key = EDIT_KEYS[name] ?? END_EDIT_KEYS[name];
    if (!key) return;
    event.preventDefault();
    if (EDIT_KEYS[name]) rememberEdit();
    return key[2](event.shiftKey ? 5 : 1);
  }
  const key = KEYS[name] ?? (IS_REVIEW ? REVIEW_KEYS[digit] : undefined);
  if (!key) return;
  event.preventDefault();
  key[2](event);
}

function leaveFocus(event) {
  event.preventDefault();
  /** @type {any} */
  const focused = document.activeElement;
  if (focused?.matches('input, select, button')) focused.blur();  // a text that was typed is saved
}

function setUpKeys() {
  const groups = [KEYS, ...(IS_REVIEW ? [REVIEW_KEYS, { save: ['Ctrl s', 'write the label files with all decisions, beside the first result'] }] : [])];
  const lines = group => Object.values(group).filter(([keys]) => keys).map(([keys, text]) => element('tr', {}, element('td', {}, element('kbd', {}, keys)), element('td', {}, text)));
  const editing = IS_REVIEW ? [element('tr', {}, element('th', { colspan: 2 }, 'In the drive')), ...lines(SCENE_KEYS),
    element('tr', {}, element('th', { colspan: 2 }, 'While correcting a box')), ...lines(EDIT_KEYS), ...lines(END_EDIT_KEYS)] : [];
  fill($('keys'), ...groups.flatMap(lines), ...editing);
  document.addEventListener('keydown', onKey);
  // The mouse leaves the focus where it is: Enter after a click is the key of the page, and does not press the button again.
  document.addEventListener('mousedown', event => { if (/** @type {any} */ (event.target).closest?.('main button, header button')) leaveFocus(event); });
  $('ask-form').onsubmit = event => { event.preventDefault(); $('ask').close('=' + $('ask-text').value.trim()); };
  $('ask-cancel').onclick = () => $('ask').close('');
  $('help-button').onclick = () => $('help').showModal();
}
