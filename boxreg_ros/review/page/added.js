// Objects that a person has added ----------------------------------------------------------------
// Each is a track like those of the report, followed by the server from its boxes: the rows `add`.

const END_REASONS = {
  end_of_sweeps: 'end of the recording', few_points: 'too few points', no_fit: 'the points do not fit',
  uncertain: 'its place is uncertain', jump: 'it would jump',
};
const additions = new Map();       // by id: the key of its boxes, its number s in DATA.tracks, its ends, problems

const seedsOf = id => (log.ofInput.get(id) ?? []).filter(row => row.decision === 'add');
const isAdded = (s, k) => DATA.tracks[s].added && log.ofInput.has(inputOf(s, k)) && seedsOf(inputOf(s, k)).length > 0;
const reasonOfEnd = end => END_REASONS[end.reason] ?? end.reason;

// Follow the objects whose boxes are new, and leave out those that were taken back.
async function followAdded() {
  const ids = new Set([...log.held.values()].filter(row => row.decision === 'add').map(row => row.track_id));
  for (const [id, { s }] of additions) {
    if (ids.has(id)) continue;
    DATA.tracks[s].withdrawn = true;
    additions.delete(id);
  }
  for (const id of ids) await followOne(id);
}

const askToFollow = (id, name, seeds, grows = false) => post('follow', { id, class: name, grows, begin_ns: DATA.begin_ns, seeds: seeds.map(row => ({ stamp: row.stamp_ns, box: row.box })) });

async function followOne(id) {
  const seeds = seedsOf(id), key = JSON.stringify(seeds.map(row => [row.stamp_ns, row.box, row.value]));
  if (additions.get(id)?.key === key) return;
  let s = additions.get(id)?.s ?? DATA.tracks.findIndex(track => track.added && track.inputs.includes(id));
  if (s >= 0 && !additions.has(id) && hasSeeds(s, seeds)) {  // the run has followed it already
    additions.set(id, { key, s, ends: [], problems: [] });
    DATA.tracks[s].withdrawn = false;
    return;
  }
  say(`Following ${id} …`);
  let found;
  try {
    found = await askToFollow(id, seeds[0].value, seeds);
  } catch (error) {
    say('');
    return fail(`The object ${id} was not followed: ${error.message}`);
  }
  const { row, part, ends, problems } = found;
  if (s < 0) s = DATA.tracks.length;
  DATA.tracks[s] = { ...row, id, inputs: [id], owners: null, added: true, rules: [], part: decoded(part), at: placed(part.stamps) };
  DATA.tracks[s].begin = DATA.times[DATA.tracks[s].at[0]];
  additions.set(id, { key, s, ends, problems });
  say(`${id}: ${part.stamps.length} boxes. ${endsText(id)} ${problems.join(' ')}`);
}

// Whether a track of the report has just these boxes of a person.
function hasSeeds(s, seeds) {
  const { states } = DATA.tracks[s], human = String.fromCharCode(97 + DATA.states.indexOf('human'));
  const known = DATA.tracks[s].at.filter((_, k) => states[k] === human).map(at => DATA.stamps[at]);
  return known.length === seeds.length && seeds.every(row => known.includes(row.stamp_ns));
}

// Where an object was lost, and why.
function endsText(id) {
  const ends = additions.get(id)?.ends ?? [];
  if (ends.length < 2) return '';
  const at = end => `${number(secondsOf(end.stamp), 1)} s (${reasonOfEnd(end)})`;
  return `Followed from ${at(ends[0])} to ${at(ends[1])}.`;
}

const secondsOf = stamp => Number(BigInt(stamp) - BigInt(DATA.begin_ns)) * 1e-9;

// The numbers of stamps among those of the drive, which may be new.
function placed(stamps) {
  const known = new Set(DATA.stamps), fresh = stamps.filter(stamp => !known.has(stamp));
  if (fresh.length) {
    const before = DATA.stamps;
    DATA.stamps = [...before, ...fresh].sort((a, b) => (BigInt(a) < BigInt(b) ? -1 : 1));
    DATA.times = DATA.stamps.map(secondsOf);
    const numbers = new Map(DATA.stamps.map((stamp, at) => [stamp, at]));
    for (const track of DATA.tracks) track.at = track.at.map(at => numbers.get(before[at]));
  }
  const numbers = new Map(DATA.stamps.map((stamp, at) => [stamp, at]));
  return stamps.map(stamp => numbers.get(stamp));
}

// An id that no track has: the next number.
function nextId() {
  const ids = [...TRACKS.map(track => track.id), ...DATA.tracks.filter(track => !track.withdrawn).flatMap(track => track.inputs), ...log.ofInput.keys()];
  return String(1 + Math.max(0, ...ids.filter(id => /^\d{1,9}$/.test(id)).map(Number)));
}

// A box that was fitted to the points of one sweep, as large as those of all show it: it is decided about as such.
async function grownBox(id, stamp, box, name) {
  try {
    const { part } = await askToFollow(id, name, [{ stamp_ns: stamp, box }], true), row = part.stamps.indexOf(stamp);
    return row < 0 ? box : moved(part.boxes[row], part.origin, 1);
  } catch { return box; }  // the page says it with the decision
}

// Add an object with a box at a stamp, and open its track; what a person has drawn stays as it is.
async function addObject(stamp, box, name, isByHand = true) {
  const id = nextId();
  if (!isByHand) box = await grownBox(id, stamp, box, name);
  const isDone = await decide([rowOf({ track_id: id, stamp_ns: stamp, end_ns: '' }, 'add', { box, value: name })]);
  const index = TRACKS.findIndex(track => track.id === id);
  if (!isDone || index < 0) return false;
  await openTrack(index, stamp);
  return true;
}
