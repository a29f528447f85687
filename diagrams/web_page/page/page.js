'use strict';
// A diagram that runs in a page: its module, its record, and what is on the page. Nothing is loaded from anywhere.

const LONGEST = 0.25;   // s of the clock that are caught up after a delay; a longer one is given up
const BUDGET = 0.012;   // s of a frame that may be spent in ticks
const KEPT = 48e6;      // bytes of the record; then its oldest part is dropped
const CHUNK = 1024;     // ticks of a call, at most

const data = JSON.parse(document.getElementById('lw-data').textContent);
const $ = name => document.getElementById(name);

// ---- the module: the diagram and its plants ----

class Model {
  constructor(bytes) {
    const math = {};
    for (const name of Object.getOwnPropertyNames(Math)) if (typeof Math[name] === 'function') math[name] = Math[name];
    this.calls = new WebAssembly.Instance(new WebAssembly.Module(bytes), { math }).exports;
    this.width = data.columns.length + 1;
    this.changed = new Map();
    this.reset();
  }
  reset() {
    this.calls.fill();
    const p = this.numbers(this.calls.parameters());
    for (const [place, value] of this.changed) p[place] = value;
    this.calls.renew();
    this.calls.begin();
  }
  get failed() { return this.calls.failed() !== 0; }
  numbers(address, count) { return new Float64Array(this.calls.memory.buffer, address, count); }
  set(place, value) {
    this.changed.set(place, value);
    this.numbers(this.calls.parameters())[place] = value;
    this.isNew = true;
  }
  run(count, until, record) {  // returns the number of ticks that were gone through, up to a time
    if (this.isNew) { this.calls.renew(); this.isNew = false; }
    let done = 0;
    for (let n = 1; n > 0 && done < count && !this.failed;) {
      n = this.calls.run(Math.min(CHUNK, count - done), until);
      record.add(this.numbers(this.calls.samples(), n * this.width), n);
      done += n;
    }
    return done;
  }
  reason(t) {
    const plant = this.calls.plant();
    const when = `at t = ${short(t)} s`;
    if (plant >= 0) return `${data.plants[plant]} can't continue ${when}: a value of it is not finite, or out of its range.`;
    const log = this.numbers(this.calls.signals());
    for (const [block, port, first, count] of data.labels)
      for (let i = first; i < first + count; i++)
        if (!Number.isFinite(log[i])) return `${block}.${port} is not finite ${when}.`;
    return `a condition of a block fails ${when}, such as the domain of a path's coordinates.`;
  }
}

// ---- the record: rows of samples ----

class Recording {
  constructor(width) { this.width = width; this.most = Math.floor(KEPT / 8 / width); this.clear(); }
  clear() { this.rows = new Float64Array(4096 * this.width); this.count = 0; this.dropped = 0; }
  add(values, n) {
    if (!n) return;
    if ((this.count + n) * this.width > this.rows.length) {
      if (this.count + n > this.most) {
        const gone = Math.max(n, this.most >> 2);
        this.rows.copyWithin(0, gone * this.width, this.count * this.width);
        this.count -= gone; this.dropped += gone;
      }
      if ((this.count + n) * this.width > this.rows.length) {
        const larger = new Float64Array(Math.max(2 * this.rows.length, (this.count + n) * this.width));
        larger.set(this.rows);
        this.rows = larger;
      }
    }
    this.rows.set(values, this.count * this.width);
    this.count += n;
  }
  time(i) { return this.rows[i * this.width]; }
  value(i, column) { return this.rows[i * this.width + 1 + column]; }
  from(t) {  // the first sample at a time or later
    let low = 0, high = this.count;
    while (low < high) { const middle = (low + high) >> 1; if (this.time(middle) < t) low = middle + 1; else high = middle; }
    return low;
  }
  csv() {
    const quoted = name => /[",\n]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name;
    const lines = [['t', ...data.columns.map(c => c.name)].map(quoted).join(',')];
    for (let i = 0; i < this.count; i++)
      lines.push(Array.from(this.rows.subarray(i * this.width, (i + 1) * this.width)).join(','));
    return lines.join('\n') + '\n';
  }
}

// ---- numbers and colours ----

function short(value, digits = 4) {
  if (!Number.isFinite(value)) return '–';
  const text = Math.abs(value) >= 1e5 || (value && Math.abs(value) < 1e-3) ? value.toExponential(digits - 2) : String(Number(value.toPrecision(digits)));
  return text.replace('-', '−');
}
const shown = value => Math.abs(value) < 1e-12 ? 0 : value;
let colours = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['ink', 'soft', 'line', 'grid', 'page', 'band', 'accent', 'robot', 'robot-edge', 'warn', ...Array.from({ length: 8 }, (_, i) => `c${i}`)])
    colours[name] = style.getPropertyValue(`--${name}`).trim();
}
const curveColour = i => colours[`c${i % 8}`];

