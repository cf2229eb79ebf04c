// Charts over time -------------------------------------------------------------------------------

// From top to bottom: name, unit, height.
/** @type {[string, string, number][]} */
const CHARTS = [['risk', 'm', 1], ['along', 'm', 1], ['across', 'm', 1], ['up', 'm', 1], ['yaw', '°', 1], ['size', 'm', 1.3], ['faces', 'm', 1.5]];
const FACES = ['front', 'rear', 'left', 'right', 'top'];
const SIZES = ['length', 'width', 'height'];
const FACE_MARKS = ['circle', 'square', 'triangle-up', 'triangle-down', 'x'];
const SIZE_COLOURS = ['refined', 'truth', 'human'];
const FACE_COLOURS = ['refined', 'input', 'truth', 'human', 'points'];

// The number of a chart behind the name of an axis: the first one has none.
function chartNumber(name) {
  const at = CHARTS.findIndex(([one]) => one === name);
  return at ? at + 1 : '';
}

// The area between two curves over time, where both are known.
function band(part, axes, name, low, high) {
  const known = part.times.map((_, i) => i).filter(i => isKnown(low[i]) && isKnown(high[i]));
  return { ...axes, x: [...known, ...known.toReversed()].map(i => part.times[i]), y: [...known.map(i => high[i]), ...known.toReversed().map(i => low[i])],
           fill: 'toself', fillcolor: colour(name) + '33', line: { width: 0 }, mode: 'lines', hoverinfo: 'skip' };
}

function chartTraces() {
  const part = view.part;
  const traces = [];
  const degrees = 180 / Math.PI;
  traces.push({ xaxis: 'x', yaxis: 'y' + chartNumber('risk'), name: 'risk', x: part.times, y: part.risk, mode: 'lines+markers', line: { width: 1 }, marker: { size: 4, color: colour('input') } });
  /** @type {[string, string, (status: string) => boolean][]} */
  const kinds = [['refined', 'circle', s => s === 'refined'], ['input', 'x', s => s === 'kept'], ['human', 'diamond', s => s === 'human']];
  ['along', 'across', 'up', 'yaw'].forEach((axis, k) => {
    const scale = k === 3 ? degrees : 1;
    const axes = { xaxis: 'x', yaxis: 'y' + chartNumber(axis) };
    const reach = part.deviations.map(d => d[k] === null ? null : 2 * scale * d[k]);
    traces.push(band(part, axes, 'refined', reach.map(r => r === null ? null : -r), reach));
    for (const [name, shape, is] of kinds) {
      const rows = part.times.map((_, i) => i).filter(i => is(part.status[i]));
      traces.push({ ...axes, name: name === 'input' ? 'kept' : name, x: rows.map(i => part.times[i]), y: rows.map(i => part.change[i][k] === null ? null : scale * part.change[i][k]),
                    mode: name === 'refined' ? 'lines+markers' : 'markers', line: { width: 1 }, marker: { size: 4, symbol: shape, color: colour(name) } });
    }
  });
  SIZES.forEach((name, k) => {
    const axes = { xaxis: 'x', yaxis: 'y' + chartNumber('size') };
    const line = { ...axes, x: part.times, mode: 'lines', name };
    const size = part.boxes.map(box => box[3 + k]), reach = part.extent_deviations.map(d => d[k] === null ? null : 2 * d[k]);
    traces.push(band(part, axes, SIZE_COLOURS[k], size.map((v, i) => reach[i] === null ? null : v - reach[i]), size.map((v, i) => reach[i] === null ? null : v + reach[i])));
    traces.push({ ...line, y: part.given.map(box => box[3 + k]), line: { color: colour('input'), dash: 'dash', width: 1.2 } });
    traces.push({ ...line, y: size, line: { color: colour(SIZE_COLOURS[k]), width: 1.8 } });
  });
  FACES.forEach((face, k) => traces.push({ xaxis: 'x', yaxis: 'y' + chartNumber('faces'), name: face, x: part.times, y: part.faces.map(one => one[k] || null), mode: 'lines+markers',
                                           line: { width: 1, color: colour(FACE_COLOURS[k]) }, marker: { size: 4, symbol: FACE_MARKS[k], color: colour(FACE_COLOURS[k]) } }));
  return traces;
}

async function drawCharts() {
  await withPlotly();
  if (!view.part || view.charts || $('tracks').hidden) return;
  view.charts = true;
  const tinted = (words, names) => words.map((word, k) => `<span style="color: ${colour(names[k])}">${word}</span>`).join(', ');
  const notes = {
    risk: 'expected error of each box; click a point to go there',
    along: 'refined − input, in the axes of the box; band: ± 2σ',
    size: `${tinted(SIZES, SIZE_COLOURS)}; band: ± 2σ; dashed: input`,
    faces: `outermost points off their face: ${tinted(FACES.map((face, k) => face + (innerWidth > 900 ? ` (${FACE_MARKS[k]})` : '')), FACE_COLOURS)}`,
  };
  const layout = { ...LAYOUT(), margin: { l: 56, r: 8, t: 16, b: 34 }, xaxis: { ...AXIS(), title: { text: 'time [s]' }, anchor: 'y' + chartNumber('faces') }, annotations: [] };
  const gap = 0.035;
  const unit = (1 - gap * (CHARTS.length - 1)) / CHARTS.reduce((sum, [, , height]) => sum + height, 0);
  let top = 1;
  for (const [name, unitName, height] of CHARTS) {
    const bottom = Math.max(0, top - unit * height);
    layout['yaxis' + chartNumber(name)] = { ...AXIS(), domain: [bottom, top], title: { text: `${name} [${unitName}]` }, nticks: 6, fixedrange: true, ...(name === 'risk' ? { rangemode: 'tozero' } : {}) };
    if (notes[name]) layout.annotations.push({ text: notes[name], xref: 'paper', yref: 'paper', x: 0, y: top, xanchor: 'left', yanchor: 'bottom', showarrow: false, font: { size: 10, color: colour('grey') } });
    top = bottom - gap;
  }
  await Plotly.react('charts', chartTraces(), layout, CONFIG);
  $('charts').removeAllListeners?.('plotly_click');
  $('charts').on('plotly_click', event => { const row = view.part.times.indexOf(event.points[0].x); if (row >= 0) step(row); });
  $('charts').removeAllListeners?.('plotly_relayout');
  $('charts').on('plotly_relayout', drawCursor);
  drawCursor();
}

function drawCursor() {
  const layout = $('charts')._fullLayout;
  $('cursor').hidden = !layout?.xaxis || !view.charts;
  if ($('cursor').hidden) return;
  const x = layout.xaxis._offset + layout.xaxis.l2p(view.part.times[view.row]);
  $('cursor').style.transform = `translateX(${x}px)`;
  $('cursor').style.height = layout.height - layout.margin.b + 'px';
}
