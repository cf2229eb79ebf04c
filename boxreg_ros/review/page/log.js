// The log of decisions ---------------------------------------------------------------------------
// A row is about boxes of the input: a track, one of its boxes, or those between two stamps. Of
// several rows of one topic about the same boxes the last one holds.

const TOPIC_OF = { accept: 'judgement', reject: 'judgement', unsure: 'judgement', pin: 'judgement', none: 'judgement',
                   delete: 'deletion', restore: 'deletion', rename: 'id', reclass: 'class', add: 'addition', withdraw: 'addition' };
const TAKEN_BACK = { judgement: 'none', deletion: 'restore', id: 'rename', class: 'reclass', addition: 'withdraw' };
/** @type {{ count: number, held: Map<string, Row>, ofInput: Map<string, Row[]>, made: Row[][], who: string, answered?: Promise<any> }} */
const log = { count: 0, held: new Map(), ofInput: new Map(), made: [], who: '' };

const scopeKey = (topic, row) => JSON.stringify([topic, row.track_id, row.stamp_ns, row.end_ns]);
const keyOf = row => scopeKey(TOPIC_OF[row.decision], row);
const isTakenBack = row => ['none', 'restore', 'withdraw'].includes(row.decision) || (['rename', 'reclass'].includes(row.decision) && !row.value);
const rowOf = (scope, decision, more = {}) => ({ ...scope, decision, comment: '', value: '', box: null, ...more });
const takenBack = row => rowOf({ track_id: row.track_id, stamp_ns: row.stamp_ns, end_ns: row.end_ns }, TAKEN_BACK[TOPIC_OF[row.decision]]);

function covers(row, stamp) {
  if (!row.stamp_ns) return true;
  if (!row.end_ns) return row.stamp_ns === stamp;
  return BigInt(row.stamp_ns) <= BigInt(stamp) && BigInt(stamp) <= BigInt(row.end_ns);
}

// The rows of a topic that hold for a box of the input, in their order.
function covering(topic, input, stamp) {
  return (log.ofInput.get(input) ?? []).filter(row => TOPIC_OF[row.decision] === topic && covers(row, stamp));
}

function receive({ first, rows }) {
  if (first === 0 && rows.length < log.count) { log.count = 0; log.held.clear(); }  // the file was replaced
  const fresh = rows.slice(log.count - first);
  if (!fresh.length) return;
  log.count = first + rows.length;
  for (const row of fresh) {
    log.held.delete(keyOf(row));
    if (!isTakenBack(row) || row.comment) log.held.set(keyOf(row), row);
  }
  log.ofInput.clear();
  for (const row of log.held.values()) {
    if (!log.ofInput.has(row.track_id)) log.ofInput.set(row.track_id, []);
    log.ofInput.get(row.track_id).push(row);
  }
  return fresh;
}

async function post(path, content) {
  const response = await fetch(path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(content) });
  if (response.ok || response.status === 409 && response.headers.get('content-type') === 'application/json') return response.json();
  throw new Error(await response.text());
}

// Write rows to the file, all or none, and note them for undo; whether that was done.
async function store(rows, note) {
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
  if (!found.message) note();
  await showDecisions(receive(found));
  if (found.message) fail(found.message);
  return !found.message;
}

async function decide(rows) {
  const before = rows.map(row => log.held.get(keyOf(row)) ?? takenBack(row));
  return store(rows, () => log.made.push(before));
}

async function undo() {
  const before = log.made.at(-1);
  if (!before || isCorrecting() || !await store(before, () => log.made.pop())) return;
  const [{ track_id: input, stamp_ns: stamp }] = before;
  const index = TRACKS.findIndex(track => track.members().some(([s, k]) => inputOf(s, k) === input && (!stamp || stampOf(s, k) === stamp)));
  if (index >= 0) openTrack(index, stamp || null);
}

// Decisions of other tabs and other people, as they are made.
function listen() {
  const source = new EventSource('events?seen=' + log.count);
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
  if (fresh.some(row => TOPIC_OF[row.decision] !== 'judgement')) await rebuildTracks();
  drawList();
  if (view.part) step(view.row, true);
  else if (!$('tracks').hidden && view.shown.length) openTrack(view.shown[Math.min(view.place, view.shown.length - 1)].index);
  if (!$('drive').hidden) showScene(scene.at, true);
}
