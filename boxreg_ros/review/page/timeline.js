// The timeline of the drive: a bar for each track ------------------------------------------------

const BAR = { least: 3, most: 14, gap: 1, height: 220 };
const MARGIN = { left: 44, right: 12, bottom: 20 };
const ADDED = ['interpolated', 'extended', 'coasted'];
// A part of a bar by status: kept boxes are pale, added ones thin, rejected ones only outlined.
const FORMS = { kept: [0.35, 1], rejected: [0.12, 1], interpolated: [1, 0.4], extended: [1, 0.4], coasted: [1, 0.4] };

function timelineBars() {
  const shown = TRACKS.filter(track => track.members().length).sort((a, b) => a.begin - b.begin || a.rank - b.rank);
  const height = Math.max(BAR.least, Math.min(BAR.most, Math.floor(BAR.height / Math.max(1, shown.length)) - BAR.gap));
  return { shown, height, step: height + BAR.gap };
}

// The colour of a risk: that of refined boxes, towards that of the input at half a metre and more.
const riskColour = risk => `color-mix(in srgb, ${colour('input')} ${Math.round(100 * Math.min(1, (risk ?? 0) / 0.5))}%, ${colour('refined')})`;

function drawTimeline() {
  const canvas = $('timeline'), { shown, height, step: pitch } = timelineBars();
  const wanted = Math.max(40, shown.length * pitch) + MARGIN.bottom;
  canvas.style.height = wanted + 'px';
  const width = canvas.clientWidth, scale = devicePixelRatio;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(wanted * scale);
  const context = canvas.getContext('2d');
  context.setTransform(scale, 0, 0, scale, 0, 0);
  const end = Math.max(1e-3, DATA.times.at(-1) ?? 1);
  const x = seconds => MARGIN.left + seconds / end * (width - MARGIN.left - MARGIN.right);
  context.font = '10px system-ui, sans-serif';
  shown.forEach((track, line) => {
    context.fillStyle = riskColour(track.risk);
    for (const [from, to, status] of runsOf(track)) {
      const [alpha, part] = FORMS[status] ?? [1, 1];
      context.globalAlpha = alpha;
      context.fillRect(x(from), line * pitch + height * (1 - part) / 2, Math.max(1.5, x(to) - x(from)), height * part);
    }
    context.globalAlpha = 1;
    if (height < 9) return;
    context.fillStyle = colour('grey');
    context.fillText(shortId(track.id), 2, line * pitch + height - 2, MARGIN.left - 4);
  });
  context.fillStyle = colour('grey');
  const tick = [0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600].find(one => end / one < 12) ?? 1200;
  for (let second = 0; second <= end; second += tick) context.fillText(`${second} s`, x(second), wanted - 5);
  canvas.seconds = clientX => (clientX - canvas.getBoundingClientRect().left - MARGIN.left) / (width - MARGIN.left - MARGIN.right) * end;
}

// Parts of a track of one status, as begin, end [s] and status.
function runsOf(track) {
  const runs = [];
  for (const [s, k] of track.members()) {
    const source = DATA.tracks[s], time = DATA.times[source.at[k]];
    const status = isDeleted(s, k) ? 'rejected' : DATA.states[source.states.charCodeAt(k) - 97];
    const last = runs.at(-1);
    if (last && last[2] === status) last[1] = time;
    else runs.push([last ? last[1] : time, time, status]);
  }
  return runs;
}

function setUpTimeline() {
  const canvas = $('timeline');
  const hit = event => {
    const { shown, step: pitch } = timelineBars();
    return shown[Math.floor((event.clientY - canvas.getBoundingClientRect().top) / pitch)];
  };
  canvas.onmousemove = event => {
    const track = hit(event);
    canvas.title = track ? `${track.id} ${track.class}: risk ${number(track.risk)} m, ${number(track.begin, 1)} to ${number(track.begin + track.seconds, 1)} s` : '';
  };
  canvas.onclick = event => {
    const track = hit(event), wanted = canvas.seconds(event.clientX);
    if (!track) return;
    const away = ([s, k]) => Math.abs(DATA.times[DATA.tracks[s].at[k]] - wanted);
    const boxes = track.members();
    openTrack(track.index, null, boxes.reduce((best, box, row) => (away(box) < away(boxes[best]) ? row : best), 0));
  };
}
