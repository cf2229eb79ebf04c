'use strict';
// The page of `boxreg relabel --report` and `boxreg review`. Its parts are joined in the order that
// review/report.py lists. Boxes are x y z length width height roll pitch yaw [m, rad];
// R = Rz(yaw) Ry(pitch) Rx(roll).

// An element of the page: those that are asked for are there.
/** @type {(id: string) => any} */
const $ = id => document.getElementById(id);
const NONCE = document.currentScript?.nonce;
const IS_REVIEW = document.documentElement.hasAttribute('data-review');
/** @type {Report} */
let DATA;                          // the report: tracks of the run, largest risk first
/** @type {Track[]} */
let TRACKS = [];                   // tracks as decided: split, joined, renamed
// The line `track` is selected; `open` is the track whose `part` is shown.
/** @type {any} */
const view = { track: -1, open: null, part: null, row: 0, mark: null, sort: 'rank', descending: false, shown: [], place: 0,
               charts: false, edit: null, isMoved: false, playing: 0,
               zoom: 1, center: [0, 0, 0], around: [], solved: null, formats: [], classes: [], changed: new Set() };

const isKnown = value => value !== null && value !== undefined && Number.isFinite(value);
const number = (value, digits = 2) => isKnown(value) ? value.toLocaleString('en', { minimumFractionDigits: digits, maximumFractionDigits: digits }) : '–';
// An id where there is little room: the end of a long one, as of a UUID.
const shortId = id => id.length <= 7 ? id : '…' + id.slice(-6);
const colour = name => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim();

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) made[name] = value;
    else if (value === true) made.setAttribute(name, '');
    else if (value !== false && value !== null) made.setAttribute(name, value);
  }
  made.append(...children.filter(child => child !== null));
  return made;
}

function fill(parent, ...children) { parent.replaceChildren(...children.filter(child => child !== null)); }

// A loop decodes Plotly in a tenth of the time of `Uint8Array.from` with a function.
function bytesOf(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

async function inflate(base64) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).text();
}

// While the page is read, an element may be missing or incomplete: whole is one that another follows.
async function textOf(id) {
  if (!$(id)?.nextSibling && document.readyState === 'loading') {
    await new Promise(done => document.addEventListener('DOMContentLoaded', done, { once: true }));
  }
  return $(id).textContent;
}

// The page as it is now has been painted.
function painted() { return new Promise(done => requestAnimationFrame(() => setTimeout(done))); }

function fail(text) {
  $('failure').textContent = text;
  $('failure').hidden = false;
}

function say(text) { $('notice').textContent = $('notice').title = text; }
