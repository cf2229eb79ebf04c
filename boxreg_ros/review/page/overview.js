// Overview ---------------------------------------------------------------------------------------

const MEANINGS = [                  // of words in the reasons of a risk
  ['uncertain', 'expected error by the standard deviations of the estimate'],
  ['off their points', 'the outermost points of these faces are not where the estimate expects them'],
  ['points left outside', 'more of the points near the box are outside of it than in other tracks'],
  ['estimates disagree', 'the early and the final estimate overlap less than their deviations explain'],
  ['size unlike its class', 'extents more than two deviations off the median of the class'],
  ['id switch', 'the track jumps by more than half an extent: it may go on with another object'],
  ['kept as in the input', 'the input box was returned unchanged'],
  ['few points', 'median of the points per box'],
];
const FIRST = 12;                  // tracks to open first
const MIN_SHARP_POINTS = 30;        // of a box whose track is shown as an example

function drawOverview() {
  const [before, after] = DATA.total;
  /** @type {[string, string, number, number, string][]} */
  const rows = [
    ['heading flips between two boxes', 'flips', 0, 1, ''],
    ['jitter of the centre', 'jitter', 3, 1, ' m'],
    ['jitter of the yaw', 'yaw_jitter', 2, 180 / Math.PI, '°'],
    ['spread of the size of a track', 'size_spread', 3, 1, ' m'],
    [`cells of ${DATA.cell} m filled by the points of all sweeps`, 'cells', 0, 1, ''],
    .../** @type {[string, string, number, number, string][]} */ (DATA.has_truth ? [['3D IoU with the true boxes', 'iou', 3, 1, '']] : []),
  ];
  if ($('quality')) fill($('quality'), element('tr', {}, element('td'), ...['input', 'refined', 'change'].map(t => element('th', { class: 'n', scope: 'col' }, t))),
    ...rows.map(([title, name, digits, scale, unit]) => {
      const [a, b] = [before[name], after[name]];
      const part = a && isKnown(a) && isKnown(b) ? 100 * (b / a - 1) : null;
      const isBetter = (name === 'iou') === (part > 0);
      return element('tr', {}, element('td', {}, title), ...[a, b].map(v => element('td', { class: 'n' }, isKnown(v) ? number(scale * v, digits) + unit : '–')),
        element('td', { class: 'n ' + (part ? (isBetter ? 'better' : 'worse') : '') }, part === null ? '' : (part > 0 ? '+' : '') + number(part, 0) + ' %'));
    }));
  const first = TRACKS.slice(0, FIRST);
  fill($('first'), element('tr', {}, ...['', 'track', 'class', 'risk', 'why'].map(t => (t ? element('th', { scope: 'col' }, t) : element('td')))),
    ...first.map((track, k) => element('tr', { class: 'link', onclick: () => openTrack(track.index, track.riskiest) },
      element('td', {}, element('canvas', { id: `thumbnail-${k}`, role: 'img', 'aria-label': `Track ${track.id} from above` })),
      element('td', { class: 'name' }, element('a', { href: hashOf(track.id, track.riskiest) }, track.id || 'no id')), element('td', { class: 'name' }, track.class),
      element('td', { class: 'n' }, `${number(track.risk)} m`), element('td', {}, ...reasonsOf(track)))));
  drawThumbnails(first);
}

// The reasons of a risk, each with its meaning as a tooltip.
function reasonsOf(track) {
  return partsOf(track.why).flatMap((part, k) => {
    const meaning = MEANINGS.find(([word]) => part.includes(word))?.[1];
    return [k ? '; ' : '', element('span', { title: meaning ?? null }, part)];
  });
}

// The track whose points of all sweeps became sharpest, in the input boxes and in the refined ones.
async function drawExample() {
  const found = TRACKS.filter(t => t.isWhole && t.sharper < 0 && t.points >= MIN_SHARP_POINTS && t.boxes >= 5).sort((a, b) => a.sharper - b.sharper)[0];
  $('example').hidden = !found;
  if (!found) return;
  const part = await loadTrack(found);
  $('example-text').textContent = `Track ${found.id} (${found.class}): all its points, in the boxes of the input and in the refined ones. Sharp edges show that the boxes follow the object. They fill ${number(-found.sharper, 0)} % fewer cells.`;
  $('example').onclick = () => openTrack(found.index);
  $('example').onkeydown = event => { if (event.key === 'Enter') openTrack(found.index); };
  drawPortrait($('example-before'), part, 'before');
  drawPortrait($('example-after'), part, 'after');
}

