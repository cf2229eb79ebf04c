// Label files: written from the page, listed, and the result that they are part of ------------------

const MEGABYTE = 1e6;

// Write the label files of the run, with all decisions, into a folder beside the first result.
async function save() {
  if (!IS_REVIEW || isCorrecting() || view.isSaving) return;
  view.isSaving = true;
  say('Writing the label files …');
  try {
    const { line, notes, error, written } = await post('save', { formats: view.formats });
    view.written = written;
    await openResult();
    say([line, ...notes].join(' '));
    if (error) fail(error);
  } catch (error) {
    say('');
    fail(`The label files were not written, the earlier ones are as they were: ${error.message}`);
  }
  view.isSaving = false;
}

function drawProgress({ done, total }) {
  if (view.isSaving && total) say(`Writing the label files … ${number(100 * Math.min(1, done / total), 0)} %, ${number(done, 0)} of ${number(total, 0)} s of the drive`);
}

// Another person has written labels: this page goes on in the new result, after a correction.
async function followWritten(count) {
  if (view.isSaving || view.written === count) return;
  view.written = count;
  while (view.edit && view.isMoved) await new Promise(done => setTimeout(done, RETRY));
  await openResult();
  say('The labels were written, with all decisions: this is the new result.');
}

// Take the result that the server has now into this page, and show what changed; decisions of others
// that arrive meanwhile are about it, and wait.
function openResult() {
  const opened = takeResult();
  log.answered = opened.catch(() => {});
  return opened;
}

async function takeResult() {
  const response = await fetch(location.pathname);
  if (!response.ok) throw new Error(await response.text());
  const fresh = new DOMParser().parseFromString(await response.text(), 'text/html');
  for (const id of ['overview', 'run']) $(id).innerHTML = fresh.getElementById(id).innerHTML;
  $('data').textContent = fresh.getElementById('data').textContent;
  document.querySelectorAll('script[id^=part-]').forEach(one => one.remove());
  document.body.append(...[...fresh.querySelectorAll('script[id^=part-]')].map(one => element('script', { type: 'text/plain', id: one.id }, one.textContent)));
  clearTimeout(view.hashTimer);  // of a box that the new result may not have
  cached.clear();
  scene.slim.clear();
  additions.clear();
  Object.assign(view, { track: -1, open: null, part: null, edit: null, isMoved: false, solved: null, mark: null, around: [], cloud: null, accumulated: null });
  forget();
  await readResult();
  setUpList();
  setUpTimeline();
  $('tab-drive').hidden = !hasScene;
  history.replaceState(null, '', '#overview');
  showTab('overview');
}

// The report and the decisions about it.
async function readResult() {
  DATA = JSON.parse(await inflate($('data').textContent));
  if (IS_REVIEW) {
    const found = await (await fetch('decisions')).json();
    if (!log.who) setUpPerson(found.who);
    receive(found);
    // A link that is copied opens the page elsewhere: it has the token.
    history.replaceState(null, '', `?${new URLSearchParams({ token: found.token })}${location.hash}`);
    hasScene = found.has_scene;
    scene.proposals = found.proposals;
    view.classes = found.classes;
    drawChanges(found.changes);
  }
  TRACKS = buildTracks();
  if (hasScene && [...log.held.values()].some(row => row.decision === 'add')) {
    await followAdded();
    TRACKS = buildTracks();
  }
}

// What changed since the result that was decided about.
function drawChanges(changes) {
  $('written').hidden = !changes;
  view.changed = new Set((changes ?? []).map(row => row.id));
  if (!changes) return;
  const words = row => [row.added && `${row.added} added`, row.removed && `${row.removed} removed`, row.changed && `${row.changed} changed, by up to ${number(row.shift)} m`, row.class && `class ${row.class}`].filter(Boolean).join('; ');
  $('written-text').textContent = changes.length ? `The decisions changed boxes of ${changes.length} ${changes.length === 1 ? 'track' : 'tracks'}:` : 'The decisions changed no box.';
  fill($('written-rows'), ...changes.map(row => element('tr', {}, element('td', {}, element('a', { href: hashOf(row.id) }, row.id)), element('td', {}, words(row)))));
}

// The files of the result, to be downloaded, and the formats to write.
async function showFiles() {
  const { folder, files, formats } = await (await fetch('files')).json();
  const link = (name, text) => element('a', { href: 'download?' + new URLSearchParams({ name }), download: '' }, text);
  const folders = new Map();
  for (const { name, size } of files) {
    const [first, ...rest] = name.split('/');
    const known = folders.get(first) ?? { count: 0, size: 0, isFolder: rest.length > 0 };
    folders.set(first, { ...known, count: known.count + 1, size: known.size + size });
  }
  $('files-folder').textContent = folder;
  fill($('files-rows'), ...[...folders].map(([name, { count, size, isFolder }]) => element('tr', {},
    element('td', {}, link(name, isFolder ? `${name}/ (zip)` : name)), element('td', { class: 'n' }, isFolder ? `${count} files` : ''), element('td', { class: 'n' }, `${number(size / MEGABYTE)} MB`))));
  fill($('files-formats'), ...formats.map(({ name, title, is_chosen: isChosen }) => element('label', { title },
    element('input', { type: 'checkbox', value: name, checked: view.formats.length ? view.formats.includes(name) : isChosen }), name)));
  $('files').showModal();
}

function setUpFiles() {
  $('files-button').onclick = showFiles;
  $('files-form').onsubmit = event => {
    view.formats = [...$('files-formats').querySelectorAll('input:checked')].map(input => input.value);
    if (event.submitter?.id === 'files-write') save();
  };
}
