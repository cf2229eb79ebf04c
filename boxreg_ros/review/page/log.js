// The log of decisions ---------------------------------------------------------------------------
// A row is about boxes of the input: a track, one of its boxes, or those between two stamps. Of
// several rows of one topic about the same boxes the last one holds.

const ROUNDING = 1e-6;             // of boxes in the file [m, rad]
const RETRY = 1000;                // of a server that refuses to stream [ms]
const TOPIC_OF = { accept: 'judgement', reject: 'judgement', unsure: 'judgement', pin: 'judgement', none: 'judgement',
                   delete: 'deletion', restore: 'deletion', rename: 'id', reclass: 'class', add: 'addition', withdraw: 'addition', attribute: 'attribute', remove: 'attribute' };
const TAKEN_BACK = { judgement: 'none', deletion: 'restore', id: 'rename', class: 'reclass', addition: 'withdraw', attribute: 'attribute' };
// What was decided at once, and what held before; those of `log.who` are undone and redone one by one.
/** @typedef {{ before: Row[], after: Row[] }} Made */
/** @type {{ count: number, rows: Row[], held: Map<string, Row>, ofInput: Map<string, Row[]>, made: Made[], undone: Made[], who: string, answered?: Promise<any>, stepping: Promise<any> }} */
const log = { count: 0, rows: [], held: new Map(), ofInput: new Map(), made: [], undone: [], who: '', stepping: Promise.resolve() };

const scopeKey = (topic, row) => JSON.stringify([topic, row.track_id, row.stamp_ns, row.end_ns]);
// An attribute is a topic of its own: NAME=VALUE, without a value to take it back; `remove` states NAME.
const topicOf = row => (TOPIC_OF[row.decision] === 'attribute' ? `attribute ${row.value.split('=')[0]}` : TOPIC_OF[row.decision]);
const keyOf = row => scopeKey(topicOf(row), row);
const isTakenBack = row => ['none', 'restore', 'withdraw'].includes(row.decision) || (['rename', 'reclass'].includes(row.decision) && !row.value) || (row.decision === 'attribute' && row.value.endsWith('='));
const rowOf = (scope, decision, more = {}) => ({ ...scope, decision, comment: '', value: '', box: null, ...more });
const takenBack = row => rowOf({ track_id: row.track_id, stamp_ns: row.stamp_ns, end_ns: row.end_ns }, TAKEN_BACK[TOPIC_OF[row.decision]], TOPIC_OF[row.decision] === 'attribute' ? { value: `${row.value.split('=')[0]}=` } : {});

function covers(row, stamp) {
  if (!row.stamp_ns) return true;
  if (!row.end_ns) return row.stamp_ns === stamp;
  return BigInt(row.stamp_ns) <= BigInt(stamp) && BigInt(stamp) <= BigInt(row.end_ns);
}

// The rows of a topic that hold for a box of the input, in their order.
function covering(topic, input, stamp) {
  return (log.ofInput.get(input) ?? []).filter(row => TOPIC_OF[row.decision] === topic && covers(row, stamp));
}

function receive({ first, rows, is_replaced: isReplaced = false }) {
  if (isReplaced) forget();  // the file was; fewer rows than are known may be those of an event that came late
  const fresh = rows.slice(log.count - first);
  if (!fresh.length) return;
  log.count = first + rows.length;
  log.rows.push(...fresh);
  takeOver(fresh);
  return fresh;
}

function forget() {
  log.held.clear();
  log.count = log.rows.length = log.made.length = log.undone.length = 0;
}

// A box that was set after a deletion was taken back: deleted again, it would be gone.
function boxSetSince(row) {
  if (row.decision !== 'delete') return undefined;
  const rows = log.rows.slice(log.rows.findLastIndex(one => keyOf(one) === keyOf(row)) + 1);
  return rows.find(one => one.box && one.track_id === row.track_id && covers(row, one.stamp_ns) && log.held.get(keyOf(one)) === one);
}

// Undo and redo are about the decisions of another person from now on.
function setPerson(who) {
  const rows = [...log.rows];
  forget();
  log.who = who;
  if (rows.length) receive({ first: 0, rows });
}

// Rows that were written at once have the same time; each holds until the next one about its boxes.
function takeOver(rows) {
  for (let first = 0, end = 0; first < rows.length; first = end) {
    while (end < rows.length && rows[end].who === rows[first].who && rows[end].when === rows[first].when) end++;
    const after = rows.slice(first, end);
    if (after[0].who === log.who && after[0].when) noteMade(after.map(row => log.held.get(keyOf(row)) ?? takenBack(row)), after);
    for (const row of after) {
      log.held.delete(keyOf(row));
      if (!isTakenBack(row) || row.comment) log.held.set(keyOf(row), row);
    }
  }
  log.ofInput.clear();
  for (const row of log.held.values()) {
    if (!log.ofInput.has(row.track_id)) log.ofInput.set(row.track_id, []);
    log.ofInput.get(row.track_id).push(row);
  }
}

