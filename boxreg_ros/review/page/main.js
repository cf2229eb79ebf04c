// The page ---------------------------------------------------------------------------------------

function hashOf(id, stamp) {
  return '#' + new URLSearchParams({ track: id, ...(stamp ? { stamp } : {}) });
}

// A track that a link, or the history, opens has its address already.
async function openTrack(index, stamp = null, row = null, isLinked = false) {
  showTab('tracks');
  const track = TRACKS[index];
  if (track !== view.open) {
    if (isCorrecting()) return;
    view.track = index;
    view.place = Math.max(0, view.shown.indexOf(track));
    selectLine();
    const part = await loadTrack(track);
    if (TRACKS[view.track] !== track) return;
    clearTimeout(view.hashTimer);
    const isNew = view.open?.id !== track.id;
    if (isNew && !isLinked) history.pushState(null, '', hashOf(track.id, stamp));
    view.open = track;
    view.part = part;
    view.charts = false;
    view.edit = view.solved = null;
    if (isNew) {
      view.mark = null;
      view.limits = limitsOf(part);
      view.zoom = 1;
      view.center = [0, 0, 0];
      view.around = [];
    }
    $('time').max = part.stamps.length - 1;
    if (IS_REVIEW) notePage(track.id);
    row ??= part.num_points.indexOf(Math.max(...part.num_points));  // the object is seen best there
    drawTitle(track);
    loadAround(track).then(found => {
      if (view.open !== track) return;
      view.around = found;
      drawViews();
    });
  }
  if (stamp) row = nearestRow(stamp);
  if (view.part) step(row ?? view.row, true);
  drawOnceSeen('charts');
}

function nearestRow(stamp, part = view.part) {
  let best = 0n, row = 0;
  part.stamps.forEach((own, k) => {
    const off = BigInt(own) - BigInt(/^\d+$/.test(stamp) ? stamp : 0);
    const away = off < 0n ? -off : off;
    if (k === 0 || away < best) { best = away; row = k; }
  });
  return row;
}

function drawTitle(track) {
  const isGiven = track.extents[0].every(isKnown);
  const facts = [`${track.boxes + track.interpolated} boxes in ${number(track.seconds, 1)} s`, `${number(track.points, 0)} points (median)`,
    ...(isGiven ? [`moved ${number(track.shift)} m`, `turned ${number(track.turn, 1)}°`] : []), track.flips ? `${track.flips} heading ${track.flips === 1 ? 'flip' : 'flips'} corrected` : '',
    `extents ${track.extents.filter(e => e.every(isKnown)).map(e => e.map(v => number(v)).join(' × ')).join(' → ')} m`,
    isKnown(track.after.iou) ? `3D IoU ${number(track.before.iou, 3)} → ${number(track.after.iou, 3)}` : '', sumOf(track.reasons)];
  const violations = track.rules.map(([rule, stamp, text]) => element('a', { href: hashOf(track.id, stamp) }, `${rule}: ${text}`));
  const seeds = track.pieces.map(({ s }) => DATA.tracks[s]).filter(source => source.added).flatMap(source => source.inputs);
  const ends = seeds.map(id => `added by a person. ${endsText(id)} ${(additions.get(id)?.problems ?? []).join(' ')}`);
  const origin = track.isWhole ? '' : `of ${[...new Set(track.pieces.map(({ s }) => DATA.tracks[s].id))].join(', ')}`;
  fill($('title'), element('b', {}, track.id || 'no id'), element('span', {}, track.class), ...(origin ? [element('span', { class: 'grey' }, origin)] : []),
    element('span', {}, `risk ${number(track.risk)} m${track.why && ': '}`, ...reasonsOf(track), ' · ', element('a', { href: hashOf(track.id, track.riskiest), title: 'key g' }, 'riskiest box')),
    ...violations, ...ends.map(text => element('span', {}, text)), element('span', { class: 'grey' }, facts.filter(Boolean).join(' · ')));
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
  const mine = IS_REVIEW ? heldOf(scopeOfBox(boxAt(row))) : null;
  const facts = [`${row + 1}/${part.stamps.length}`, `${number(part.times[row], 2)} s`, part.status[row] + (part.reasons[row] ? ` (${part.reasons[row]})` : ''),
    IS_REVIEW && isDeleted(...boxAt(row)) ? 'deleted' : '', mine ? (mine.decision === 'none' ? mine.comment : mine.decision) : '',
    attributesText(row), `${part.num_points[row]} points`, `risk ${number(part.risk[row])} m`,
    isKnown(part.iou[1][row]) ? `IoU ${number(part.iou[0][row])} → ${number(part.iou[1][row])}` : ''];
  $('clock').textContent = facts.filter(Boolean).join(' · ');
  $('clock').title = `${$('clock').textContent} · stamp ${part.stamps[row]} ns`;
  clearTimeout(view.hashTimer);  // browsers limit how often the address may change
  view.hashTimer = setTimeout(() => history.replaceState(null, '', hashOf(current().id, view.part.stamps[view.row])), 200);
  drawViews();
  drawCursor();
  if (IS_REVIEW) drawDecisions();
}