// A box of a track from above, with the points of all sweeps: what the views show is put aside.
function drawPortrait(canvas, part, mode) {
  const saved = [view.local, view.lines, view.limits, view.frame, view.zoom, view.center, view.far];
  const row = part.num_points.indexOf(Math.max(...part.num_points)), frame = frameBox(part, row, mode) ?? part.usable[row];
  if (!frame) return;
  [view.local, view.limits, view.frame, view.zoom, view.center, view.far] = [localPoints(part, row, mode), limitsOf(part), frame, 1, [0, 0, 0], []];
  view.lines = [{ name: mode === 'before' ? 'input' : 'refined', dash: [], corners: corners(frame).map(c => toFrame(c, frame, rotation(frame))) }];
  drawFlat(canvas, ...VIEWS.top);
  [view.local, view.lines, view.limits, view.frame, view.zoom, view.center, view.far] = saved;
}

// The tracks of the list, one after the other: the page stays quick.
async function drawThumbnails(shown) {
  for (const [index, track] of shown.entries()) {
    await painted();
    const canvas = $('thumbnail-' + index);
    if (!canvas || $('overview').hidden) return;
    drawPortrait(canvas, await loadTrack(track), 'after');
  }
}

const LAYOUT = () => ({
  paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)', showlegend: false, hovermode: 'closest', dragmode: 'pan',
  font: { color: colour('text'), size: 11, family: 'system-ui, sans-serif' }, margin: { l: 56, r: 8, t: 8, b: 34 },
});
const AXIS = () => ({ gridcolor: colour('line'), zerolinecolor: colour('line'), linecolor: colour('line') });
const CONFIG = { displaylogo: false, responsive: true, scrollZoom: true, displayModeBar: false };
let plotly;

function withPlotly() {
  plotly ??= (async () => {
    await painted();  // the script takes a while to start
    document.head.append(element('script', { nonce: NONCE }, await inflate(await textOf('plotly'))));
    $('plotly').remove();
  })();
  return plotly;
}

// Plotly takes a second: it draws what is scrolled into view.
const onceSeen = new IntersectionObserver(entries => {
  for (const { isIntersecting, target } of entries) if (isIntersecting) (target.id === 'map' ? drawMap : drawCharts)();
});

function drawOnceSeen(id) {
  onceSeen.unobserve($(id));  // what is in view already is reported again
  onceSeen.observe($(id));
}

// A browser does not wait for what is drawn while it prints.
async function printPage() {
  await ($('overview').hidden ? drawCharts() : drawMap());
  print();
}

async function drawMap() {
  await withPlotly();
  if ($('map').hasChildNodes()) return;
  const lines = { x: [], y: [], customdata: [], text: [] };
  const shownAs = new Map(TRACKS.flatMap(({ pieces, index }) => pieces.map(({ s }) => [DATA.tracks[s], index])));
  for (const track of DATA.tracks) {
    for (const [k, [x, y]] of track.path.entries()) {
      lines.x.push(x); lines.y.push(y); lines.customdata.push([shownAs.get(track), track.rows[k]]); lines.text.push(escaped(`${track.id} ${track.class}`));
    }
    lines.x.push(null); lines.y.push(null); lines.customdata.push([0, 0]); lines.text.push('');
  }
  const names = DATA.tracks.filter(t => t.path.length);
  const risky = names.filter(t => isKnown(t.risk));
  const middle = track => track.path[track.path.length >> 1];
  const mark = track => [shownAs.get(track), track.rows[track.rows.length >> 1]];
  await Plotly.newPlot('map', [
    { x: DATA.sensor.map(p => p[0]), y: DATA.sensor.map(p => p[1]), mode: 'lines', line: { color: colour('grey'), dash: 'dot', width: 1.5 }, hoverinfo: 'skip' },
    { ...lines, mode: 'lines+markers', line: { color: colour('refined'), width: 1.5 }, marker: { size: 4, color: colour('refined') }, hovertemplate: '%{text}<extra></extra>' },
    { x: risky.map(t => middle(t)[0]), y: risky.map(t => middle(t)[1]), customdata: risky.map(mark), text: risky.map(t => escaped(`${t.id} ${t.class}: ${number(t.risk)} m`)),
      mode: 'markers', hovertemplate: '%{text}<extra></extra>', marker: { size: risky.map(t => Math.min(30, 6 + 30 * t.risk)), color: colour('input'), opacity: 0.45 } },
    { x: names.map(t => middle(t)[0]), y: names.map(t => middle(t)[1]), customdata: names.map(mark), text: names.map(t => escaped(shortId(t.id))), mode: names.length <= 60 ? 'text' : 'none', textposition: 'top center', textfont: { size: 10, color: colour('grey') }, hoverinfo: 'skip' },
  ], { ...LAYOUT(), xaxis: { ...AXIS(), title: { text: 'x [m]' } }, yaxis: { ...AXIS(), title: { text: 'y [m]' }, scaleanchor: 'x' } }, CONFIG);
  $('map').on('plotly_click', event => {
    const [index, row] = event.points[0].customdata;
    openTrack(index, null, TRACKS[index].isWhole ? row : null);
  });
}

// Plotly reads some tags in texts.
const escaped = text => text.replace(/[&<>]/g, c => ({ '&': '&amp;', '<': '&lt;', '>': '&gt;' })[c]);