function fit(canvas) {  // the drawing context in CSS pixels
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const ctx = canvas.getContext('2d');
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  return [ctx, box.width, box.height];
}

// ---- plots ----

class Plot {
  constructor(of) {
    this.of = of;
    const box = document.createElement('figure');
    box.className = 'plot';
    const legend = document.createElement('figcaption');
    legend.className = 'legend';
    this.outputs = of.curves.map((curve, i) => {
      const key = document.createElement('span'), mark = document.createElement('i'), value = document.createElement('output');
      key.className = 'key';
      mark.style.background = `var(--c${i % 8})`;
      key.append(mark, `${data.columns[curve].label} `, value);
      key.title = data.columns[curve].name;
      legend.append(key);
      return value;
    });
    if (of.unit) legend.append(Object.assign(document.createElement('span'), { className: 'unit', textContent: `[${of.unit}]` }));
    this.canvas = document.createElement('canvas');
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', of.curves.map(c => data.columns[c].label).join(', '));
    this.canvas.onpointermove = event => { cursor = event.offsetX; this.at = this.timeAt(event.offsetX); redraw(); };
    this.canvas.onpointerleave = () => { cursor = null; redraw(); };
    box.append(legend, this.canvas);
    $('plots').append(box);
    this.low = this.high = null;
  }
  timeAt(x) { return this.t0 + (x - this.left) / (this.w - this.left) * (this.t1 - this.t0); }
  draw(record, t, span) {
    const [ctx, w, h] = fit(this.canvas), left = 54, bottom = h - 18, top = 6;
    Object.assign(this, { left, w });
    const t1 = Math.max(t, span), t0 = t1 - span;
    this.t0 = t0; this.t1 = t1;
    const first = record.from(t0), n = record.count, curves = this.of.curves, bins = Math.max(1, Math.floor(w - left));
    let low = Infinity, high = -Infinity;
    const step = Math.max(1, Math.floor((n - first) / (8 * bins)));  // eight samples of a pixel at most
    for (const curve of curves)
      for (let i = first; i < n; i += step) { const v = record.value(i, curve); if (v < low) low = v; if (v > high) high = v; }
    if (!(low <= high)) { low = 0; high = 1; }
    const least = Math.max(Math.abs(low), Math.abs(high)) * 1e-6 || 1e-9;
    const flat = high - low < least;
    if (flat) { const middle = (low + high) / 2; low = middle - Math.max(least, 0.5 * Math.abs(middle) || 0.5); high = middle + Math.max(least, 0.5 * Math.abs(middle) || 0.5); }
    // the scale grows at once, and shrinks slowly; that of a constant is not kept
    if (this.flat || flat) this.low = this.high = null;
    this.flat = flat;
    this.low = this.low === null || low < this.low ? low : this.low + (low - this.low) * 0.05;
    this.high = this.high === null || high > this.high ? high : this.high + (high - this.high) * 0.05;
    const pad = 0.06 * (this.high - this.low), y0 = this.low - pad, y1 = this.high + pad;
    const x = time => left + (time - t0) / span * (w - left), y = v => bottom - (v - y0) / (y1 - y0) * (bottom - top);
    ctx.clearRect(0, 0, w, h);
    ctx.font = '11px system-ui, sans-serif';
    ctx.lineWidth = 1;
    ctx.textAlign = 'right'; ctx.textBaseline = 'middle';
    for (const v of ticks(y0, y1, Math.max(2, Math.floor((bottom - top) / 34)))) {
      const at = Math.round(y(v)) + 0.5;
      ctx.strokeStyle = colours.grid; ctx.beginPath(); ctx.moveTo(left, at); ctx.lineTo(w, at); ctx.stroke();
      ctx.fillStyle = colours.soft; ctx.fillText(short(shown(v)), left - 6, at);
    }
    ctx.textAlign = 'center'; ctx.textBaseline = 'alphabetic';
    for (const v of ticks(t0, t1, Math.max(2, Math.floor(w / 110)))) {
      const at = Math.round(x(v)) + 0.5;
      if (at < left) continue;
      ctx.strokeStyle = colours.grid; ctx.beginPath(); ctx.moveTo(at, top); ctx.lineTo(at, bottom); ctx.stroke();
      ctx.fillStyle = colours.soft; ctx.fillText(`${short(shown(v))} s`, Math.min(at, w - 14), h - 4);
    }
    ctx.save();
    ctx.beginPath(); ctx.rect(left, 0, w - left, bottom + 1); ctx.clip();
    ctx.lineJoin = 'round';
    curves.forEach((curve, k) => {
      ctx.strokeStyle = curveColour(k); ctx.lineWidth = 1.6; ctx.beginPath();
      if ((n - first) / bins <= 3) {
        for (let i = Math.max(0, first - 1); i < n; i++) ctx.lineTo(x(record.time(i)), y(record.value(i, curve)));
      } else {  // the smallest and the largest value of each pixel
        let i = first, pixel = Math.floor(x(record.time(first)));
        while (i < n) {
          let least = Infinity, most = -Infinity, last = 0;
          for (; i < n && x(record.time(i)) < pixel + 1; i++) { last = record.value(i, curve); if (last < least) least = last; if (last > most) most = last; }
          if (least <= most) { ctx.lineTo(pixel + 0.5, y(least)); ctx.lineTo(pixel + 0.5, y(most)); ctx.lineTo(pixel + 0.5, y(last)); }
          pixel++;
        }
      }
      ctx.stroke();
    });
    ctx.restore();
    let row = n - 1;
    if (cursor !== null && n) {
      const at = Math.max(left, Math.min(w, cursor));
      row = Math.max(0, Math.min(n - 1, record.from(this.timeAt(at))));
      ctx.strokeStyle = colours.soft; ctx.beginPath(); ctx.moveTo(at + 0.5, top); ctx.lineTo(at + 0.5, bottom); ctx.stroke();
    }
    curves.forEach((curve, k) => { this.outputs[k].textContent = n ? short(record.value(row, curve)) : ''; });
  }
}