function play() {
  if (!view.isPlaying && isCorrecting()) return;
  cancelAnimationFrame(view.playing);
  view.isPlaying = !view.isPlaying;
  $('play').textContent = view.isPlaying ? 'Pause' : 'Play';
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

const TABS = ['overview', 'tracks', 'drive', 'run'];

function showTab(name) {
  for (const one of TABS) {
    $(one).hidden = one !== name;
    $('tab-' + one).setAttribute('aria-selected', String(one === name));
  }
  if (name === 'overview') { drawOverview(); drawTimeline(); }
  if (name === 'overview' && !$('map').hasChildNodes()) setTimeout(() => { drawOnceSeen('map'); drawExample(); });
  if (name === 'tracks') drawLines();
  if (name === 'drive') showScene(scene.sweep ? scene.at : Math.max(0, view.part ? DATA.stamps.indexOf(view.part.stamps[view.row]) : 0), true);
}

async function followHash() {
  const hash = location.hash.slice(1);
  if (TABS.includes(hash)) return selectTab(hash);
  const wanted = new URLSearchParams(hash);
  if (wanted.has('scene') && hasScene) {
    scene.at = Math.max(0, DATA.stamps.indexOf(wanted.get('scene')));
    showTab('drive');
    return showScene(scene.at, true);
  }
  if (wanted.has('rule')) {
    clearFilters();
    $('f-rule').value = wanted.get('rule');
    drawList();
    return openTrack((view.shown[0] ?? TRACKS[0]).index);
  }
  if (!wanted.has('track')) return showTab(TRACKS.length || !hasScene ? 'overview' : 'drive');
  const track = TRACKS.find(one => one.id === wanted.get('track'));
  if (!track) {
    showTab('overview');
    return fail(`No track ${wanted.get('track')} in this report.`);
  }
  await openTrack(track.index, wanted.get('stamp'), null, true);
}

// The drive at the box that is shown, in its middle; `act` adds objects there.
async function inDrive(act) {
  if (!hasScene) return say('Objects are added to results of boxreg relabel, which have a recording.');
  if (isCorrecting()) return;
  const box = view.part.usable[view.row];
  showTab('drive');
  await showScene(DATA.stamps.indexOf(view.part.stamps[view.row]), true);
  if (box && scene.sweep) scene.offset = [0, 1].map(k => box[k] + view.part.origin[k] - scene.sweep.sensor[k]);
  $('scene-view').focus({ preventScroll: true });
  act();
}

function selectTab(name) {
  if (name === 'tracks') {
    const index = view.track >= 0 ? view.track : view.shown[0]?.index;
    if (index !== undefined) return openTrack(index);
  }
  history.replaceState(null, '', '#' + name);
  showTab(name);
}

// The buttons in the views: closer, farther, all of it.
function zoomByButton(sign) {
  const isScene = !$('drive').hidden;
  if (!sign) return isScene ? wholeScene() : resetViews();
  const factor = ZOOM_STEP ** (2 * sign);
  return isScene ? zoomScene(factor) : zoomBy(factor);
}

function redrawAll() {
  view.charts = false;
  $('map').replaceChildren();
  if (!$('overview').hidden) { drawMap(); drawOverview(); drawTimeline(); drawExample(); }
  if (view.part && !$('tracks').hidden) { drawViews(); drawCharts(); }
  drawScene();
}

function setUpPerson(who) {
  const named = localStorage.getItem('who') ?? who;
  $('who').value = named;
  setPerson(named || who);
  $('who').onchange = event => {
    localStorage.setItem('who', event.target.value.trim());
    setPerson(event.target.value.trim() || who);
  };
}

async function main() {
  await painted();  // title and figures, before the lists of many tracks are made
  await readResult();
  if (IS_REVIEW) {
    $('tab-drive').hidden = !hasScene;
    setUpScene();
    $('all-drives').hidden = location.pathname === '/';
    $('all-drives').href = '../';
    setUpNumbers();
    setUpFiles();
    $('decide').hidden = $('save-button').hidden = $('files-button').hidden = $('person').hidden = $('accept-below').hidden = false;
    $('save-button').onclick = save;
    $('accept-below').onclick = acceptBelow;
    listen();
  }
  setUpList();
  setUpTimeline();
  setUpKeys();
  for (const name of Object.keys(VIEWS)) {
    setUpPinch($(name), (factor, event) => zoomBy(factor, $(name), event));
    setUpDragging($(name));
  }
  setUpSpace();
  setUpSizes();
  for (const one of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll('[data-zoom]'))) one.onclick = () => zoomByButton(Number(one.dataset.zoom));
  for (const one of TABS) $('tab-' + one).onclick = () => {
    selectTab(one);
    if (one === 'tracks') $('rows').focus({ preventScroll: true });
  };
  $('time').oninput = () => step(Number($('time').value));
  $('mode').onchange = drawViews;
  $('play').onclick = play;
  addEventListener('hashchange', followHash);
  addEventListener('beforeunload', event => { if (view.edit && view.isMoved) event.preventDefault(); });
  addEventListener('resize', () => {
    drawLines();
    if (!$('overview').hidden) drawTimeline();
    drawScene();
  });
  for (const media of ['(prefers-color-scheme: dark)', 'print']) matchMedia(media).addEventListener('change', redrawAll);
  await followHash();
  document.documentElement.dataset.ready = '';
}

addEventListener('unhandledrejection', event => fail(`This page failed: ${event.reason?.message ?? event.reason}`));
main();