// Whether rows state the same, whoever wrote them.
const isSameRow = (a, b) => keyOf(a) === keyOf(b) && a.decision === b.decision && a.comment === b.comment && a.value === b.value
  && (a.box === null) === (b.box === null) && (a.box ?? []).every((v, k) => Math.abs(k < 6 ? v - b.box[k] : Math.sin((v - b.box[k]) / 2)) < ROUNDING);
const isSame = (first, second) => first?.length === second.length && first.every((row, k) => isSameRow(row, second[k]));

// The history is that of the file: rows that restore what held before an own decision undo it.
function noteMade(before, after) {
  if (isSame(log.made.at(-1)?.before, after)) return void log.undone.push(log.made.pop());
  if (isSame(log.undone.at(-1)?.after, after)) return void log.made.push(log.undone.pop());
  log.made.push({ before, after });
  log.undone.length = 0;
}

async function post(path, content) {
  const response = await fetch(path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(content) })
    .catch(error => { setLost(true); throw error; });
  if (response.ok || response.status === 409 && response.headers.get('content-type') === 'application/json') return response.json();
  throw new Error(await response.text());
}

// The banner: nothing is saved until the server answers again, which `listen` waits for.
function setLost(isLost) {
  if (!isLost && !$('lost').hidden) say('boxreg review answers again.');
  $('lost').hidden = !isLost;
}

// Write rows to the file, all or none; whether that was done.
async function decide(rows) {
  let found;
  const answered = post('decisions', { seen: log.count, rows: rows.map(row => ({ ...row, who: log.who })) });
  log.answered = answered.catch(() => {});
  try {
    found = await answered;
  } catch (error) {
    fail(`The decision was not saved: ${error.message}. Check that boxreg review still runs, then decide again.`);
    return false;
  }
  $('failure').hidden = true;
  await showDecisions(receive(found));
  if (found.message) fail(found.message);
  return !found.message;
}

// One step back or forth, after the one that is under way.
const undo = () => takeStep(() => log.made.at(-1), 'before', 'after', 'Nothing of yours to undo.', 'Undone');
const redo = () => takeStep(() => log.undone.at(-1), 'after', 'before', 'Nothing of yours to do again.', 'Done again');

function takeStep(next, wanted, now, nothing, word) {
  log.stepping = log.stepping.then(async () => {
    const found = next();
    if (!found) return say(nothing);
    if (isCorrecting()) return;
    const other = found[now].map(row => log.held.get(keyOf(row)) ?? takenBack(row)).find((row, k) => !isSameRow(row, found[now][k]))
      ?? found[wanted].map(boxSetSince).find(Boolean);
    if (other) return fail(`${other.who || 'Another person'} has decided about track ${other.track_id} since (${other.decision}): nothing was changed. Decide about it anew.`);
    if (!await decide(found[wanted])) return;
    const [{ decision, value, track_id: id }] = found.after;
    say(`${word}: ${decision} ${value} of track ${id}. What was written before changes with the next labels (Ctrl-S).`);
    openDecided(found[wanted][0]);
  });
  return log.stepping;
}

function openDecided({ track_id: input, stamp_ns: stamp }) {
  const index = TRACKS.findIndex(track => track.members().some(([s, k]) => inputOf(s, k) === input && (!stamp || stampOf(s, k) === stamp)));
  if (index >= 0) openTrack(index, stamp || null);
}

// Decisions of other tabs and other people, as they are made.
function listen() {
  const source = new EventSource('events?seen=' + log.count);
  source.onopen = () => setLost(false);
  source.onerror = () => {
    setLost(true);
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, RETRY);  // refused: it asks no more
  };
  source.addEventListener('progress', event => drawProgress(JSON.parse(event.data)));
  source.addEventListener('written', event => followWritten(Number(event.data)));
  source.onmessage = async event => {
    await log.answered;  // decisions of this tab are not those of another
    const fresh = receive(JSON.parse(event.data));
    if (!fresh) return;
    const other = fresh.at(-1);
    say(`${other.who || 'Someone'} decided about track ${other.track_id}: ${other.decision} ${other.value}`);
    showDecisions(fresh);
  };
}

// Decisions about ids change the list of tracks.
async function showDecisions(fresh) {
  if (!fresh) return;
  if (fresh.some(row => TOPIC_OF[row.decision] === 'addition')) await followAdded();
  if (fresh.some(row => !['judgement', 'attribute'].includes(TOPIC_OF[row.decision]))) await rebuildTracks();
  drawList();
  if (view.part) step(view.row, true);
  else if (!$('tracks').hidden && view.shown.length) openTrack(view.shown[Math.min(view.place, view.shown.length - 1)].index);
  if (!$('drive').hidden) showScene(scene.at, true);
}