function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const sizes = [0.2, 0.5, 1, 2, 5, 10].map(m => m * power), multiples = size => Math.floor(high / size) - Math.ceil(low / size) + 1;
  let i = sizes.findIndex(size => size >= rough);
  while (i > 0 && multiples(sizes[i]) < 2) i--;  // an axis has two numbers at least
  const size = sizes[i], found = [];
  for (let k = Math.ceil(low / size); k * size <= high; k++) found.push(k * size);
  return found;
}

// ---- sliders ----

class Slider {
  constructor(of, box) {
    this.of = of; this.value = of.value;
    const row = this.row = document.createElement('div'), id = `s${Slider.count = (Slider.count ?? 0) + 1}`;
    row.className = 'slider';
    const label = Object.assign(document.createElement('label'), { textContent: of.label, htmlFor: id, title: of.name });
    this.number = Object.assign(document.createElement('input'), { type: 'number', step: 'any', inputMode: 'decimal' });
    this.number.setAttribute('aria-label', `${of.label}, value`);
    const unit = Object.assign(document.createElement('span'), { className: 'unit', textContent: of.unit });
    this.range = Object.assign(document.createElement('input'), { type: 'range', id, min: 0, max: 1, step: 0.001 });
    this.range.oninput = () => this.set(this.rounded(this.unscaled(Number(this.range.value))), true);
    this.range.ondblclick = () => this.set(of.value);
    label.ondblclick = () => this.set(of.value);
    this.number.onchange = () => { const v = Number(this.number.value); if (this.number.value !== '' && Number.isFinite(v)) this.set(Math.min(of.high, Math.max(of.low, v))); else this.show(); };
    row.append(label, this.number, unit, this.range);
    box.append(row);
    this.show();
  }
  scaled(v) { const { low, high, log } = this.of; return log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low); }
  unscaled(s) { const { low, high, log } = this.of; return log ? low * (high / low) ** s : low + s * (high - low); }
  rounded(v) { return Math.min(this.of.high, Math.max(this.of.low, Number(v.toPrecision(3)))) || 0; }
  show(byHand) {
    if (!byHand) this.range.value = this.scaled(this.value);
    this.number.value = Number(this.value.toPrecision(6));
    this.row.classList.toggle('moved', this.value !== this.of.value);
  }
  set(value, byHand) {
    this.value = value;
    model.set(this.of.place, value);
    this.show(byHand);
    redraw();
  }
}

// ---- running at the pace of the clock ----

const model = new Model(Uint8Array.from(atob($('lw-module').textContent.trim()), c => c.charCodeAt(0)));
const record = new Recording(model.width);
let cursor = null, running = false, speed = data.speed, span = data.span, ticksDone = 0, origin = 0, base = 0, drawn = false, behind = 0, scene = null;
const sliders = new Map(), plots = data.plots.map(of => new Plot(of));

for (const group of data.groups) {
  const box = document.createElement('section');
  box.className = 'group';
  if (group.title) box.append(Object.assign(document.createElement('h2'), { textContent: group.title }));
  for (const of of group.sliders) sliders.set(of.name, new Slider(of, box));
  $('sliders').append(box);
}

function say(text) { $('note').textContent = text; $('note').hidden = !text; }
function time() { return record.count ? record.time(record.count - 1) : 0; }

function advance(count, until = Infinity) {  // so many ticks, up to a time, at once
  const done = model.run(count, until, record);
  ticksDone += done;
  if (model.failed) {
    pause();
    say(`It has ended: ${model.reason(time())} Change what led there, and reset.`);
  }
  redraw();
  return done;
}
function frame(now) {
  if (running) {
    now /= 1000;
    const until = base + (now - origin) * speed, started = performance.now() / 1000;
    let done = 64, spent = 0;
    while (done === 64 && running && spent < BUDGET) {
      done = advance(64, until);
      spent = performance.now() / 1000 - started;
    }
    const late = done === 64 ? (until - time()) / speed : 0;
    if (late > LONGEST) {
      behind += late;
      if (spent >= BUDGET)
        say(`${short(behind, 2)} s behind the clock: this machine is too slow for ${short(speed)} times real time. Choose a lower speed.`);
      start(now);
    }
    drawn = false;
  }
  if (!drawn) draw();
  requestAnimationFrame(frame);
}
function start(now = performance.now() / 1000) { origin = now; base = time(); }
function play() {
  if (model.failed) return;
  running = true; start();
  $('play').textContent = 'Pause';
}
function pause() { running = false; $('play').textContent = 'Run'; }
function reset() {
  model.reset(); record.clear(); ticksDone = 0; behind = 0; start(); say('');
  for (const plot of plots) plot.low = plot.high = null;
  if (scene && scene.reset) scene.reset();
  if (model.failed) say(`It can't begin: ${model.reason(0)} Change what led there, and reset.`); else advance(1);
  redraw();
}
function redraw() { drawn = false; }
function draw() {
  drawn = true;
  const t = time();
  $('time').textContent = t.toFixed(data.step < 0.01 ? 2 : 1);
  if (scene) scene.draw();
  for (const plot of plots) if (isSeen(plot.canvas)) plot.draw(record, t, span);
}
function isSeen(e) { const box = e.getBoundingClientRect(); return box.bottom > 0 && box.top < window.innerHeight; }
function save() {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([record.csv()], { type: 'text/csv' }));
  link.download = `${data.name}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

$('play').onclick = () => running ? pause() : play();
$('step').onclick = () => { pause(); advance(1); };
$('reset').onclick = reset;
$('save').onclick = save;
$('speed').onchange = event => { speed = Number(event.target.value); behind = 0; say(''); start(); };
$('span').onchange = event => { span = Number(event.target.value); redraw(); };
document.onkeydown = event => {
  if (event.target.closest('input, select, button, summary') || event.ctrlKey || event.metaKey || event.altKey) return;
  const act = { ' ': () => running ? pause() : play(), ArrowRight: () => { pause(); advance(event.shiftKey ? 100 : 1); }, r: reset }[event.key];
  if (act) { event.preventDefault(); act(); }
};
window.onresize = redraw;
window.onscroll = redraw;
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { readColours(); redraw(); });
document.onvisibilitychange = () => { if (!document.hidden && running) start(); };

readColours();
$('step').title = `one tick of ${short(data.step)} s`;
for (const name of ['speed', 'span']) $(name).value = String(data[name]);
window.page = {  // for scenes, scripts and tests
  data, record, sliders, fit, short, advance, play, pause, reset, redraw, model,
  get colours() { return colours; }, get time() { return time(); }, get running() { return running; }, get behind() { return behind; },
  get ticks() { return ticksDone; },
  now(name) { const i = data.columns.findIndex(c => c.name === name); return record.count ? record.value(record.count - 1, i) : 0; },
  set(name, value) { sliders.has(name) ? sliders.get(name).set(value) : model.set(data.hidden[name], value); },
};
if (window.makeScene) scene = window.makeScene(window.page, $('scene'));
reset();
if (data.autoplay) play();
requestAnimationFrame(frame);
